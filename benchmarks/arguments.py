# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Arguments of several benchmarks."""

from __future__ import annotations

import argparse

from mddag_executor.cli import common, options
from mddag_executor.resources import find
from msg_graph import TaskSet

LIVE_SEED = 2
"""Seed of the execution times of live runs: every deadline of the Autoware workload has slack."""


def add_graph(parser: argparse.ArgumentParser) -> None:
    """Declare `--graph`."""
    parser.add_argument(
        '--graph', metavar='FILE', type=options.Input,
        help="a declaration instead of the shipped one ('-': standard input)")


def load_workload(given: str | None) -> TaskSet:
    """Return the task set of a declaration; None: the paper's workload."""
    return common.load_graph(str(find('config/autoware.yaml')) if given is None else given)


def add_repeat(
    parser: argparse.ArgumentParser, default: int,
    what: str = 'measure everything R times, and report the medians',
) -> None:
    """Declare `--repeat`."""
    parser.add_argument('--repeat', type=options.positive_int, default=default, metavar='R',
                        help=f'{what} (default: %(default)s)')

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `bench`: measurements; each of its own verbs is a module `bench_…`."""

from __future__ import annotations

import argparse

from mddag_executor.cli.options import add_verbs

EXAMPLE = 'mddag bench live --load autoware --executors rad-events,multi --utilisation 0.6'

VERBS = ('live', 'core', 'replay', 'evaluate')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of this verb, with their arguments."""
    add_verbs(parser, 'bench', VERBS)

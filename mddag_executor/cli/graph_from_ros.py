# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph from-ros`: a declaration to fill in, from the nodes that run now."""

from __future__ import annotations

import argparse

from mddag_executor.cli import options
from mddag_executor.cli.text import Progress, warn
from mddag_executor.errors import InputError

EXAMPLE = """\
mddag graph from-ros -o graph.yaml
mddag graph from-ros --timeout 10s -o graph.yaml
"""
DESCRIPTION = """\
Make a declaration from the nodes that run now in this ROS domain: their subscriptions, services
and publishers. The ROS graph shows no timers, callback groups and execution times, and not
which callback publishes what. A node without subscriptions and services is assumed to have one
timer, with the rate of its topics; in other nodes each callback may publish each topic. All of
that is marked 'FILL IN', like deadlines and periods, with a proposal. A recorded run shows more:
see 'mddag graph from-trace'. Services that every node has, such as those for parameters, are left
out."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--timeout', type=_seconds, default=5.0, metavar='TIME',
        help='how long to listen and to measure rates, for instance 10s (default: 5s)')
    options.add(parser, '--output')


def _seconds(text: str) -> float:
    """Return the seconds of a time; a plain number is seconds, too."""
    return options.duration(text if text[-1:].isalpha() else f'{text}s') / 1e9


def main(args: argparse.Namespace) -> int:
    from mddag_executor.cli.systems import write_declaration
    from mddag_executor.hosting.graph_probe import draft_of, probe
    from msg_graph.draft import declaration_of
    with Progress('listening to the nodes', args.timeout) as line:
        found = probe(args.timeout, line.update)
    warn(*found.warnings)
    draft = draft_of(found)
    if not draft.nodes:
        raise InputError(
            'ROS graph', 'no node was found',
            'start the nodes, check ROS_DOMAIN_ID, or give a longer --timeout')
    write_declaration(args.output, declaration_of(draft))
    return 0

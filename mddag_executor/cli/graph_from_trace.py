# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph from-trace`: a declaration to fill in, from a recorded run."""

from __future__ import annotations

import argparse

from mddag_executor.cli import options
from mddag_executor.errors import InputError

EXAMPLE = """\
mddag graph from-trace run.mcap -o graph.yaml
mddag graph from-trace run.mcap --accept -o graph.yaml
mddag graph from-trace ~/.ros/tracing/session-20261121 -o graph.yaml
"""
DESCRIPTION = """\
Make a declaration from a recorded run: a trace of this executor or those of all its processes, an
imported recording of CARET or ros2_tracing, or the folder of such a recording. A trace shows the
nodes, their timers, subscriptions and services, callback groups, what each callback published,
and the quantiles of its execution time (0, 50, 90, 99, 100 %). Facts that it lacks (deadlines,
periods of messages from outside, queue edges) are in comments marked 'FILL IN', with a proposal
from the recorded rates; remove the first '# ' of such a line once its value is right. If the run
was recorded with a declaration, its names, deadlines, queue edges, paths and processes are kept.
Services that every node has, such as those for parameters, are left out, and so are services and
subscriptions from outside that never ran. A comment in the declaration lists these."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('trace', metavar='TRACE', type=options.Input, nargs='+',
                        help="a trace (MCAP; '-': standard input), the traces of all processes of "
                        'a run or their folder, or the folder of a session that LTTng recorded')
    parser.add_argument('--accept', action='store_true',
                        help='accept the proposals: a source gets its measured period, and a sink '
                        'the period of its source as deadline; topics that were not seen to be '
                        'published, and sources without a measured rate, are left out')
    options.add(parser, '--output', '--overwrite')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.cli.systems import recorded_system, write_declaration
    from msg_graph.draft import accept, declaration_of
    system = recorded_system(*args.trace)
    draft = system.draft()
    if args.accept:
        accept(draft)
    if not draft.nodes:
        raise InputError(
            system.name, 'none of its callbacks has a known rate', 'record for a longer time')
    write_declaration(args.output, declaration_of(draft, args.accept))
    return 0

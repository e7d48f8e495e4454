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
Make a declaration from a recorded run: a trace of this executor, a CARET or ros2_tracing recording
that was imported, or the folder of one. A trace shows the nodes, their timers, subscriptions and
services, callback groups, what each callback published, and the quantiles of its execution time
(0, 50, 90, 99, 100 %). Facts that it lacks (deadlines, periods of messages from outside, queue
edges) are in comments marked 'FILL IN', with a proposal from the recorded rates; remove the
first '# ' of such a line once its value is right. If the run was recorded with a declaration, its
names, deadlines, queue edges and paths are kept. Services that every node has, such as those for
parameters, are left out, and so are services and subscriptions from outside that never ran; the
declaration names the latter."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('trace', metavar='TRACE', type=options.Input,
                        help="a trace (MCAP; '-': standard input), or the folder of a session "
                        'that LTTng recorded (needs python3-bt2)')
    parser.add_argument('--accept', action='store_true',
                        help='accept the proposals: the period of a source is the measured one, '
                        'a deadline is the period of the source that leads to the sink; what was '
                        'not seen to be published is not, and a source without a measured rate '
                        'is left out')
    options.add(parser, '--output', '--overwrite')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.cli.systems import recorded_system, write_declaration
    from msg_graph import loads
    from msg_graph.draft import accept, declaration_of
    draft = recorded_system(args.trace).draft()
    if args.accept:
        accept(draft)
    if not draft.nodes:
        raise InputError(
            args.trace, 'none of its callbacks has a known rate', 'record for a longer time')
    text = declaration_of(draft, args.accept)
    write_declaration(args.output, text)
    if args.accept:     # what blanks do not hide, such as a cycle, is an error of the declaration
        loads(text, '<stdout>' if args.output == '-' else args.output)
    return 0

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph from-trace`: a declaration to fill in, from a recorded run."""

from __future__ import annotations

import argparse

from mddag_executor.cli import options

HELP = 'make a declaration to fill in from a recorded run'
EXAMPLE = """\
mddag graph from-trace run.mcap -o graph.yaml
mddag graph from-trace ~/.ros/tracing/session-20261121 -o graph.yaml
"""
DESCRIPTION = """\
Make a declaration from a recorded run: a trace of this executor, a CARET or ros2_tracing recording
that was imported, or the folder of one. A trace shows the nodes, their timers, subscriptions and
services, callback groups, what each callback published, and the quantiles of its execution time
(0, 50, 90, 99, 100 %). What it cannot show (deadlines, periods of what comes from outside, queue
edges) stands in comments marked 'FILL IN', with a proposal from the recorded rates; remove the
first '# ' of such a line once its value is right. If the run was recorded with a declaration, its
names, deadlines and queue edges are kept. Services that every node has, such as those for
parameters, are left out."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('trace', metavar='TRACE', type=options.Input,
                        help="a trace (MCAP; '-': standard input), or the folder of a session "
                        'that LTTng recorded (needs python3-bt2)')
    options.add(parser, '--output')


def main(args: argparse.Namespace) -> int:
    """Write the declaration."""
    from mddag_executor.cli.systems import recorded_system, write_declaration
    from msg_graph.draft import declaration_of
    write_declaration(args.output, declaration_of(recorded_system(args.trace).draft()))
    return 0

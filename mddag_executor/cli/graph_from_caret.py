# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph from-caret`: a declaration to fill in, from a CARET architecture file."""

from __future__ import annotations

import argparse

from mddag_executor.cli import common, options
from mddag_executor.cli.text import warn

EXAMPLE = """\
mddag graph from-caret architecture.yaml -o graph.yaml
mddag graph from-caret architecture.yaml ~/.ros/tracing/session-20261121 -o graph.yaml
mddag graph check graph.yaml
"""
DESCRIPTION = """\
Make a declaration from a CARET architecture file: nodes, callbacks, timers, topics, callback
groups, variable passings, message contexts and named paths. Facts that such a file lacks
(deadlines, rates from outside, which callback publishes) are in comments marked 'FILL IN', with a
proposal; remove the first '# ' of such a line once its value is right. A recording of the same
system (TRACE) proposes the rates of sources, and fills in the quantiles of the measured execution
times (0, 50, 90, 99, 100 %) and the publishers of each topic."""

REMOVED_OPTIONS = {'--trace': 'name the recording after ARCHITECTURE.yaml'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('architecture', metavar='ARCHITECTURE.yaml', type=options.Input,
                        help="the architecture file ('-': standard input)")
    parser.add_argument('trace', metavar='TRACE', type=options.Input, nargs='?',
                        help='measure rates and execution times in this recording: a trace '
                        "(MCAP; '-': standard input), or the folder of a session that LTTng "
                        'recorded')
    options.add(parser, '--output', '--overwrite')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.cli.systems import recorded_system, write_declaration
    from msg_graph.caret import read_architecture
    from msg_graph.draft import declaration_of
    name, text = common.read_text(args.architecture)
    draft = read_architecture(text, name)
    if args.trace is not None:
        system = recorded_system(args.trace)
        every, count = len(list(draft.callbacks())), system.measure(draft)
        if count < every:
            warn(f'{system.name}: {every - count} of the {every} callbacks of {name} did not run')
    write_declaration(args.output, declaration_of(draft))
    return 0

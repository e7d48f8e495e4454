# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The verb `graph from-caret`: a declaration to fill in, from a CARET architecture file."""

from __future__ import annotations

import argparse

from mddag_executor.cli import common

HELP = 'make a declaration to fill in from a CARET architecture file'
EXAMPLE = """\
mddag graph from-caret architecture.yaml -o graph.yaml
mddag graph check graph.yaml
"""
DESCRIPTION = """\
Make a declaration from a CARET architecture file: nodes, callbacks, timers, topics, callback
groups, variable passings, message contexts and named paths. What such a file cannot know
(deadlines, rates from outside, which callback publishes, where to cut a cycle) stands in comments
marked 'FILL IN', with a proposal; take the first '# ' of such a line away once its value is
right."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('architecture', metavar='ARCHITECTURE.yaml',
                        help="the architecture file ('-': standard input)")
    parser.add_argument('-o', '--output', metavar='GRAPH', default='-',
                        help="the declaration ('-': standard output, the default)")


def main(args: argparse.Namespace) -> int:
    """
    Write the declaration.

    :raises msg_graph.GraphError: when the file is no architecture file
    """
    from msg_graph.from_caret import declaration_from_caret, MARK
    common.check_output(args.output)
    name, text = common.read_text(args.architecture)
    result = declaration_from_caret(text, name)
    common.write_text(args.output, result)
    if args.output != '-':
        count = sum(MARK in line for line in result.splitlines()[2:])
        print(f"{count} blanks to fill in, marked '{MARK}'")
    return 0

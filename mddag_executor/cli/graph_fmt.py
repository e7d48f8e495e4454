# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph fmt`: declarations in normal form."""

from __future__ import annotations

import argparse
import sys

from mddag_executor.cli import common, options
from mddag_executor.cli.text import one_line

HELP = 'format a declaration; comments and order stay'
EXAMPLE = """\
mddag graph fmt graph.yaml
mddag graph fmt --check graph.yaml
"""
DESCRIPTION = """\
Format a declaration: two spaces of indentation for each level, and long lists in brackets broken
near column 90. Comments, quotes, order and meaning stay. The file is replaced as a whole;
'-' reads standard input and writes standard output."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    options.add(parser, 'graph')
    parser.add_argument(
        '--check', action='store_true',
        help='change nothing; exit with 1 if the declaration is not in its normal form')


def main(args: argparse.Namespace) -> int:
    """
    Lay out.

    :returns: 1 with `--check` if there is something to change
    """
    from msg_graph.layout import format_text
    name, text = common.read_text(args.graph)
    result = format_text(text, name)
    if args.check:
        if result != text:
            print(one_line(f"{name}: not in normal form: run 'mddag graph fmt' on it"),
                  file=sys.stderr)
        return int(result != text)
    if args.graph == '-' or result != text:
        common.check_output(args.graph)
        common.write_text(args.graph, result)
    return 0

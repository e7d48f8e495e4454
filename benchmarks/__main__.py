# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import sys

from benchmarks import core, evaluate, live, overload, replay
from mddag_executor.cli.common import check_files
from mddag_executor.cli.main import main
from mddag_executor.cli.parsing import Parser

BENCHMARKS = {'live': live, 'core': core, 'replay': replay, 'evaluate': evaluate,
              'overload': overload}


def run(argv: Sequence[str]) -> int:
    """Parse a command line and run the named benchmark; return the exit status."""
    parser = Parser(
        prog='python -m benchmarks', allow_abbrev=False,
        description='Measure the executor, the core, the replayer and the batch evaluation.')
    parsers = parser.add_subparsers(metavar='BENCHMARK', required=True, title='benchmarks')
    for name, module in BENCHMARKS.items():
        each = parsers.add_parser(
            name, help=module.HELP, allow_abbrev=False, description=module.DESCRIPTION,
            epilog='\n  '.join(('example:', *module.EXAMPLE.strip().splitlines())),
            formatter_class=argparse.RawDescriptionHelpFormatter)
        module.add_arguments(each)
        each.set_defaults(main=module.main)
    args = parser.parse_args(argv)
    check_files(args)
    return int(args.main(args))


if __name__ == '__main__':
    sys.exit(main(run=run))

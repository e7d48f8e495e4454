# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `bench rerun`: how fast nodes run again in virtual time.

The nodes are made from a declaration and do as little as they can, so this is what a rerun adds to
the callbacks' own computing.  The machine decides about the figures, and whatever else it does.
"""

from __future__ import annotations

import argparse

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress
from mddag_executor.text import counted

HELP = 'measure nodes that run again in virtual time'
DESCRIPTION = (
    'Run real nodes that do as little as they can in virtual time, and say how much faster than '
    'real time that is.')
EXAMPLE = """\
mddag bench rerun
mddag bench rerun --duration 20s --repeat 5 --json rerun.json"""

_DURATION_NS = 30_000_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    options.add_workload(parser)
    options.add_workers(parser)
    parser.add_argument(
        '--duration', type=options.duration, default=_DURATION_NS, metavar='TIME',
        help=f'virtual time of each run (default: {_DURATION_NS // 10 ** 9}s)')
    options.add_seed(parser, 'of the execution times')
    options.add_repeat(parser, 3)
    options.add_json(parser)


def main(args: argparse.Namespace) -> int:
    """Measure and print."""
    from mddag_executor.rerun.measure import measure
    common.check_output(args.json)
    task_set = common.load_workload(args.graph)
    with Progress('measuring'):
        result = measure(
            task_set, defaults.workers(args.workers, task_set), args.duration, args.seed,
            args.repeat)
    if common.write_result(args, result):
        same = 'the same outputs each time' if result['same'] else 'NOT the same outputs each time'
        print(f'{counted(result["callbacks"], "callback")} and '
              f'{counted(result["messages"], "message")}, {result["virtual_s"]:.3f} s in '
              f'{result["elapsed_s"]:.3f} s: {result["times_real_time"]:.1f} times as fast as '
              f'real time; {result["started_s"]:.3f} s of it to make the nodes, then '
              f'{result["us_per_callback"]:.0f} us a callback; {same}')
    return 0

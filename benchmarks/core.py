# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmark `core`: CPU time of the scheduler core in plain Python, under each policy.

The core adds this to each callback in a live run; it is also that of simulation without llvmlite.
Figures depend on the machine and its other load: all are medians.
"""

from __future__ import annotations

import argparse
from typing import Any

from benchmarks import arguments
from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress, table
from mddag_executor.errors import UsageError
from mddag_executor.simulate import ALL_POLICIES

HELP = 'measure the scheduler core'
DESCRIPTION = 'Measure the core in plain Python: CPU time for each event and each job of a vertex.'
EXAMPLE = """\
python -m benchmarks core
python -m benchmarks core --policies rad,ros2 --repeat 9 --json core.json"""

_LONGEST_NS = 60_000_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    arguments.add_graph(parser)
    options.add(parser, '--workers', '--duration', '--seed', '--json')
    parser.add_argument(
        '--policies', default=','.join(ALL_POLICIES), metavar='P,P…', help='(default: all)')
    arguments.add_repeat(parser, 5)


def main(args: argparse.Namespace) -> int:
    """Measure and print."""
    policies = options.policies(args.policies)
    if args.duration > _LONGEST_NS:
        raise UsageError('--duration: that is too long: give at most 60s')
    from benchmarks.virtual_time import time_core
    task_set = arguments.load_workload(args.graph)
    workers = defaults.workers(args.workers, task_set)
    rows: list[dict[str, Any]] = []
    with Progress('measuring', len(policies)) as line:
        for name in policies:
            line.update(len(rows), name)
            rows.append(time_core(
                task_set, name, workers=workers, duration_ns=args.duration, seed=args.seed,
                repeat=args.repeat))
    common.show(args, {
        'graph': task_set.file, 'workers': workers, 'duration_ns': args.duration,
        'seed': args.seed, 'core': rows}, [table(
            ('policy', 'preemptive', 'events', 'vertex jobs', 'us an event', 'us a vertex job',
             'us a vertex job, live calls'),
            [(row['policy'], 'yes' if row['preemptive'] else 'no', row['events'],
              row['vertex_jobs'], *(None if row[us] is None else f'{row[us]:.2f}' for us in (
                  'us_per_event', 'us_per_vertex_job', 'live_us_per_vertex_job')))
             for row in rows])])
    return 0

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

"""
The verb `bench core`: CPU time of the scheduler core in plain Python, under each policy.

This is what the core adds to each callback in a live run, and what simulation takes without numba.
The machine decides about the figures, and whatever else it does: all are medians.
"""

from __future__ import annotations

import argparse
from typing import Any

from mddag_executor.cli import common
from mddag_executor.cli.text import Progress, table
from mddag_executor.core import POLICIES
from mddag_executor.core import policy as find_policy
from mddag_executor.errors import UsageError
from mddag_executor.resources import find

HELP = 'measure the core in plain Python: CPU time for each event and each job of a vertex'
EXAMPLE = """\
mddag bench core
mddag bench core --policies rad,ros2 --repeat 9 --json core.json"""

_LONGEST_NS = 60_000_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('--graph', metavar='FILE',
        help="a declaration to take instead of the paper's workload ('-': standard input)")
    add('--policies', default=','.join(POLICIES), metavar='P,P…', help='(default: all)')
    add('--workers', type=common.positive_int, metavar='M',
        help="of the simulated runs (default: the declaration's, else 7)")
    add('--duration', type=common.duration, default=3_000_000_000, metavar='TIME',
        help='virtual time of each run (default: 3s)')
    add('--seed', type=common.seed, default=0, metavar='N',
        help='of the execution times (default: %(default)s)')
    add('--repeat', type=common.positive_int, default=5, metavar='R',
        help='measure everything R times, and take the medians (default: %(default)s)')
    common.add_json(parser)


def main(args: argparse.Namespace) -> int:
    """
    Measure and print.

    :raises msg_graph.GraphError: when the declaration is wrong
    :raises mddag_executor.errors.MddagError: when anything else can not be used
    """
    common.check_output(args.json)
    policies = [name.strip() for name in args.policies.split(',')]
    for i, name in enumerate(policies):
        find_policy(name)
        if name in policies[:i]:
            raise UsageError(f"--policies: '{name}' stands there twice: name each once")
    if args.duration > _LONGEST_NS:
        raise UsageError('--duration: that is too long: give at most 60s')
    result = _measure(args, policies)
    if args.json is not None:
        common.write_json(args.json, result)
    if common.wants_tables(args):
        _show(result)
    return 0


def _measure(args: argparse.Namespace, policies: list[str]) -> dict[str, Any]:
    from mddag_executor.simulate.measure_core import time_core
    task_set = common.load_graph(args.graph or str(find('config/autoware.yaml')))
    workers = args.workers or task_set.workers or 7
    rows: list[dict[str, Any]] = []
    with Progress('measuring', len(policies)) as line:
        for name in policies:
            line.update(len(rows), name)
            rows.append(time_core(
                task_set, name, workers=workers, duration_ns=args.duration, seed=args.seed,
                repeat=args.repeat))
    return {'graph': task_set.file, 'workers': workers, 'duration_ns': args.duration,
            'seed': args.seed, 'core': rows}


def _show(result: dict[str, Any]) -> None:
    print(table(
        ('policy', 'preemptive', 'events', 'vertex jobs', 'us an event', 'us a vertex job',
         'us a vertex job, live calls'),
        [(row['policy'], 'yes' if row['preemptive'] else 'no', row['events'], row['vertex_jobs'],
          _us(row['us_per_event']), _us(row['us_per_vertex_job']),
          _us(row['live_us_per_vertex_job'])) for row in result['core']]))


def _us(value: float | None) -> str | None:
    return None if value is None else f'{value:.2f}'

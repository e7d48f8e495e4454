# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmark `evaluate`: time of a run, and of a job of a vertex in task sets of any size.

Figures depend on the machine and its other load: all are medians.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

from benchmarks import arguments
from benchmarks.readers import peak_memory_mb
from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress, table
from mddag_executor.errors import UsageError

HELP = 'measure the batch evaluation'
DESCRIPTION = """\
Measure the batch evaluation: time for each run and policy, and for each vertex job."""
EXAMPLE = """\
python -m benchmarks evaluate
python -m benchmarks evaluate --runs 5000 --jobs 1,2,4 --repeat 5 --json evaluate.json"""

SIZES = (10, 100, 1000, 10_000)
CORES = ('compiled', 'plain')
# Plain Python takes about 30 times as long; fewer runs are enough.
_PLAIN_SHARE = 50
_VERTEX_JOBS = {'compiled': 200_000, 'plain': 20_000}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    arguments.add_graph(parser)
    options.add(parser, '--json')
    add('--runs', type=options.positive_int, default=2000, metavar='N',
        help=f'for each measurement; one in {_PLAIN_SHARE} in plain Python (default: %(default)s)')
    add('--policies', default='rad,rm,wc', metavar='P,P…', help='(default: %(default)s)')
    add('--jobs', type=options.list_of(options.positive_int), metavar='N,N…',
        help='runs to simulate at a time (default: 1 and the number of processors)')
    add('--vertices', type=options.list_of(options.positive_int), default=SIZES, metavar='N,N…',
        help='sizes of the random task sets (default: 10,100,1000,10000)')
    arguments.add_repeat(parser, 3)


def main(args: argparse.Namespace) -> int:
    """Measure and print."""
    from benchmarks.virtual_time import time_runs, time_vertex_jobs
    from mddag_executor.laboratory.experiment import Experiment
    from mddag_executor.simulate.compiled import available
    policies = options.policies(args.policies)
    if max(args.vertices) > 100_000:
        raise UsageError('--vertices: that is too many: give at most 100000')
    cores = CORES if available() else CORES[1:]
    task_set = arguments.load_workload(args.graph)
    experiment = Experiment(task_set, policies, workers=defaults.workers(None, task_set))
    jobs = args.jobs or sorted({1, defaults.processors()})
    runs: list[dict[str, Any]] = []
    sizes: list[dict[str, Any]] = []
    steps = len(cores) * (len(jobs) + len(args.vertices))
    with Progress('measuring', steps) as line:
        for core in cores:
            count = args.runs if core == 'compiled' else max(1, args.runs // _PLAIN_SHARE)
            for number in jobs:
                line.update(len(runs) + len(sizes), f'{core} core, {number} at a time')
                runs.append(time_runs(
                    experiment, count, core=core, jobs=number, repeat=args.repeat))
        peak = peak_memory_mb()
        for size in args.vertices:
            for core in cores:
                line.update(len(runs) + len(sizes), f'{core} core, {size} vertices')
                sizes.append(time_vertex_jobs(
                    size, core=core, vertex_jobs=_VERTEX_JOBS[core], repeat=args.repeat))
    common.show(args, {
        'graph': task_set.file, 'runs': runs, 'vertex_jobs': sizes, 'peak_memory_mb': peak,
    }, _lines(runs, sizes, peak, cores))
    return 0


def _lines(
    runs: list[dict[str, Any]], sizes: list[dict[str, Any]], peak: float, cores: Sequence[str]
) -> Iterator[str]:
    yield table(
        ('core', 'at a time', 'runs', 'ms a run and policy', 'runs a second'),
        [(row['core'], row['jobs'], row['runs'], f'{row["ms"]:.3f}', round(row['runs_per_s']))
         for row in runs])
    found = {(row['vertices'], row['core']): row['ns'] for row in sizes}
    yield table(
        ('vertices', *(f'ns a vertex job, {core}' for core in cores)),
        [(size, *(round(found[size, core]) for core in cores))
         for size in dict.fromkeys(row['vertices'] for row in sizes)])
    yield f'peak memory of the runs: {peak:.0f} MB'

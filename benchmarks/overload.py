# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmark `overload`: the share of results in time at loads around and above the capacity.

Each declaration is simulated with execution times that are drawn and scaled to the load.  The
capacity is that of the workers or, with `--interpreter`, of one interpreter that all callbacks
hold.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from benchmarks import arguments
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress, table
from mddag_executor.core.tally import total
from mddag_executor.laboratory.generate import generate
from mddag_executor.laboratory.generate_options import Options
from mddag_executor.simulate import (
    draw_execution_times,
    periodic_load,
    scale_execution_times,
    Settings,
    simulate,
)
from msg_graph import ExecutionTime, loads, TaskSet

HELP = 'measure the share of results in time in an overload'
DESCRIPTION = 'Measure the share of results in time around and above the capacity, simulated.'
EXAMPLE = """\
python -m benchmarks overload --graph config/autoware.yaml
python -m benchmarks overload --sets 1000 --interpreter --preemptive"""

WAYS = (('rad', 'continue'), ('rad', 'demote'), ('rad', 'abort'), ('fifo', 'continue'))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    arguments.add_graph(parser)
    options.add(parser, '--duration', '--preemptive', '--json')
    add('--sets', type=options.positive_int, metavar='N',
        help='random sets instead of a declaration')
    add('--workers', type=options.positive_int, default=7, metavar='W', help='(default: 7)')
    add('--interpreter', action='store_true', help='every callback holds the one interpreter')
    add('--loads', default='0.9,1,1.1,1.2,1.5,2', metavar='U,U…',
        help='multiples of the capacity (default: 0.9 to 2)')
    options.add_seed(parser, 'seed of the sets and execution times')


def main(args: argparse.Namespace) -> int:
    """Measure and print."""
    factors = [float(each) for each in args.loads.split(',')]
    sets = [arguments.load_workload(args.graph)] if args.sets is None else list(_random(args))
    rows: list[dict[str, Any]] = []
    with Progress('simulating', len(factors) * len(sets)) as line:
        for load in factors:
            shares: dict[str, list[float]] = {}
            for number, task_set in enumerate(sets):
                line.update(len(rows) * len(sets) + number)
                for name, share in _shares(args, task_set, load, args.seed + number):
                    shares.setdefault(name, []).append(share)
            rows.append({'load': load, **{
                name: sum(each) / len(each) for name, each in shares.items()}})
    names = [name for name in rows[0] if name != 'load']
    common.show(args, {'workers': args.workers, 'interpreter': args.interpreter,
                       'preemptive': bool(args.preemptive), 'overload': rows}, [table(
        ('load', *names),
        [(f'{row["load"]:g}', *(f'{row[name]:.1%}' for name in names)) for row in rows])])
    return 0


def _random(args: argparse.Namespace) -> Iterator[TaskSet]:
    for number in range(args.sets):
        yield loads(generate(Options(seed=args.seed), number), f'set {number}')


def _with_means(task_set: TaskSet, times: Sequence[Sequence[int]]) -> TaskSet:
    """Return a task set that declares the execution times of a run."""
    return replace(task_set, dags=tuple(
        replace(dag, vertices=tuple(
            replace(vertex, callback=replace(
                vertex.callback, execution_time=ExecutionTime((time,), (50.0,))))
            for vertex, time in zip(dag.vertices, of_dag)))
        for dag, of_dag in zip(task_set.dags, times)))


def _shares(
    args: argparse.Namespace, task_set: TaskSet, load: float, seed: int
) -> Iterator[tuple[str, float]]:
    """Yield the share of results in time, by policy and handling of late jobs."""
    capacity = 1 if args.interpreter else args.workers
    times = scale_execution_times(task_set, draw_execution_times(task_set, seed), capacity, load)
    known = _with_means(task_set, times)
    arrivals = periodic_load(known, times, args.duration)
    if args.interpreter:
        arrivals = arrivals._replace(holds=[1] * len(arrivals.costs))
    for policy, on_late in WAYS:
        settings = Settings(
            policy=policy, workers=args.workers, duration_ns=args.duration,
            preemptive=bool(args.preemptive) and policy != 'fifo', on_late=on_late)
        verdicts = total(simulate(known, arrivals, settings).result()['dags'])
        yield (policy if on_late == 'continue' and policy == 'fifo' else on_late,
               verdicts.in_time / max(1, verdicts.due))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The benchmark `overload`: the share of results in time at loads around and above the capacity.

Each declaration is simulated with execution times that are drawn and scaled to the load.  The
capacity is that of the workers or of one interpreter, which all callbacks hold.  `important`: the
share of the sinks of a third of the DAGs, which have a high importance (`demote`); `alone`: their
share if the other DAGs are never released, which no scheduling of the others can exceed by much.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterator
import random
from typing import Any, BinaryIO, NamedTuple

from benchmarks import arguments
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress, table
from mddag_executor.core import Tables
from mddag_executor.core.state import SINK_DROPPED, SINK_IN_TIME
from mddag_executor.core.tables import IMPORTANT, ON_LATE
from mddag_executor.laboratory.generate import generate, Options
from mddag_executor.simulate import (
    draw_execution_times,
    periodic_workload,
    scale_execution_times,
    Settings,
    Workload,
)
from mddag_executor.simulate.execution_times import with_execution_times
from mddag_executor.simulate.schedule import prepare, schedule
from msg_graph import loads, TaskSet
import numpy as np

HELP = 'measure the share of results in time in an overload'
DESCRIPTION = 'Measure the share of results in time around and above the capacity, simulated.'
EXAMPLE = """\
python -m benchmarks overload --graph config/autoware.yaml --duration 3s
python -m benchmarks overload --sets 1000 --plot overload.svg"""

WAYS = ('continue', 'demote', 'fifo', 'important', 'alone')
LOADS = (0.9, 1.0, 1.1, 1.2, 1.5, 2.0)


class Mode(NamedTuple):
    """What limits a run, and whether urgent executions preempt."""

    interpreter: bool
    preemptive: bool

    @property
    def title(self) -> str:
        """Return its name."""
        return (('interpreter' if self.interpreter else 'workers')
                + (', preemptive' if self.preemptive else ''))


MODES = [Mode(interpreter, preemptive) for interpreter in (False, True)
         for preemptive in (False, True)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    arguments.add_graph(parser)
    options.add(parser, '--duration', '--json')
    add('--sets', type=options.positive_int, metavar='N',
        help='random sets instead of a declaration')
    add('--workers', type=options.positive_int, default=7, metavar='W', help='(default: 7)')
    add('--plot', metavar='OUT.svg', help='draw a figure')
    options.add(parser, '--seed', help='seed of the sets and execution times')


def main(args: argparse.Namespace) -> int:
    """Measure and print."""
    sets = [arguments.load_workload(args.graph)] if args.sets is None else list(_random(args))
    rows: list[dict[str, Any]] = []
    steps = [(mode, load) for mode in MODES for load in LOADS]
    with Progress('simulating', len(steps) * len(sets)) as line:
        for step, (mode, load) in enumerate(steps):
            shares: dict[str, list[float]] = {way: [] for way in WAYS}
            for number, task_set in enumerate(sets):
                line.update(step * len(sets) + number)
                _Case(args, task_set, mode, load, args.seed + number).add_to(shares)
            rows.append({'mode': mode.title, 'load': load, **{
                way: sum(each) / len(each) for way, each in shares.items()}})
    if args.plot is not None:
        with open(args.plot, 'wb') as file:
            draw(rows, file)
    common.show(args, {'workers': args.workers, 'sets': len(sets), 'overload': rows}, [table(
        ('capacity', 'load', *WAYS),
        [(row['mode'], f'{row["load"]:g}', *(f'{row[way]:.1%}' for way in WAYS))
         for row in rows])])
    return 0


def _random(args: argparse.Namespace) -> Iterator[TaskSet]:
    for number in range(args.sets):
        yield loads(generate(Options(seed=args.seed), number), f'set {number}')


class _Case:
    """A task set with the execution times of a load."""

    def __init__(
        self, args: argparse.Namespace, task_set: TaskSet, mode: Mode, load: float, seed: int
    ) -> None:
        self._args, self._mode = args, mode
        times = scale_execution_times(
            task_set, draw_execution_times(task_set, seed),
            1 if mode.interpreter else args.workers, load)
        n_dags = len(task_set.dags)
        self._important = {*random.Random(seed).sample(range(n_dags), -(-n_dags // 3))}
        self._tables = Tables.build(with_execution_times(task_set, times))
        load_ = periodic_workload(task_set, times, args.duration)
        if mode.interpreter:
            load_ = load_._replace(holds=[1] * len(load_.costs))
        self._load = load_

    def add_to(self, shares: dict[str, list[float]]) -> None:
        """Add the share of results in time of each way."""
        tables, load = self._tables, self._load
        every = range(tables.n_dags)
        for on_late in ('continue', 'demote'):
            shares[on_late].append(self._share('rad', on_late, tables, load, every))
        shares['fifo'].append(self._share('fifo', 'continue', tables, load, every))
        marked = tables._replace(importance=[
            IMPORTANT if dag in self._important else importance
            for dag, importance in zip(tables.dag_of, tables.importance)])
        shares['important'].append(
            self._share('rad', 'demote', marked, load, self._important))
        mine = [i for i, dag in enumerate(load.dags) if dag in self._important]
        alone = load._replace(**{
            name: [getattr(load, name)[i] for i in mine] for name in ('times', 'dags', 'jobs')})
        shares['alone'].append(self._share('rad', 'demote', tables, alone, self._important))

    def _share(
        self, policy: str, on_late: str, tables: Tables, load: Workload, dags: Collection[int]
    ) -> float:
        """Return the share of the results of some DAGs that are in time."""
        settings = Settings(
            policy=policy, pools=(self._args.workers,), duration_ns=self._args.duration,
            preemptive=self._mode.preemptive and policy != 'fifo')
        tables = tables._replace(on_late=[ON_LATE[on_late]] * len(tables.on_late))
        compiled = prepare(tables, load, settings, 24 * len(WAYS) * (self._args.sets or 1))
        decisions = np.array(schedule(tables, load, settings, compiled=compiled).decisions)
        kinds, of = decisions.reshape(-1, 6)[:, :2].T
        kinds = kinds[np.isin(of, [*dags]) & (kinds <= SINK_DROPPED)]  # the verdicts
        return np.count_nonzero(kinds == SINK_IN_TIME) / max(1, len(kinds))


def draw(rows: list[dict[str, Any]], file: BinaryIO) -> None:
    """Draw the shares by load, a panel for each mode, as SVG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    styles = dict(zip(WAYS, (
        '#D55E00-', '#0072B2-', '#000000:', '#CC79A7-', '#CC79A7:')))
    with rc_context({'svg.hashsalt': 'mddag', 'svg.fonttype': 'none', 'font.size': 9.0}):
        figure = Figure(figsize=(8.0, 5.0), layout='constrained')
        for axes, mode in zip(figure.subplots(2, 2, sharex=True, sharey=True).flat, MODES):
            mine = [row for row in rows if row['mode'] == mode.title]
            for way, style in styles.items():
                axes.plot([row['load'] for row in mine], [100 * row[way] for row in mine],
                          color=style[:7], linestyle=style[7:], label=way)
            axes.set_title(mode.title, fontsize=9)
            axes.grid(color='0.9')
            axes.set_ylim(-3, 103)
        figure.supxlabel('load, as a multiple of the capacity')
        figure.supylabel('results in time, %')
        figure.axes[0].legend(frameon=False, fontsize=8)
        figure.savefig(file, format='svg', metadata={'Date': None})

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Necessary tests: if one fails, no scheduler can keep the deadlines.

Theory of operation
-------------------
1. *Longest path*: the vertices of a path run one after the other, so a sink is not done before the
   length of the longest path to it, on however many workers.
2. *Utilisation*: more work than the workers can do piles up.
3. *Demand bound*: with all first releases together and all later ones as early as they may come,
   what has to be done in [0, t] is no more than m t. This amount is refined for each sink:
   a vertex counts by when it has to be done so that each sink after it can still be in time
   (``Task.latest``), not by the deadline of the whole DAG. (Baruah, Mok and Rosier, RTSS 1990, for
   one processor and sequential tasks.)  If U < m only a bounded number of t can fail; of those
   at most ``MOST_POINTS`` are checked, the smallest.

All three assume that executions take their budgets; the utilisation also assumes that releases
come as often as declared, and the demand bound that all DAGs may be released at the same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heapreplace
from typing import Any, NamedTuple

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.tasks import Task, tasks_of
from mddag_executor.text import counted
from msg_graph import format_duration, TaskSet

MOST_POINTS = 300_000


@dataclass(frozen=True)
class Verdict:
    """
    The outcome of one test.

    :ivar holds: False if no scheduler can keep the deadlines.
    :ivar figure: what was compared, in words.
    :ivar reason: why the test holds or fails, in words.
    :ivar details: figures of single sinks or DAGs, in ns.
    """

    test: str
    holds: bool
    figure: str
    reason: str
    details: dict[str, Any]


def necessary_tests(task_set: TaskSet, workers: int, budget: str = 'mean') -> list[Verdict]:
    """
    Return the verdicts of the three tests.

    :param budget: what of each execution time counts: one of ``defaults.BUDGETS``.
    :raises UsageError: if an execution time is not declared, or there is no worker.
    """
    if workers < 1:
        raise UsageError(f'workers: {workers} is too few: give at least 1')
    tasks = [task for task in tasks_of(task_set, budget) if not task.dag.once]
    return [_longest_path(tasks), _utilisation(tasks, workers), _demand(tasks, workers)]


def _longest_path(tasks: Sequence[Task]) -> Verdict:
    sinks = [(task.dag.vertices[sink].name, deadline, length)
             for task in tasks for sink, deadline, length in task.sinks]
    if not sinks:
        return Verdict('longest path', True, 'no deadline', 'no sink has a deadline', {})
    late = sum(length > deadline for _, deadline, length in sinks)
    worst, deadline, length = max(sinks, key=lambda sink: sink[2] / sink[1])
    return Verdict(
        'longest path', not late,
        f'{format_duration(length)} of {format_duration(deadline)} at {worst}',
        f'too long for {late} of {counted(len(sinks), "sink")}' if late
        else 'each longest path is within its deadline',
        {name: {'deadline_ns': deadline, 'longest_path_ns': length}
         for name, deadline, length in sinks})


def _utilisation(tasks: Sequence[Task], workers: int) -> Verdict:
    total = sum(task.utilisation for task in tasks)
    fits = total <= workers * (1 + 1e-12)
    return Verdict(
        'utilisation', fits, f'{total / workers:.3f} of {counted(workers, "worker")}',
        'at most 1' if fits else 'above 1: the backlog grows without end',
        {task.dag.name: task.utilisation for task in tasks})


def _demand(tasks: Sequence[Task], workers: int) -> Verdict:
    demand = largest_demand(tasks, workers)
    fits = demand.work <= workers * demand.time
    reason = 'no interval asks for more work than there is time'
    if not fits:
        reason = 'if all first releases come together, more work is due than there is time'
    elif not demand.complete:
        reason += f', in the {counted(demand.points, "instant")} that were checked'
    figure = (f'{format_duration(demand.work)} due within {format_duration(demand.time)}, '
              f'of {format_duration(workers * demand.time)}')
    if demand.time == 1:
        figure = f'{format_duration(demand.work)} due before it can have been done'
    return Verdict('demand bound', fits, figure, reason,
                   {'time_ns': demand.time, 'work_ns': demand.work})


class Demand(NamedTuple):
    """The largest demand found: at ``time`` ns that much work, ns; ``points`` were checked."""

    time: int
    work: int
    points: int
    complete: bool


def largest_demand(tasks: Sequence[Task], workers: int) -> Demand:
    """Return the point with the largest demand by time, or the first with too large a demand."""
    heap = [(max(1, latest), cost, task.period)
            for task in tasks for latest, cost in zip(task.latest, task.costs) if cost]
    if not heap:
        return Demand(1, 0, 0, True)
    heapify(heap)
    spare = workers - sum(task.utilisation for task in tasks)
    slack = sum(cost * max(0.0, 1 - latest / task.period)
                for task in tasks for latest, cost in zip(task.latest, task.costs))
    until = slack / spare if spare > 1e-9 else float('inf')
    work, best = 0, (heap[0][0], 0)
    for points in range(MOST_POINTS):
        time, cost, period = heap[0]
        if points and time > until:
            return Demand(*best, points, True)
        work += cost
        if work * best[0] > best[1] * time:
            best = (time, work)
        if work > workers * time:
            return Demand(time, work, points + 1, True)
        heapreplace(heap, (time + period, cost, period))
    return Demand(*best, MOST_POINTS, False)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Sufficient tests: where one holds, its scheduler keeps all deadlines.

Theory of operation
-------------------
m workers; len and vol are the longest path and the sum of the budgets; a release of task i comes
at least T_i after the one before. Work is never idle: a worker is free only if nothing is ready.
None of these tests looks at overheads.

1. *Graham* (Bounds on multiprocessing timing anomalies, SIAM J. Appl. Math. 1969). Walk back
   from sink v: whenever no vertex of that chain runs, all workers are busy with other vertices. So
   v is done by len_v + (vol - len_v) / m, if nothing else runs: no other DAG and no other job.
2. *Response time under any work-conserving policy*, after Melani, Bertogna, Bonifaci, Marchetti-
   Spaccamela and Buttazzo (ECRTS 2015). The same walk, with what other jobs can do in a window of
   length x from the release on: v is done by x if len_v + (vol - len_v + W(x)) / m <= x. Let the
   first miss be that of v; then every job released D_i (its latest deadline) before the window or
   earlier is done. Of task i the most fits in if one job ends as late as it may and the others
   follow densely: with y = x + D_i - vol_i / m, W_i(x) = floor(y / T_i) vol_i
   + min(vol_i, m (y mod T_i)), and never more than m x. (vol_i <= m T_i and vol_i <= m D_i are
   necessary anyhow.) Jobs of the own task before and after count the same way, T apart. Nothing
   here asks for priorities, so it holds for several deadlines, with preemption and without.
3. *Response time under RAD with preemption*: the same walk once more, after Bertogna and Cirinei
   (RTSS 2007). Vertices on the chain to v have a RAD of at most d_v = release + D_v, and with
   preemption only what has a RAD up to d_v can keep them waiting. A vertex u with an absolute
   RAD of e is done by e, if no deadline before d_v was missed; so of a window of length D_v it
   takes at most min(c_u, D_v - (d_v - e)), and its instances have RADs at least T apart. That is
   sum over j >= 0 of min(c_u, D_v - j T), whatever the RAD of u is. Vertices of the own job with a
   RAD beyond d_v do not count. For each task the lesser of this and W_i(x) of test 2 counts.
4. *Bonifaci, Marchetti-Spaccamela, Stiller and Wiese* (Feasibility analysis in the sporadic DAG
   task model, ECRTS 2013; one deadline for each DAG, arbitrary): their lemma. If EDF with
   preemption misses, then for every a with a len_i <= D_i there is a window of some length t in
   which a schedule on unlimited workers of speed 1/a, which starts all as soon as possible, works
   more than (m - (m - 1) / a) t on jobs whose deadlines lie up to the window's end. A job counts
   only if it is not done there before the window begins, so of task i at most
   ceil((t - D_i + a len_i) / T_i) jobs do, with vol_i each. Some values of a are tried.
5. *Li, Agrawal, Lu and Gill* (ECRTS 2013) and *Li, Chen, Agrawal, Lu, Gill and Saifullah* (ECRTS
   2014): capacity augmentation bounds of EDF with preemption for implicit deadlines (D = T):
   schedulable if U <= m / b and len_i <= D_i / b, with b = 4 - 2 / m and b = (3 + sqrt 5) / 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from heapq import heapify, heapreplace
import math
from typing import NamedTuple

from mddag_executor.analysis.model import Task

_MOST_POINTS = 100_000
_MOST_JOBS = 1_000  # of more jobs than these, in one window, each counts in full
_TRIES = 16
GRID = 1024


class Bound(NamedTuple):
    """A bound on a sink's response time, ns; None where none below its deadline was found."""

    task: Task
    sink: int
    deadline: int
    response: int | None


def graham(task: Task, workers: int) -> list[Bound]:
    """Return the bounds of test 1; None for all where the DAG is not done within its period."""
    responses = [length + (task.volume - length) // workers for _, _, length in task.sinks]
    alone = max(responses) <= task.period
    return [Bound(task, sink, deadline, response if alone and response <= deadline else None)
            for (sink, deadline, _), response in zip(task.sinks, responses)]


def least_response(length: int, deadline: int, workers: int, work: Callable[[int], int]) -> int:
    """
    Return the least x from ``length`` on with length + work(x) / m <= x: tests 2 and 3.

    What is beyond the deadline is no bound, but tells that there is none.

    :param work: what is done beside the longest path in a window, ns; it grows with the window.
    """
    response = length
    while response <= deadline:
        after = length + work(response) // workers
        if after <= response:
            break
        response = after
    return response


def bounds_of_sinks(
    tasks: Sequence[Task], response: Callable[[Task, int, int, int], int]
) -> list[Bound]:
    """
    Return the bounds, up to the first sink that has none: those after it would mean nothing.

    :param response: of a task, its sink, deadline and longest path there (see ``least_response``).
    """
    bounds = []
    for task in tasks:
        for sink, deadline, length in task.sinks:
            found = response(task, sink, deadline, length)
            bounds.append(Bound(task, sink, deadline, found if found <= deadline else None))
            if found > deadline:
                return bounds
    return bounds


def work_conserving(tasks: Sequence[Task], workers: int) -> list[Bound]:
    """Return the bounds of test 2, up to the first sink that has none."""
    def response(task: Task, sink: int, deadline: int, length: int) -> int:
        def work(window: int) -> int:
            own = task.volume - length + own_jobs(task, window, workers)
            return own + sum(workload(other, window, workers) for other in others)

        others = [other for other in tasks if other is not task]
        return least_response(length, deadline, workers, work)

    return bounds_of_sinks(tasks, response)


def workload(task: Task, window: int, workers: int) -> int:
    """Return the most that the jobs of a task work in a window (test 2), ns."""
    scaled = workers * (window + task.deadline) - task.volume
    whole, rest = divmod(max(0, scaled), workers * task.period)
    return min(workers * window, whole * task.volume + min(task.volume, rest))


def own_jobs(task: Task, window: int, workers: int) -> int:
    """Return what the jobs of the same task before and after work in a window, ns."""
    work = 0
    for reach in (task.deadline, window):
        if reach > _MOST_JOBS * task.period:
            work += (reach // task.period) * task.volume
            continue
        for left in range(reach - task.period, 0, -task.period):
            work += min(task.volume, workers * left)
    return work


def rad_preemptive(tasks: Sequence[Task], workers: int) -> list[Bound]:
    """Return the bounds of test 3, up to the first sink that has none."""
    urgent_of = Urgent()

    def response(task: Task, sink: int, deadline: int, length: int) -> int:
        def work(window: int) -> int:
            return own + sum(min(most, workload(other, window, workers)) for other, most in fixed)

        own = own_urgent(task, deadline) - length
        fixed = [(other, urgent_of(other, deadline)) for other in tasks if other is not task]
        return least_response(length, deadline, workers, work)

    return bounds_of_sinks(tasks, response)


def urgent(task: Task, deadline: int) -> int:
    """Return what another task works with RADs up to the end of a window as long, ns."""
    if deadline > _MOST_JOBS * task.period:
        return -(-deadline // task.period) * task.volume
    return sum(
        sum(min(cost, left) for cost in task.costs)
        for left in range(deadline, 0, -task.period))


class Urgent:
    """``urgent`` of a task set's tasks, remembered: many sinks have the same deadline."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], int] = {}

    def __call__(self, task: Task, deadline: int) -> int:
        """Return it, ns."""
        key = (task.dag.index, deadline)
        if key not in self._known:
            self._known[key] = urgent(task, deadline)
        return self._known[key]


def own_urgent(task: Task, deadline: int) -> int:
    """Return what the own task works with RADs up to ``deadline`` after a job's release, ns."""
    work = 0
    for cost, rad in zip(task.costs, task.rad):
        if rad <= deadline:
            work += cost * (1 + (deadline - rad) // task.period)  # of the job, and of later ones
        if rad > _MOST_JOBS * task.period:
            work += cost * (rad // task.period)
            continue
        for left in range(rad - task.period, 0, -task.period):  # of earlier ones
            if left <= deadline:
                work += min(cost, left)
    return work


class Slowdown(NamedTuple):
    """The value of a with which test 4 holds, and how many points were looked at."""

    factor: float
    points: int


def factors(tasks: Sequence[Task]) -> list[int]:
    """Return the values of a that tests like 4 try, times GRID; none where a path is too long."""
    largest = min((Fraction(task.deadline, task.length) for task in tasks if task.length),
                  default=Fraction(GRID))
    if largest < 1:
        return []
    return [math.floor((1 + (largest - 1) * step / _TRIES) * GRID) for step in range(_TRIES + 1)]


def bonifaci(tasks: Sequence[Task], workers: int) -> Slowdown | None:
    """Return how test 4 holds; None where it does not, or not within a bounded search."""
    for numerator in factors(tasks):
        points = _demand_holds(tasks, workers, numerator)
        if points:
            return Slowdown(numerator / GRID, points)
    return None


def demand_limits(
    tasks: Sequence[Task], workers: int, numerator: int
) -> tuple[int, float] | None:
    """
    Return what bounds the demand with a = numerator / GRID; None where it is too much anyhow.

    The first is m - (m - 1) / a, times ``numerator``; the second the length of window, times GRID,
    beyond which nothing can fail.
    """
    share = workers * numerator - (workers - 1) * GRID
    spare = share / numerator - sum(task.utilisation for task in tasks)
    if spare <= 1e-9:
        return None
    slack = sum(
        task.volume * max(0.0, 1 - (GRID * task.deadline - numerator * task.length)
                          / (GRID * task.period))
        for task in tasks)
    return share, slack / spare * GRID * 1.001 + 1


def _demand_holds(tasks: Sequence[Task], workers: int, numerator: int) -> int:
    """Look at test 4 with a = numerator / GRID, times in units of 1 / GRID ns; 0: it fails."""
    begins = [GRID * task.deadline - numerator * task.length for task in tasks]
    limits = demand_limits(tasks, workers, numerator)
    if limits is None or min(begins) <= 0:
        return 0
    share, until = limits
    heap = [(begin, task.volume, GRID * task.period) for task, begin in zip(tasks, begins)]
    heapify(heap)
    work = 0
    for points in range(1, _MOST_POINTS):
        time, volume, period = heap[0]
        if time > until:
            return points
        work += volume
        if work * numerator * GRID > share * time:
            return 0
        heapreplace(heap, (time + period, volume, period))
    return 0


def capacity_bound(workers: int) -> float:
    """Return b of test 5, rounded up."""
    return min(4 - 2 / workers, (3 + math.sqrt(5)) / 2) * (1 + 1e-12)


def li(tasks: Sequence[Task], workers: int) -> bool:
    """Tell whether test 5 holds."""
    bound = capacity_bound(workers)
    return (sum(task.utilisation for task in tasks) * bound <= workers
            and all(task.length * bound <= task.deadline for task in tasks))

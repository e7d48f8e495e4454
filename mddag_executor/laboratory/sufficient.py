# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Sufficient tests: if one holds, its scheduler keeps all deadlines.

Theory of operation
-------------------
m workers; len and vol are the longest path and the sum of the budgets; a release of task i comes
at least T_i after the one before. Work is never idle: a worker is free only if nothing is ready.
Nothing is preempted, as an executor of callbacks cannot. No test includes overheads.

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
3. *Response time under RAD*: the same walk once more. Vertices on the chain to v have a RAD of at
   most d_v = release + D_v, the first deadline that is missed. Whenever none of them runs, one is
   ready and all workers are busy, with vertices of two kinds:

   - *urgent* ones, with a RAD up to d_v (after Bertogna and Cirinei, RTSS 2007). A vertex u with
     an absolute RAD of e is done by e, as no deadline before d_v was missed; so of a window of
     length D_v it takes at most min(c_u, D_v - (d_v - e)), and its instances have RADs at least T
     apart. That is sum over j >= 0 of min(c_u, D_v - j T), whatever the RAD of u is. Vertices of
     the own job with a RAD beyond d_v do not count. Of each other task the lesser of this and
     W_i(x) counts;
   - *blocking* ones, with a later RAD. Such a vertex had begun before the ready vertex of the
     chain became ready. At one instant at most m vertices run, and each runs on once: the chain to
     v has at most k_v vertices, so all blocking together is at most k_v times the m largest
     budgets among the vertices that can have such a RAD. One of those was released before v's
     release + x, so its RAD offset is more than D_v - x. (Blocking at each vertex is the idea of
     limited preemption: Serrano, Melani, Bertogna and Quinones, DATE 2016.)

   All of this is also work of some job, so it is no more than what test 2 counts.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import NamedTuple

from mddag_executor.laboratory.tasks import Task
from msg_graph.model import path_lengths

_MOST_JOBS = 1_000  # of more jobs than these, in one window, each counts in full


class Bound(NamedTuple):
    """A bound on a sink's response time, ns; None: none below its deadline was found."""

    task: Task
    sink: int
    deadline: int
    response: int | None


def graham(task: Task, workers: int) -> list[Bound]:
    """Return the bounds of test 1; None for all if the DAG is not done within its period."""
    responses = [length + (task.volume - length) // workers for _, _, length in task.sinks]
    alone = max(responses) <= task.period
    return [Bound(task, sink, deadline, response if alone and response <= deadline else None)
            for (sink, deadline, _), response in zip(task.sinks, responses)]


def work_conserving(tasks: Sequence[Task], workers: int) -> list[Bound]:
    """Return the bounds of test 2, up to the first sink that has none."""
    def work_of(task: Task, _: int, __: int, length: int) -> Callable[[int], int]:
        return lambda window: _all_work(task, length, _workloads(tasks, task, window, workers),
                                        window, workers)

    return _bounds(tasks, workers, work_of)


def rad(tasks: Sequence[Task], workers: int) -> list[Bound]:
    """Return the bounds of test 3, up to the first sink that has none."""
    blocking = _Blocking(tasks, workers)
    known: dict[tuple[int, int], int] = {}  # many sinks have the same deadline

    def urgent_of(task: Task, deadline: int) -> int:
        key = (task.dag.index, deadline)
        if key not in known:
            known[key] = urgent(task, deadline)
        return known[key]

    def work_of(task: Task, sink: int, deadline: int, length: int) -> Callable[[int], int]:
        def work(window: int) -> int:
            loads = _workloads(tasks, task, window, workers)
            some = own + sum(min(pair) for pair in zip(most, loads))
            some += steps[sink] * blocking(deadline - window)
            return min(some, _all_work(task, length, loads, window, workers))

        most = [urgent_of(other, deadline) for other in tasks if other is not task]
        own = own_urgent(task, deadline) - length
        steps = path_lengths(task.dag, [1] * len(task.costs))
        return work

    return _bounds(tasks, workers, work_of)


def _bounds(
    tasks: Sequence[Task], workers: int,
    work_of: Callable[[Task, int, int, int], Callable[[int], int]],
) -> list[Bound]:
    """
    Return for each sink the least x from its longest path on with length + work(x) / m <= x.

    A first sink with none up to its deadline is the last one: those after it would mean nothing.

    :param work_of: of a task, its sink, deadline and longest path there: what is done in
        addition to that path in a window, ns; it grows with the window.
    """
    bounds = []
    for task in tasks:
        for sink, deadline, length in task.sinks:
            work = work_of(task, sink, deadline, length)
            response = length
            while response <= deadline:
                after = length + work(response) // workers
                if after <= response:
                    break
                response = after
            in_time = response <= deadline
            bounds.append(Bound(task, sink, deadline, response if in_time else None))
            if not in_time:
                return bounds
    return bounds


def _workloads(tasks: Sequence[Task], task: Task, window: int, workers: int) -> list[int]:
    return [workload(other, window, workers) for other in tasks if other is not task]


def _all_work(task: Task, length: int, loads: list[int], window: int, workers: int) -> int:
    """Return what test 2 counts in addition to the longest path, ns."""
    return task.volume - length + own_jobs(task, window, workers) + sum(loads)


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


def urgent(task: Task, deadline: int) -> int:
    """Return what another task works with RADs up to the end of a window as long, ns."""
    if deadline > _MOST_JOBS * task.period:
        return -(-deadline // task.period) * task.volume
    return sum(
        sum(min(cost, left) for cost in task.costs)
        for left in range(deadline, 0, -task.period))


def own_urgent(task: Task, deadline: int) -> int:
    """Return what the own task works with RADs up to ``deadline`` after a job's release, ns."""
    work = 0
    for cost, rad_offset in zip(task.costs, task.rad):
        if rad_offset <= deadline:  # of the job, and of later ones
            work += cost * (1 + (deadline - rad_offset) // task.period)
        if rad_offset > _MOST_JOBS * task.period:
            work += cost * (rad_offset // task.period)
            continue
        for left in range(rad_offset - task.period, 0, -task.period):  # of earlier ones
            if left <= deadline:
                work += min(cost, left)
    return work


class _Blocking:
    """Returns the sum of the m largest budgets of vertices with a RAD offset above a value, ns."""

    def __init__(self, tasks: Sequence[Task], workers: int) -> None:
        every = sorted(((rad, cost) for task in tasks for rad, cost in zip(task.rad, task.costs)),
                       reverse=True)
        self._minus_rad = [-rad for rad, _ in every]
        self._sums = [0]
        largest: list[int] = []
        for _, cost in every:
            heappush(largest, cost)
            dropped = heappop(largest) if len(largest) > workers else 0
            self._sums.append(self._sums[-1] + cost - dropped)

    def __call__(self, above: int) -> int:
        return self._sums[bisect_left(self._minus_rad, -above)]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Response times under RAD without preemption, which is how this executor runs callbacks.

Theory of operation
-------------------
The walk back from sink v, as in tests 2 and 3 of ``sufficient``; d_v = release + D_v is the first
missed deadline, and v is to be done by x after its release. Whenever no vertex of the chain runs,
one of it is ready and all workers are busy. What they are busy with is

1. *urgent*: vertices with a RAD up to d_v. Of these the figures of test 3 hold, as they only ask
   that nothing was missed before d_v;
2. or *blocking*: a vertex with a later RAD than d_v. The ready vertex of the chain is more urgent
   (its RAD is at most d_v), so the blocking one had begun before that became ready. At one instant
   at most m vertices run, and each runs on once: the chain to v has at most k_v vertices, so all
   blocking together is at most k_v times the m largest budgets among the vertices that can have
   such a RAD. One of those was released before v's release + x, so its RAD offset is more than
   D_v - x.

All of this is also work of some job, so it is no more than what test 2 counts. The least x with
len_v + min(urgent + blocking, work of test 2) / m <= x is a bound. The idea of blocking at each
vertex is that of limited preemption (Serrano, Melani, Bertogna and Quinones, DATE 2016).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from heapq import heappop, heappush

from mddag_executor.analysis.model import Task
from mddag_executor.analysis.sufficient import (
    Bound,
    bounds_of_sinks,
    least_response,
    own_jobs,
    own_urgent,
    Urgent,
    workload,
)
from msg_graph.analysis import path_lengths


def rad_non_preemptive(tasks: Sequence[Task], workers: int) -> list[Bound]:
    """Return the bounds, up to the first sink that has none."""
    blocking = _Blocking(tasks, workers)
    urgent_of = Urgent()
    chains = {task.dag.index: path_lengths(task.dag, [1] * len(task.costs)) for task in tasks}

    def response(task: Task, sink: int, deadline: int, length: int) -> int:
        def work(window: int) -> int:
            loads = [workload(other, window, workers) for other in others]
            some = own + sum(min(pair) for pair in zip(most, loads))
            some += steps * blocking(deadline - window)
            every = task.volume - length + own_jobs(task, window, workers) + sum(loads)
            return min(some, every)

        others = [other for other in tasks if other is not task]
        most = [urgent_of(other, deadline) for other in others]
        own = own_urgent(task, deadline) - length
        steps = chains[task.dag.index][sink]
        return least_response(length, deadline, workers, work)

    return bounds_of_sinks(tasks, response)


class _Blocking:
    """Tells the sum of the m largest budgets of vertices with a RAD offset above a value, ns."""

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
        """Return the sum."""
        return self._sums[bisect_left(self._minus_rad, -above)]

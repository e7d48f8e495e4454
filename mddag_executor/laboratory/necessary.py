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
   what has to be done in [0, t] is no more than m t. What has to be done is refined for each sink:
   a vertex counts by when it has to be done so that each sink after it can still be in time
   (``Task.latest``), not by the deadline of the whole DAG. (Baruah, Mok and Rosier, RTSS 1990, for
   one processor and sequential tasks.)  If U < m only a bounded number of t can fail; of those
   at most ``MOST_POINTS`` are checked, the smallest.
"""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heapify, heapreplace
from typing import NamedTuple

from mddag_executor.laboratory.tasks import Task

MOST_POINTS = 300_000


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

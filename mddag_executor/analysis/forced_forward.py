# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The forced-forward test of GEDF, for one deadline for each DAG, which may exceed the period.

Theory of operation
-------------------
After Baruah, Improved multiprocessor global schedulability analysis of sporadic DAG task systems,
ECRTS 2014.

1. The lemma is that of test 4 in ``sufficient`` (Bonifaci et al. 2013): if EDF with preemption
   misses on m workers, then for every a >= 1 with a len_i <= D_i there is a window of some length
   t in which S, the schedule on unlimited workers of speed 1/a that starts all as soon as
   possible, works more than (m - (m - 1) / a) t on jobs with deadlines up to the window's end.
2. There every job that is not done when the window begins counts in full. Here only what S still
   has to do of it counts: the *forced-forward demand*. A job with its deadline s before the
   window's end was released D_i + s - t before the window; what S has left of it then, after_i(D_i
   + s - t), grows as s falls. So the most that task i can bring is the sum over k >= 0 of
   after_i(D_i + k T_i - t): the last deadline at the window's end, the others T_i apart.
3. Both sides are piecewise linear in t, and the right one is a line through 0. So it is enough to
   look where the left one bends: at t = D_i + k T_i - a z, for every z at which a vertex begins or
   ends when the DAG runs on unlimited workers of speed 1. Times are exact, in units of 1/GRID ns;
   where an instant falls between two ns within a job, the earlier one counts, which is more work.
4. Beyond the t of test 4 nothing can fail. Where test 4 holds with some a, so does this one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from heapq import heapify, heapreplace
from typing import NamedTuple

from mddag_executor.analysis.model import Task
from mddag_executor.analysis.sufficient import bonifaci, demand_limits, factors, GRID, Slowdown
from msg_graph.analysis import topological_order

_MOST_POINTS = 30_000
"""Instants that are looked at, for all values of a together."""


class _Profile(NamedTuple):
    """A DAG on unlimited workers of speed 1: at the time ``at`` so much work is ``done``, ns."""

    task: Task
    at: tuple[int, ...]
    done: tuple[int, ...]
    slope: tuple[int, ...]

    def left(self, z: int) -> int:
        """Return the work that is left z ns after the release."""
        if z <= 0:
            return self.task.volume
        if z >= self.at[-1]:
            return 0
        place = bisect_right(self.at, z) - 1
        return self.task.volume - self.done[place] - self.slope[place] * (z - self.at[place])


def forced_forward(tasks: Sequence[Task], workers: int) -> Slowdown | None:
    """Return the value of a with which the test holds; None where none does that was tried."""
    simple = bonifaci(tasks, workers)
    if simple is not None:
        return simple
    profiles = [_profile(task) for task in tasks if task.volume]
    left = _MOST_POINTS
    for numerator in factors(tasks):
        points, holds = _holds(profiles, tasks, workers, numerator, left)
        if holds:
            return Slowdown(numerator / GRID, points)
        left -= points
        if left <= 0:
            return None
    return None


def _profile(task: Task) -> _Profile:
    ends = [0] * len(task.costs)
    change: dict[int, int] = {0: 0}
    for index in topological_order(task.dag):
        begin = max((ends[p] for p in task.dag.vertices[index].predecessors), default=0)
        ends[index] = begin + task.costs[index]
        change[begin] = change.get(begin, 0) + 1
        change[ends[index]] = change.get(ends[index], 0) - 1
    at = tuple(sorted(change))
    done, slopes, work, slope = [], [], 0, 0
    for place, time in enumerate(at):
        if place:
            work += slope * (time - at[place - 1])
        slope += change[time]
        done.append(work)
        slopes.append(slope)
    return _Profile(task, at, tuple(done), tuple(slopes))


def _demand(profile: _Profile, time: int, numerator: int) -> int:
    """Return the forced-forward demand of a task in a window, ns; rules 2 and 3."""
    task = profile.task
    deadline, period = GRID * task.deadline, GRID * task.period
    full = max(0, (time - deadline) // period + 1)
    work = full * task.volume
    ahead = deadline + full * period - time
    length = numerator * task.length
    while ahead < length:
        work += profile.left(ahead // numerator)
        ahead += period
    return work


def _holds(
    profiles: Sequence[_Profile], tasks: Sequence[Task], workers: int, numerator: int, most: int
) -> tuple[int, bool]:
    """Return how many instants were looked at, and whether the test holds with this a."""
    limits = demand_limits(tasks, workers, numerator)
    if limits is None:
        return 1, False
    share, until = limits
    heap = [(GRID * p.task.deadline - numerator * z, GRID * p.task.period)
            for p in profiles for z in p.at]
    heapify(heap)
    for points in range(1, most + 1):
        time, period = heap[0]
        if time > until:
            return points, True
        if time > 0:
            work = sum(_demand(profile, time, numerator) for profile in profiles)
            if work * numerator * GRID > share * time:
                return points, False
        heapreplace(heap, (time + period, period))
    return most, False

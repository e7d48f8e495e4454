# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Latest starts from measured execution times, for drivers that measure (rule 7).

``State.start_by`` and ``reach_by`` begin with the declared execution times.  When the measured
time of a vertex has changed by more than an eighth, its latest starts are computed again, and
those of the vertices before it.  So most executions cost one comparison.  Measured is the time
that the callback needs when nothing disturbs it: the mean CPU time or, if it waits, the least
recent duration (``executor.gil``).  After ``FORGET_PERIODS`` without a new measurement, the
declared time counts again.
"""

from __future__ import annotations

from mddag_executor.core.overload import admit, set_start
from mddag_executor.core.state import State
from mddag_executor.core.tables import NEVER, Tables

CHANGE = 8
"""A mean counts as changed when it differs by more than this fraction (an eighth)."""
LEAST_CHANGE_NS = 100_000
FORGET_PERIODS = 10
"""A measured time is forgotten after this many periods of its DAG without a new one."""
ADMIT_NS = 50_000_000
"""
How often the demand of all callbacks is compared with the capacity, if their times change.

It is a sum over all vertices.  On a busy machine some time changes at each tenth execution.
"""

Steps = list[tuple[int, list[tuple[int, list[int]]]]]
"""
Vertices, each after its successors.

With each are its sinks as indices of ``reach_by``, and with each sink the same of its successors.
"""


class Estimates:
    """The latest starts of a run; times are ns."""

    def __init__(self, t: Tables, s: State) -> None:
        self._t, self._s = t, s
        # by vertex: what depends on its time; made when that first changes
        self._steps: dict[int, Steps] = {}
        # when to compare demand and capacity; NEVER: no time has changed
        self._admit_at = NEVER
        self._admitted_at = -NEVER
        # when the first measured time is too old; NEVER: none was measured
        self._forget_at = NEVER
        # the earlier one of these
        self._act_at = NEVER

    def note(self, vertex: int, mean: int, holds: int, now: int) -> None:
        """
        Note the recent execution time of a vertex, and whether it holds the GIL.

        :param mean: -1: not known yet.
        """
        s = self._s
        known = s.mean[vertex]
        if mean < 0:
            mean = known
        else:
            s.measured_at[vertex] = now
            if self._forget_at == NEVER:
                self._forget_at = self._act_at = now  # finds out
        if abs(mean - known) * CHANGE > known + LEAST_CHANGE_NS or holds != s.holder[vertex]:
            s.mean[vertex] = mean
            s.holder[vertex] = holds
            self._update(vertex)
        if now >= self._act_at:
            self._act(now)

    def _act(self, now: int) -> None:
        """Forget old times, and compare demand and capacity, if it is time to."""
        if now >= self._forget_at:
            self._forget(now)
        if now >= self._admit_at:
            self._admit_at, self._admitted_at = NEVER, now
            admit(self._t, self._s)
        self._act_at = min(self._forget_at, self._admit_at)

    def _forget(self, now: int) -> None:
        """Forget the times that were measured too long ago."""
        t, s = self._t, self._s
        self._forget_at = NEVER
        for vertex in range(t.n_vertices):
            if s.measured_at[vertex] < 0:
                continue
            until = s.measured_at[vertex] + FORGET_PERIODS * t.period[t.dag_of[vertex]]
            if until >= now:
                self._forget_at = min(self._forget_at, until + 1)
            else:
                s.measured_at[vertex] = -1
                s.mean[vertex] = t.mean_time[vertex]
                self._update(vertex)

    def _update(self, vertex: int) -> None:
        """Compute the latest starts of a vertex, and of those before it, again."""
        t, s = self._t, self._s
        means, reach_by, deadlines = s.mean, s.reach_by, t.reach_deadline
        steps = self._steps.get(vertex)
        if steps is None:
            steps = self._steps[vertex] = _steps_to(t, vertex)
        for each, sinks in steps:
            for i, after in sinks:
                start = deadlines[i]
                for j in after:
                    if reach_by[j] < start:
                        start = reach_by[j]
                reach_by[i] = start - means[each]
            set_start(t, s, each)
        self._admit_at = self._admitted_at + ADMIT_NS
        self._act_at = min(self._act_at, self._admit_at)


def _steps_to(t: Tables, vertex: int) -> Steps:
    """Return how to compute the latest starts of a vertex, and of those before it."""
    first, last = t.first_vertex[t.dag_of[vertex]:t.dag_of[vertex] + 2]
    found: Steps = []
    dependent = {vertex}
    for each in sorted(range(first, last), key=lambda v: t.height[v]):
        successors = t.successors[t.first_successor[each]:t.first_successor[each + 1]]
        if each == vertex or not dependent.isdisjoint(successors):
            dependent.add(each)
            found.append((each, [
                (i, [j for after in successors for j in _reaches(t, after)
                     if t.reach_sink[j] == t.reach_sink[i]])
                for i in _reaches(t, each)]))
    return found


def _reaches(t: Tables, vertex: int) -> range:
    """Return the indices of ``reach_by`` of a vertex."""
    return range(t.first_reach[vertex], t.first_reach[vertex + 1])

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Latest starts from measured execution times, for drivers that measure (rule 7).

``State.start_by`` and ``reach_by`` begin with the declared execution times.  When the measured
time of a vertex has changed by more than an eighth, those of its DAG are computed again.  So most
executions cost one comparison.  Measured is the time that the callback needs when nothing disturbs
it: the mean CPU time or, if it waits, the least recent duration (``executor.gil``).  After
``FORGET_PERIODS`` without a new measurement, the declared time counts again.
"""

from __future__ import annotations

from mddag_executor.core.overload import admit, set_start
from mddag_executor.core.state import FORGET_AT, State
from mddag_executor.core.tables import NEVER, Tables

CHANGE = 8
"""A mean counts as changed when it differs by more than this fraction (an eighth)."""
LEAST_CHANGE_NS = 100_000
FORGET_PERIODS = 10
"""A measured time is forgotten after this many periods of its DAG without a new one."""


def note_time(t: Tables, s: State, vertex: int, mean: int, holds: int, now: int) -> None:
    """
    Note the recent execution time of a vertex, ns, and whether it holds the GIL.

    :param mean: -1: not known yet.
    """
    known = s.mean[vertex]
    if mean < 0:
        mean = known
    else:
        s.measured_at[vertex] = now
        if s.scalars[FORGET_AT] == NEVER:
            s.scalars[FORGET_AT] = now  # the next measurement finds out
    if now > s.scalars[FORGET_AT]:
        _forget(t, s, now)
    if abs(mean - known) * CHANGE > known + LEAST_CHANGE_NS or holds != s.holder[vertex]:
        s.mean[vertex] = mean
        s.holder[vertex] = holds
        _update(t, s, t.dag_of[vertex])


def _forget(t: Tables, s: State, now: int) -> None:
    """Forget the times that were measured too long ago."""
    changed = set()
    s.scalars[FORGET_AT] = NEVER
    for vertex in range(t.n_vertices):
        if s.measured_at[vertex] < 0:
            continue
        dag = t.dag_of[vertex]
        until = s.measured_at[vertex] + FORGET_PERIODS * t.period[dag]
        if until >= now:
            s.scalars[FORGET_AT] = min(s.scalars[FORGET_AT], until)
        else:
            s.measured_at[vertex] = -1
            s.mean[vertex] = t.mean_time[vertex]
            changed.add(dag)
    for dag in changed:
        _update(t, s, dag)


def _update(t: Tables, s: State, dag: int) -> None:
    """Compute the latest starts of a DAG again, and which importance gives way."""
    first, last = t.first_vertex[dag:dag + 2]
    starts: dict[tuple[int, int], int] = {}
    for vertex in sorted(range(first, last), key=lambda v: t.height[v]):
        after = t.successors[t.first_successor[vertex]:t.first_successor[vertex + 1]]
        for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
            sink = t.reach_sink[i]
            start = t.reach_deadline[i]
            for each in after:
                start = min(start, starts.get((each, sink), start))
            s.reach_by[i] = starts[vertex, sink] = start - s.mean[vertex]
        set_start(t, s, vertex)
    admit(t, s)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Why a deadline was missed, as far as the executor knows at once.

Theory of operation
-------------------
Of the job's executions the core still has when each became ready and when it started.  So, along
the chain of the messages that came last, it is known how late the source was ready, and how long
callbacks waited.  If the job would have been in time without both, the larger is the cause; else
its callbacks ran long.  A stop of the machine that overlaps the job goes before.

What a callback waited for is not looked into here: `mddag explain` does that, with a trace.
"""

from __future__ import annotations

from mddag_executor.core import legs_of, Tables
from mddag_executor.core.state import IDLE, SINK_EXPIRED, SINK_FAILED, State
from msg_graph import TaskSet

WAITED, RAN_LONG, RELEASED_LATE, MACHINE, LOST, FAILED = CAUSES = (
    'waited', 'ran long', 'released late', 'machine', 'lost', 'failed')

NOTICED_NS = 5_000_000
"""A release is noticed in time within this."""


class Why:
    """Finds the causes of misses, from what the core has of their jobs."""

    def __init__(self, task_set: TaskSet | None, tables: Tables) -> None:
        self._tables = tables
        # by global vertex and leg: the vertex whose message it is
        self._before = [] if task_set is None else [
            [first + before for _, before in legs_of(vertex, dag.vertices)]
            for dag, first in zip(task_set.dags, tables.first_vertex) for vertex in dag.vertices]

    def cause(
        self, state: State, kind: int, dag: int, vertex: int, job: int, deadline: int, until: int
    ) -> str:
        """
        Return the cause of a miss that no stop explains.

        :param until: when the sink completed, or was given up.
        """
        if kind == SINK_FAILED:
            return FAILED
        slot = self._slot(state, dag, job)
        if slot < 0:    # it made room for a new job
            return LOST
        lag, waited, reached = self._along(state, slot, vertex, until)
        if kind == SINK_EXPIRED:
            if reached:
                return LOST
            # a release that is skipped: noticed late, or its callback waits for the one before
            return RELEASED_LATE if lag >= NOTICED_NS else WAITED
        if lag + waited < until - deadline:
            return RAN_LONG
        return WAITED if waited >= lag else RELEASED_LATE

    def _slot(self, state: State, dag: int, job: int) -> int:
        """Return the slot of a job that is open or has just ended, -1 if it has another one."""
        return next((slot for slot, (of, index) in enumerate(zip(state.job_dag, state.job_index))
                     if index == job and of == dag), -1)

    def _along(self, state: State, slot: int, vertex: int, until: int) -> tuple[int, int, bool]:
        """Return how late the source was ready, how long callbacks waited, and whether any ran."""
        waited, reached = 0, False
        since = state.job_release[slot]
        while True:
            x = self._last_leg(state, slot, vertex)
            ready = until
            if state.x_state[x] != IDLE:
                ready, started = state.x_ready[x], state.x_started[x]
                reached = True
                waited += (started if started >= 0 else until) - ready
            if not self._before[vertex]:
                return max(0, ready - since), waited, reached
            leg = x - state.job_base[slot] - self._tables.region_offset[vertex]
            vertex = self._before[vertex][leg]

    def _last_leg(self, state: State, slot: int, vertex: int) -> int:
        """Return the execution of a vertex whose message came last, of those that have come."""
        first = state.job_base[slot] + self._tables.region_offset[vertex]
        legs = range(first, first + max(1, len(self._before[vertex])))
        return max(legs, key=lambda x: (state.x_state[x] != IDLE, state.x_ready[x]))

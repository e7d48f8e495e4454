# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What executions deliver in virtual time, where that is more than the edges of the graph at once.

Theory of operation
-------------------
Where messages take time, what a vertex publishes makes its edge to a successor true ``delay``
after the vertex completes; the core is told of each with ``rules.edge``.  A delay may be negative:
the callback published before its end.  Then the edge comes true that long before the end, as far
as the execution had begun.  Where executions may be preempted, their edges come true at the end.
Where they may stand still (see ``machine``), the end is not known in advance; but how far the
execution is when it publishes, its *place*, is.

A message whose job has ended meanwhile is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from heapq import heappop, heappush
from typing import NamedTuple

from mddag_executor.core import NEVER, rules, Tables
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.state import OPEN, PREEMPTIVE, State

DELAY_NS = 1_000_000
"""What a message takes to another process of this machine, whose interpreter is in use."""


class Transports(NamedTuple):
    """
    How long after a vertex's completion each of its edges comes true.

    The delay (ns) of edge e in job k of DAG d is ``delays[base[d] + k * stride[d] + e]``; the
    edges of a DAG are numbered as in ``Tables.successors``, from its first vertex on.
    """

    delays: Sequence[int]
    base: list[int]
    stride: list[int]


def edges_of(tables: Tables) -> list[int]:
    """Return the number of edges of each declared DAG."""
    first = [tables.first_successor[v] for v in tables.first_vertex]
    return [after - before for before, after in zip(first, first[1:])]


def edge_numbers(tables: Tables) -> dict[tuple[int, int], int]:
    """Return the number of each edge in its DAG, by the global vertices that it joins."""
    first = tables.first_successor
    return {
        (vertex, tables.successors[i]): i - first[tables.first_vertex[tables.dag_of[vertex]]]
        for vertex in range(tables.n_vertices) for i in range(first[vertex], first[vertex + 1])}


class Deliveries:
    """
    The messages of one run, and which of its executions fail.

    :param state: of the core, empty, made with ``propagate=2``.
    :param failed: the vertices and jobs whose executions fail.
    :param stops: whether executions may stand still.
    :param skipped: the DAGs and jobs whose sources do not run: they expire at once.
    """

    def __init__(
        self, tables: Tables, state: State, key: KeyFunction, transports: Transports,
        failed: Set[tuple[int, int]] = frozenset(), stops: bool = False,
        skipped: Set[tuple[int, int]] = frozenset(),
    ) -> None:
        self._t = tables
        self._s = state
        self._key = key
        self._transports = transports
        self._failed = failed
        self.skipped = skipped
        self._first_edge = [tables.first_successor[v] for v in tables.first_vertex]
        self._early = not state.scalars[PREEMPTIVE]
        # (time, order, slot, job, vertex that the message starts)
        self._messages: list[tuple[int, int, int, int, int]] = []
        self._sent = 0
        self._stops = stops
        # of those that run and may stand still, by execution: the places at which they publish
        # before their end, and what that starts; the next one last
        self._to_come: dict[int, list[tuple[int, int]]] = {}

    def next_time(self) -> int:
        """Return when the next message arrives, ns."""
        return self._messages[0][0] if self._messages else NEVER

    def started(self, x: int, now: int) -> None:
        """Send what an execution that starts publishes before or after its end."""
        if self._early and self._stops:
            self._find_places(x)
        elif self._early:
            self._send(x, now + self._s.x_left[x], now)

    def _find_places(self, x: int) -> None:
        s = self._s
        cost = s.x_cost[x]
        found = [(max(0, cost + delay), after) for after, delay in self._edges(x) if delay < 0]
        if found:
            self._to_come[x] = sorted(found, reverse=True)

    def next_place(self, x: int) -> int:
        """Return how far a running execution is when it publishes next."""
        to_come = self._to_come.get(x)
        return to_come[-1][0] if to_come else NEVER

    def _edges(self, x: int) -> list[tuple[int, int]]:
        """Return what an execution starts, and how long after its end."""
        t, s = self._t, self._s
        vertex = s.x_vertex[x]
        first, end = t.first_successor[vertex], t.first_successor[vertex + 1]
        if first == end:
            return []
        base = self._base(t.dag_of[vertex], s.job_index[s.x_slot[x]])
        delays = self._transports.delays
        return [(t.successors[i], delays[base + i]) for i in range(first, end)]

    def complete(self, x: int, now: int) -> None:
        """End an execution, and send what it publishes."""
        t, s = self._t, self._s
        slot = s.x_slot[x]
        job = s.job_index[slot]
        edges = self._edges(x)
        for _, after in reversed(self._to_come.pop(x, ())):
            self._arrive(slot, job, after, now)
        end = rules.fail if (s.x_vertex[x], job) in self._failed else rules.complete
        end(t, s, self._key, x, now)
        for after, delay in edges:
            if delay == 0 or (delay < 0 and not self._early):
                self._arrive(slot, job, after, now)
            elif delay > 0 and (self._stops or not self._early):
                self._post(now + delay, slot, job, after)

    def arrive(self, now: int) -> None:
        """Make the edges true whose messages arrive now, in the order in which they were sent."""
        messages = self._messages
        while messages and messages[0][0] <= now:
            _, _, slot, job, vertex = heappop(messages)
            self._arrive(slot, job, vertex, now)
        if self._to_come:
            self._publish(now)

    def _publish(self, now: int) -> None:
        """Make the edges true that running executions publish now, before their end."""
        s = self._s
        for x in s.worker_x:
            to_come = self._to_come.get(x)
            if to_come:
                at = rules.progress(s, x, now)
                while to_come and to_come[-1][0] <= at:
                    slot = s.x_slot[x]
                    self._arrive(slot, s.job_index[slot], to_come.pop()[1], now)

    def _base(self, dag: int, job: int) -> int:
        transports = self._transports
        return transports.base[dag] + job * transports.stride[dag] - self._first_edge[dag]

    def _send(self, x: int, finish: int, now: int) -> None:
        """Send what an execution publishes and that needs time, or came before its end."""
        slot = self._s.x_slot[x]
        for after, delay in self._edges(x):
            if delay:
                self._post(max(now, finish + delay), slot, self._s.job_index[slot], after)

    def _post(self, time: int, slot: int, job: int, vertex: int) -> None:
        self._sent += 1
        heappush(self._messages, (time, self._sent, slot, job, vertex))

    def _arrive(self, slot: int, job: int, vertex: int, now: int) -> None:
        t, s = self._t, self._s
        if (s.job_state[slot] == OPEN and s.job_index[slot] == job
                and s.job_dag[slot] == t.dag_of[vertex]):
            rules.edge(t, s, self._key, slot, vertex, now)

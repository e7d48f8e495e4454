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

A message whose job has ended meanwhile is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from heapq import heappop, heappush
from typing import NamedTuple

from mddag_executor.core import NEVER, rules, Tables
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.state import OPEN, PREEMPTIVE, State


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
    """

    def __init__(
        self, tables: Tables, state: State, key: KeyFunction, transports: Transports,
        failed: Set[tuple[int, int]] = frozenset(),
    ) -> None:
        self._t = tables
        self._s = state
        self._key = key
        self._transports = transports
        self._failed = failed
        self._first_edge = [tables.first_successor[v] for v in tables.first_vertex]
        self._early = not state.scalars[PREEMPTIVE]
        # (time, order, slot, job, vertex that the message starts)
        self._messages: list[tuple[int, int, int, int, int]] = []
        self._sent = 0

    def next_time(self) -> int:
        """Return when the next message arrives, ns."""
        return self._messages[0][0] if self._messages else NEVER

    def started(self, x: int, now: int) -> None:
        """Send what an execution that starts publishes before or after its end."""
        if self._early:
            self._send(x, now + self._s.x_left[x], now)

    def complete(self, x: int, now: int) -> None:
        """End an execution, and send what it publishes."""
        t, s = self._t, self._s
        slot = s.x_slot[x]
        job = s.job_index[slot]
        vertex = s.x_vertex[x]
        end = rules.fail if (vertex, job) in self._failed else rules.complete
        end(t, s, self._key, x, now)
        if not self._early:
            self._send(x, now, now)
            return
        first, end_of = t.first_successor[vertex], t.first_successor[vertex + 1]
        if first < end_of:
            base = self._base(t.dag_of[vertex], job)
            for i in range(first, end_of):
                if self._transports.delays[base + i] == 0:
                    self._arrive(slot, job, t.successors[i], now)

    def arrive(self, now: int) -> None:
        """Make the edges true whose messages arrive now, in the order in which they were sent."""
        messages = self._messages
        while messages and messages[0][0] <= now:
            _, _, slot, job, vertex = heappop(messages)
            self._arrive(slot, job, vertex, now)

    def _base(self, dag: int, job: int) -> int:
        transports = self._transports
        return transports.base[dag] + job * transports.stride[dag] - self._first_edge[dag]

    def _send(self, x: int, finish: int, now: int) -> None:
        """Send what an execution publishes; with ``_early`` what needs no time is left out."""
        t, s = self._t, self._s
        vertex = s.x_vertex[x]
        first, end = t.first_successor[vertex], t.first_successor[vertex + 1]
        if first == end:
            return
        slot = s.x_slot[x]
        job = s.job_index[slot]
        base = self._base(t.dag_of[vertex], job)
        for i in range(first, end):
            delay = self._transports.delays[base + i]
            after = t.successors[i]
            if self._early:
                if delay:
                    self._post(max(now, finish + delay), slot, job, after)
            elif delay > 0:
                self._post(finish + delay, slot, job, after)
            else:
                self._arrive(slot, job, after, now)

    def _post(self, time: int, slot: int, job: int, vertex: int) -> None:
        self._sent += 1
        heappush(self._messages, (time, self._sent, slot, job, vertex))

    def _arrive(self, slot: int, job: int, vertex: int, now: int) -> None:
        t, s = self._t, self._s
        if (s.job_state[slot] == OPEN and s.job_index[slot] == job
                and s.job_dag[slot] == t.dag_of[vertex]):
            rules.edge(t, s, self._key, slot, vertex, now)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The event loop of rescheduling: virtual time around the core's rules, with messages that take time.

Theory of operation
-------------------
Like the simulator's (``simulate.engine``), but the edges of the graph come true by messages: what
a vertex publishes makes its edge to a successor true ``delay`` after the vertex completes.  The
driver tells the core of each with ``rules.edge``, and of nothing else that the simulator's does
not.

At one instant first the completions are told to the core, workers in ascending order, with the
edges that need no time; then the messages that arrive, in the order in which they were sent; then
the releases in DAG order; then the core dispatches until it has nothing left to do.  Without any
delay this is the simulator's order (design section 9).

A delay may be negative: the callback published before its end.  Then the edge comes true that long
before the end, as far as the execution had begun.  Where the execution may be preempted its end is
not known in advance, so its edges come true at the end.

A message whose job has ended meanwhile is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from heapq import heappop, heappush
from typing import NamedTuple

from mddag_executor.core import NEVER, rules, Tables
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.state import OPEN, PREEMPTIVE, State
from mddag_executor.simulate import END, Load, LogEntry, PREEMPT, START
from mddag_executor.simulate.engine import release_load


class Transports(NamedTuple):
    """
    How long after a vertex's completion each of its edges comes true.

    The delay (ns) of edge e in job k of DAG d is ``delays[base[d] + k * stride[d] + e]``; the
    edges of a DAG are numbered as in ``Tables.successors``, from its first vertex on.
    """

    delays: Sequence[int]
    base: list[int]
    stride: list[int]

    @staticmethod
    def none(tables: Tables) -> Transports:
        """Return the transports of messages that arrive at once."""
        n = max(edges_of(tables), default=0)
        return Transports([0] * n, [0] * tables.n_dags, [0] * tables.n_dags)


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


class Engine:
    """
    One rescheduled run.

    :param state: of the core, empty, made with ``propagate=2``.
    :param failed: the vertices and jobs whose executions fail.
    :ivar log: every start, end and preemption.
    """

    def __init__(
        self, tables: Tables, state: State, key: KeyFunction, load: Load, transports: Transports,
        failed: Set[tuple[int, int]] = frozenset(),
    ) -> None:
        self._t = tables
        self._s = state
        self._key = key
        self._load = load
        self._transports = transports
        self._failed = failed
        self._first_edge = [tables.first_successor[v] for v in tables.first_vertex]
        self._early = not state.scalars[PREEMPTIVE]
        self._finish_at = [NEVER] * len(state.worker_x)
        self._running = [-1] * len(state.worker_x)
        # (time, order, slot, job, vertex that the message starts)
        self._messages: list[tuple[int, int, int, int, int]] = []
        self._sent = 0
        self.log: list[LogEntry] = []

    def run(self, horizon: int) -> None:
        """Run until the horizon (ns); decisions are left in the state."""
        times = self._load.times
        n = 0
        finish_at, messages = self._finish_at, self._messages
        while True:
            instant = min(finish_at)
            if n < len(times) and times[n] < instant and times[n] < horizon:
                instant = times[n]
            if messages and messages[0][0] < instant:
                instant = messages[0][0]
            if instant > horizon or instant >= NEVER:
                return
            for worker, finish in enumerate(finish_at):
                if finish == instant:
                    self._complete(worker, instant)
            if instant == horizon:
                return
            while messages and messages[0][0] <= instant:
                _, _, slot, job, vertex = heappop(messages)
                self._arrive(slot, job, vertex, instant)
            while n < len(times) and times[n] == instant:
                release_load(self._t, self._s, self._key, self._load, n, instant)
                n += 1
            self._dispatch(instant)

    def _dispatch(self, now: int) -> None:
        t, s, running = self._t, self._s, self._running
        while True:
            x = rules.schedule(t, s, self._key, now)
            if x < 0:
                return
            worker = s.x_worker[x]
            finish = now + s.x_left[x]
            self._finish_at[worker] = finish
            if running[worker] >= 0:
                self._note(now, PREEMPT, worker, running[worker])
            running[worker] = x
            self._note(now, START, worker, x)
            if self._early:
                self._send(x, finish, now)

    def _complete(self, worker: int, now: int) -> None:
        self._finish_at[worker] = NEVER
        x = self._running[worker]
        self._running[worker] = -1
        self._note(now, END, worker, x)
        slot = self._s.x_slot[x]
        job = self._s.job_index[slot]
        vertex = self._s.x_vertex[x]
        end = rules.fail if (vertex, job) in self._failed else rules.complete
        end(self._t, self._s, self._key, x, now)
        if self._early:
            for after in self._at_once(slot, job, vertex):
                self._arrive(slot, job, after, now)
        else:
            self._send(x, now, now)

    def _at_once(self, slot: int, job: int, vertex: int) -> list[int]:
        """Return the vertices that a completion makes ready without any delay."""
        t = self._t
        first, end = t.first_successor[vertex], t.first_successor[vertex + 1]
        if first == end:
            return []
        dag = t.dag_of[vertex]
        base = self._base(dag, job)
        delays = self._transports.delays
        return [t.successors[i] for i in range(first, end) if delays[base + i] == 0]

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

    def _note(self, now: int, kind: int, worker: int, x: int) -> None:
        s = self._s
        vertex = s.x_vertex[x]
        self.log.append(
            (now, kind, worker, self._t.dag_of[vertex], vertex, s.job_index[s.x_slot[x]]))


def busy_times(log: Sequence[LogEntry], workers: int, end: int) -> list[int]:
    """Return for each worker how long it was busy until the end, ns."""
    busy = [0] * workers
    since = [-1] * workers
    for time, kind, worker, *_ in log:
        if since[worker] >= 0:
            busy[worker] += time - since[worker]
        since[worker] = time if kind == START else -1
    for worker, start in enumerate(since):
        if start >= 0:
            busy[worker] += end - start
    return busy

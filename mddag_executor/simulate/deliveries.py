# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages in virtual time, if transport takes time or executions may fail.

Theory of operation
-------------------
If transport takes time, an edge to a successor is satisfied ``delay`` after its vertex completes;
the engine reports each edge to the core (``rules.satisfy_edge``).  With a negative delay the
callback published before its end: the edge is satisfied that long before the end, but not before
the start.  With preemption, edges are satisfied at the end.  A delay of NEVER means that nothing
is published; over an edge that its publisher takes only sometimes, the vertex is then not due
(rule 13).  If executions may be stopped (see ``machine``), the end is not known in advance, but
the *place* is: the progress of the execution when it publishes.

A message is ignored if its job has ended.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import NamedTuple

from mddag_executor.core.jobs import withhold
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.rules import complete, fail, satisfy_edge
from mddag_executor.core.state import OPEN, QueueEntry, State
from mddag_executor.core.tables import NEVER, Tables
from mddag_executor.simulate.machine import is_used, Machine, progress
from mddag_executor.simulate.workload import FAILS, place_of, Workload

# Columns of ``Deliveries.scalars``.
SENT, MAY_PREEMPT = range(2)

DELAY_NS = 1_000_000
"""Time of a message to another process of this machine whose interpreter is busy."""


class Deliveries(NamedTuple):
    """
    The messages of one run of a state made with ``propagate=2``; initially empty.

    ``messages`` is a heap of messages in transport: (time, order, slot, job, vertex that it
    starts); ``scalars`` has their total number, and whether executions may be preempted.
    ``next_vertex`` has, by running
    execution that may be stopped, the vertex that it starts next before its end, at
    ``Machine.publishes_at``.
    """

    messages: list[QueueEntry]
    scalars: list[int]
    next_vertex: list[int]


def next_arrival(d: Deliveries) -> int:
    """Return when the next message arrives, ns."""
    return d.messages[0][0] if len(d.messages) > 0 else NEVER


def delay_of(t: Tables, s: State, load: Workload, x: int, edge: int) -> int:
    """Return how long after the end of an execution an edge of its vertex is satisfied."""
    slot = s.x_slot[x]
    dag = s.job_dag[slot]
    return load.delays[load.delay_base[dag] + s.job_index[slot] * load.delay_stride[dag]
                       + edge - t.first_successor[t.first_vertex[dag]]]


def sends_at_start(
    t: Tables, s: State, load: Workload, d: Deliveries, m: Machine, x: int, now: int
) -> None:
    """Send the messages of a started execution, as far as their times are known."""
    vertex = s.x_vertex[x]
    first, end = t.first_successor[vertex], t.first_successor[vertex + 1]
    if d.scalars[MAY_PREEMPT] != 0 or first == end:
        return
    if is_used(m):
        while len(d.next_vertex) <= x:
            d.next_vertex.append(-1)
        d.next_vertex[x] = -1
        _find_next_place(t, s, load, d, m, x)
        return
    finish = now + s.x_left[x]
    for edge in range(first, end):
        delay = delay_of(t, s, load, x, edge)
        if delay != 0:
            _post(s, d, max(now, finish + delay), x, t.successors[edge])


def _find_next_place(
    t: Tables, s: State, load: Workload, d: Deliveries, m: Machine, x: int
) -> None:
    """Find the next publication of an execution before its end, and its place."""
    vertex = s.x_vertex[x]
    last_place, last = m.publishes_at[x], d.next_vertex[x]
    place, after = NEVER, -1
    for edge in range(t.first_successor[vertex], t.first_successor[vertex + 1]):
        delay = delay_of(t, s, load, x, edge)
        if delay < 0:
            at, to = max(0, s.x_cost[x] + delay), t.successors[edge]
            if ((last < 0 or at > last_place or (at == last_place and to > last))
                    and (at < place or (at == place and to < after))):
                place, after = at, to
    m.publishes_at[x] = place
    d.next_vertex[x] = after


def ends_sending(
    t: Tables, s: State, key: KeyFunction, load: Workload, d: Deliveries, m: Machine, x: int,
    now: int,
) -> None:
    """End an execution, and send its messages."""
    slot, vertex = s.x_slot[x], s.x_vertex[x]
    job = s.job_index[slot]
    if is_used(m):
        while m.publishes_at[x] < NEVER:
            _publish_next(t, s, key, load, d, m, x, now)
    if len(load.fates) > 0 and load.fates[place_of(s, load, x)] == FAILS:
        fail(t, s, key, x, now)
    else:
        if s.job_state[slot] == OPEN:
            _withhold_unsent(t, s, load, x, now)
        complete(t, s, key, x, now)
    preemptive = d.scalars[MAY_PREEMPT] != 0
    for edge in range(t.first_successor[vertex], t.first_successor[vertex + 1]):
        delay = delay_of(t, s, load, x, edge)
        if delay == 0 or (delay < 0 and preemptive):
            _arrive(t, s, key, slot, job, t.successors[edge], now)
        elif delay > 0 and (is_used(m) or preemptive):
            _post(s, d, now + delay, x, t.successors[edge])


def _withhold_unsent(t: Tables, s: State, load: Workload, x: int, now: int) -> None:
    """Leave out of a job what an execution that ends might have started, but has not."""
    vertex = s.x_vertex[x]
    for edge in range(t.first_successor[vertex], t.first_successor[vertex + 1]):
        if t.is_optional[edge] != 0 and delay_of(t, s, load, x, edge) >= NEVER:
            withhold(t, s, s.x_slot[x], t.successors[edge], now)


def arrive_due(
    t: Tables, s: State, key: KeyFunction, load: Workload, d: Deliveries, m: Machine, now: int
) -> None:
    """Satisfy the edges whose messages arrive now, in the order of sending."""
    while len(d.messages) > 0 and d.messages[0][0] <= now:
        message = heappop(d.messages)
        _arrive(t, s, key, message[2], message[3], message[4], now)
    if is_used(m):  # publications of running executions before their end
        for worker in range(len(s.worker_x)):
            x = s.worker_x[worker]
            if x >= 0 and m.publishes_at[x] < NEVER:
                at = progress(s, x, now)
                while m.publishes_at[x] <= at:
                    _publish_next(t, s, key, load, d, m, x, now)


def _publish_next(
    t: Tables, s: State, key: KeyFunction, load: Workload, d: Deliveries, m: Machine, x: int,
    now: int,
) -> None:
    slot, after = s.x_slot[x], d.next_vertex[x]
    _find_next_place(t, s, load, d, m, x)
    _arrive(t, s, key, slot, s.job_index[slot], after, now)


def _post(s: State, d: Deliveries, time: int, x: int, vertex: int) -> None:
    slot = s.x_slot[x]
    if time < NEVER:
        d.scalars[SENT] += 1
        heappush(d.messages, (time, d.scalars[SENT], slot, s.job_index[slot], vertex))


def _arrive(
    t: Tables, s: State, key: KeyFunction, slot: int, job: int, vertex: int, now: int
) -> None:
    if (s.job_state[slot] == OPEN and s.job_index[slot] == job
            and s.job_dag[slot] == t.dag_of[vertex]):
        satisfy_edge(t, s, key, slot, vertex, now)

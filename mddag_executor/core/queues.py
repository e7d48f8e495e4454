# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The queues in which executions wait: rules 3, 4, 9, 11 and 12 (see ``rules``).

Theory of operation
-------------------
A waiting execution is in exactly one of

* the ready queue (``State.ready``), a heap by the keys of the policy;
* the heap of its callback group (``State.group_heap``), if the group was busy when it came first;
* the heap of deferred executions (``State.held_back``), if an execution as urgent held the
interpreter when it came first, or no worker of its process was idle;
* under a policy that polls, the queue of its *entity* (``State.entity_queue``), as in the wait set
of rclpy and rclcpp: a timer, or a subscription with its waiting messages.

A dropped execution leaves a *stale* entry, until the entry reaches the top or stale entries are
the larger part of all.  So does one whose key changes (rule 7); if it gets an earlier key back, it
has two equal entries, and one of them counts as stale.

**Polling rounds** (rule 9).  Between two polls the ready queue is the result of the last one;
executions that become ready wait at their entity, in that order.  ``poll`` takes the first of
every entity, so each entity runs at most once in a round.  Undeclared executions share one queue,
in which every entry counts as a separate entity.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush

from mddag_executor.core.state import (
    N_HOLDING,
    N_STALE,
    QueueEntry,
    State,
    WAITING,
)
from mddag_executor.core.tables import Tables

TURN_NS = 1_000_000
"""No overtaking if the holder needs less time than this: Python switches threads no sooner."""
PATIENCE = 2
"""Overtaking pays if the wait for the interpreter, times this, reaches RAD minus release."""
SWEEP_AT = 64
"""How many stale entries are always allowed in the queues."""


def is_stale(s: State, entry: QueueEntry) -> bool:
    """Return whether an entry is of a dropped execution (whose id may be in use again)."""
    return s.x_state[entry[4]] != WAITING or s.x_key[entry[4]] != entry


def add_stale(s: State) -> None:
    """Count one more stale entry; remove all when they are the larger part."""
    s.scalars[N_STALE] += 1
    if s.scalars[N_STALE] > SWEEP_AT:
        _sweep(s)


def _sweep(s: State) -> None:
    """Remove stale entries from all queues when they are the larger part: memory is bounded."""
    length = len(s.ready) + len(s.held_back)
    for group in range(len(s.group_heap)):
        length += len(s.group_heap[group])
    for entity in range(len(s.entity_queue)):
        length += len(s.entity_queue[entity])
    if 2 * s.scalars[N_STALE] <= length:
        return
    seen = [False] * len(s.x_state)
    _keep_valid(s, s.ready, seen)
    _keep_valid(s, s.held_back, seen)
    for group in range(len(s.group_heap)):
        _keep_valid(s, s.group_heap[group], seen)
    for entity in range(len(s.entity_queue)):
        _keep_valid(s, s.entity_queue[entity], seen)
    kept = 0
    for i in range(len(s.unpolled)):
        if len(s.entity_queue[s.unpolled[i]]) > 0:
            s.unpolled[kept] = s.unpolled[i]
            kept += 1
    del s.unpolled[kept:]
    s.scalars[N_STALE] = 0


def _keep_valid(s: State, heap: list[QueueEntry], seen: list[bool]) -> None:
    """Keep the entries that are not stale, of two equal ones the first."""
    kept = 0
    for i in range(len(heap)):
        x = heap[i][4]
        if not is_stale(s, heap[i]) and not seen[x]:
            seen[x] = True
            heap[kept] = heap[i]
            kept += 1
    del heap[kept:]
    heapify(heap)


def next_queue(t: Tables, s: State, first: bool) -> list[QueueEntry]:
    """
    Return the queue whose first entry is dispatched first; empty if there is none.

    Deferred executions count once they may start (rules 11 and 12).

    :param first: no execution has been set aside since a resource became free.
    """
    if s.scalars[N_STALE] > 0:
        _drop_stale(s, s.ready)
        _drop_stale(s, s.held_back)
    if len(s.overtaking) > 2:
        if first:
            _bring_forward(t, s)
        return s.ready
    if len(s.held_back) == 0 or (len(s.ready) > 0 and s.ready[0] < s.held_back[0]):
        return s.ready
    return s.held_back if may_start(t, s, s.held_back[0]) else s.ready


def _bring_forward(t: Tables, s: State) -> None:
    """Move deferred executions that may start now into the ready queue."""
    kept = 0
    for i in range(len(s.held_back)):
        entry = s.held_back[i]
        if not is_stale(s, entry) and may_start(t, s, entry):
            heappush(s.ready, entry)
        else:
            s.held_back[kept] = entry
            kept += 1
    del s.held_back[kept:]
    heapify(s.held_back)


def _drop_stale(s: State, queue: list[QueueEntry]) -> None:
    while queue and is_stale(s, queue[0]):
        heappop(queue)
        s.scalars[N_STALE] -= 1


def idle_worker(t: Tables, s: State, x: int) -> int:
    """Return the first idle worker, of its process if there are several; -1: there is none."""
    process = t.process[s.x_vertex[x]]
    for worker in range(len(s.worker_x)):
        if s.worker_x[worker] < 0 and (len(s.pool) == 0 or s.pool[worker] == process):
            return worker
    return -1


def may_start(t: Tables, s: State, entry: QueueEntry) -> bool:
    """
    Return whether a waiting execution may start.

    Its process must have an idle worker (rule 12), and no execution that is as urgent or more may
    hold the interpreter that it needs (rule 11).
    """
    interpreter = s.x_holds[entry[4]]
    if interpreter != 0 and s.scalars[N_HOLDING] > 0:
        for worker in range(len(s.worker_x)):
            x = s.worker_x[worker]
            if (x >= 0 and s.x_holds[x] == interpreter
                    and (s.overtaking[interpreter] == 0 or s.x_key[x][0] <= entry[0])):
                return False
    return len(s.pool) == 0 or idle_worker(t, s, entry[4]) >= 0


def first_waiting(t: Tables, s: State, process: int) -> int:
    """Return the first waiting execution of all, or of one process if there are several."""
    first = -1
    for queue in (s.ready, s.held_back):
        for i in range(len(queue) if len(s.overtaking) > 2 else min(1, len(queue))):
            x = queue[i][4]
            if ((len(s.overtaking) == 2 or t.process[s.x_vertex[x]] == process)
                    and (first < 0 or queue[i] < s.x_key[first])):
                first = x
    return first


def overtaking_pays(
    t: Tables, s: State, process: int, held: int, usual: int, preempts: bool
) -> bool:
    """
    Return whether the first waiting execution may overtake a holder of its interpreter (rule 11).

    The two would share the interpreter, which slows both down.  So the waiting execution is
    deferred if its wait is short compared with its relative deadline (RAD minus release).  (Not
    compared with the rest of that: if all are late, all would overtake.)

    :param held: how long the holder has held the interpreter; ``usual``: its usual duration, ns.
    :param preempts: whether the holder would pause meanwhile, so that the two share nothing.
    """
    # A holder that takes longer than usual is expected to go on for as long as it is over that.
    left = abs(usual - held)
    if left < TURN_NS or preempts:
        return left >= TURN_NS
    first = first_waiting(t, s, process)
    return first < 0 or PATIENCE * left >= t.rad_offset[s.x_vertex[first]]


def overtaking_pays_from(
    t: Tables, s: State, process: int, usual: int, preempts: bool
) -> int:
    """Return after which time of holding the interpreter overtaking pays again, ns."""
    first = -1 if preempts else first_waiting(t, s, process)
    wait = 0 if first < 0 else -(-t.rad_offset[s.x_vertex[first]] // PATIENCE)
    return usual + max(TURN_NS, wait)


def wait_for_poll(t: Tables, s: State, entry: QueueEntry) -> None:
    """Queue an execution at its entity until a poll (rule 9)."""
    x = entry[4]
    vertex = s.x_vertex[x]
    entity = t.entity[vertex]
    if vertex < t.n_vertices:  # each topic of a sync is a separate subscription
        leg = x - s.job_base[s.x_slot[x]] - t.region_offset[vertex]
        entity += t.leg_topic[t.first_leg[vertex] + leg]
    queue = s.entity_queue[entity]
    if len(queue) == 0:
        s.unpolled.append(entity)
    heappush(queue, entry)


def poll(t: Tables, s: State) -> None:
    """Begin a round: move the first of every entity to the ready queue, which is empty."""
    kept = 0
    for i in range(len(s.unpolled)):
        entity = s.unpolled[i]
        queue = s.entity_queue[entity]
        waits = True
        while queue and waits:
            entry = heappop(queue)
            if is_stale(s, entry):
                s.scalars[N_STALE] -= 1
            else:
                heappush(s.ready, entry)
                waits = entity == t.n_entities
        if queue:
            s.unpolled[kept] = entity
            kept += 1
    del s.unpolled[kept:]

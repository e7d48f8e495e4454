# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The queues in which executions wait: rules 3, 4 and 10 (see ``rules``).

Theory of operation
-------------------
Each callback has a *queue*: a vertex has one (with legs, each leg has one), and so has each
undeclared callback of a live run.  Executions that have not started wait in their queue in the
order of their keys.  The queue is a list linked by ``State.x_next``, and nearly every execution is
appended at its end.  The first execution of a queue runs first.  So messages of a callback keep
their order, even if keys change.

A queue that is not empty has exactly one *entry* in a heap, with the key of the queue
(``State.queue_key``).  The key of a queue is the smallest key of its executions, including those
that were dropped since the last one started.  If the queue is late, rule 7 gives its key.  So age
and place belong to the queue, and dropping an execution costs nothing.

An execution that has begun waits *alone*: it was preempted or refused, or it goes on after it has
waited.  It has an entry of its own, and does not stop the executions in the queue.  In simulation,
an undeclared execution has no queue, and waits alone as well.

Each entry is in exactly one of these heaps:

* the ready heap (``State.ready``), in the order of the policy's keys;
* the heap of a callback group (``State.group_heap``), if the group was busy when the entry came
first;
* the heap of an outer group (``State.outer_heap``), if the outer group had no place when the entry
came first;
* the heap of deferred entries (``State.deferred``), if an execution that is as urgent held the
interpreter when the entry came first.

An entry whose key changes is replaced in its heap, so no heap has an outdated entry.  Nearly
always the changed entry is the first one; only for another one the heap is searched.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush

from mddag_executor.core.state import (
    ALONE,
    DEFERRED,
    N_HOLDING,
    NO_PLACE,
    OUTER,
    PLACED,
    QueueEntry,
    READY,
    RETURNS,
    State,
    WAITING,
)
from mddag_executor.core.tables import Tables

TURN_NS = 1_000_000
"""No overtaking if the holder needs less time than this: Python switches threads no sooner."""
LONG_WAITS = 2
"""Overtaking pays if the wait for the interpreter, times this, reaches RAD minus release."""


def enqueue(t: Tables, s: State, x: int) -> None:
    """Let a fresh execution wait in the queue of its callback, in the order of its key."""
    queue = s.x_queue[x]
    entry = s.x_key[x]
    s.x_started[x] = -1
    s.x_state[x] = WAITING
    before = s.queue_last[queue]
    if before < 0:
        s.queue_first[queue] = s.queue_last[queue] = x
        s.queue_key[queue] = entry
        heappush(s.ready, entry)
        return
    after = -1
    while before >= 0 and entry < s.x_key[before]:
        after = before
        before = s.x_previous[before]
    _link(s, queue, before, x)
    _link(s, queue, x, after)
    # while an undeclared queue is late, no execution in it counts as in time (rule 7)
    if entry < s.queue_key[queue] and (
            s.queue_demoted[queue] < 0 or s.x_vertex[x] < t.n_vertices):
        change_key(s, queue, entry)


def wait_alone(s: State, x: int) -> None:
    """Let an execution wait with an entry of its own, not in a queue."""
    key = s.x_key[x]
    s.x_key[x] = (min(key[0], s.x_urged[x]), key[1], key[2], key[3], ~x)
    s.x_state[x] = ALONE
    heappush(s.ready, s.x_key[x])


def urge(s: State, x: int, priority: int) -> None:
    """Let the owner of a callback group have the priority of one that waits for it (rule 4)."""
    key = s.x_key[x]
    s.x_urged[x] = priority
    if s.x_state[x] == ALONE:
        unlink(s, x)
        wait_alone(s, x)
    else:
        s.x_key[x] = (priority, key[1], key[2], key[3], key[4])


def _link(s: State, queue: int, before: int, after: int) -> None:
    """Let an execution follow another one in a queue; -1: there is none."""
    if before < 0:
        s.queue_first[queue] = after
    else:
        s.x_next[before] = after
    if after < 0:
        s.queue_last[queue] = before
    else:
        s.x_previous[after] = before


def put(s: State, entry: QueueEntry) -> None:
    """Add the entry of a queue that had none."""
    queue = entry[4]
    s.queue_key[queue] = entry
    heappush(s.ready, entry)


def unlink(s: State, x: int) -> None:
    """Take a waiting execution out of its queue, or away with its entry."""
    if s.x_state[x] == ALONE:
        remove(s.ready, ~x)
        remove(s.deferred, ~x)
        if s.x_group[x] >= 0:
            remove(s.group_heap[s.x_group[x]], ~x)
        if s.x_outer[x] >= 0:
            remove(s.outer_heap[s.x_outer[x]], ~x)
        return
    queue = s.x_queue[x]
    is_first = s.queue_first[queue] == x
    _link(s, queue, s.x_previous[x], s.x_next[x])
    s.x_next[x] = s.x_previous[x] = -1
    if s.queue_first[queue] < 0:
        remove(heap_at(s, s.queue_place[queue]), queue)
        s.queue_place[queue] = READY
        s.queue_demoted[queue] = -1
    elif is_first and s.queue_place[queue] != READY:
        # the next one may be of another group, or not need the interpreter
        change_key(s, queue, s.queue_key[queue])


def heap_at(s: State, place: int) -> list[QueueEntry]:
    """Return the heap at a place."""
    if place >= 0:
        return s.group_heap[place]
    if place <= OUTER:
        return s.outer_heap[OUTER - place]
    return s.deferred if place == DEFERRED else s.ready


def change_key(s: State, queue: int, entry: QueueEntry) -> None:
    """Replace the entry of a queue, and let it come forward: its first execution may be new."""
    heap = heap_at(s, s.queue_place[queue])
    s.queue_key[queue] = entry
    if s.queue_place[queue] == READY:
        heap[_place_of(heap, queue)] = entry
        heapify(heap)
    else:
        remove(heap, queue)
        come_forward(s, entry)


def come_forward(s: State, entry: QueueEntry) -> None:
    """Put an entry that was set aside into the ready heap."""
    if entry[4] >= 0:
        s.queue_place[entry[4]] = READY
    heappush(s.ready, entry)


def has_place(s: State, x: int) -> bool:
    """Return whether an execution may run as far as its outer group is concerned (rule 4)."""
    outer = s.x_outer[x]
    if outer < 0 or s.x_place[x] == PLACED:
        return True
    limit = s.outer_limit[outer]
    if limit < 1 and s.x_place[x] == RETURNS:
        limit = 1  # an execution that has begun goes on, even if its group is closed
    return s.outer_running[outer] < limit


def wait_for_outer(s: State, entry: QueueEntry, outer: int) -> None:
    """Set an entry aside until its outer group has a place (rule 4)."""
    if entry[4] >= 0:
        s.queue_place[entry[4]] = OUTER - outer
    heappush(s.outer_heap[outer], entry)


def call_next(s: State, outer: int) -> None:
    """Bring what waits first for a free place of an outer group forward."""
    heap = s.outer_heap[outer]
    if len(heap) == 0:
        return
    if has_place(s, first_of(s, heap[0])):
        come_forward(s, heappop(heap))
    elif s.outer_limit[outer] < 1 and s.outer_running[outer] == 0:
        _call_returning(s, heap)


def _call_returning(s: State, heap: list[QueueEntry]) -> None:
    """Bring those forward that go on although their outer group is closed."""
    kept = 0
    for i in range(len(heap)):
        entry = heap[i]
        if s.x_place[first_of(s, entry)] == RETURNS:
            come_forward(s, entry)
        else:
            heap[kept] = entry
            kept += 1
    del heap[kept:]
    heapify(heap)


def leave_outer(s: State, x: int) -> None:
    """Give up the place of an execution in its outer group (rule 4)."""
    s.x_place[x] = NO_PLACE
    outer = s.x_outer[x]
    s.outer_running[outer] -= 1
    call_next(s, outer)


def open_outer(s: State, outer: int, limit: int, once: int) -> None:
    """
    Set how many executions of an outer group may run at a time (rule 4).

    :param once: 1: the group closes when the next one starts.
    """
    s.outer_limit[outer] = limit
    s.outer_once[outer] = once
    call_next(s, outer)


def first_of(s: State, entry: QueueEntry) -> int:
    """Return the first execution of the queue that an entry represents, or its own."""
    return s.queue_first[entry[4]] if entry[4] >= 0 else ~entry[4]


def _place_of(heap: list[QueueEntry], what: int) -> int:
    """Return the index of the entry of a queue, or ``~x``, in a heap; -1: it is not there."""
    for i in range(len(heap)):
        if heap[i][4] == what:
            return i
    return -1


def remove(heap: list[QueueEntry], what: int) -> bool:
    """Remove the entry of a queue, or ``~x``, from a heap; return whether it was there."""
    place = _place_of(heap, what)
    if place >= 0:
        last = heap.pop()
        if place < len(heap):
            heap[place] = last
            heapify(heap)
    return place >= 0


def next_heap(s: State) -> list[QueueEntry]:
    """
    Return the heap whose first entry is dispatched first; empty if there is none.

    A deferred execution counts once it may start (rule 10).
    """
    if len(s.deferred) == 0 or (len(s.ready) > 0 and s.ready[0] < s.deferred[0]):
        return s.ready
    return s.deferred if may_start(s, s.deferred[0]) else s.ready


def defer(s: State, heap: list[QueueEntry], deferred: list[QueueEntry]) -> None:
    """Move the first entry of a heap to the heap of deferred ones."""
    entry = heappop(heap)
    if entry[4] >= 0:
        s.queue_place[entry[4]] = DEFERRED
    heappush(deferred, entry)


def may_start(s: State, entry: QueueEntry) -> bool:
    """Return whether no execution that is as urgent or more holds its interpreter (rule 10)."""
    interpreter = s.x_holds[first_of(s, entry)]
    if interpreter != 0 and s.scalars[N_HOLDING] > 0:
        for worker in range(len(s.worker_x)):
            x = s.worker_x[worker]
            if (x >= 0 and s.x_holds[x] == interpreter
                    and (s.overtaking[interpreter] == 0 or s.x_key[x][0] <= entry[0])):
                return False
    return True


def first_waiting(s: State) -> int:
    """Return the first waiting execution; -1: there is none."""
    heap = s.ready
    if len(s.deferred) > 0 and (len(heap) == 0 or s.deferred[0] < heap[0]):
        heap = s.deferred
    return first_of(s, heap[0]) if len(heap) > 0 else -1


def overtaking_pays(
    t: Tables, s: State, first: int, held: int, usual: int, preempts: bool
) -> bool:
    """
    Return whether the first waiting execution may overtake a holder of its interpreter (rule 10).

    The two would share the interpreter, which slows both down.  So the waiting execution is
    deferred if its wait is short compared with its relative deadline (RAD minus release).  (Not
    compared with the rest of that: if all are late, all would overtake.)

    :param first: that execution; -1: there is none.
    :param held: how long the holder has held the interpreter; ``usual``: its usual duration, ns.
    :param preempts: whether the holder would pause meanwhile, so that the two share nothing.
    """
    # A holder that takes longer than usual is expected to go on for as long as it is over that.
    left = abs(usual - held)
    if left < TURN_NS or preempts:
        return left >= TURN_NS
    return first < 0 or LONG_WAITS * left >= _relative_deadline(t, s, first)


def overtaking_pays_from(
    t: Tables, s: State, first: int, usual: int, preempts: bool
) -> int:
    """Return after which time of holding the interpreter overtaking pays again, ns."""
    wait = 0 if first < 0 or preempts else -(-_relative_deadline(t, s, first) // LONG_WAITS)
    return usual + max(TURN_NS, wait)


def _relative_deadline(t: Tables, s: State, x: int) -> int:
    """Return RAD minus release of an execution, or of the one that it inherits from (rule 15)."""
    like = s.x_like[x]
    return t.rad_offset[like if like >= 0 else t.n_vertices]

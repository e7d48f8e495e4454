# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The queues in which executions wait: rules 3, 4, 9, 11 and 12 (see ``rules``).

Theory of operation
-------------------
Each callback has a *queue*: a vertex has one (with legs, each leg), and so has each undeclared
callback of a live run.  Executions that have not started wait in it in the order of their keys: a
list linked by ``State.x_next``, to which nearly all are appended.  Its first execution runs first.
So messages of a callback keep their order, whatever happens to keys.  A queue that is not empty
has exactly one *entry*, with the key of the queue (``State.queue_key``).  That is the smallest key
of its executions, also of those that were dropped since the last one started, or the one by rule 7
if it is late.  So age and place belong to the queue, and dropping an execution costs nothing.

An execution that has begun (it was preempted or refused, or goes on after it has waited) waits
*alone*: it has an entry of its own, and does not stop those in the queue.  So does an undeclared
one without a queue (simulation).

Each entry is in exactly one of

* the ready heap (``State.ready``), by the keys of the policy;
* the heap of a callback group (``State.group_heap``), if the group was busy when it came first;
* the heap of an outer group (``State.outer_heap``), if that had no place when it came first;
* the heap of what is deferred (``State.held_back``), if an execution as urgent held the
interpreter when it came first, or no worker of its process was idle;
* under a policy that polls, the list of what waits for a poll (``State.unpolled``).

An entry whose key changes is replaced where it is, so no heap has an outdated one.  It nearly
always is the first one; for any other the heap is searched, which is rare.

**Polling rounds** (rule 9).  Between two polls the ready heap is the result of the last one; what
becomes ready waits for the next one.  Of each *entity*, as in the wait set of rclpy and rclcpp (a
timer, or a subscription with its waiting messages), ``poll`` takes the first execution, so each
entity runs at most once in a round.  Vertices of one callback are one entity; undeclared queues
and executions are an entity each.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush

from mddag_executor.core.state import (
    ALONE,
    HELD_BACK,
    N_HOLDING,
    NO_PLACE,
    OUTER,
    PLACED,
    POLLING,
    QueueEntry,
    READY,
    RETURNS,
    State,
    UNPOLLED,
    WAITING,
)
from mddag_executor.core.tables import NEVER, Tables

TURN_NS = 1_000_000
"""No overtaking if the holder needs less time than this: Python switches threads no sooner."""
PATIENCE = 2
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
        if s.scalars[POLLING] == 0:  # not put(): a call less for each execution
            heappush(s.ready, entry)
        else:
            wait_for_poll(s, entry)
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
    s.x_key[x] = (key[0], key[1], key[2], key[3], ~x)
    s.x_state[x] = ALONE
    heappush(s.ready, s.x_key[x])


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
    if s.scalars[POLLING] == 0:
        heappush(s.ready, entry)
    else:
        wait_for_poll(s, entry)


def unlink(s: State, x: int) -> None:
    """Take a waiting execution out of its queue, or away with its entry."""
    if s.x_state[x] == ALONE:
        remove(s.ready, ~x)
        remove(s.held_back, ~x)
        remove(s.unpolled, ~x)
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
    elif is_first and s.queue_place[queue] != READY and s.queue_place[queue] != UNPOLLED:
        # the next one may be of another group, or not need the interpreter
        change_key(s, queue, s.queue_key[queue])


def heap_at(s: State, place: int) -> list[QueueEntry]:
    """Return the heap, or the list of what waits for a poll, at a place."""
    if place >= 0:
        return s.group_heap[place]
    if place <= OUTER:
        return s.outer_heap[OUTER - place]
    if place == HELD_BACK:
        return s.held_back
    return s.unpolled if place == UNPOLLED else s.ready


def change_key(s: State, queue: int, entry: QueueEntry) -> None:
    """Replace the entry of a queue, and let it come forward: its first execution may be new."""
    heap = heap_at(s, s.queue_place[queue])
    s.queue_key[queue] = entry
    if s.queue_place[queue] == READY or s.queue_place[queue] == UNPOLLED:
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
        limit = 1  # one that has begun goes on, also if its group is closed
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


def next_heap(t: Tables, s: State, first: bool) -> list[QueueEntry]:
    """
    Return the heap whose first entry is dispatched first; empty if there is none.

    What is deferred counts once it may start (rules 11 and 12).

    :param first: nothing has been set aside since a resource became free.
    """
    if len(s.overtaking) > 2:
        if first:
            _bring_forward(t, s)
        return s.ready
    if len(s.held_back) == 0 or (len(s.ready) > 0 and s.ready[0] < s.held_back[0]):
        return s.ready
    return s.held_back if may_start(t, s, s.held_back[0]) else s.ready


def _bring_forward(t: Tables, s: State) -> None:
    """Move what is deferred, and may start now, into the ready heap."""
    kept = 0
    for i in range(len(s.held_back)):
        entry = s.held_back[i]
        if may_start(t, s, entry):
            come_forward(s, entry)
        else:
            s.held_back[kept] = entry
            kept += 1
    del s.held_back[kept:]
    heapify(s.held_back)


def idle_worker(t: Tables, s: State, x: int) -> int:
    """Return the first idle worker, of its process if there are several; -1: there is none."""
    process = t.process[s.x_vertex[x]]
    for worker in range(len(s.worker_x)):
        if s.worker_x[worker] < 0 and (len(s.pool) == 0 or s.pool[worker] == process):
            return worker
    return -1


def may_start(t: Tables, s: State, entry: QueueEntry) -> bool:
    """
    Return whether what waits with an entry may start.

    Its process must have an idle worker (rule 12), and no execution that is as urgent or more may
    hold the interpreter that it needs (rule 11).
    """
    interpreter = s.x_holds[first_of(s, entry)]
    if interpreter != 0 and s.scalars[N_HOLDING] > 0:
        for worker in range(len(s.worker_x)):
            x = s.worker_x[worker]
            if (x >= 0 and s.x_holds[x] == interpreter
                    and (s.overtaking[interpreter] == 0 or s.x_key[x][0] <= entry[0])):
                return False
    return len(s.pool) == 0 or idle_worker(t, s, first_of(s, entry)) >= 0


def first_waiting(t: Tables, s: State, process: int) -> int:
    """Return the first waiting execution of all, or of one process if there are several."""
    first = -1
    smallest = (NEVER, 0, 0, 0, 0)
    for heap in (s.ready, s.held_back):
        for i in range(len(heap) if len(s.overtaking) > 2 else min(1, len(heap))):
            if heap[i] < smallest:
                x = first_of(s, heap[i])
                if len(s.overtaking) == 2 or t.process[s.x_vertex[x]] == process:
                    first = x
                    smallest = heap[i]
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


def wait_for_poll(s: State, entry: QueueEntry) -> None:
    """Let an entry wait for the next poll (rule 9)."""
    if entry[4] >= 0:
        s.queue_place[entry[4]] = UNPOLLED
    s.unpolled.append(entry)


def poll(t: Tables, s: State) -> None:
    """Begin a round: move the first of every entity to the ready heap, which is empty."""
    for i in range(len(s.unpolled)):
        entity = _entity(t, s.unpolled[i])
        if entity >= 0:
            s.first_order[entity] = min(s.first_order[entity], s.unpolled[i][1])
    kept = 0
    for i in range(len(s.unpolled)):
        entry = s.unpolled[i]
        entity = _entity(t, entry)
        if entity < 0 or entry[1] == s.first_order[entity]:
            come_forward(s, entry)
        else:
            s.unpolled[kept] = entry
            kept += 1
    del s.unpolled[kept:]
    for entity in range(len(s.first_order)):
        s.first_order[entity] = NEVER


def _entity(t: Tables, entry: QueueEntry) -> int:
    """Return the entity of what waits for a poll, -1: its own; each topic of a sync is one."""
    queue = entry[4]
    if queue < 0 or queue >= len(t.leg_topic):
        return -1
    return entry[0] + t.leg_topic[queue]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Late queues and importance: rules 7 and 12 of the scheduling rules, which ``rules`` lists.

What comes first is checked (``demote``) after ``State.start_by`` of its vertex.  That is the
latest start with which all its sinks are in time, or the past if the vertex gives way to more
important ones.  So work that is in time costs one comparison.  Like ``rules`` this module contains
only integer arithmetic, list indexing and ``heapq``.

docs/overload.md names the sources.
"""

from __future__ import annotations

from heapq import heappop

from mddag_executor.core.inheritance import undeclared_priority
from mddag_executor.core.jobs import demotes, judge
from mddag_executor.core.queues import change_key, come_forward
from mddag_executor.core.state import (
    ALONE,
    DEADLINE_KEYS,
    ELSEWHERE,
    OPEN,
    QueueEntry,
    SINK_DEMOTED,
    START_KEYS,
    State,
    URGENCY,
)
from mddag_executor.core.tables import IMPORTANT, NEVER, Tables

LATE_DEADLINES = 6
"""
A late queue is ordered as if it were released this many relative deadlines later.

It is found late at the latest one deadline after its release, and its turn is at the latest one
deadline after its new release: eight in all.  The release may be one deadline after the last
start, and one deadline is left for what runs already or has its turn at the same time.  So each
callback starts once in ten of its relative deadlines, however long the overload lasts.  Less
important work gives way to a late sink for this many.
"""
PPM = 1_000_000


def demote(t: Tables, s: State, heap: list[QueueEntry], x: int, now: int) -> bool:
    """
    Check what comes first in a heap, with its execution, which may be late (rule 7).

    :return: whether it has a larger key now, with which it is in the ready heap.
    """
    entry = heap[0]
    priority = NEVER
    if entry[4] >= 0 or s.x_like[x] >= 0 or s.x_started[x] < 0:
        priority = _priority_in_time(t, s, x, now)
        if priority == NEVER:
            priority = _late_priority(t, s, x, now)
        if entry[4] < 0:
            priority = min(priority, s.x_urged[x])
    if priority == NEVER or priority <= entry[0]:
        return False
    heappop(heap)
    entry = (priority, entry[1], entry[2], entry[3], entry[4])
    if entry[4] >= 0:
        s.queue_key[entry[4]] = entry
    else:
        s.x_key[x] = entry
    come_forward(s, entry)
    return True


def _priority_in_time(t: Tables, s: State, x: int, now: int) -> int:
    """
    Return the priority of the first execution, from one on in its queue, that can be in time.

    NEVER: there is none.  In an overload the mean execution times of those before it count.  A
    queue whose first execution was late gets no larger priority than a late queue.  Sinks at which
    the given one is late are noted.
    """
    vertex = s.x_vertex[x]
    if vertex == t.n_vertices:
        return undeclared_priority(t, s, x, now)
    process = s.process[vertex]
    yields = _still_gives_way(t, s, vertex, now)
    begin = now
    if s.x_started[x] >= 0:  # it was preempted
        begin -= max(0, s.x_cost[x] - s.x_left[x])  # less than 0: overheads
    each = x
    while each >= 0:
        slot = s.x_slot[each]
        release = s.job_release[slot]
        deadline = NEVER
        start = NEVER
        for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
            if yields or begin > release + s.reach_by[i]:
                if each == x:
                    note_late(t, s, t.reach_sink[i], now)
                    _announce_demoted(t, s, slot, t.reach_sink[i], now)
            else:
                deadline = min(deadline, t.reach_deadline[i])
                start = min(start, t.reach_start[i])
        if deadline < NEVER:
            priority = _priority(t, s, vertex, release, deadline, start)
            queue = s.x_queue[x]
            if s.x_state[x] != ALONE and (each != x or s.queue_demoted[queue] >= 0):
                priority = min(priority, _aged_priority(t, s, vertex, queue, now))
            return priority
        if s.overloaded[process] != 0:
            begin += s.mean[vertex]
        each = s.x_next[each]
    return NEVER


def _aged_priority(t: Tables, s: State, vertex: int, queue: int, now: int) -> int:
    """Return the largest priority of a queue whose first execution was late, since it was."""
    if s.queue_demoted[queue] < 0:
        s.queue_demoted[queue] = now + LATE_DEADLINES * t.late_deadline[t.dag_of[vertex]]
    return _priority_of_turn(t, s, vertex, s.queue_demoted[queue])


def _late_priority(t: Tables, s: State, x: int, now: int) -> int:
    """Return the priority of a late queue, or late execution that waits alone."""
    slot, vertex, queue = s.x_slot[x], s.x_vertex[x], s.x_queue[x]
    if s.x_state[x] == ALONE:
        queue = -1
    release = s.job_demoted[slot]
    if queue >= 0 and s.queue_demoted[queue] >= 0 and (
            release < 0 or s.queue_demoted[queue] < release):
        release = s.queue_demoted[queue]
    if release < 0:
        release = now + LATE_DEADLINES * t.late_deadline[t.dag_of[vertex]]
    if s.job_demoted[slot] < 0:
        s.job_demoted[slot] = release
    if queue >= 0:
        s.queue_demoted[queue] = release
    return _priority_of_turn(t, s, vertex, release)


def _priority_of_turn(t: Tables, s: State, vertex: int, release: int) -> int:
    """Return the priority of a late vertex that counts as released at a time."""
    priority = _priority(t, s, vertex, release, t.rad_offset[vertex], t.latest_start[vertex])
    return min(priority, release + t.late_deadline[t.dag_of[vertex]])


def take_turn(s: State, x: int) -> None:
    """Let the job of an execution that starts in a late queue be as old at its later vertices."""
    slot, turn = s.x_slot[x], s.queue_demoted[s.x_queue[x]]
    if s.job_demoted[slot] < 0 or turn < s.job_demoted[slot]:
        s.job_demoted[slot] = turn


def _priority(t: Tables, s: State, vertex: int, release: int, deadline: int, start: int) -> int:
    """Return the priority by a policy whose keys are times."""
    if s.scalars[URGENCY] == DEADLINE_KEYS:
        return release + deadline
    if s.scalars[URGENCY] == START_KEYS:
        return release + start
    return release + t.dag_deadline[t.dag_of[vertex]]


def next_entry(t: Tables, s: State, queue: int, now: int) -> QueueEntry:
    """Return the entry of a queue whose first execution starts now, for the next one."""
    after = s.queue_first[queue]
    entry = s.x_key[after]
    if s.queue_demoted[queue] >= 0:
        s.queue_demoted[queue] = -1
        if s.x_vertex[after] == t.n_vertices:  # it remains late until it is empty
            late = _late_priority(t, s, after, now)
            priority = min(late, undeclared_priority(t, s, after, now))
            entry = (priority, entry[1], entry[2], entry[3], queue)
    return entry


def is_late(t: Tables, s: State, x: int, now: int) -> bool:
    """Return whether a waiting execution that starts now can be in time at no sink (rule 7)."""
    vertex = s.x_vertex[x]
    release = s.job_release[s.x_slot[x]]
    if now <= release + s.start_by[vertex]:
        return False
    if not _still_gives_way(t, s, vertex, now):
        for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
            if now <= release + s.reach_by[i]:
                return False
    return True


def announce_late(t: Tables, s: State, x: int, now: int) -> None:
    """Note that an execution, which is to be dropped, is late at all of its sinks."""
    for i in range(t.first_reach[s.x_vertex[x]], t.first_reach[s.x_vertex[x] + 1]):
        note_late(t, s, t.reach_sink[i], now)
        _announce_demoted(t, s, s.x_slot[x], t.reach_sink[i], now)


def drop_late(t: Tables, s: State, x: int, now: int) -> None:
    """Demote the queue of an execution that is late, and was just dropped from it."""
    queue = s.x_queue[x]
    priority = _late_priority(t, s, x, now)
    key = s.x_key[s.queue_first[queue]]
    if s.x_vertex[x] == t.n_vertices or priority < key[0]:
        key = (priority, key[1], key[2], key[3], queue)
    change_key(s, queue, key)


def set_start(t: Tables, s: State, vertex: int) -> None:
    """Set from when on an execution of a vertex that comes first is checked."""
    s.start_by[vertex] = NEVER
    if gives_way(t, s, vertex):
        s.start_by[vertex] = -NEVER
    elif demotes(t, s, t.dag_of[vertex]):
        for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
            s.start_by[vertex] = min(s.start_by[vertex], s.reach_by[i])


# --- importance ----------------------------------------------------------------------------------

def admit(t: Tables, s: State) -> None:
    """
    Set which importance gives way in each process (rule 12), and whether the rest is too much.

    A driver calls this at the begin and when the execution times have changed.
    """
    changed = False
    for process in range(1, len(s.overtaking)):
        below = s.late_importance[process]
        s.overloaded[process] = 1
        for importance in range(IMPORTANT + 1):
            demand, held = _demand(t, s, process, importance)
            if demand > 0 and importance > below:
                below = importance
            if demand <= s.n_workers[process] * PPM and held <= PPM:
                s.overloaded[process] = int(importance > below)
                break
        changed = changed or below != s.demoted_below[process]
        s.demoted_below[process] = below
    if changed:
        for vertex in range(t.n_vertices):
            set_start(t, s, vertex)


def _demand(t: Tables, s: State, process: int, importance: int) -> tuple[int, int]:
    """Return the utilisation by vertices of at least some importance, and by those that hold."""
    demand = 0
    held = 0
    for v in range(t.n_vertices):
        if (t.importance[v] >= importance and s.expected[v] != ELSEWHERE
                and s.process[v] == process):
            share = s.mean[v] * PPM // t.period[t.dag_of[v]]
            demand += share
            if s.holder[v] != 0:
                held += share
    return demand, held


def gives_way(t: Tables, s: State, vertex: int) -> bool:
    """Return whether all jobs are demoted at a vertex, for more important ones (rule 12)."""
    return (t.importance[vertex] < s.demoted_below[s.process[vertex]]
            and demotes(t, s, t.dag_of[vertex]))


def _still_gives_way(t: Tables, s: State, vertex: int, now: int) -> bool:
    """Return whether a vertex gives way now: to a late sink it does only for a while."""
    process = s.process[vertex]
    if now > s.late_until[process] and s.late_importance[process] > 0:
        s.late_importance[process] = 0
        admit(t, s)
    return gives_way(t, s, vertex)


def note_late(t: Tables, s: State, sink: int, now: int) -> None:
    """Note that a sink is late: less important work gives way to it for a while (rule 12)."""
    if not demotes(t, s, t.dag_of[sink]) or gives_way(t, s, sink):
        return  # late jobs of the DAG are not demoted, or it must itself give way
    process = s.process[sink]
    if t.importance[sink] >= s.late_importance[process]:
        s.late_until[process] = now + LATE_DEADLINES * t.sink_deadline[sink]
    if t.importance[sink] > s.late_importance[process]:
        s.late_importance[process] = t.importance[sink]
        admit(t, s)


def _announce_demoted(t: Tables, s: State, slot: int, vertex: int, now: int) -> None:
    """Report once that a sink of an open job is demoted."""
    head = s.job_base[slot] + t.region_offset[vertex]
    job = s.job_index[slot]
    if s.job_state[slot] == OPEN and s.x_demoted[head] != job and s.x_pending[head] >= 0:
        s.x_demoted[head] = job
        judge(t, s, slot, SINK_DEMOTED, vertex, s.job_release[slot] + t.sink_deadline[vertex], now)

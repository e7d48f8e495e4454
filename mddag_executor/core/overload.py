# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Demoted jobs: rules 7 and 14 of the scheduling rules, which ``rules`` lists.

An execution is checked (``demote``) when it comes first in a queue after ``State.start_by`` of its
vertex.  That is the latest start with which all its sinks are in time; or the past if every
execution of the vertex must be checked, because an older one is demoted or the vertex gives way to
more important ones.  So work that is in time costs one comparison.  Like ``rules`` this module
contains only integer arithmetic, list indexing and ``heapq``.

docs/run.md names the sources.
"""

from __future__ import annotations

from heapq import heappop, heappush

from mddag_executor.core.jobs import demotes, judge
from mddag_executor.core.queues import add_stale
from mddag_executor.core.state import (
    DEADLINE_KEYS,
    ELSEWHERE,
    OPEN,
    OTHER_KEYS,
    SINK_DEMOTED,
    START_KEYS,
    State,
    URGENCY,
    WAITING,
)
from mddag_executor.core.tables import IMPORTANT, NEVER, Tables

LATE_PATIENCE = 10
"""
A demoted job is ordered as if it were released this many relative deadlines after that.

So its callbacks run, however long the overload lasts, with about a tenth of what they need.
Less important work gives way to a late sink for as many of the sink's relative deadlines.
"""
PPM = 1_000_000


def demote(t: Tables, s: State, x: int, now: int) -> bool:
    """
    Change the key of the execution that comes first in a queue, or of an older one (rules 7, 14).

    :return: whether a key changed; the old entry is then stale.
    """
    key = s.x_key[x]
    vertex = s.x_vertex[x]
    if vertex == t.n_vertices:
        return demote_undeclared(t, s, x, now)
    demoted = s.demoted[vertex]
    while demoted and (s.x_state[demoted[0][4]] != WAITING
                       or s.x_key[demoted[0][4]][3] != demoted[0][0]):
        heappop(demoted)  # it has started or was dropped
        if len(demoted) == 0:
            set_start(t, s, vertex)
    if s.urged[vertex] == key[3]:
        return False  # it has the key of another one
    fresh = s.x_started[x] < 0
    first = -1
    if fresh and demoted and demoted[0][0] < key[3]:
        first = demoted[0][4]
    priority = late_priority(t, s, x, first, now)
    if priority > key[0]:
        if fresh:
            heappush(demoted, (key[3], 0, 0, 0, x))
            s.start_by[vertex] = -NEVER
        _change_key(s, x, priority)
        return True
    if first < 0 or s.x_key[first][0] <= key[0]:
        return False
    s.urged[vertex] = s.x_key[first][3]
    _change_key(s, first, key[0])
    return True


def demote_undeclared(t: Tables, s: State, x: int, now: int) -> bool:
    """Demote the first undeclared execution of a queue, once; return whether its key changed."""
    slot, vertex, queue = s.x_slot[x], s.x_vertex[x], s.x_queue[x]
    if s.x_started[x] >= 0 or s.job_demoted[slot] >= 0:
        return False
    s.job_demoted[slot] = now + LATE_PATIENCE * t.rad_offset[vertex]
    if queue >= 0:
        s.queue_late[queue] = 1
    priority = _priority(
        t, s, x, s.job_demoted[slot], t.rad_offset[vertex], t.latest_start[vertex])
    if priority > s.x_key[x][0]:
        _change_key(s, x, priority)
        return True
    return False


def _change_key(s: State, x: int, priority: int) -> None:
    key = s.x_key[x]
    s.x_key[x] = (priority, key[1], key[2], key[3], x)
    heappush(s.ready, s.x_key[x])
    add_stale(s)


def _priority(t: Tables, s: State, x: int, release: int, deadline: int, start: int) -> int:
    """Return the priority by a policy whose keys are times."""
    if s.scalars[URGENCY] == DEADLINE_KEYS:
        return release + deadline
    if s.scalars[URGENCY] == START_KEYS:
        return release + start
    return release + t.dag_deadline[s.job_dag[s.x_slot[x]]]


def late_priority(t: Tables, s: State, x: int, first: int, now: int) -> int:
    """
    Return the priority of an execution by the sinks that can be in time; if none, demote its job.

    :param first: the oldest demoted execution of its vertex if that is older, or -1.
    """
    slot = s.x_slot[x]
    vertex = s.x_vertex[x]
    process = _process(t, s, vertex)
    begin = now
    if first >= 0 and s.overloaded[process] != 0:
        begin += len(s.demoted[vertex]) * s.mean[vertex]
    elif s.x_started[x] >= 0:  # it was preempted
        begin -= max(0, s.x_cost[x] - s.x_left[x])  # less than 0: overheads
    yields = _still_gives_way(t, s, vertex, now)
    deadline = NEVER
    start = NEVER
    for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
        sink = t.reach_sink[i]
        if yields or begin > s.job_hope[slot] + s.reach_by[i]:
            note_late(t, s, slot, sink, now)
            _announce_demoted(t, s, slot, sink, now)
        else:
            deadline = min(deadline, t.reach_deadline[i])
            start = min(start, t.reach_start[i])
    if deadline < NEVER:
        release = s.job_release[slot]
        if 0 <= s.waits_since[vertex] < release:
            release = s.waits_since[vertex]
        return _priority(t, s, x, release, deadline, start)
    if first >= 0:
        return s.x_key[first][0]
    if s.job_demoted[slot] < 0:
        s.job_demoted[slot] = now + LATE_PATIENCE * t.dag_deadline[s.job_dag[slot]]
        if s.passed_on[vertex] >= 0:
            s.job_demoted[slot] = s.passed_on[vertex]
            s.passed_on[vertex] = -1
    return _priority(
        t, s, x, s.job_demoted[slot], t.rad_offset[vertex], t.latest_start[vertex])


def is_late(t: Tables, s: State, x: int, now: int) -> bool:
    """Return whether an execution that starts now can be in time at no sink (rule 7)."""
    vertex = s.x_vertex[x]
    for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
        if now <= s.job_hope[s.x_slot[x]] + s.reach_by[i]:
            return False
    return vertex < t.n_vertices


def pass_on_age(t: Tables, s: State, x: int, now: int) -> None:
    """Let the next execution of a vertex go as early as this one, which is about to be dropped."""
    slot, vertex = s.x_slot[x], s.x_vertex[x]
    if vertex == t.n_vertices or s.scalars[URGENCY] == OTHER_KEYS:
        return
    if s.job_hope[slot] < NEVER and s.job_demoted[slot] < 0 and s.job_state[slot] == OPEN:
        late_priority(t, s, x, -1, now)  # demotes its job if that is late
    since = s.job_demoted[slot]
    if s.job_hope[slot] < NEVER and since >= 0:
        if s.passed_on[vertex] < 0 or since < s.passed_on[vertex]:
            s.passed_on[vertex] = since
    elif s.waits_since[vertex] < 0 or s.job_release[slot] < s.waits_since[vertex]:
        s.waits_since[vertex] = s.job_release[slot]


def inherit_age(t: Tables, s: State, x: int) -> None:
    """Let the first waiting execution of a vertex go as early as those dropped before it."""
    vertex = s.x_vertex[x]
    demoted, waits = s.passed_on[vertex], s.waits_since[vertex]
    if demoted < 0 and waits < 0 or s.x_state[x] != WAITING or s.x_started[x] >= 0:
        return
    offset, start = t.rad_offset[vertex], t.latest_start[vertex]
    if demoted >= 0:
        priority = _priority(t, s, x, demoted, offset, start)
        if priority < s.x_key[x][0]:
            s.urged[vertex] = s.x_key[x][3]
            _change_key(s, x, priority)
    if waits >= 0 and not gives_way(t, s, vertex):
        priority = _priority(t, s, x, waits, offset, start)
        if priority < s.x_key[x][0]:
            _change_key(s, x, priority)


def set_start(t: Tables, s: State, vertex: int) -> None:
    """Set from when on an execution of a vertex that comes first is checked."""
    if s.demoted[vertex] or gives_way(t, s, vertex):
        s.start_by[vertex] = -NEVER
        return
    s.start_by[vertex] = NEVER
    for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
        s.start_by[vertex] = min(s.start_by[vertex], s.reach_by[i])


# --- importance ----------------------------------------------------------------------------------

def admit(t: Tables, s: State) -> None:
    """
    Set which importance gives way in each process (rule 14), and whether the rest is too much.

    A driver calls this at the begin and when the execution times have changed.
    """
    changed = False
    for process in range(1, len(s.overtaking)):
        workers = len(s.worker_x)
        if len(s.pool) > 0:
            workers = 0
            for worker in range(len(s.pool)):
                workers += int(s.pool[worker] == process)
        below = s.late_importance[process]
        s.overloaded[process] = 1
        for importance in range(IMPORTANT + 1):
            demand, held = _demand(t, s, process, importance)
            if demand > 0 and importance > below:
                below = importance
            if demand <= workers * PPM and held <= PPM:
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
                and (len(s.pool) == 0 or t.process[v] == process)):
            share = s.mean[v] * PPM // t.period[t.dag_of[v]]
            demand += share
            if s.holder[v] != 0:
                held += share
    return demand, held


def gives_way(t: Tables, s: State, vertex: int) -> bool:
    """Return whether all jobs are demoted at a vertex, for more important ones (rule 14)."""
    return (t.importance[vertex] < s.demoted_below[_process(t, s, vertex)]
            and demotes(t, s, t.dag_of[vertex]))


def _still_gives_way(t: Tables, s: State, vertex: int, now: int) -> bool:
    """Return whether a vertex gives way now: to a late sink it does only for a while."""
    process = _process(t, s, vertex)
    if now > s.late_until[process] and s.late_importance[process] > 0:
        s.late_importance[process] = 0
        admit(t, s)
    return gives_way(t, s, vertex)


def _process(t: Tables, s: State, vertex: int) -> int:
    return 1 if len(s.pool) == 0 else t.process[vertex]


def note_late(t: Tables, s: State, slot: int, sink: int, now: int) -> None:
    """Note that a sink is late: less important work gives way to it for a while (rule 14)."""
    if s.job_hope[slot] == NEVER or gives_way(t, s, sink):
        return  # late jobs of the DAG are not demoted, or it must itself give way
    process = _process(t, s, sink)
    if t.importance[sink] >= s.late_importance[process]:
        s.late_until[process] = now + LATE_PATIENCE * t.sink_deadline[sink]
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

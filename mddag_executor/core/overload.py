# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Demoted jobs: rules 7 and 14 of the scheduling rules, which ``rules`` lists.

An execution is checked (``demote``) when it comes first in a queue after ``State.start_by`` of its
vertex.  That is the latest start with which all its sinks are in time; or the past if every
execution of the vertex must be checked, because an older one is demoted or the vertex is refused.
So work that is in time costs one comparison.  Like ``rules`` this module contains only integer
arithmetic, list indexing and ``heapq``.

docs/run.md names the sources.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush

from mddag_executor.core.jobs import demotes, judge
from mddag_executor.core.queues import add_stale, is_stale
from mddag_executor.core.state import (
    CHECK_AT,
    DEADLINE_KEYS,
    ELSEWHERE,
    N_IDLE,
    N_STALE,
    OPEN,
    PREEMPTIVE,
    REFUSES,
    SINK_DEMOTED,
    START_KEYS,
    State,
    URGENCY,
    WAITING,
)
from mddag_executor.core.tables import IMPORTANT, NEVER, Tables

LATE_PATIENCE = 10
"""A late job is ordered as if it were released this many relative deadlines after it was demoted:
so demoted callbacks run, however long the overload lasts, with about a tenth of what they need."""
USED_UP_PATIENCE = 1
"""The same for a sink that tolerates no further miss."""
REFUSED_PATIENCE = 100
"""The same for a refused job."""
RESERVED_PATIENCE = 10
"""A refused execution leaves room for as many relative deadlines, so long ones run, too: with 3,
0.4 % fewer important results are in time in the benchmark's sets at 1.2 interpreters."""
PPM = 1_000_000


def demote(t: Tables, s: State, x: int, now: int) -> bool:
    """
    Change the key of the execution that comes first in a queue, or of an older one (rules 7, 14).

    :return: whether a key changed; the old entry is then stale.
    """
    key = s.x_key[x]
    vertex = s.x_vertex[x]
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
        begin -= s.x_cost[x] - s.x_left[x]
    refused = _is_still_refused(t, s, vertex, now)
    patience = REFUSED_PATIENCE if refused else LATE_PATIENCE
    deadline = NEVER
    start = NEVER
    for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
        sink = t.reach_sink[i]
        if refused or begin > s.job_hope[slot] + s.reach_by[i]:
            if not refused and _is_used_up(t, s, sink, s.job_index[slot]):
                patience = USED_UP_PATIENCE
            note_miss(t, s, slot, sink, now)
            _announce_demoted(t, s, slot, sink, now)
        else:
            deadline = min(deadline, t.reach_deadline[i])
            start = min(start, t.reach_start[i])
    if deadline < NEVER:
        return _priority(t, s, x, s.job_release[slot], deadline, start)
    if first >= 0:
        return s.x_key[first][0]
    if s.job_demoted[slot] < 0:
        s.job_demoted[slot] = now + patience * t.dag_deadline[s.job_dag[slot]]
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


def inherit_age(t: Tables, s: State, x: int) -> None:
    """Let an execution that was just made ready go as early as one that was dropped before it."""
    vertex = s.x_vertex[x]
    if s.passed_on[vertex] < 0 or s.x_state[x] != WAITING:
        return
    priority = _priority(
        t, s, x, s.passed_on[vertex], t.rad_offset[vertex], t.latest_start[vertex])
    if priority < s.x_key[x][0]:
        s.urged[vertex] = s.x_key[x][3]
        _change_key(s, x, priority)


def set_start(t: Tables, s: State, vertex: int) -> None:
    """Set from when on an execution of a vertex that comes first is checked."""
    if s.demoted[vertex] or is_refused(t, s, vertex):
        s.start_by[vertex] = -NEVER
        return
    s.start_by[vertex] = NEVER
    for i in range(t.first_reach[vertex], t.first_reach[vertex + 1]):
        s.start_by[vertex] = min(s.start_by[vertex], s.reach_by[i])


# --- importance ----------------------------------------------------------------------------------

def admit(t: Tables, s: State) -> None:
    """
    Set which importance is refused in each process (rule 14), and whether the rest is too much.

    A driver calls this at the begin and when the execution times have changed.
    """
    changed = False
    s.scalars[REFUSES] = 0
    for process in range(1, len(s.overtaking)):
        workers = len(s.worker_x)
        if len(s.pool) > 0:
            workers = 0
            for worker in range(len(s.pool)):
                workers += int(s.pool[worker] == process)
        refused = s.refused_late[process]
        s.overloaded[process] = 1
        for importance in range(IMPORTANT + 1):
            demand, held = _demand(t, s, process, importance)
            if demand > 0 and importance > refused:
                refused = importance
            if demand <= workers * PPM and held <= PPM:
                s.overloaded[process] = int(importance > refused)
                break
        changed = changed or refused != s.refused_below[process]
        s.refused_below[process] = refused
        s.reserved_from[process] = -NEVER
        s.scalars[REFUSES] = max(s.scalars[REFUSES], refused)
    for dag in range(t.n_dags):
        s.interpreter_time[dag] = 0
    for vertex in range(t.n_vertices):
        if s.holder[vertex] != 0 and s.expected[vertex] != ELSEWHERE and (
                not is_refused(t, s, vertex)):
            s.interpreter_time[t.dag_of[vertex]] += s.mean[vertex]
        if changed:
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


def is_refused(t: Tables, s: State, vertex: int) -> bool:
    """Return whether jobs are refused at a vertex in its process, for more important ones."""
    return (t.importance[vertex] < s.refused_below[_process(t, s, vertex)]
            and demotes(t, s, t.dag_of[vertex]))


def _is_still_refused(t: Tables, s: State, vertex: int, now: int) -> bool:
    """Return whether jobs are refused at a vertex now: because of a late job only for a while."""
    process = _process(t, s, vertex)
    if now > s.refused_until[process] and s.refused_late[process] > 0:
        s.refused_late[process] = 0
        admit(t, s)
    return is_refused(t, s, vertex)


def leaves_room(t: Tables, s: State, x: int, now: int) -> bool:
    """
    Return whether an execution ends before its interpreter or worker is reserved (rule 14).

    Only refused ones may have to wait, for ``RESERVED_PATIENCE`` of their relative deadlines.
    """
    vertex = s.x_vertex[x]
    if (s.x_started[x] >= 0 or not _is_still_refused(t, s, vertex, now)
            or now >= s.x_key[x][0] - t.dag_deadline[t.dag_of[vertex]] * (
                REFUSED_PATIENCE + 1 - RESERVED_PATIENCE)
            or s.holder[vertex] == 0 and (s.scalars[N_IDLE] > 1 or s.scalars[PREEMPTIVE] != 0)):
        return True
    process = _process(t, s, vertex)
    if now > s.reserved_from[process]:
        s.reserved_from[process] = _next_start(t, s, process, now)
    if now + s.mean[vertex] <= s.reserved_from[process]:
        return True
    s.scalars[CHECK_AT] = min(s.scalars[CHECK_AT], s.reserved_from[process] + 1)
    return False


def _next_start(t: Tables, s: State, process: int, now: int) -> int:
    """Return until when the next jobs must start that are not refused and can be in time."""
    first = NEVER
    for dag in range(t.n_dags):
        source = t.source[dag]
        release = s.next_release[dag]
        if release + t.dag_deadline[dag] >= now and (
                _process(t, s, source) == process and not is_refused(t, s, source)):
            start = release + t.rad_offset[source]
            start -= _interpreter_time(t, s, now, start)
            for i in range(t.first_reach[source], t.first_reach[source + 1]):
                if s.reach_by[i] >= 0:
                    latest = max(release, min(start, release + s.reach_by[i]))
                    if latest >= now:
                        first = min(first, latest)
    return first


def _interpreter_time(t: Tables, s: State, now: int, until: int) -> int:
    """Return how long the next jobs with deadlines up to a time need the interpreter."""
    needed = 0
    for dag in range(t.n_dags):
        if now < s.next_release[dag] + t.rad_offset[t.source[dag]] <= until:
            needed += s.interpreter_time[dag]
    return needed


def return_reserved(t: Tables, s: State, now: int) -> None:
    """Put the deferred executions that may start now into the ready queue."""
    s.scalars[CHECK_AT] = NEVER
    kept = 0
    for i in range(len(s.reserved)):
        entry = s.reserved[i]
        if is_stale(s, entry):
            s.scalars[N_STALE] -= 1
        elif leaves_room(t, s, entry[4], now):
            heappush(s.ready, entry)
        else:
            s.reserved[kept] = entry
            kept += 1
    del s.reserved[kept:]
    heapify(s.reserved)


def _process(t: Tables, s: State, vertex: int) -> int:
    return 1 if len(s.pool) == 0 else t.process[vertex]


def _refuse_for(t: Tables, s: State, sink: int, now: int) -> None:
    """Refuse what is less important than a sink that missed a deadline, for a while."""
    process = _process(t, s, sink)
    if t.importance[sink] >= s.refused_late[process]:
        s.refused_until[process] = now + REFUSED_PATIENCE * t.sink_deadline[sink]
    if t.importance[sink] > s.refused_late[process]:
        s.refused_late[process] = t.importance[sink]
        admit(t, s)


# --- tolerated misses ----------------------------------------------------------------------------

def _is_used_up(t: Tables, s: State, sink: int, job: int) -> bool:
    """Return whether a sink tolerates no miss of this job: it has missed as many before."""
    if t.tolerated[sink] == 0:
        return False
    oldest = s.missed_jobs[t.first_miss[sink] + s.next_miss[sink]]
    return oldest > job - t.tolerated_of[sink]


def note_miss(t: Tables, s: State, slot: int, sink: int, now: int) -> None:
    """Note a job that misses the deadline of a sink; a job may be noted more than once."""
    if s.job_hope[slot] == NEVER:
        return  # late jobs of the DAG are not demoted
    if not is_refused(t, s, sink):
        _refuse_for(t, s, sink, now)
    misses = t.tolerated[sink]
    if misses == 0:
        return
    job = s.job_index[slot]
    first = t.first_miss[sink]
    place = s.next_miss[sink]
    if s.missed_jobs[first + (place + misses - 1) % misses] < job:
        s.missed_jobs[first + place] = job
        s.next_miss[sink] = (place + 1) % misses


def _announce_demoted(t: Tables, s: State, slot: int, vertex: int, now: int) -> None:
    """Report once that a sink of an open job is demoted."""
    head = s.job_base[slot] + t.region_offset[vertex]
    job = s.job_index[slot]
    if s.job_state[slot] == OPEN and s.x_demoted[head] != job and s.x_pending[head] >= 0:
        s.x_demoted[head] = job
        judge(s, slot, SINK_DEMOTED, vertex, s.job_release[slot] + t.sink_deadline[vertex], now)

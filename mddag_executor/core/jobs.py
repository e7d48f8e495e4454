# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Jobs as a whole: rules 1, 6, 8, 9, 11 and 13 of the scheduling rules, which ``rules`` lists.

Jobs are opened, judged and ended here, and their slots recycled.  Like ``rules`` this module
contains only integer arithmetic and list indexing.
"""

from __future__ import annotations

from mddag_executor.core.state import (
    ABORTED,
    COMPLETED,
    ELSEWHERE,
    EXPIRED,
    FREE,
    HERE,
    IDLE,
    JOB_END,
    JUDGE_FROM,
    JUDGE_UNTIL,
    LATE,
    LEADS_OUT,
    NOT_JUDGED,
    OPEN,
    OTHER_KEYS,
    OUTDATED,
    set_ending,
    SINK_ABORTED,
    SINK_DROPPED,
    SINK_IN_TIME,
    SINK_MISSED,
    SINK_NOT_DUE,
    SINK_OVERDUE,
    SKIP,
    State,
    URGENCY,
)
from mddag_executor.core.tables import AFTER_DRIVEN, DEMOTE, KEEP_NEWEST, NEVER, Tables


def release_job(t: Tables, s: State, dag: int, job: int, release: int, now: int) -> int:
    """
    Open a job (rule 1) and return its slot, or -1 when the DAG needs one more slot first.

    :param job: index of the job in its DAG, from 0.
    :param release: time its source became due, ns; not later than ``now``.
    """
    if s.oldest[dag] >= 0 and t.expire_after[dag] < NEVER:
        expire_idle(t, s, dag, now)
    if s.n_open[dag] >= t.max_active_jobs[dag]:
        give_up(t, s, s.oldest[dag], EXPIRED, now)
    slot = s.free_slot[dag]
    if slot < 0:
        return -1
    s.free_slot[dag] = s.job_next[slot]
    s.job_index[slot] = job
    s.job_release[slot] = release
    if s.scalars[SKIP] > 0 and s.scalars[JUDGE_FROM] == -NEVER:
        s.scalars[JUDGE_FROM] = release + s.scalars[SKIP]
    s.job_state[slot] = OPEN
    s.job_sinks_left[slot] = t.first_sink[dag + 1] - t.first_sink[dag]
    s.job_late[slot] = 0
    s.job_demoted[slot] = -1
    s.job_active[slot] = 0
    newest = s.newest[dag]
    s.job_previous[slot] = newest
    s.job_next[slot] = -1
    if newest < 0:
        s.oldest[dag] = slot
    else:
        s.job_next[newest] = slot
    s.newest[dag] = slot
    s.n_open[dag] += 1
    base = s.job_base[slot]
    for x in range(base, base + t.n_region[dag]):
        s.x_state[x] = IDLE
        s.x_pending[x] = t.n_predecessors[s.x_vertex[x]]
    if s.partial[dag] != 0:
        _leave_out(t, s, slot)
    return slot


def demotes(t: Tables, s: State, dag: int) -> bool:
    """Return whether jobs of a DAG are demoted when they are late, or give way (rule 7)."""
    return t.on_late[dag] == DEMOTE and s.scalars[URGENCY] != OTHER_KEYS


def source_depth(t: Tables, s: State, dag: int) -> int:
    """
    Return how many releases of a timer source may wait: as many as can be in time.

    They take no more than half of the open jobs: else a job would expire (rule 1) before its
    source has run, and its messages would belong to no job.  If its executions drop older ones,
    the last release may do so before it counts (rule 11).
    """
    drops = t.keep[t.source[dag]] == KEEP_NEWEST or demotes(t, s, dag)
    in_time = -(-t.dag_deadline[dag] // t.period[dag])
    return max(1, min(in_time, t.max_active_jobs[dag] // 2)) + int(drops)


def expect(t: Tables, s: State, dag: int, here: list[int]) -> None:
    """
    Set which vertices of a DAG are expected here (rule 9), for the jobs released from now on.

    :param here: by local index, 1 for a vertex that runs here and 0 for one that does not.
    """
    first = t.first_vertex[dag]
    s.partial[dag] = 0
    for i in range(len(here)):
        s.expected[first + i] = HERE
        if here[i] == 0:
            s.expected[first + i] = ELSEWHERE
            s.partial[dag] = 1
        else:
            for e in range(t.first_successor[first + i], t.first_successor[first + i + 1]):
                if here[t.successors[e] - first] == 0:
                    s.expected[first + i] = LEADS_OUT
        set_ending(t, s, first + i)


def _leave_out(t: Tables, s: State, slot: int) -> None:
    """Leave out of a new job what is not expected here, as if it had completed (rule 9)."""
    dag = s.job_dag[slot]
    for vertex in range(t.first_vertex[dag], t.first_vertex[dag + 1]):
        if s.expected[vertex] == ELSEWHERE:
            s.x_pending[s.job_base[slot] + t.region_offset[vertex]] = -1
            if t.sink_deadline[vertex] >= 0:
                s.job_sinks_left[slot] -= 1
        elif s.expected[vertex] == LEADS_OUT:
            s.job_sinks_left[slot] += 1


def judge_from(s: State, release: int) -> None:
    """Judge only jobs released from a time on (rule 6); NEVER: none for now."""
    s.scalars[JUDGE_FROM] = release + s.scalars[SKIP]


def is_judged(s: State, slot: int) -> bool:
    """Return whether a job was released after judging began, and before it ended (rule 6)."""
    return s.scalars[JUDGE_FROM] <= s.job_release[slot] < s.scalars[JUDGE_UNTIL]


def is_miss(kind: int) -> bool:
    """Return whether a decision is a miss: about a sink that was not in time (rule 6)."""
    return SINK_IN_TIME < kind < JOB_END


def judge(
    t: Tables, s: State, slot: int, kind: int, vertex: int, deadline: int, time: int
) -> None:
    """Decide the result of a job at a sink, if both are judged (rule 6)."""
    if t.judged[vertex] != 0 and (  # not is_judged(): one call less
            s.scalars[JUDGE_FROM] <= s.job_release[slot] < s.scalars[JUDGE_UNTIL]):
        s.decisions.append(
            (kind, s.job_dag[slot], vertex, s.job_index[slot], deadline, time))


def close_job(s: State, slot: int, end: int, now: int) -> None:
    """End an open job (rule 8): remove it from the list; free its slot if nothing is active."""
    judged = NOT_JUDGED
    if s.scalars[JUDGE_FROM] <= s.job_release[slot] < s.scalars[JUDGE_UNTIL]:
        judged = -1
    dag = s.job_dag[slot]
    s.decisions.append((JOB_END, dag, judged, s.job_index[slot], end, now))
    before, after = s.job_previous[slot], s.job_next[slot]
    if before < 0:
        s.oldest[dag] = after
    else:
        s.job_next[before] = after
    if after < 0:
        s.newest[dag] = before
    else:
        s.job_previous[after] = before
    s.n_open[dag] -= 1
    s.job_state[slot] = end
    if s.job_active[slot] == 0:
        free_slot(s, slot)


def free_slot(s: State, slot: int) -> None:
    """Make the slot of an ended job free for the next one of its DAG."""
    dag = s.job_dag[slot]
    s.job_state[slot] = FREE
    s.job_next[slot] = s.free_slot[dag]
    s.free_slot[dag] = slot


def expire_idle(t: Tables, s: State, dag: int, now: int) -> None:
    """Expire the jobs of a DAG that can no longer complete (rule 1), the oldest first."""
    if t.expire_after[dag] >= NEVER:
        return
    longest = t.dag_deadline[dag] + t.expire_after[dag]
    slot = s.oldest[dag]
    while slot >= 0:  # all of them: releases from messages may be out of order
        after = s.job_next[slot]
        if s.job_active[slot] == 0 and now - s.job_release[slot] > longest:
            give_up(t, s, slot, EXPIRED, now)
        slot = after


def give_up(t: Tables, s: State, slot: int, end: int, now: int) -> None:
    """
    End an open job early: each sink that has not completed is missed.

    :param end: EXPIRED (rules 1 and 8), FAILED (rule 8), or OUTDATED (rule 11).
    """
    judge_incomplete(t, s, slot, SINK_ABORTED + end - ABORTED, -NEVER, NEVER)
    close_job(s, slot, end, now)


def judge_incomplete(
    t: Tables, s: State, slot: int, kind: int, after: int, until: int
) -> int:
    """
    Judge the incomplete sinks of an open job with deadlines after a time up to another one.

    :return: the number of judged ones.
    """
    dag = s.job_dag[slot]
    found = 0
    for i in range(t.first_sink[dag], t.first_sink[dag + 1]):
        vertex = t.sinks[i]
        deadline = s.job_release[slot] + t.sink_deadline[vertex]
        if after < deadline <= until and (
                s.x_pending[s.job_base[slot] + t.region_offset[vertex]] >= 0) and (
                kind != SINK_OVERDUE or is_due(t, s, slot, vertex)):
            judge(t, s, slot, kind, vertex, deadline, -1)
            found += t.judged[vertex]
    return found


def is_due(t: Tables, s: State, slot: int, vertex: int) -> bool:
    """Return whether a sink is known to be due: all its gates were opened (rule 13)."""
    for i in range(t.first_gate[vertex], t.first_gate[vertex + 1]):
        if s.x_state[s.job_base[slot] + t.gates[i]] == IDLE:
            return False
    return True


def finish(t: Tables, s: State, now: int) -> None:
    """Judge the jobs that are open when the run ends (rule 6); they stay open."""
    for dag in range(t.n_dags):
        slot = s.oldest[dag]
        while slot >= 0:
            s.job_late[slot] += judge_incomplete(t, s, slot, SINK_MISSED, -NEVER, now)
            slot = s.job_next[slot]


def outdate_sink(t: Tables, s: State, slot: int, vertex: int, now: int) -> None:
    """Drop a sink of an open job that has not started when the next job's is ready (rule 11)."""
    head = s.job_base[slot] + t.region_offset[vertex]
    if s.x_pending[head] < 0:
        return
    s.x_pending[head] = -1
    judge(t, s, slot, SINK_DROPPED, vertex, s.job_release[slot] + t.sink_deadline[vertex], -1)
    s.job_late[slot] += t.judged[vertex]
    s.job_sinks_left[slot] -= 1
    if s.job_sinks_left[slot] == 0:
        close_job(s, slot, OUTDATED, now)


def withhold_from(t: Tables, s: State, slot: int, by: int, vertex: int, now: int) -> None:
    """
    Note that an execution which is about to end has not published what starts a vertex (rule 13).

    The vertex is not due in the job, nor in those in which the publishing vertex completes with
    this job's (rule 14).  A driver calls this before it reports the end of the execution.
    """
    older = s.job_previous[slot]
    withhold(t, s, slot, vertex, now)
    while older >= 0 and t.driven[by] >= AFTER_DRIVEN:
        before = s.job_previous[older]
        x = s.job_base[older] + t.region_offset[by]
        if s.x_follows[x] == s.job_index[older] and s.x_pending[x] >= 0:
            withhold(t, s, older, vertex, now)
        older = before


def withhold(t: Tables, s: State, slot: int, vertex: int, now: int) -> None:
    """
    Note that no message starts a vertex of an open job (rule 13).

    The vertex and all after it are not due in this job: a sync among them can never be complete.
    """
    base = s.job_base[slot]
    after = [vertex]
    while len(after) > 0:
        v = after.pop()
        head = base + t.region_offset[v]
        elsewhere = s.expected[v] == ELSEWHERE
        if s.x_pending[head] < (-1 if elsewhere else 0):
            continue  # it has completed, or is known not to be due
        s.x_pending[head] = -2 if elsewhere else -1
        for i in range(t.first_successor[v], t.first_successor[v + 1]):
            after.append(t.successors[i])
        if elsewhere:
            continue
        if t.sink_deadline[v] >= 0:
            judge(t, s, slot, SINK_NOT_DUE, v, s.job_release[slot] + t.sink_deadline[v], -1)
        if t.sink_deadline[v] >= 0 or s.expected[v] == LEADS_OUT:
            s.job_sinks_left[slot] -= 1
    if s.job_sinks_left[slot] == 0:
        close_job(s, slot, LATE if s.job_late[slot] > 0 else COMPLETED, now)


def due_of_answer(t: Tables, s: State, vertex: int, now: int) -> int:
    """
    Return the reference absolute deadline of an execution that may complete a driven sync.

    It is that of the earliest job whose vertex it may complete in time, or else of the next job
    (rule 14).
    """
    dag = t.dag_of[vertex]
    slot = s.oldest[dag]
    while slot >= 0:
        due = s.job_release[slot] + t.rad_offset[vertex]
        if due >= now and s.x_pending[s.job_base[slot] + t.region_offset[vertex]] >= 0:
            return due
        slot = s.job_next[slot]
    release = now
    if s.newest[dag] >= 0 and t.period[dag] < NEVER:
        release = max(now, s.job_release[s.newest[dag]] + t.period[dag])
    return release + t.rad_offset[vertex]


def next_deadline(t: Tables, s: State, slot: int, after: int) -> int:
    """Return the first deadline, after a time, of a job's incomplete sinks; NEVER: none."""
    dag = s.job_dag[slot]
    first = NEVER
    for i in range(t.first_sink[dag], t.first_sink[dag + 1]):
        vertex = t.sinks[i]
        deadline = s.job_release[slot] + t.sink_deadline[vertex]
        if after < deadline < first and (
                s.x_pending[s.job_base[slot] + t.region_offset[vertex]] >= 0):
            first = deadline
    return first


def deactivate(s: State, slot: int) -> None:
    """Count one active execution of a job less; free the slot of an ended job."""
    s.job_active[slot] -= 1
    if s.job_active[slot] == 0 and s.job_state[slot] != OPEN:
        free_slot(s, slot)

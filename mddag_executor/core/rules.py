# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The scheduling rules, all of them and only here (what concerns whole jobs is in ``jobs``).

Theory of operation
-------------------
A driver (live executor, replayer, simulator) reports what happened and when; the rules change the
state and answer with decisions.  There is no clock, thread, ROS or file in here.  Every function
takes the tables ``t`` and the state ``s``, and uses nothing but integer arithmetic, list indexing
and ``heapq``, so that the same source runs on plain lists and can be compiled on arrays.

1.  **Release.**  ``release_job`` opens job J_x^k of a DAG.  At most ``max_active_jobs`` jobs of a
    DAG are open; the oldest expires to make room.  A job that is idle (nothing of it waits or
    runs) and ``expire_after`` past its latest deadline can no longer complete: it expires too.
2.  **Readiness.**  A vertex becomes ready when its join countdown reaches zero: when all its
    predecessors have completed (AND).  Vertices that several publishers trigger are several
    vertices (OR), so the countdown is all there is.  Where sync callbacks run leg by leg (live),
    each leg, the message of one vertex before it, is ready when that is there, and the countdown
    is taken at its completion: the vertex completes with the leg that made it whole.
3.  **Order.**  Ready executions wait in a heap by the key of the policy; the smallest goes first.
    Ties that a policy leaves go by the *order*: one running number, given when an execution
    becomes ready and again when it is put back.  At one instant, as in the paper's own program,
    first come the completions, workers in ascending order, and of each its successors in the
    reverse of the order in which its edges are listed; then the releases, DAGs in ascending
    order; then, while workers are given out, what is preempted.
4.  **Callback groups.**  Each group has at most one owner, from its first dispatch to its
    completion (also while preempted or suspended).  What would run next but whose group is busy
    is set aside in the group's own heap; when the owner completes, the group's smallest returns.
    A group can also be a gate that lets its executions through one by one: the driver finds out
    whether the owner may begin.  If so, it leaves the group for good (``leave_group``); if not,
    it waits, owner still, so that none of the group passes it (``refuse``, then ``resume``).
5.  **Workers.**  A fresh execution takes the idle worker with the lowest number (``schedule``),
    or that of the worker that asks (``take``: live, it is warm).  With no worker idle and
    preemption on, the running execution with the largest priority (on a tie the one with the
    highest worker number) is put back, if its priority is strictly larger than the smallest
    waiting one.  Migration is free; overheads are added to what is left to execute.
6.  **Verdicts.**  A sink that completes after its absolute deadline (release plus its relative
    deadline) is late; at the deadline is in time.  ``finish`` judges what is open when the run
    ends: an absolute deadline at or before the end has been missed.  Each sink of a job gets one
    verdict.  A driver with a clock also learns when a deadline passes (``deadlines``): the sink is
    *overdue* until its verdict, which is not in time.  Jobs that are released less
    than ``SKIP`` after the first one, or before ``JUDGE_FROM``, get no verdicts: a warm-up.
    ``judge_from`` says that the run begins in earnest later: live, when all programs have started.
7.  **Late jobs.**  ``CONTINUE`` lets a late job go on.  ``ABORT`` drops what is left of it, as
    soon as the miss is known: at a late completion, or when something of it comes first in the
    ready queue after the deadline of a sink that is not done.  What has started runs on.
    ``DEMOTE`` puts an execution behind all that can be in time, when it comes first in a queue and
    none of the sinks that it leads to can be: the time plus the mean execution times on the
    longest path to the sink is past its deadline.  Demoted executions go by their keys among
    themselves.  An execution with sinks of both kinds has the earliest deadline of those that can
    be in time as its RAD.  What runs keeps the key that it was dispatched with.
8.  **Ends.**  A job ends in exactly one of completed, late, aborted, expired, failed.  It fails
    when an execution of it fails (a callback lets an exception out): that vertex has not
    delivered, so each sink that has not completed is missed.  After an abort executions of the
    job that have not started are dropped; after an expiry or a failure they run (live: each
    stands for a message, which is never lost silently) but make no further edge true and are not
    judged.  What fails after its job has ended changes nothing.  The slot is free for the next
    job when none of its executions waits, runs or is suspended.
9.  **Polling.**  Under a policy that polls (``ros2``), the ready queue is what the last poll
    found.  When an idle worker finds nothing to run there, it polls: the first waiting execution
    of every entity (timer, subscription, …) becomes one round's queue.  What becomes ready later
    waits for the next poll, and so does what is passed over because its group is busy when its
    turn comes.  There is no preemption.
10. **Several processes.**  Of a DAG whose callbacks run in several processes (live), a job has in
    each of them the vertices that are *expected here*.  The others count as done before it begins:
    they are not judged here and keep no job open.  A job ends when the sinks that are here have
    completed, and the vertices that *lead out*, to one that is not here: what these publish goes
    to another process, and belongs to the job as long as they run.
11. **The interpreter.**  Python's lock lets one thread compute at a time.  An execution that holds
    the interpreter (the driver says so, ``State.x_holds``) starts only if none on a worker whose
    priority is the same or smaller holds it; until then it is held back, and others go past it.
    One that is more urgent than all that hold it overtakes them, unless the driver says that
    nothing does for the moment (``State.overtaking``, by ``queues.overtaking_pays``: where the
    wait is short).  An execution that lends its worker, is suspended or turns out to wait
    (``stop_holding``) holds it no more.
12. **One machine, several processes.**  In virtual time one state can stand for all processes of a
    run (``state.divide``).  Each has workers and an interpreter of its own, for which rules 5 and
    11 hold by themselves; what finds none of its workers idle is held back.  There is no
    preemption then, and no polling.
13. **Only the newest.**  Of a source or sink with ``keep: newest`` at most one execution waits:
    one that has not started is dropped when that of a later job becomes ready.  A job without its
    source is ``OUTDATED``; a dropped sink is not in time.
"""

from __future__ import annotations

from heapq import heappop, heappush

from mddag_executor.core.jobs import (
    abort_job,
    close_job,
    deactivate,
    fail_job,
    free_slot,
    judge,
    outdate_job,
    outdate_sink,
    overdue,
)
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.queues import (
    add_stale,
    idle_worker,
    is_stale,
    lower_key,
    may_start,
    next_queue,
    poll,
    wait_for_poll,
)
from mddag_executor.core.state import (
    ABORTED,
    add_slot,
    BEHIND,
    COMPLETED,
    DISPATCH_OVERHEAD,
    DONE,
    DROP,
    DROPPED,
    EXPIRED,
    LATE,
    LEADS_OUT,
    N_HOLDING,
    N_IDLE,
    N_STALE,
    OPEN,
    ORDER,
    POLLING,
    PREEMPTIVE,
    PROPAGATE,
    RUNNING,
    SINK_IN_TIME,
    SINK_LATE,
    State,
    SUSPENDED,
    SWITCH_OVERHEAD,
    WAITING,
)
from mddag_executor.core.tables import ABORT, Tables


def make_ready(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> None:
    """Put an execution into the ready queue (rule 3)."""
    slot = s.x_slot[x]
    s.job_active[slot] += 1
    s.x_ready[x] = now
    s.x_started[x] = -1
    s.x_left[x] = s.x_cost[x]
    s.scalars[ORDER] += 1
    k = key(t, s.x_vertex[x], s.job_release[slot], s.job_index[slot], s.scalars[ORDER])
    entry = (k[0], k[1], k[2], k[3], x)
    s.x_key[x] = entry
    s.x_state[x] = WAITING
    if s.scalars[POLLING] == 0:
        heappush(s.ready, entry)
    else:
        wait_for_poll(t, s, entry)
    if t.keep_newest[s.x_vertex[x]] != 0:
        _keep_newest(t, s, x, now)


def _keep_newest(t: Tables, s: State, x: int, now: int) -> None:
    """Drop the older one of two executions that wait where only the newest is kept (rule 13)."""
    vertex = s.x_vertex[x]
    before = s.newest_ready[vertex]
    s.newest_ready[vertex] = x
    if before < 0 or before == x or s.x_state[before] != WAITING or s.x_started[before] >= 0:
        return
    older = before
    if s.job_index[s.x_slot[before]] > s.job_index[s.x_slot[x]]:
        s.newest_ready[vertex] = before
        older = x
    slot = s.x_slot[older]
    if slot == s.x_slot[s.newest_ready[vertex]]:
        return  # another message of a sync of the same job
    if s.job_state[slot] == OPEN:
        if t.n_predecessors[vertex] == 0:
            outdate_job(t, s, slot, now)
        else:
            outdate_sink(t, s, slot, vertex, now)
    drop(s, older, now)


def ready_undeclared(
    t: Tables, s: State, key: KeyFunction, job: int, group: int, holds: int, now: int
) -> int:
    """
    Make a callback ready that no DAG declares, as the one execution of a job of its own.

    :param job: the job's index; ``group`` and ``holds``: see ``State.x_group``, ``x_holds``.
    :return: the execution.
    """
    dag = t.n_dags
    if s.free_slot[dag] < 0:
        add_slot(t, s, dag)
    slot = s.free_slot[dag]
    s.free_slot[dag] = s.job_next[slot]
    s.job_index[slot] = job
    s.job_release[slot] = now
    s.job_state[slot] = OPEN
    s.job_active[slot] = 1
    x = s.job_base[slot]
    s.x_group[x] = group
    s.x_holds[x] = holds
    s.x_ready[x] = now
    s.x_started[x] = -1
    s.scalars[ORDER] += 1
    k = key(t, t.n_vertices, now, job, s.scalars[ORDER])
    entry = (k[0], k[1], k[2], k[3], x)
    s.x_key[x] = entry
    s.x_state[x] = WAITING
    if s.scalars[POLLING] == 0:
        heappush(s.ready, entry)
    else:
        wait_for_poll(t, s, entry)
    return x


def edge(t: Tables, s: State, key: KeyFunction, slot: int, vertex: int, now: int) -> None:
    """Make one trigger edge into ``vertex`` true for a job: its join countdown (rule 2)."""
    x = s.job_base[slot] + t.region_offset[vertex]
    s.x_pending[x] -= 1
    if s.x_pending[x] == 0:
        make_ready(t, s, key, x, now)


def drop(s: State, x: int, now: int) -> None:
    """
    Drop a waiting execution, for example because its queue is full; it never runs.

    Its entry stays in a queue, stale, until it gets to the top or stale ones are the larger part.
    An undeclared callback's job has nothing else, so it ends here.
    """
    in_queue = s.x_state[x] == WAITING  # not what was refused
    s.x_state[x] = DROPPED
    slot = s.x_slot[x]
    dag = s.job_dag[slot]
    s.decisions.append((DROP, dag, s.x_vertex[x], s.job_index[slot], x, now))
    group = s.x_group[x]
    if group >= 0 and (s.group_owner[group] == -1 or s.group_owner[group] == x):
        _release_group(s, group)  # it may have stood in the ready queue for those of its group
    if dag == len(s.free_slot) - 1:
        s.job_state[slot] = EXPIRED
    deactivate(s, slot)
    if in_queue:
        add_stale(s)


# --- dispatch ------------------------------------------------------------------------------------

def peek(t: Tables, s: State, now: int) -> int:
    """
    Return the execution that goes next, or -1 when none may run.

    On the way, what cannot go next leaves the queue: dropped and aborted executions for good,
    those whose group is busy into their group's heap (rule 4) or to the next poll (rule 9), those
    that may not start into the heap of what is held back (rules 11 and 12).  Late ones go behind
    (rule 7).
    """
    again = True
    divided = len(s.pool) > 0
    while True:
        plain = s.scalars[N_STALE] == 0 and len(s.held_back) == 0
        queue = s.ready if plain else next_queue(t, s, True)
        while queue:
            entry = queue[0]
            x = entry[4]
            group = s.x_group[x]
            slot = s.x_slot[x]
            if (now > s.job_hope[slot] + s.start_by[s.x_vertex[x]] and entry[0] < BEHIND // 2
                    and lower_key(t, s, x, now)):
                heappop(queue)
                heappush(s.ready, s.x_key[x])
                if group >= 0 and s.group_owner[group] == -1:
                    _release_group(s, group)  # others of it may go first
                queue = next_queue(t, s, False)
                continue
            if group >= 0 and s.group_owner[group] != -1 and s.group_owner[group] != x:
                heappop(queue)
                if s.scalars[POLLING] == 0:
                    heappush(s.group_heap[group], entry)
                else:
                    wait_for_poll(t, s, entry)
                queue = next_queue(t, s, False)
                continue
            if ((divided or s.x_holds[x] != 0 and s.scalars[N_HOLDING] > 0)
                    and not may_start(t, s, entry)):
                heappop(queue)
                heappush(s.held_back, entry)
                if group >= 0 and s.group_owner[group] == -1:
                    _release_group(s, group)  # others of it may go first
                queue = next_queue(t, s, False)
                continue
            if s.job_state[slot] == OPEN:
                if t.on_late[s.job_dag[slot]] != ABORT or not overdue(t, s, slot, now):
                    return x
                abort_job(t, s, slot, now)
            if s.job_state[slot] != ABORTED or s.x_started[x] >= 0:
                return x
            drop(s, x, now)
            queue = next_queue(t, s, False)
            again = True
        if not again or len(s.unpolled) == 0:
            return -1
        again = False  # a poll that finds nothing but busy groups is the last
        poll(t, s)


def take(t: Tables, s: State, worker: int, now: int) -> int:
    """Dispatch the next execution on this idle worker and return it, or -1 (rule 5)."""
    x = peek(t, s, now)
    if x < 0:
        return -1
    heappop(s.ready if len(s.ready) > 0 and s.ready[0][4] == x else s.held_back)
    start_on(s, x, worker, now)
    return x


def start_on(s: State, x: int, worker: int, now: int) -> None:
    """Start an execution that is ready, and in no queue any more, on this idle worker."""
    s.x_state[x] = RUNNING
    s.x_worker[x] = worker
    s.scalars[N_HOLDING] += s.x_holds[x]
    s.x_started[x] = now
    s.worker_x[worker] = x
    s.scalars[N_IDLE] -= 1
    if s.x_group[x] >= 0:
        s.group_owner[s.x_group[x]] = x


def schedule(t: Tables, s: State, key: KeyFunction, now: int) -> int:
    """
    Dispatch one execution (rule 5) and return it, or -1 when the pool is as it should be.

    A driver calls this until it answers -1.
    """
    if s.scalars[N_IDLE] > 0 and len(s.pool) > 0:
        x = peek(t, s, now)
        return -1 if x < 0 else _begin(t, s, idle_worker(t, s, x), now)
    if s.scalars[N_IDLE] > 0:
        worker = 0
        while s.worker_x[worker] >= 0:
            worker += 1
        return _begin(t, s, worker, now)
    if s.scalars[POLLING] != 0:
        return -1  # only a worker that is free looks, and polls
    x = peek(t, s, now)
    if x < 0 or s.scalars[PREEMPTIVE] == 0:
        return -1
    worker = 0
    largest = s.x_key[s.worker_x[0]][0]
    for w in range(1, len(s.worker_x)):
        priority = s.x_key[s.worker_x[w]][0]
        if priority >= largest:
            worker, largest = w, priority
    if largest <= s.x_key[x][0]:
        return -1
    victim = s.worker_x[worker]
    _leave_worker(s, victim)
    x = _begin(t, s, worker, now)
    _put_back(t, s, key, victim, now)
    return x


def _begin(t: Tables, s: State, worker: int, now: int) -> int:
    """Dispatch as ``take`` does; the dispatch takes time of its own."""
    x = take(t, s, worker, now)
    if x >= 0:
        s.x_left[x] += s.scalars[DISPATCH_OVERHEAD]
    return x


def _put_back(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> None:
    """Put what is preempted into the ready queue again, with what is left of it (rules 3, 5)."""
    s.x_left[x] += s.scalars[SWITCH_OVERHEAD] - (now - s.x_started[x])
    s.scalars[ORDER] += 1
    slot = s.x_slot[x]
    k = key(t, s.x_vertex[x], s.job_release[slot], s.job_index[slot], s.scalars[ORDER])
    s.x_key[x] = (k[0], k[1], k[2], k[3], x)
    s.x_state[x] = WAITING
    heappush(s.ready, s.x_key[x])


def _leave_worker(s: State, x: int) -> None:
    worker = s.x_worker[x]
    if worker >= 0:
        s.worker_x[worker] = -1
        s.x_worker[x] = -1
        s.scalars[N_HOLDING] -= s.x_holds[x]
        s.scalars[N_IDLE] += 1


def progress(s: State, x: int, now: int) -> int:
    """Return how far a running execution is, where it is known what it takes, ns."""
    return s.x_cost[x] - s.x_left[x] + now - s.x_started[x]


def lend(s: State, x: int) -> None:
    """Give a running execution's worker free while it waits for something; it keeps its group."""
    _leave_worker(s, x)


def stop_holding(s: State, x: int) -> None:
    """Give the interpreter back for an execution that turns out not to hold it (rule 11)."""
    if s.x_worker[x] >= 0:
        s.scalars[N_HOLDING] -= s.x_holds[x]
    s.x_holds[x] = 0


def suspend(s: State, x: int) -> None:
    """Take a running execution off its worker until ``resume``; it keeps its group."""
    _leave_worker(s, x)
    s.x_state[x] = SUSPENDED


def refuse(s: State, x: int) -> None:
    """Take a running execution that may not begin off its worker until ``resume`` (rule 4)."""
    suspend(s, x)
    s.x_started[x] = -1


def leave_group(s: State, x: int) -> None:
    """Let a running execution go on without its group, which is free for the next (rule 4)."""
    group = s.x_group[x]
    s.x_group[x] = -1
    _release_group(s, group)


def resume(s: State, x: int) -> None:
    """Put a suspended or refused execution back into the ready queue, under the key it had."""
    s.x_state[x] = WAITING
    heappush(s.ready, s.x_key[x])


# --- completion ----------------------------------------------------------------------------------

def complete(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> bool:
    """
    End a running execution (rules 2, 4, 6 and 7).

    :return: whether its vertex has completed: False only for a leg that did not make it whole.
    """
    worker = s.x_worker[x]
    if worker >= 0:  # not _leave_worker: a call less for each execution
        s.worker_x[worker] = -1
        s.x_worker[x] = -1
        s.scalars[N_HOLDING] -= s.x_holds[x]
        s.scalars[N_IDLE] += 1
    s.x_state[x] = DONE
    group = s.x_group[x]
    if group >= 0 and s.group_owner[group] == x:
        if s.group_heap[group]:
            _release_group(s, group)
        else:
            s.group_owner[group] = -1
    slot = s.x_slot[x]
    vertex = s.x_vertex[x]
    if vertex == t.n_vertices:  # no DAG declares it, so its job has nothing else
        s.job_active[slot] = 0
        free_slot(s, slot)
        return True
    head = s.job_base[slot] + t.region_offset[vertex]
    whole = True
    if s.scalars[PROPAGATE] == 0 and t.n_predecessors[vertex] > 0:
        s.x_pending[head] -= 1
        whole = s.x_pending[head] == 0
    if whole:
        s.x_pending[head] = -1
        if s.job_state[slot] == OPEN:
            _complete_vertex(t, s, key, slot, vertex, now)
    deactivate(s, slot)
    return whole


def record(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> bool:
    """End an execution as it was recorded: past the ready queue, its group and the workers."""
    s.job_active[s.x_slot[x]] += 1
    return complete(t, s, key, x, now)


def fail(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> bool:
    """End a running execution that failed, and with it its job (rule 8); see ``complete``."""
    slot = s.x_slot[x]
    if s.job_state[slot] == OPEN and s.job_dag[slot] < t.n_dags:
        fail_job(t, s, slot, now)
    return complete(t, s, key, x, now)


def _release_group(s: State, group: int) -> None:
    s.group_owner[group] = -1
    heap = s.group_heap[group]
    while heap and is_stale(s, heap[0]):
        heappop(heap)
        s.scalars[N_STALE] -= 1
    if heap:
        heappush(s.ready, heappop(heap))


def _complete_vertex(
    t: Tables, s: State, key: KeyFunction, slot: int, vertex: int, now: int
) -> None:
    dag = s.job_dag[slot]
    if t.sink_deadline[vertex] >= 0:
        deadline = s.job_release[slot] + t.sink_deadline[vertex]
        late = now > deadline
        judge(s, slot, SINK_LATE if late else SINK_IN_TIME, vertex, deadline, now)
        s.job_sinks_left[slot] -= 1
        if late:
            s.job_late[slot] += 1
        if s.job_sinks_left[slot] == 0:
            close_job(s, slot, LATE if s.job_late[slot] > 0 else COMPLETED, now)
        elif late and t.on_late[dag] == ABORT:
            abort_job(t, s, slot, now)
    elif s.expected[vertex] == LEADS_OUT:
        s.job_sinks_left[slot] -= 1
        if s.job_sinks_left[slot] == 0:
            close_job(s, slot, LATE if s.job_late[slot] > 0 else COMPLETED, now)
    if s.scalars[PROPAGATE] == 1:  # a sink, which may have ended the job, has no successors
        for i in range(t.first_successor[vertex], t.first_successor[vertex + 1]):
            edge(t, s, key, slot, t.successors[i], now)

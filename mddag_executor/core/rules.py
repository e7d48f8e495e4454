# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The scheduling rules: all of them are listed here.

Their code is here, in ``jobs`` (whole jobs), ``queues`` (order, groups, the interpreter),
``overload`` (late queues), ``driven`` (syncs of two rates), ``inheritance`` (requests) and
``simulate.dispatch`` (preemption).

Theory of operation
-------------------
A driver (live executor, replayer, simulator) reports events with their times.  The rules change
the state and return decisions.  There is no clock, thread, ROS or file here.  Every function gets
the tables ``t`` and the state ``s``, and uses only integer arithmetic, list indexing and
``heapq``, so that the same source runs on plain lists and compiled on arrays.

1.  **Release.**  ``release_job`` opens job J_x^k of a DAG.  At most ``max_active_jobs`` jobs of a
    DAG are open: the oldest one expires to make room.  A job is idle if none of its executions
    waits or runs.  An idle job expires ``expire_after`` past its latest deadline.
2.  **Readiness.**  A vertex becomes ready when its join countdown reaches zero: all its
    predecessors have completed (AND).  Vertices that several publishers trigger are several
    vertices (OR).  In a live run, a sync callback runs leg by leg.  A leg is the message of one
    predecessor, and is ready when the message arrives.  The countdown happens when the leg
    completes, and the last leg completes the vertex.
3.  **Order.**  Each callback has a queue, in which its ready executions wait in the order of the
    policy's keys, smallest first (``queues``).  The first execution of a queue runs first.  The
    queues wait in a heap, each with its smallest key.  Ties go by the *order*: a running number
    that an execution gets when it becomes ready or is put back.  At one instant, as in the paper's
    own program, completions come first, by worker, and of each completion the successors in
    reverse order of its edges; then releases, by DAG; then, during dispatch, preempted executions.
    An execution that goes on after it was preempted or has waited (*resumes*) waits alone.  It
    keeps the key of its job; the key of an undeclared one is counted from the time at which it
    resumes, but it goes on inheriting (rule 15).
4.  **Callback groups.**  A group has at most one owner, from its first dispatch to its completion,
    including the time in which it is preempted or suspended.  If a queue comes first while the
    group of its first execution is busy, its entry is set aside in the heap of the group.  When
    the owner completes, the smallest entry of the group returns.  Until then the owner is *urged*:
    it has at most the priority of each entry that was set aside (``urge``).  Otherwise all that is
    more urgent than the owner would hold up what waits for it.
    A group of a user's own class lets executions run one by one.  If the owner may begin, it
    leaves the group for ever (``leave_group``).  If it may not, it waits as the owner, so that no
    other execution overtakes it (``refuse``, then ``ask_again``).
    In a live run, callbacks of one of a program's executors belong to an *outer group*.  At most a
    given number of them may run at a time, or none while the outer group is closed
    (``open_outer``).  If a queue comes first while its outer group has no place, its entry is set
    aside in the heap of the outer group.  An execution has a place while it runs, but not while it
    is suspended, nor while it has lent its worker if only one may run.  Then it asks for a place
    again, even if the group is closed.
5.  **Workers.**  The execution that comes first goes to an idle worker (``take``), which the
    driver chooses.  Simulated workers may also be preempted, poll, or belong to several processes:
    see ``simulate.dispatch``.
6.  **Verdicts.**  A sink is late if it completes after its absolute deadline (release plus
    relative deadline); at the deadline it is in time.  ``finish`` judges open jobs at the end of
    the run: an absolute deadline at or before the end was missed.  Each sink of a job gets one
    verdict.  For a driver with a clock (``deadlines``) a sink is *overdue* from its deadline to
    its verdict, which is then not in time.  Jobs get no verdicts if they are released less than
    ``SKIP`` after the first one (warm-up), before ``JUDGE_FROM``, or not before ``JUDGE_UNTIL``.
    A live run calls ``judge_from`` when all programs have started.
7.  **Late queues.**  With ``CONTINUE``, late work goes on as before.  With ``DEMOTE``, a queue
    that comes first is *late* if none of its executions can be in time at any of their sinks: the
    time plus the mean execution times on the longest path to the sink is past its deadline.  Until
    one of its executions starts, a late queue counts as released ``LATE_DEADLINES`` relative
    deadlines later, and so does the job of its first execution at all later vertices, as does the
    job of an execution that starts in a late queue.  (In a DAG without any deadline the queue
    counts as due at once: its relative deadline is ten periods already.)  So late work ages, and
    each callback gets some time.  As long as another execution in the queue can be in time, the
    queue has the place of the first such execution, by the earliest deadline that this one can
    meet.  So a backlog is worked off.  In a lasting overload (``State.overloaded``) the mean
    execution times of the executions before it count as well.
    But once a queue was late, or its first execution was, it has no later place than that of a
    late queue until one of its executions starts: otherwise new executions, which can be in time,
    would put it off again and again.
    Age and place belong to the queue: if an execution is dropped (rule 11, or live a full queue),
    the queue keeps the place and the lateness of the dropped execution.  A preempted execution
    is checked by itself.  Running executions keep their keys, unless they are urged (rule 4).
    Only policies whose keys are times demote.
    It is not known how long undeclared callbacks take.  Their queue is late when its first
    execution is past its deadline, and remains late until it is empty.  So an overload of
    undeclared callbacks never makes a declared deadline miss for long, and each of them gets its
    turn.
8.  **Ends.**  A job ends as exactly one of completed, late, expired, failed, outdated.  It fails
    when an execution of it fails (its callback raises): each incomplete sink is missed.
    Executions that have not started when their job expires or fails still run, because in a live
    run each of them has a message, which is never lost silently.  But they make no further edge
    true, and are not judged.  Later failures change nothing.  The slot is free when no execution
    of the job waits, runs or is suspended.
9.  **Several processes.**  If the callbacks of a DAG run in several processes (live), each process
    expects some of a job's vertices *here*.  The others count as done: they are not judged here
    and keep no job open.  A job ends when its sinks here have completed, and also its vertices
    here that *lead out*, to a vertex elsewhere: their messages belong to the job until they end.
10. **The interpreter.**  Python's lock lets one thread compute at a time.  An execution that holds
    the interpreter (reported by the driver, ``State.x_holds``) starts only if no running execution
    with the same or a smaller priority holds it.  Until then its queue is deferred
    (``State.deferred``), and others overtake it.  If it is more urgent than all holders, it
    starts, unless the driver forbids it for the moment (``State.overtaking``, from
    ``queues.overtaking_pays``: the wait is short).  In a live run, the overtaken executions pause,
    or share the interpreter with it.  An execution that lends its worker, is suspended or turns
    out to wait (``stop_holding``) does not hold the interpreter any more, and needs it and a
    worker again when it resumes.
11. **Only the newest.**  A source or sink with ``keep: newest`` has at most one waiting execution:
    one that has not started is dropped when the execution of a later job becomes ready.  A waiting
    release of a timer is dropped as well if it is late then (``KEEP_TIMELY``).  A job without its
    source is ``OUTDATED``; a dropped sink is not in time.
12. **Importance.**  A vertex has the highest importance of the sinks that it leads to, over
    trigger and queue edges.  While an important sink is late, or the known execution times demand
    more than the workers or the interpreter of a process can give, work of lower importance is
    demoted as if it were late (rule 7), and nothing more.  A sink counts as late for
    ``LATE_DEADLINES`` of its relative deadlines.  If the demand is too high, the lowest importance
    is demoted, as many levels as necessary, but never the highest.
13. **Not due.**  A vertex may publish some of its topics only sometimes.  If it completes without
    one of them, the vertices that the topic leads to, and all after these, are not due in the job
    (``withhold_from``): a sync needs all of its legs.  They get no verdict, and the job does not
    wait for them.  Until it is known that a sink is due, it is not overdue (``is_due``).  If its
    job expires or fails before, it is missed.  Sinks without a deadline are never judged.
14. **Driven syncs.**  Of a sync with ``driven_by`` the message of one topic belongs to a job and
    starts its vertex; messages of the other topics start executions without a job.  In a live run,
    the vertex completes with the first execution that *answers* the job: see ``driven``.  In
    virtual time it completes with its own execution, as any other vertex.  An answer also
    completes the vertex in the older jobs that still await one.  After that these jobs *follow*
    the answered job: a vertex completes in them when it completes in a later job.  Executions
    without a job are ordered as if they belonged to the earliest job that they may complete in
    time (``due_of_answer``).
15. **Requests.**  A request to a service or action that an execution of a job sends *inherits*: it
    has the priority with which that execution was dispatched, if this is smaller than its own.  So
    do the requests that it sends itself, its task if it is a goal, and the callbacks of the
    response.  Requests of a callback keep their order, so those before it inherit as well.  If the
    priority is over (a time in the past), they are ordered like any other undeclared execution.
    Only with policies whose keys are times; a declared service keeps its own deadline.
"""

from __future__ import annotations

from heapq import heappop, heappush

from mddag_executor.core.inheritance import inherit
from mddag_executor.core.jobs import (
    close_job,
    deactivate,
    free_slot,
    give_up,
    judge,
    outdate_sink,
    withhold,
)
from mddag_executor.core.overload import (
    announce_late,
    demote,
    drop_late,
    is_late,
    next_entry,
    note_late,
    take_turn,
)
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.queues import (
    call_next,
    come_forward,
    defer,
    enqueue,
    first_of,
    has_place,
    leave_outer,
    may_start,
    next_heap,
    put,
    unlink,
    urge,
    wait_alone,
    wait_for_outer,
)
from mddag_executor.core.state import (
    add_slot,
    ALONE,
    COMPLETED,
    DONE,
    DROP,
    DROPPED,
    ENDS,
    FAILED,
    IDLE,
    LATE,
    LEADS_OUT,
    N_HOLDING,
    N_IDLE,
    NO_PLACE,
    OPEN,
    ORDER,
    OUTDATED,
    PARTS,
    PLACED,
    PROPAGATE,
    QueueEntry,
    READY,
    RETURNS,
    RUNNING,
    SINK_IN_TIME,
    SINK_LATE,
    State,
    SUSPENDED,
    WAITING,
)
from mddag_executor.core.tables import AFTER_DRIVEN, DRIVEN, KEEP_ALL, KEEP_NEWEST, NEVER, Tables


def make_ready(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> None:
    """Let an execution wait in its queue (rule 3)."""
    slot = s.x_slot[x]
    s.job_active[slot] += 1
    order = s.scalars[ORDER] = s.scalars[ORDER] + 1
    vertex = s.x_vertex[x]
    queue = s.x_queue[x]
    s.x_key[x] = key(t, vertex, s.job_release[slot], s.job_index[slot], order) + (queue,)
    enqueue(t, s, x)
    keep = t.keep[vertex]
    if keep != KEEP_ALL and s.queue_first[queue] != s.queue_last[queue]:
        if keep == KEEP_NEWEST:
            _keep_newest(t, s, x, now)
        else:
            _keep_timely(t, s, x, now)


def _keep_newest(t: Tables, s: State, x: int, now: int) -> None:
    """Drop the older of the two executions in a queue of which only the newest is kept."""
    older = s.x_previous[x]
    if older < 0:
        older = s.x_next[x]
    if s.job_index[s.x_slot[older]] > s.job_index[s.x_slot[x]]:
        older = x
    _outdate(t, s, older, now)


def _keep_timely(t: Tables, s: State, x: int, now: int) -> None:
    """Drop the waiting releases of a timer before this one that are late (rule 11)."""
    older = s.x_previous[x]
    while older >= 0:
        before = s.x_previous[older]
        if is_late(t, s, older, now):
            _outdate(t, s, older, now)
        older = before


def _outdate(t: Tables, s: State, x: int, now: int) -> None:
    """Drop a waiting execution for that of a newer job, and its job or sink with it (rule 11)."""
    slot, vertex = s.x_slot[x], s.x_vertex[x]
    if s.job_state[slot] == OPEN:
        if is_late(t, s, x, now):
            announce_late(t, s, x, now)
        if t.n_predecessors[vertex] == 0:
            give_up(t, s, slot, OUTDATED, now)
        else:
            outdate_sink(t, s, slot, vertex, now)
    drop(t, s, x, now)


def ready_undeclared(
    t: Tables, s: State, key: KeyFunction, job: int, group: int, holds: int, queue: int, now: int
) -> int:
    """
    Make an undeclared callback ready: it is not judged, and has no job to account for.

    :param job: its index, for the key; ``group``, ``holds``: see ``State.x_group``, ``x_holds``.
    :param queue: the queue of its callback; -1: it waits alone.
    :return: the execution.
    """
    if len(s.undeclared) == 0:
        add_slot(t, s, t.n_dags)
    x = s.undeclared.pop()
    s.x_group[x] = group
    s.x_holds[x] = holds
    s.x_queue[x] = queue
    slot = s.x_slot[x]
    s.job_release[slot] = now
    s.x_like[x] = s.job_demoted[slot] = -1
    order = s.scalars[ORDER] = s.scalars[ORDER] + 1
    s.x_key[x] = key(t, t.n_vertices, now, job, order) + (queue,)
    if queue >= 0:
        enqueue(t, s, x)
    else:
        s.x_started[x] = -1
        wait_alone(s, x)
    return x


def satisfy_edge(t: Tables, s: State, key: KeyFunction, slot: int, vertex: int, now: int) -> None:
    """Make one trigger edge into ``vertex`` true for a job: its join countdown (rule 2)."""
    x = s.job_base[slot] + t.region_offset[vertex]
    s.x_pending[x] -= 1
    if s.x_pending[x] == 0:
        make_ready(t, s, key, x, now)


def drop(t: Tables, s: State, x: int, now: int) -> None:
    """Drop a waiting or refused execution, for example of a full queue: it never runs."""
    queue = s.x_queue[x]
    if s.x_state[x] == WAITING:
        late = is_late(t, s, x, now)
        if late:
            announce_late(t, s, x, now)
        unlink(s, x)
        if late and s.queue_first[queue] >= 0:
            drop_late(t, s, x, now)
    elif s.x_state[x] == ALONE:
        unlink(s, x)
    s.x_state[x] = DROPPED
    slot = s.x_slot[x]
    dag = s.job_dag[slot]
    s.decisions.append((DROP, dag, s.x_vertex[x], s.job_index[slot], x, now))
    group = s.x_group[x]
    s.x_urged[x] = NEVER
    if group >= 0 and (s.group_owner[group] == -1 or s.group_owner[group] == x):
        _free_group(s, group)  # its entry may have been its group's in the ready heap
    _count_wait(s, x, now)
    _let_others(s, x)  # or that of its outer group
    if dag == len(s.free_slot):
        s.undeclared.append(x)
    else:
        deactivate(s, slot)


# --- dispatch ------------------------------------------------------------------------------------

def peek(t: Tables, s: State, now: int) -> int:
    """
    Return the execution that is dispatched next, or -1 when none may run.

    Late queues are demoted (rule 7).  An execution that cannot be next is set aside: if its group
    is busy, in the heap of the group (rule 4); if it may not hold the interpreter, with those that
    are deferred (rule 10).
    """
    heap = s.ready
    if s.deferred:
        heap = next_heap(s)
    while heap:
        entry = heap[0]
        queue = entry[4]
        x = s.queue_first[queue] if queue >= 0 else ~queue
        group = s.x_group[x]
        if (now > s.job_release[s.x_slot[x]] + s.start_by[s.x_vertex[x]]
                and demote(t, s, heap, x, now)):
            let_group(s, x)  # others of the group may go first
            _let_others(s, x)
        elif group >= 0 and s.group_owner[group] != -1 and s.group_owner[group] != x:
            heappop(heap)
            _wait_for_group(s, entry, group)
            _let_others(s, x)
        elif s.outer_limit and not has_place(s, x):
            heappop(heap)
            if s.x_aside[x] < 0 and s.outer_limit[s.x_outer[x]] > 0:
                s.x_aside[x] = now
            wait_for_outer(s, entry, s.x_outer[x])
            let_group(s, x)  # others of the group may be of another outer one
        elif s.x_holds[x] != 0 and s.scalars[N_HOLDING] > 0 and not may_start(s, entry):
            defer(s, heap, s.deferred)
            let_group(s, x)
            _let_others(s, x)
        else:
            return x
        heap = next_heap(s)
    return -1


def _wait_for_group(s: State, entry: QueueEntry, group: int) -> None:
    """Set an entry aside until its group is free, and urge the owner (rule 4)."""
    if entry[4] >= 0:
        s.queue_place[entry[4]] = group
    heappush(s.group_heap[group], entry)
    owner = s.group_owner[group]
    if entry[0] < s.x_key[owner][0]:
        urge(s, owner, entry[0])


def let_group(s: State, x: int) -> None:
    """Let others of the callback group of an execution that cannot start yet go first."""
    group = s.x_group[x]
    if group >= 0 and s.group_owner[group] == -1:
        _free_group(s, group)


def _let_others(s: State, x: int) -> None:
    """Let others have the place in its outer group that an execution cannot take yet."""
    if s.x_outer[x] >= 0:
        call_next(s, s.x_outer[x])


def _count_wait(s: State, x: int, now: int) -> None:
    """Count how long an execution that starts or is dropped has waited for its outer group."""
    if s.x_aside[x] >= 0 and s.x_outer[x] >= 0:
        s.outer_wait[s.x_outer[x]] += now - s.x_aside[x]
    s.x_aside[x] = -1


def _enter_outer(s: State, x: int, outer: int, now: int) -> None:
    """Give an execution that starts a place in its outer group."""
    _count_wait(s, x, now)
    if s.x_place[x] != PLACED:
        s.x_place[x] = PLACED
        s.outer_running[outer] += 1
        if s.outer_once[outer] != 0:
            s.outer_limit[outer] = s.outer_once[outer] = 0
        call_next(s, outer)


def take(t: Tables, s: State, worker: int, now: int) -> int:
    """Dispatch the next execution to an idle worker and return it, or -1 (rule 5)."""
    x = peek(t, s, now)
    if x < 0:
        return -1
    entry = _pop_first(s, x) if s.deferred else heappop(s.ready)
    s.x_key[x] = entry
    queue = entry[4]
    if queue >= 0:
        if s.queue_demoted[queue] >= 0:
            take_turn(s, x)
        after = s.queue_first[queue] = s.x_next[x]
        if after < 0:
            s.queue_last[queue] = s.queue_demoted[queue] = -1
        else:
            s.x_next[x] = s.x_previous[after] = -1
            put(s, next_entry(t, s, queue, now))
    s.x_state[x] = RUNNING
    s.x_worker[x] = worker
    s.x_started[x] = now
    s.worker_x[worker] = x
    s.scalars[N_IDLE] -= 1
    if s.x_holds[x] != 0:
        s.scalars[N_HOLDING] += 1
    group = s.x_group[x]
    if group >= 0:
        s.group_owner[group] = x
    if s.outer_limit and s.x_outer[x] >= 0:
        _enter_outer(s, x, s.x_outer[x], now)
    return x


def _pop_first(s: State, x: int) -> QueueEntry:
    """Remove and return the entry of an execution, first of those that are ready or deferred."""
    if s.ready and first_of(s, s.ready[0]) == x:
        return heappop(s.ready)
    entry = heappop(s.deferred)
    if entry[4] >= 0:
        s.queue_place[entry[4]] = READY
    return entry


def lend(s: State, x: int) -> None:
    """Free the worker of a running execution, if it has one; it keeps its group."""
    worker = s.x_worker[x]
    if worker >= 0:
        s.worker_x[worker] = -1
        s.x_worker[x] = -1
        s.scalars[N_HOLDING] -= int(s.x_holds[x] != 0)
        s.scalars[N_IDLE] += 1
    if s.x_place[x] == PLACED and s.outer_limit[s.x_outer[x]] <= 1:
        leave_outer(s, x)


def stop_holding(s: State, x: int) -> None:
    """Give up the interpreter for an execution that turns out not to hold it (rule 10)."""
    if s.x_worker[x] >= 0:
        s.scalars[N_HOLDING] -= int(s.x_holds[x] != 0)
    s.x_holds[x] = 0


def suspend(s: State, x: int) -> None:
    """Suspend a running execution until ``resume``: it keeps its group, but no worker."""
    lend(s, x)
    s.x_state[x] = SUSPENDED
    if s.x_place[x] == PLACED:
        leave_outer(s, x)


def refuse(s: State, x: int) -> None:
    """Suspend a running execution that may not begin until ``resume`` (rule 4)."""
    suspend(s, x)
    s.x_started[x] = -1


def leave_group(s: State, x: int) -> None:
    """Let a running execution go on without its group, which becomes free (rule 4)."""
    group = s.x_group[x]
    s.x_group[x] = -1
    s.x_urged[x] = NEVER
    _free_group(s, group)


def ask_again(s: State, x: int) -> None:
    """Let a refused execution wait again, with the same key (rule 4)."""
    wait_alone(s, x)


def resume(
    t: Tables, s: State, key: KeyFunction, x: int, job: int, holds: int, now: int
) -> None:
    """
    Put a suspended execution, or one that has lent its worker, back into the ready queue (rule 3).

    :param job: its index, for the key of an undeclared one; ``holds``: see ``State.x_holds``.
    """
    like = -1
    priority = s.x_key[x][0]
    if s.x_vertex[x] == t.n_vertices:
        order = s.scalars[ORDER] = s.scalars[ORDER] + 1
        s.x_key[x] = key(t, t.n_vertices, now, job, order) + (~x,)
        s.job_release[s.x_slot[x]] = now
        like = s.x_like[x]
        s.x_like[x] = -1
    s.x_holds[x] = holds
    wait_alone(s, x)
    if like >= 0:
        inherit(t, s, x, priority, like)


def rejoin(
    t: Tables, s: State, key: KeyFunction, x: int, job: int, holds: int, now: int
) -> None:
    """Put an execution that has lent its worker back into the ready queue; see ``resume``."""
    if s.x_outer[x] >= 0 and s.x_place[x] == NO_PLACE:
        s.x_place[x] = RETURNS
    resume(t, s, key, x, job, holds, now)


def go_on_without(s: State, x: int) -> None:
    """Let a waiting execution that has run before go on without worker and interpreter."""
    unlink(s, x)
    s.x_state[x] = RUNNING
    s.x_aside[x] = -1
    if s.x_place[x] == RETURNS:
        s.x_place[x] = PLACED
        s.outer_running[s.x_outer[x]] += 1


# --- completion ----------------------------------------------------------------------------------

def complete(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> bool:
    """
    End a running execution (rules 2, 4, 6 and 7).

    :return: whether its vertex has completed: False only for a leg that was not the last.
    """
    worker = s.x_worker[x]
    if worker >= 0:  # not lend(): a call less for each execution
        s.worker_x[worker] = s.x_worker[x] = -1
        s.scalars[N_IDLE] += 1
        if s.x_holds[x] != 0:
            s.scalars[N_HOLDING] -= 1
    s.x_state[x] = DONE
    if s.outer_limit and s.x_place[x] == PLACED:
        leave_outer(s, x)
    group = s.x_group[x]
    if group >= 0 and s.group_owner[group] == x:
        s.group_owner[group] = -1
        s.x_urged[x] = NEVER
        if s.group_heap[group]:
            _free_group(s, group)
    vertex = s.x_vertex[x]
    if vertex == t.n_vertices:
        s.undeclared.append(x)
        return True
    slot = s.x_slot[x]
    whole = True
    ending = s.ending[vertex]
    if ending == PARTS:
        whole = _complete_part(t, s, key, slot, vertex, now)
    elif s.x_pending[x] < 0:
        whole = False  # it was known not to be due
    else:
        s.x_pending[x] = -1
        if ending == ENDS and s.job_state[slot] == OPEN:
            _end_in(t, s, slot, vertex, now)
    active = s.job_active[slot] = s.job_active[slot] - 1  # not deactivate(): one call less
    if active == 0 and s.job_state[slot] != OPEN:
        free_slot(s, slot)
    return whole


def _complete_part(
    t: Tables, s: State, key: KeyFunction, slot: int, vertex: int, now: int
) -> bool:
    """Note that an execution of a vertex has ended; return whether the vertex has completed."""
    head = s.job_base[slot] + t.region_offset[vertex]
    if s.scalars[PROPAGATE] == 0:
        if t.driven[vertex] & DRIVEN != 0:
            return False  # the driver says which execution answers
        if t.n_predecessors[vertex] > 0:
            pending = s.x_pending[head] = s.x_pending[head] - 1
            if pending != 0:
                return False
    s.x_pending[head] = -1
    if s.job_state[slot] == OPEN:
        _complete_vertex(t, s, key, slot, vertex, now)
    return True


def answer(
    t: Tables, s: State, key: KeyFunction, slot: int, vertex: int, answered: int, now: int
) -> None:
    """
    Complete a driven sync in an open job, live (rule 14).

    :param answered: the slot of the job that an execution answers: this one, or a later one, which
        this one follows from now on.
    """
    head = s.job_base[slot] + t.region_offset[vertex]
    if s.job_state[slot] != OPEN or s.x_pending[head] < 0:
        return
    s.x_pending[head] = -1
    _complete_vertex(t, s, key, slot, vertex, now)
    if slot != answered:
        follow(t, s, key, slot, vertex, answered, now)


def follow(
    t: Tables, s: State, key: KeyFunction, slot: int, vertex: int, answered: int, now: int
) -> None:
    """Let the vertices after a driven sync complete when they do in a later job (rule 14)."""
    base, other = s.job_base[slot], s.job_base[answered]
    after = [vertex]
    while len(after) > 0:
        v = after.pop()
        for i in range(t.first_successor[v], t.first_successor[v + 1]):
            successor = t.successors[i]
            x, there = base + t.region_offset[successor], other + t.region_offset[successor]
            if s.x_follows[x] == s.job_index[slot] or s.x_pending[x] < 0 or (
                    s.job_state[slot] != OPEN):
                continue
            s.x_follows[x] = s.job_index[slot]
            after.append(successor)
            if s.x_pending[there] < 0 and s.x_state[there] == IDLE:
                withhold(t, s, slot, successor, now)
            elif s.x_pending[there] < 0:
                s.x_pending[x] = -1  # the message was published before the execution ended
                _complete_vertex(t, s, key, slot, successor, now)


def fail(t: Tables, s: State, key: KeyFunction, x: int, now: int) -> bool:
    """End a running execution that failed, and with it its job (rule 8); see ``complete``."""
    slot = s.x_slot[x]
    if s.job_state[slot] == OPEN and s.job_dag[slot] < t.n_dags:
        give_up(t, s, slot, FAILED, now)
    return complete(t, s, key, x, now)


def _free_group(s: State, group: int) -> None:
    s.group_owner[group] = -1
    heap = s.group_heap[group]
    if heap:
        come_forward(s, heappop(heap))


def _complete_vertex(
    t: Tables, s: State, key: KeyFunction, slot: int, vertex: int, now: int
) -> None:
    """Complete a vertex in an open job, and in those that follow it there (rule 14)."""
    propagate = s.scalars[PROPAGATE]
    older = -1
    if t.driven[vertex] >= AFTER_DRIVEN and propagate == 0:
        older = s.job_previous[slot]
    ends = t.sink_deadline[vertex] >= 0 or s.expected[vertex] == LEADS_OUT
    if ends:
        _end_in(t, s, slot, vertex, now)
    if propagate == 0:
        while older >= 0:
            before = s.job_previous[older]
            x = s.job_base[older] + t.region_offset[vertex]
            if s.x_follows[x] == s.job_index[older] and s.x_pending[x] >= 0:
                s.x_pending[x] = -1
                if ends:
                    _end_in(t, s, older, vertex, now)
            older = before
    elif propagate == 1:  # a sink, which may have ended the job, has no successors
        for i in range(t.first_successor[vertex], t.first_successor[vertex + 1]):
            satisfy_edge(t, s, key, slot, t.successors[i], now)


def _end_in(t: Tables, s: State, slot: int, vertex: int, now: int) -> None:
    """Complete a sink, or what leads out, in one job: judge it, and end the job after its last."""
    relative = t.sink_deadline[vertex]
    if relative >= 0 and t.judged[vertex] != 0:
        deadline = s.job_release[slot] + relative
        late = now > deadline
        judge(t, s, slot, SINK_LATE if late else SINK_IN_TIME, vertex, deadline, now)
        if late:
            s.job_late[slot] += 1
            note_late(t, s, vertex, now)
    left = s.job_sinks_left[slot] = s.job_sinks_left[slot] - 1
    if left == 0:
        close_job(s, slot, LATE if s.job_late[slot] > 0 else COMPLETED, now)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The state that the scheduling rules change, as columns.

A *slot* holds one open job of one DAG and owns a region of *executions* ``x``: one for each vertex
(or leg) of that DAG.  Slots of a DAG are recycled through a free list; open jobs of a DAG form a
list in order of release.  Columns are plain lists in a live run; a compiled driver makes them
arrays.  ``scalars`` holds single integers, because fields of a named tuple cannot change.  In
plain Python, attributes of an object are read in half the time of a tuple's: see ``as_object``.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

from mddag_executor.core.tables import DEMOTE, NEVER, Tables

# States of an execution: it waits in its queue or alone (see ``queues``).  A refused execution is
# suspended.
IDLE, WAITING, ALONE, RUNNING, SUSPENDED, DONE, DROPPED = range(7)

# Whether an execution has a place in its outer group, or continues after it has lent its place.
NO_PLACE, PLACED, RETURNS = range(3)

# States of a job.  Every ended job is in exactly one of the last six; only recordings of version 2
# and before have aborted ones.
FREE, OPEN, COMPLETED, LATE, ABORTED, EXPIRED, FAILED, OUTDATED = range(8)

# Where a vertex is expected to run; LEADS_OUT: here, and a successor is not.
ELSEWHERE, HERE, LEADS_OUT = range(3)

# What the end of an execution means for its vertex (``ending``).  NOTHING: the vertex has
# completed, and nothing follows from that here; ENDS: it ends in the job (``rules._end_in``);
# PARTS: there is more to find out (``rules._complete_part``).
NOTHING, ENDS, PARTS = range(3)

# Columns of ``scalars``.
(ORDER, N_IDLE, PROPAGATE, JUDGE_FROM, JUDGE_UNTIL, SKIP, N_HOLDING, URGENCY,
 N_SCALARS) = range(9)

# Where the entry of a queue is (``queue_place``), if not in the heap of a callback group.
READY, DEFERRED = -1, -2
OUTER = -3  # the first outer group, the next one is -4, …

# Which times the keys of a policy are (``URGENCY``): none, deadlines of sinks, latest starts for
# them, or deadlines of DAGs.
OTHER_KEYS, DEADLINE_KEYS, START_KEYS, DAG_KEYS = range(4)

# Decisions: (kind, DAG, global vertex, job index, deadline, time).  Each sink of a job is in time,
# or late: it completed; or missed: it had not completed when the run ended past its deadline; or
# its job was aborted, expired or failed, or the sink was dropped for a newer job's.  Before that,
# it may be reported overdue (its deadline is over; it is not in time then), or demoted.  A sink
# that is not due in a job has no other verdict about it.  The
# deadline is that of the sink; DROP has the execution there, the end of a job its outcome.  The
# time is that of the decision (for a completed sink the completion), or -1 for sinks whose jobs
# ended otherwise.  The end of a job has -1, or NOT_JUDGED, instead of a vertex.
(SINK_IN_TIME, SINK_LATE, SINK_MISSED, SINK_ABORTED, SINK_EXPIRED, SINK_FAILED, SINK_DROPPED,
 JOB_END, DROP, SINK_OVERDUE, SINK_DEMOTED, SINK_NOT_DUE) = range(12)
SINK_COMPLETED = (SINK_IN_TIME, SINK_LATE)
NOT_JUDGED = -2

QueueEntry = tuple[int, int, int, int, int]
"""An entry of a heap: the four integers of a key, then a queue, or ``~x`` of an execution."""

Decision = tuple[int, int, int, int, int, int]
Kind = TypeVar('Kind')


class State(NamedTuple):
    """Everything that changes during a run; see ``fill_state``."""

    scalars: list[int]
    # heaps with an entry for each queue that is not empty, and each execution that waits alone:
    # those that may come first, those that are deferred for the interpreter, and for each callback
    # group those that wait for it
    ready: list[QueueEntry]
    deferred: list[QueueEntry]
    group_heap: list[list[QueueEntry]]
    group_owner: list[int]
    # by outer group: a heap of what waits for a place in it, how many may run at a time, how many
    # do, whether it closes when the next one starts, and how long others have waited for it
    outer_heap: list[list[QueueEntry]]
    outer_limit: list[int]
    outer_running: list[int]
    outer_once: list[int]
    outer_wait: list[int]
    # the execution of each worker
    worker_x: list[int]
    # by process, from 1: its number of workers; by vertex: its process, in a live run always 1
    n_workers: list[int]
    process: list[int]
    # by interpreter, from 1: whether a more urgent execution may overtake its holder
    overtaking: list[int]
    # the executions of undeclared callbacks that may be used again
    undeclared: list[int]
    # by queue: its first and its last execution, or -1; its entry, and where that is; the release
    # that counts for its order since it was demoted, or -1
    queue_first: list[int]
    queue_last: list[int]
    queue_key: list[QueueEntry]
    queue_place: list[int]
    queue_demoted: list[int]
    # by process, from 1: the least importance that is not demoted, and whether that needs too much
    demoted_below: list[int]
    overloaded: list[int]
    # the highest importance of the sinks that were late, and until when they count
    late_importance: list[int]
    late_until: list[int]
    # by DAG
    free_slot: list[int]
    oldest: list[int]
    newest: list[int]
    n_open: list[int]
    # whether some of its vertices are not expected here; by vertex: whether it is (see ``expect``)
    partial: list[int]
    expected: list[int]
    # by vertex: what the end of an execution means (``NOTHING``, …), which follows from the tables
    # and ``expected``
    ending: list[int]
    # by vertex: how long after its release an execution is checked when it comes first (see
    # ``overload``; NEVER: not); the known mean execution time, and whether it holds the
    # interpreter; when that time was measured last, or -1: it is the declared one
    start_by: list[int]
    mean: list[int]
    holder: list[int]
    measured_at: list[int]
    # ``Tables.reach_start`` with the known execution times
    reach_by: list[int]
    # by slot
    job_dag: list[int]
    job_base: list[int]
    job_index: list[int]
    job_release: list[int]
    job_state: list[int]
    job_sinks_left: list[int]
    job_late: list[int]
    # the release that counts for its order since it was demoted, or -1
    job_demoted: list[int]
    # of an undeclared execution with the priority of another one (see ``inheritance``): when it
    # became ready, what it inherits itself, and from which vertex
    job_ready: list[int]
    job_inherited: list[int]
    job_heir: list[int]
    job_active: list[int]
    job_next: list[int]
    job_previous: list[int]
    # by execution
    x_slot: list[int]
    x_vertex: list[int]
    # the vertex whose relative deadline it has: its own or, if it is undeclared, the one that its
    # priority is inherited from; -1: it has the default one
    x_like: list[int]
    x_state: list[int]
    x_pending: list[int]
    x_group: list[int]
    # its outer group, or -1; whether it has a place in it (``PLACED``), or goes on (``RETURNS``);
    # since when it waits for one, or -1
    x_outer: list[int]
    x_place: list[int]
    x_aside: list[int]
    # the queue of its callback, or -1; in it, the next and the previous execution, or -1
    x_queue: list[int]
    x_next: list[int]
    x_previous: list[int]
    # which interpreter it holds while it runs, from 1; 0: none
    x_holds: list[int]
    x_worker: list[int]
    x_key: list[QueueEntry]
    # the least priority of what waits for its callback group, or NEVER
    x_urged: list[int]
    x_started: list[int]
    x_left: list[int]
    x_cost: list[int]
    # of a sink: the last demoted job
    x_demoted: list[int]
    # the last job in which its vertex completes when it does in a later job (rule 14)
    x_follows: list[int]
    # decisions that the driver has not fetched yet
    decisions: list[Decision]


Columns = TypeVar('Columns', State, Tables)

_OBJECTS: dict[type, Any] = {
    kind: type(kind.__name__, (), {'__slots__': kind._fields}) for kind in (State, Tables)}


def as_object(columns: Columns) -> Columns:
    """Return the columns as an object with exactly these attributes."""
    result: Columns = _OBJECTS[type(columns)]()
    for name in columns._fields:
        setattr(result, name, getattr(columns, name))
    return result


def empty(kind: type[Kind]) -> Kind:
    """Return a named tuple of empty columns."""
    return kind(*([] for _ in kind._fields))    # type: ignore[attr-defined]


def fill_state(
    t: Tables, s: State, n_workers: int, propagate: int, urgency: int
) -> None:
    """
    Fill the columns of an empty state.

    :param propagate: 1: completions make the graph's edges true at once (simulation); 0: messages
        do, leg by leg, and the driver makes each leg ready (live); 2: messages do, and the driver
        reports each with ``rules.satisfy_edge`` (rescheduling, with message latency).
    :param urgency: the kind of the policy's keys, ``DEADLINE_KEYS``, …
    """
    for _ in range(N_SCALARS):
        s.scalars.append(0)
    s.scalars[N_IDLE] = n_workers
    s.scalars[PROPAGATE] = propagate
    s.scalars[URGENCY] = urgency
    s.scalars[JUDGE_FROM], s.scalars[JUDGE_UNTIL] = -NEVER, NEVER
    for v in range(t.n_vertices + 1):
        demotes = t.on_late[t.dag_of[v]] == DEMOTE and urgency != OTHER_KEYS
        s.start_by.append(t.latest_start[v] if demotes else NEVER)
        s.mean.append(t.mean_time[v])
        s.holder.append(0)
        s.measured_at.append(-1)
        s.expected.append(HERE)
        s.process.append(1)
        s.ending.append(PARTS)
        set_ending(t, s, v)
    for i in range(len(t.reach_start)):
        s.reach_by.append(t.reach_start[i])
    add_process(s, 0)
    add_process(s, n_workers)
    for _ in range(t.n_queues):
        add_queue(s)
    for _ in range(t.n_groups):
        add_group(s)
    for _ in range(n_workers):
        s.worker_x.append(-1)
    for _ in range(t.n_dags):
        s.free_slot.append(-1)
        s.oldest.append(-1)
        s.newest.append(-1)
        s.n_open.append(0)
        s.partial.append(0)


def set_ending(t: Tables, s: State, vertex: int) -> None:
    """Set what the end of an execution means for its vertex."""
    is_inner = t.first_successor[vertex] < t.first_successor[vertex + 1]
    propagate = s.scalars[PROPAGATE]
    if (t.n_legs[vertex] > 1 or s.expected[vertex] == ELSEWHERE
            or propagate == 0 and t.driven[vertex] != 0 or propagate == 1 and is_inner):
        s.ending[vertex] = PARTS
    elif t.sink_deadline[vertex] >= 0 or s.expected[vertex] == LEADS_OUT:
        s.ending[vertex] = ENDS
    else:
        s.ending[vertex] = NOTHING


def add_slot(t: Tables, s: State, dag: int) -> None:
    """
    Add a slot to a DAG, with the region of executions that a job of it needs.

    A slot of the undeclared DAG has one execution, which is used again.
    """
    slot = len(s.job_dag)
    s.job_dag.append(dag)
    s.job_base.append(len(s.x_slot))
    s.job_index.append(-1)
    s.job_release.append(0)
    s.job_state.append(FREE if dag < t.n_dags else OPEN)
    s.job_sinks_left.append(0)
    s.job_late.append(0)
    s.job_demoted.append(-1)
    s.job_ready.append(0)
    s.job_inherited.append(NEVER)
    s.job_heir.append(-1)
    s.job_active.append(0)
    s.job_next.append(-1)
    s.job_previous.append(-1)
    last = t.n_vertices + 1
    if dag < t.n_dags:
        s.job_next[slot] = s.free_slot[dag]
        s.free_slot[dag] = slot
        last = t.first_vertex[dag + 1]
    else:
        s.undeclared.append(s.job_base[slot])
    for vertex in range(t.first_vertex[dag], last):
        for leg in range(t.n_legs[vertex]):
            s.x_slot.append(slot)
            s.x_vertex.append(vertex)
            s.x_like.append(vertex if dag < t.n_dags else -1)
            s.x_group.append(t.group[vertex])
            s.x_outer.append(-1)
            s.x_place.append(0)
            s.x_aside.append(-1)
            s.x_queue.append(t.first_leg[vertex] + leg)
            s.x_next.append(-1)
            s.x_previous.append(-1)
            s.x_holds.append(0)
            s.x_key.append((0, 0, 0, 0, 0))
            s.x_urged.append(NEVER)
            s.x_state.append(IDLE)
            s.x_pending.append(0)
            s.x_worker.append(-1)
            s.x_started.append(-1)
            s.x_left.append(0)
            s.x_cost.append(0)
            s.x_demoted.append(-1)
            s.x_follows.append(-1)


def add_process(s: State, n_workers: int) -> None:
    """Add a process with an interpreter of its own."""
    s.n_workers.append(n_workers)
    s.overtaking.append(1)
    s.demoted_below.append(0)
    s.overloaded.append(0)
    s.late_importance.append(0)
    s.late_until.append(-NEVER)


def add_group(s: State) -> int:
    """Add a mutually exclusive callback group and return its number."""
    s.group_owner.append(-1)
    add_heap(s.group_heap)
    return len(s.group_owner) - 1


def add_outer_group(s: State) -> int:
    """Add an outer group, which is closed, and return its number."""
    add_heap(s.outer_heap)
    s.outer_limit.append(0)
    s.outer_running.append(0)
    s.outer_once.append(0)
    s.outer_wait.append(0)
    return len(s.outer_limit) - 1


def add_queue(s: State) -> int:
    """Add an empty queue and return its number."""
    s.queue_first.append(-1)
    s.queue_last.append(-1)
    s.queue_key.append((0, 0, 0, 0, 0))
    s.queue_place.append(READY)
    s.queue_demoted.append(-1)
    return len(s.queue_first) - 1


def add_heap(heaps: list[list[Any]]) -> None:
    """Add an empty heap."""
    heaps.append([])

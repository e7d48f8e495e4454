# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes the trace of a computed run as the live executor would record it.

Theory of operation
-------------------
Virtual time is the trace's clock: it starts at 0.  A worker is a thread; the address of a callback
is its index in the declaration, from 1.  A preempted execution is recorded in pieces, like a
suspended coroutine.  A sync callback, which the simulator runs once, completes all its legs at its
end; the last leg gets all of its time.  If executions shared CPUs or held the GIL, their CPU time
(the execution time) is recorded, and whether they held the GIL.

Events are in the order of time.  At the same instant ends, completions and releases are in the
order in which the core processed them, each with its verdicts; starts come last.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from typing import Any

from mddag_executor.analysis.deadlines import Judged
from mddag_executor.core import DEFAULT_DEADLINE_NS, NEVER, rad_offsets, Tables
from mddag_executor.core.tables import ON_LATE
from mddag_executor.recording import tables
from mddag_executor.recording.columns import Table
from mddag_executor.simulate import SimulatedRun, Workload
from mddag_executor.trace import TraceFile
from mddag_executor.whatif.computed import ComputedRun
from msg_graph import TaskSet

PROCESS = 1
_MOST = 2 ** 31 - 1
_ENDS = {tables.EXPIRED: 'expire', tables.OUTDATED: 'outdate'}
_Entry = tuple[tuple[int, int, int], str, int, int, tuple[Any, ...]]
"""Position in the order, name, time, thread, fields."""


def write_trace(
    path: str | os.PathLike[str], task_set: TaskSet, load: Workload, run: SimulatedRun
) -> None:
    """Write the trace of a run that was simulated with its log."""
    settings = run.settings
    knows_cpu = settings.cpus is not None or len(load.holds) > 0
    events = sorted(_events(ComputedRun.of_run(task_set, load, run), knows_cpu),
                    key=lambda event: event[0])
    with TraceFile(path) as file:
        file.extend([
            ('task_set', 0, 0, task_set.text, task_set.file, settings.policy, settings.workers,
             DEFAULT_DEADLINE_NS, _MOST, settings.preempts, settings.cpus or 0,
             ON_LATE[settings.on_late]),
            *(('rclcpp_callback_register', 0, 0, place, callback.key)
              for place, callback in enumerate(task_set.callbacks, 1))], PROCESS)
        file.extend(((name, time, thread, *fields)
                     for _, name, time, thread, fields in events), PROCESS)
        file.extend([('shutdown', run.ended_ns, 0, run.ended_ns)], PROCESS)
        assert file.rejected == 0, file.rejection


def _events(run: ComputedRun, knows_cpu: bool) -> Iterator[_Entry]:
    recording = run.recording()
    judged = Judged(recording)
    local = judged.tables.index_in_dag
    release: dict[tuple[int, int], int] = {}
    for row in recording.releases.tolist():
        _, dag, job, released, now, order = row
        release[dag, job] = released
        yield (now, order, 0), 'job_release', now, 0, (dag, job, released)
    yield from _executions(run, recording.executions, local, release, knows_cpu)
    for _, dag, _, job, now, reason, order in recording.job_ends.tolist():
        if reason != tables.FAILED:
            yield (now, order, 0), _ENDS[reason], now, 0, (dag, job)
    missed = judged.missed
    for _, dag, sink, job, _, deadline, completed, until, _, order in missed.tolist():
        yield (until, min(order, NEVER), 1), 'deadline', until, 0, (
            dag, local[sink], job, deadline, completed)
    dag_of = judged.tables.dag_of
    for _, callback, vertex, job, now, reason in recording.drops.tolist():
        yield (now, NEVER - 2, 0), 'drop', now, 0, (
            callback, dag_of[vertex], local[vertex], job,
            recording.names.drop_reasons[reason])
    for _, dag, vertex, job, now in recording.demotions.tolist():
        yield (now, NEVER - 2, 0), 'demote', now, 0, (dag, local[vertex], job)


def _executions(
    run: ComputedRun, executions: Table, local: list[int],
    release: dict[tuple[int, int], int], knows_cpu: bool,
) -> Iterator[_Entry]:
    load = run.load
    rad = [offset for dag in run.task_set.dags for offset in rad_offsets(dag)]
    n_legs = Tables.build(run.task_set, legs=True).n_legs
    columns = ('callback', 'dag', 'vertex', 'job', 'leg', 'thread', 'worker', 'ready', 'start',
               'end', 'completes', 'order')
    for (callback, dag, vertex, job, leg, thread, worker, ready, start, end, completes,
         order) in zip(*(executions[name].tolist() for name in columns)):
        if vertex < 0:
            continue    # the simulator has no undeclared callbacks of its own
        yield (start, NEVER - 1, 0), 'dispatch', start, thread, (
            callback, dag, local[vertex], job, worker, ready, release[dag, job] + rad[vertex])
        yield (start, NEVER - 1, 1), 'callback_start', start, thread, (callback, False)
        if end < 0:
            continue
        at = (end, order, -1) if completes and end > start else (
            (end, -1, 0) if end > start else (end, NEVER - 1, 2))
        yield at, 'callback_end', end, thread, (callback,)
        for each in range(n_legs[vertex] if leg < 0 else 1) if completes else ():
            whole = each == n_legs[vertex] - 1 or leg >= 0
            computed: tuple[Any, ...] = ()
            if whole and knows_cpu:
                place = load.cost_base[dag] + job * load.cost_stride[dag] + local[vertex]
                computed = load.costs[place], bool(len(load.holds) and load.holds[place])
            at = (end, order, 0) if end > start else (end, NEVER - 1, 3)
            yield at, 'complete', end, thread, (
                callback, dag, local[vertex], job, whole, end, each, *computed)

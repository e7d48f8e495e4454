# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0


"""Simulated, non-preemptive schedules as traces, with executions that no DAG declares."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mddag_executor.core import NEVER, Tables
from mddag_executor.core.state import Decision, SINK_LATE
from mddag_executor.simulate.engine import END, LogEntry, START
from mddag_executor.simulate.load import Load
from mddag_executor.trace import TraceFile
from msg_graph import TaskSet

from .helpers import MS, START_TIME, VPID


def write_simulated(
    path: Path, task_set: TaskSet, load: Load, log: list[LogEntry], decisions: list[Decision], *,
    policy: str = 'rad', workers: int = 2, end: int,
) -> None:
    """Record a simulated, non-preemptive schedule as the live executor would have."""
    legs = Tables.build(task_set, legs=True)
    events: list[tuple[Any, ...]] = []
    ready: dict[tuple[int, int], int] = {}
    ended: dict[tuple[int, int, int], int] = {}
    for i, (time, dag, job) in enumerate(zip(load.times, load.dags, load.jobs)):
        ready[(dag, job)] = time
        if dag < legs.n_dags:
            release = load.releases[i] if load.releases else time
            events.append(('job_release', time, 2, dag, job, release))
    for start, entry in executions(log):
        time, _, worker, dag, vertex, job = entry
        declared = dag < legs.n_dags
        local = legs.index_in_dag[vertex]
        address = 1000 + vertex
        where = (dag, local, job) if declared else (-1, -1, -1)
        before = task_set.dags[dag].vertices[local].predecessors if declared else ()
        noticed = max((ended[(dag, p, job)] for p in before), default=ready[(dag, job)])
        ended[(dag, local, job)] = time
        events += [
            ('dispatch', start, 100 + worker, address, *where, worker, noticed, 0),
            ('callback_start', start, 100 + worker, address, False),
            ('callback_end', time, 100 + worker, address)]
        for leg in range(legs.n_legs[vertex] if declared else 0):
            events.append(('complete', time, 100 + worker, address, *where,
                           leg == legs.n_legs[vertex] - 1, time, leg))
    for kind, dag, vertex, job, deadline, time in decisions:
        if kind == SINK_LATE:
            events.append(
                ('deadline', time, 2, dag, legs.index_in_dag[vertex], job, deadline, time))
    with TraceFile(path, overwrite=True) as file:
        file.add('task_set', START_TIME - 1, VPID, 1, task_set.text, task_set.file, policy,
                 workers, 100 * MS, 0, False)
        for event in sorted(events, key=lambda e: e[1]):
            file.add(event[0], event[1], VPID, *event[2:])
        file.add('shutdown', end, VPID, 1, end)


def executions(log: list[LogEntry]) -> Iterator[tuple[int, LogEntry]]:
    """Yield start and end entry of each execution of a non-preemptive log, by order of end."""
    since: dict[int, int] = {}
    for entry in log:
        if entry[1] == START:
            since[entry[2]] = entry[0]
        else:
            assert entry[1] == END
            yield since.pop(entry[2]), entry


def loose(task_set: TaskSet) -> Tables:
    """Return tables without bounds, for simulations."""
    return Tables.build(task_set, max_active_jobs=NEVER)

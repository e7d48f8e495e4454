# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The core's decisions: counted, reported to the user, written to the trace."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
import threading
from typing import Any, Protocol

from mddag_executor.core import Tables, Tally
from mddag_executor.core.state import (
    Decision,
    DROP,
    EXPIRED,
    JOB_END,
    OUTDATED,
    SINK_DEMOTED,
    SINK_FAILED,
    SINK_IN_TIME,
    SINK_LATE,
    SINK_NOT_DUE,
    SINK_OVERDUE,
)
from mddag_executor.core.stops import LEAST_NS, Stops
from mddag_executor.core.tally import VERDICTS
from mddag_executor.executor.attribution import Origin
from mddag_executor.executor.entity import Entity
from msg_graph import TaskSet

KEEP_RESPONSES = 2_000
_RECORDED_ENDS = {EXPIRED: 'expire', OUTDATED: 'outdate'}


@dataclass(frozen=True)
class DeadlineMiss:
    """
    A sink that missed its deadline; times in ns since the epoch.

    ``kind`` is ``overdue`` if it was not known to be complete after its deadline, which is
    reported at once, but not while the thread of a callback that has ended still has to report
    that: it may have ended in time.  ``kind`` is ``late`` if the executor
    learnt of the completion first, at the time ``completed_ns`` (else None).  A miss that is
    certain before the deadline is ``expired`` or ``failed`` (a callback of the job raised) if the
    job can no longer complete, or ``dropped`` for a newer job (``keep: newest``).
    """

    dag: str
    vertex: str
    job: int
    release_ns: int
    deadline_ns: int
    completed_ns: int | None
    kind: str


class Record(Protocol):
    """Writes trace events (see ``mddag_executor.trace.TraceWriter.record``)."""

    def __call__(self, event: str, timestamp: int, vtid: int, /, *fields: Any) -> None:
        """Record one event."""


class Verdicts:
    """
    The run's counts, misses and mddag trace events.

    :param record: receives trace events; None: they are not recorded.
    :param on_miss: receives every miss under the engine's lock, so it must not wait.
    """

    def __init__(
        self, task_set: TaskSet | None, tables: Tables, record: Record | None,
        on_miss: Callable[[DeadlineMiss], None] | None,
    ) -> None:
        self.tally = Tally(task_set, tables, KEEP_RESPONSES)
        self.stops = Stops()
        #: By DAG: how many misses are explained by stops of the machine.
        self.in_stops = [0] * tables.n_dags
        #: How many misses were reported, each of them once.
        self.missed = 0
        self._last_missed = -1, -1
        #: The declared callbacks that lack a timer, a subscription or a service that they had
        #: (``bindings.Bindings`` keeps them).
        self.gone: Collection[str] = ()
        self.record = record
        self._dags = task_set.dags if task_set is not None else ()
        self._tables = tables
        self._on_miss = on_miss
        #: Called with DAG and release of each job that starts.
        self.on_release: Callable[[int, int], None] | None = None
        #: Called with DAG, number and end of each job that has ended.
        self.on_end: Callable[[int, int, int], None] | None = None

    def add(self, decisions: list[Decision], now: int) -> list[int]:
        """Count decisions of the core; return the executions that it dropped."""
        dropped = []
        for kind, dag, vertex, job, deadline, time in decisions:
            if kind == SINK_IN_TIME:
                continue
            if kind == JOB_END:
                if self.on_end is not None or self.record is not None:
                    self._ended(dag, job, deadline, now)
            elif kind == DROP:
                dropped.append(deadline)
            elif kind == SINK_OVERDUE:
                self._report(kind, dag, vertex, job, deadline, None)
            elif kind == SINK_DEMOTED:
                if self.record is not None:
                    self.record('demote', now, threading.get_native_id(), dag,
                                self._tables.index_in_dag[vertex], job)
            elif kind != SINK_NOT_DUE:
                self._missed(kind, dag, vertex, job, deadline, time, now)
        self.tally.add(decisions)  # last: it knows which sinks were overdue before
        return dropped

    def _ended(self, dag: int, job: int, end: int, now: int) -> None:
        name = _RECORDED_ENDS.get(end)
        if self.record is not None and name is not None:
            self.record(name, now, threading.get_native_id(), dag, job)
        if self.on_end is not None:
            self.on_end(dag, job, end)

    def _missed(
        self, kind: int, dag: int, vertex: int, job: int, deadline: int, time: int, now: int,
    ) -> None:
        if self.record is not None:
            self.record(
                'deadline', now, threading.get_native_id(), dag,
                self._tables.index_in_dag[vertex], job, deadline, time)
        completed = time if kind == SINK_LATE else None
        # a failure is caused by its callback
        if kind != SINK_FAILED:
            release = deadline - self._tables.sink_deadline[vertex]
            self.in_stops[dag] += self.stops.missed(release, deadline, time, dag)
        if (vertex, job) not in self.tally.overdue:
            self._report(kind, dag, vertex, job, deadline, completed)

    def _report(
        self, kind: int, dag: int, vertex: int, job: int, deadline: int, completed: int | None
    ) -> None:
        self.missed += 1
        self._last_missed = vertex, job
        if self._on_miss is not None:
            self._on_miss(DeadlineMiss(
                self._dags[dag].name, self.tally.vertex_name(vertex), job,
                deadline - self._tables.sink_deadline[vertex], deadline, completed,
                VERDICTS[kind]))

    def last_missed(self) -> tuple[str, str, int, int]:
        """Return DAG, sink, job and relative deadline of the last miss; there must be one."""
        vertex, job = self._last_missed
        return (self._dags[self._tables.dag_of[vertex]].name, self.tally.vertex_name(vertex), job,
                self._tables.sink_deadline[vertex])

    def released(self, dag: int, job: int, release: int, now: int, judged: bool) -> None:
        """Note that a job was released."""
        if judged:
            self.tally.jobs[dag] += 1
        if self.on_release is not None:
            self.on_release(dag, release)
        if self.record is not None:
            self.record('job_release', now, threading.get_native_id(), dag, job, release)

    def machine_stopped(self, begin: int, end: int) -> None:
        """Note a time in which no thread of the process ran, which has just ended."""
        for dag in self.stops.stopped(begin, end) if end - begin >= LEAST_NS else ():
            self.in_stops[dag] += 1
        if self.record is not None:
            self.record('stop', end, threading.get_native_id(), begin, end)

    def dropped(self, entity: Entity, origin: Origin, reason: str, now: int) -> None:
        """Note that an execution was dropped."""
        entity.dropped += 1
        if self.record is not None:
            _, dag, job, vertex = origin
            self.record(
                'drop', now, threading.get_native_id(), entity.address, dag,
                self._tables.index_in_dag[vertex] if dag >= 0 else -1, job, reason)

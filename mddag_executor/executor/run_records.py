# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the engine records of messages and executions: see ``trace.schema``."""

from __future__ import annotations

from collections.abc import Iterable
from threading import get_native_id
from typing import Any

from mddag_executor.core import Tables
from mddag_executor.core.state import ALONE, State, WAITING
from mddag_executor.executor.attribution import header_stamp, NO_ORIGIN, Origin
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.unfinished import Unfinished
from mddag_executor.executor.verdicts import Record
from mddag_executor.executor.work import Work
from mddag_executor.trace.groups import EXECUTION, PUBLICATION
from mddag_executor.trace.schema import GOES_ON


class RunRecords:
    """
    Records messages and executions.

    :param record: receives the trace's events.
    """

    def __init__(self, record: Record, tables: Tables, state: State) -> None:
        self._record = record
        self._tables = tables
        self._state = state

    def message_taken(
        self, entity: Entity, message: Any, source_timestamp: int, number: int | None, now: int
    ) -> None:
        """
        Record that a message was taken at ``now``, which is not after it became ready.

        :param number: its number among the messages of its publisher, if known.
        """
        self._record(
            'rmw_take', now, get_native_id(), id(entity.rclpy_object), id(message),
            source_timestamp, True, number or 0)

    def messages_lost(self, entity: Entity, count: int, now: int) -> None:
        """Record that the middleware dropped messages."""
        self._record('messages_lost', now, get_native_id(), entity.address, count)

    def on_behalf(self, work: Work, origin: Origin, now: int, vtid: int) -> None:
        """Record on behalf of which execution a thread publishes next, at the same time."""
        _, _, job, _ = origin
        self._record('on_behalf', now, vtid, work.entity.address, job, work.ready_ns)

    def publication(self, address: int, message: Any, now: int, vtid: int) -> None:
        """Record that a thread publishes."""
        self._record(
            PUBLICATION, now, vtid, address, id(message), max(0, header_stamp(message)))

    def run(
        self, work: Work, x: int, start: int, end: int, vtid: int, worker: int,
        goes_on: bool = False,
    ) -> None:
        """
        Record the run of an undeclared callback, or of one that goes on later.

        :param x: the execution, even if it has just ended; -1: the core does not know it.
        """
        self.dispatch(work, x, start, vtid, worker, goes_on)
        self._record('callback_start', start, vtid, work.entity.address, False)
        self._record('callback_end', end, vtid, work.entity.address)

    def execution(
        self, work: Work, origin: Origin, x: int, leg: int, start: int, end: int, now: int,
        vtid: int, worker: int, *, whole: bool, failed: bool,
    ) -> None:
        """
        Record an execution of a job that has ended.

        :param origin: the vertex and job; ``leg``: which message of the vertex it was for.
        :param whole: whether it has completed its vertex.
        """
        state, tables = self._state, self._tables
        slot, dag, job, vertex = origin
        if failed:  # first, or its completion would count
            self._record('fail', now, vtid, dag, tables.index_in_dag[vertex], job)
        self._record(
            EXECUTION, start, vtid, work.entity.address, dag, tables.index_in_dag[vertex], job,
            worker, work.ready_ns, state.job_release[slot] + tables.rad_offset[vertex],
            end, now, whole, leg, work.cpu_ns, state.x_holds[x])

    def dispatch(
        self, work: Work, x: int, time: int, vtid: int, worker: int, goes_on: bool = False
    ) -> None:
        """Record that an execution was dispatched; see ``run``."""
        slot, dag, job, vertex = work.origin or NO_ORIGIN
        if goes_on and dag < 0:     # only this says which pieces are one execution
            job = GOES_ON
        index, deadline, cpu_ns, holds = -1, 0, work.cpu_ns, work.entity.habit.holds
        if dag >= 0:    # its completion says how long it computed
            index, cpu_ns, holds = self._tables.index_in_dag[vertex], -1, 0
            deadline = self._state.job_release[slot] + self._tables.rad_offset[vertex]
        elif x >= 0 and self._state.x_like[x] >= 0:     # it inherits
            deadline = self._state.x_key[x][0]
        self._record(
            'dispatch', time, vtid, work.entity.address, dag, index, job, worker, work.ready_ns,
            deadline, work.due_ns, cpu_ns, holds)

    def waiting(self, several: Iterable[Work], now: int) -> None:
        """Record what waits at the end as dispatched then: a reader sees that it was not lost."""
        state = self._state
        for work in several:
            if (state.x_state[work.x] in (WAITING, ALONE) and state.x_started[work.x] < 0
                    and work.origin is not None):
                self.dispatch(work, work.x, now, get_native_id(), -1)

    def unfinished(self, several: Iterable[Unfinished], now: int) -> None:
        """Record executions that have not ended."""
        for work, vtid, worker, since, where in several:
            _, dag, job, vertex = work.origin or NO_ORIGIN
            self._record(
                'unfinished', now, vtid, work.entity.address, dag,
                self._tables.index_in_dag[vertex] if dag >= 0 else -1, job, worker,
                work.ready_ns, since, where)

    def judge_from(self, release: int, now: int) -> None:
        """Record from which release on jobs are judged."""
        self._record('judge_from', now, get_native_id(), release)

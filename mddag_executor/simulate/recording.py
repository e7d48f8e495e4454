# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The trace of a simulated run, as the live executor would have recorded it.

Theory of operation
-------------------
Virtual time is the trace's clock: it starts at 0.  A worker is a thread; the address of a callback
is its place in the declaration, from 1.  An execution that was preempted is recorded in pieces, as
a coroutine that was suspended.  A sync callback, which the simulator runs once, completes with all
its legs at its end, and all of its time is the last one's.  Where executions shared CPUs or held
the interpreter, their CPU time is recorded, which is their execution time, and whether they did.

A replayer feeds the events to a core again, so they must be in the order in which the core saw
them: at one instant each completion with what it decided, then each release with the expiry that
made room for it, then aborts and dispatches.  The log and the core's decisions are both in that
order; this module merges them.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from typing import Any

from mddag_executor.core import DEFAULT_DEADLINE_NS, legs_of, rad_offsets
from mddag_executor.core.state import (
    ABORTED,
    Decision,
    DROP,
    EXPIRED,
    JOB_END,
    SINK_ABORTED,
    SINK_COMPLETED,
    SINK_EXPIRED,
    SINK_IN_TIME,
)
from mddag_executor.simulate.engine import END, LogEntry, START
from mddag_executor.simulate.load import Load
from mddag_executor.simulate.run import Run
from mddag_executor.trace import TraceFile
from msg_graph import TaskSet

PROCESS = 1
_MOST = 2 ** 31 - 1

_NO_DECISION = (-1, -1, -1, -1, -1, -1)

Event = tuple[Any, ...]
Id = tuple[int, int, int]
"""DAG, global vertex, job."""


def write_trace(
    path: str | os.PathLike[str], task_set: TaskSet, load: Load, run: Run
) -> None:
    """
    Write the trace of a run that was simulated with its log.

    :raises mddag_executor.trace.TraceError: when the file cannot be written.
    """
    with TraceFile(path) as file:
        file.extend(_Merger(task_set, load, run).events(), PROCESS)
        assert file.rejected == 0, file.rejection


class _Merger:
    """Makes events of the releases, the log and the decisions of a run."""

    def __init__(self, task_set: TaskSet, load: Load, run: Run) -> None:
        self._task_set = task_set
        self._load = load
        self._run = run
        self._vertices = task_set.vertices
        self._last_leg = [
            max(1, len(legs_of(vertex, task_set.dags[vertex.dag].vertices))) - 1
            for vertex in self._vertices]
        self._address = [place + 1 for place in task_set.places_of_vertices()]
        self._rad = [offset for dag in task_set.dags for offset in rad_offsets(dag)]
        self._first = [0]
        for dag in task_set.dags:
            self._first.append(self._first[-1] + len(dag.vertices))
        self._decisions = run.decisions
        self._next_decision = 0
        self._next_release = 0
        self._ready: dict[Id, int] = {}
        self._release: dict[tuple[int, int], int] = {}

    def events(self) -> Iterator[Event]:
        """Yield the events in the order of the core."""
        settings = self._run.settings
        yield ('task_set', 0, 0, self._task_set.text, self._task_set.file, settings.policy,
               settings.workers, DEFAULT_DEADLINE_NS, _MOST, self._run.preemptive,
               settings.cpus or 0)
        for place, callback in enumerate(self._task_set.callbacks, 1):
            yield ('rclcpp_callback_register', 0, 0, place, callback.key)
        for entry in self._run.log:
            # what ends at an instant does so before anything is released or dispatched there
            before = entry[0] - 1 if entry[1] == END else entry[0]
            yield from self._releases(before)
            yield from self._aborts(before)
            yield from self._logged(entry)
        end = self._run.ended_ns
        yield from self._releases(end)
        yield from self._aborts(end)
        yield from self._decided(len(self._decisions) - 1, end)
        yield ('shutdown', end, 0, end)

    def _logged(self, entry: LogEntry) -> Iterator[Event]:
        """Yield the events of one change of a worker."""
        now, kind, worker, dag, v, job = entry
        vertex, address, thread = self._vertices[v], self._address[v], worker + 1
        if kind == START:
            yield ('dispatch', now, thread, address, dag, vertex.index, job, worker,
                   self._ready[dag, v, job], self._release[dag, job] + self._rad[v])
            yield ('callback_start', now, thread, address, False)
            return
        last = self._last_leg[v]
        if kind == END:
            for leg in range(last):  # they took no time: the piece belongs to the last one
                yield ('complete', now, thread, address, dag, vertex.index, job, False, now, leg)
        yield ('callback_end', now, thread, address)
        if kind == END:
            yield ('complete', now, thread, address, dag, vertex.index, job, True, now, last,
                   *self._computed(dag, vertex.index, job))
            del self._ready[dag, v, job]
            yield from self._verdict(dag, v, job, now)
            for after in vertex.successors:
                self._ready[dag, self._first[dag] + after, job] = now

    def _computed(self, dag: int, vertex: int, job: int) -> tuple[int, bool] | tuple[()]:
        """Return the CPU time of an execution and whether it held the interpreter."""
        load = self._load
        if self._run.settings.cpus is None and not load.holds:
            return ()
        place = load.cost_base[dag] + job * load.cost_stride[dag] + vertex
        return load.costs[place], bool(load.holds and load.holds[place])

    def _verdict(self, dag: int, v: int, job: int, now: int) -> Iterator[Event]:
        """Yield what the completion of a vertex decided."""
        i = self._next_decision
        kind, *of = self._decision(i)[:4]
        if kind not in SINK_COMPLETED or of != [dag, v, job]:
            return  # no sink, or its job has ended before
        yield from self._decided(i, now)
        ahead = self._ahead()
        kind, of_dag, _, of_job, end, when = self._decision(ahead)
        if (kind, of_dag, of_job, when) == (JOB_END, dag, job, now) and end != EXPIRED:
            yield from self._decided(ahead, now)

    def _releases(self, now: int) -> Iterator[Event]:
        """Yield the releases up to an instant, each after the expiry that it causes."""
        load = self._load
        while self._next_release < len(load.times):
            i = self._next_release
            time, dag, job = load.times[i], load.dags[i], load.jobs[i]
            if time > now or time >= self._run.settings.duration_ns:
                return
            yield from self._aborts(time - 1)
            ahead = self._ahead()
            kind, of_dag, _, _, end, when = self._decision(ahead)
            if (kind, of_dag, end, when) == (JOB_END, dag, EXPIRED, time):
                yield from self._decided(ahead, time)
            release = load.releases[i] if load.releases else time
            self._next_release += 1
            self._release[dag, job] = release
            self._ready[dag, self._first[dag] + self._task_set.dags[dag].source, job] = time
            yield ('job_release', time, 0, dag, job, release)

    def _aborts(self, now: int) -> Iterator[Event]:
        """Yield the aborts, with their drops, that were decided up to an instant."""
        while True:
            ahead = self._ahead()
            kind, _, _, _, end, time = self._decision(ahead)
            if not (kind == DROP or (kind == JOB_END and end == ABORTED)) or time > now:
                return
            yield from self._decided(ahead, time)

    def _decision(self, i: int) -> Decision:
        return self._decisions[i] if i < len(self._decisions) else _NO_DECISION

    def _ahead(self) -> int:
        """Return the place of the next decision that has its time: sinks given up have none."""
        i = self._next_decision
        while self._decision(i)[0] in (SINK_ABORTED, SINK_EXPIRED):
            i += 1
        return i

    def _decided(self, last: int, now: int) -> Iterator[Event]:
        """Yield the events of all decisions up to one, as the live executor records them."""
        while self._next_decision <= last:
            yield from self._event(self._decision(self._next_decision), now)
            self._next_decision += 1

    def _event(self, decision: Decision, now: int) -> Iterator[Event]:
        kind, dag, v, job, deadline, time = decision
        if kind == JOB_END:
            if deadline in (ABORTED, EXPIRED):
                yield ('abort' if deadline == ABORTED else 'expire', now, 0, dag, job)
            return
        vertex = self._vertices[v]
        if kind == DROP:
            yield ('drop', now, 0, self._address[v], dag, vertex.index, job, 'aborted')
        elif kind != SINK_IN_TIME:
            yield ('deadline', now, 0, dag, vertex.index, job, deadline, time)

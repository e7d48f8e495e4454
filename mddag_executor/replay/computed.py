# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A computed schedule as the recording of a run.

Theory of operation
-------------------
The simulator and the rescheduler keep a log: which worker began, ended or preempted which vertex,
and when.  With the load and the ends of jobs decided by the core this contains all data of a
recording.  So every analysis works as on a recording and finds the same verdicts.

At the same instant ends of executions come first, each with the job that it aborts, then early
ends of jobs, then releases, then starts.  A vertex is ready when the last message that it needs
has arrived: at the end of the publishing execution, shifted by ``delays``.  A preempted execution
has several pieces, like a suspended coroutine.  A sync callback runs once for all of its legs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from mddag_executor.core import DEFAULT_DEADLINE_NS, legs_of, NEVER
from mddag_executor.core.state import (
    ABORTED,
    Decision,
    DROP,
    EXPIRED,
    JOB_END,
    OUTDATED,
    SINK_DEMOTED,
    SINK_LATE,
)
from mddag_executor.recording import tables
from mddag_executor.recording.entities import Entities
from mddag_executor.recording.head import Head
from mddag_executor.recording.tables import Recording, Rows, UNKNOWN
from mddag_executor.simulate import END, Load, LogEntry, SimulatedRun, START
from mddag_executor.simulate.load import as_lists, FAILS
from msg_graph import TaskSet

Delay = Callable[[int, int, int, int], int]
"""Time (ns) from the end of an execution to its message: DAG, job in the load, edge's ends."""

Id = tuple[int, int, int]
"""DAG, global vertex, job in the load."""

_DROPS = -1, ABORTED, EXPIRED      # ends of jobs, in the order of the drop reasons
_REASONS = {ABORTED: tables.ABORTED, EXPIRED: tables.EXPIRED, OUTDATED: tables.OUTDATED}
"""Reasons, in terms of a recording, why jobs ended early."""


class ComputedRun(NamedTuple):
    """
    A computed schedule.

    :ivar horizon: no job is released from then on, ns.
    :ivar end: when it ended, ns; open jobs are then judged if ``judged``.
    :ivar numbers: by DAG the recorded numbers of the load's jobs; None: as in the load.
    :ivar delay: transport time of messages; None: 0.
    :ivar judge_from: jobs released before are not judged.
    """

    task_set: TaskSet
    load: Load
    log: Sequence[LogEntry]
    decisions: Sequence[Decision]
    horizon: int
    end: int
    judged: bool = True
    numbers: Sequence[Sequence[int]] | None = None
    delay: Delay | None = None
    judge_from: int = -NEVER

    @classmethod
    def of_run(cls, task_set: TaskSet, load: Load, run: SimulatedRun) -> ComputedRun:
        """Return a run that was simulated with its log."""
        horizon = run.settings.duration_ns
        stopped = run.settings.stop_at_first_miss and run.ended_ns < horizon
        judged = run.settings.judge == 'horizon' and not stopped
        return cls(task_set, load, run.log, run.decisions, horizon, run.ended_ns, judged)

    def recording(self, workers: int = 0) -> Recording:
        """Return the schedule as a recording."""
        return _Player(self).recording(workers)


class _Running(NamedTuple):
    """The execution of a worker, and its start; `busy` is the time of earlier pieces."""

    since: int
    ready: int
    first: int
    busy: int
    piece: int


class _Player:
    """Converts a schedule, event by event."""

    def __init__(self, schedule: ComputedRun) -> None:
        task_set = schedule.task_set
        self._schedule = schedule
        self._load = as_lists(schedule.load)
        self._releases = Rows(tables.RELEASES, 'dag', 'job', 'release', 'noticed', 'order')
        self._executions = Rows(
            tables.EXECUTIONS, 'callback', 'dag', 'vertex', 'job', 'leg', 'piece', 'thread',
            'worker', 'ready', 'began', 'start', 'end', 'busy', 'completes', 'order', 'cpu',
            'message')
        self._ends = Rows(
            tables.JOB_ENDS, 'dag', 'vertex', 'job', 'time', 'reason', 'order')
        self._order = 0
        self._vertices = task_set.vertices
        self._leg = [
            0 if len(legs_of(vertex, task_set.dags[vertex.dag].vertices)) < 2
            else tables.ALL_LEGS for vertex in self._vertices]
        self._n_dags = len(task_set.dags)
        self._first = [0]
        for dag in task_set.dags:
            self._first.append(self._first[-1] + len(dag.vertices))
        self._sources = [self._first[dag.index] + dag.source for dag in task_set.dags]
        self._callback = [place + 1 for place in task_set.places_of_vertices()]
        self._next = 0
        self._ends_of_jobs = self._job_ends()
        self._next_end = next(self._ends_of_jobs, None)
        self._ready: dict[Id, int] = {}
        self._running: dict[Id, tuple[_Running, int]] = {}
        self._begun: dict[Id, _Running] = {}

    def recording(self, workers: int) -> Recording:
        schedule = self._schedule
        for entry in schedule.log:
            # ends come before releases and early ends of jobs at the same instant
            self._until(entry[0] - 1 if entry[1] == END else entry[0])
            self._change(entry)
            now, kind, _, dag, v, job = entry
            if kind == END and self._next_end == (now, dag, job, True, v):
                self._end_job()     # completions at the same instant are too late
        self._until(schedule.end)
        for what, (ran, worker) in self._running.items():
            self._row(what, ran, worker, UNKNOWN, tables.NOTHING)
        task_set = schedule.task_set
        who = Entities(by_address=True)
        who.note('ros2:rclcpp_callback_register', {
            '_timestamp': 0, '_vpid': 0, 'callback': 0, 'symbol': 'undeclared callbacks'})
        found = Recording(
            task_set.file, Head(0, task_set.text, task_set.file, '', workers,
                                DEFAULT_DEADLINE_NS, 0, False),
            task_set, task_set, who, same=False, releases=self._releases.table(),
            executions=self._executions.table(), job_ends=self._ends.table(),
            drops=self._drops(), drop_reasons=('newer', 'aborted', 'expired'),
            demotions=self._demotions(),
            end=schedule.end, judged=schedule.judged, judged_until=schedule.end,
            workers_each=workers,
            judge_from=schedule.judge_from)
        found.start = tables.earliest(found.releases['release'], found.executions['ready'])
        return found

    def _drops(self) -> tables.Table:
        """Return the dropped executions; ``reason``: how their job had ended."""
        ended: dict[tuple[int, int], int] = {}
        drops = Rows(tables.DROPS, 'vertex', 'job', 'time', 'reason')
        for kind, dag, vertex, job, end, now in self._schedule.decisions:
            if kind == JOB_END and end in _DROPS:
                ended[dag, job] = _DROPS.index(end)
            elif kind == DROP and dag < self._n_dags:
                drops.add(vertex, self._number(dag, job), now, ended.get((dag, job), 0))
        return drops.table()

    def _demotions(self) -> tables.Table:
        demotions = Rows(tables.DEMOTIONS, 'dag', 'vertex', 'job', 'time')
        for kind, dag, vertex, job, _, now in self._schedule.decisions:
            if kind == SINK_DEMOTED:
                demotions.add(dag, vertex, self._number(dag, job), now)
        return demotions.table()

    def _next_order(self) -> int:
        self._order += 1
        return self._order

    def _number(self, dag: int, job: int) -> int:
        numbers = self._schedule.numbers
        return job if numbers is None or dag >= self._n_dags else numbers[dag][job]

    def _job_ends(self) -> Iterator[tuple[int, int, int, int, int]]:
        """Yield early ends of jobs, and the vertex that aborts one."""
        late = (-1, -1, -1), -1
        for kind, dag, v, job, how, time in self._schedule.decisions:
            if kind == SINK_LATE:
                late = (dag, job, time), v
            elif kind == JOB_END and how in _REASONS and dag < self._n_dags:
                vertex = late[1] if late[0] == (dag, job, time) else -1
                yield time, dag, job, _REASONS[how], vertex

    def _until(self, now: int) -> None:
        """Process releases and early ends up to an instant."""
        load, schedule = self._load, self._schedule
        while True:
            release = load.times[self._next] if self._next < len(load.times) else now + 1
            if release >= schedule.horizon:
                release = now + 1
            end = self._next_end
            if end is not None and end[0] <= min(now, release):
                self._end_job()
            elif release <= now:
                self._release(self._next, release)
                self._next += 1
            else:
                return

    def _end_job(self) -> None:
        assert self._next_end is not None
        now, dag, job, reason, _ = self._next_end
        self._ends.add(dag, -1, self._number(dag, job), now,
                       reason, self._next_order())
        self._next_end = next(self._ends_of_jobs, None)

    def _release(self, i: int, now: int) -> None:
        load = self._load
        dag, job = load.dags[i], load.jobs[i]
        if dag >= self._n_dags:
            self._ready[dag, len(self._vertices), job] = now
            return
        self._ready[dag, self._sources[dag], job] = now
        release = load.releases[i] if load.releases else now
        self._releases.add(dag, self._number(dag, job), release, now, self._next_order())

    def _change(self, entry: LogEntry) -> None:
        now, kind, worker, dag, v, job = entry
        what = (dag, v, job)
        if kind == START:
            before = self._begun.pop(what, None)
            if before is None:
                ready = min(now, self._ready.pop(what, now))
                before = _Running(now, ready, now, 0, 0)
            self._running[what] = before._replace(since=now), worker
            return
        ran, worker = self._running.pop(what)
        busy = ran.busy + now - ran.since
        ended = kind == END and dag < self._n_dags
        if ended and self._fails(dag, v, job):
            self._ends.add(
                dag, v, self._number(dag, job), now, tables.FAILED, self._next_order())
        self._row(what, ran, worker, now, tables.VERTEX if ended else tables.NOTHING)
        if kind != END:
            self._begun[what] = ran._replace(busy=busy, piece=ran.piece + 1)
        elif ended:
            self._complete(what, ran, now)

    def _row(self, what: Id, ran: _Running, worker: int, end: int, completes: int) -> None:
        """Add a row of an execution."""
        dag, v, job = what
        declared = dag < self._n_dags
        self._executions.add(
            self._callback[v] if declared else 0, dag if declared else -1,
            v if declared else -1,
            self._number(dag, job), self._leg[v] if completes else 0, ran.piece, worker + 1,
            worker, ran.ready, ran.first, ran.since, end,
            UNKNOWN if end < 0 else ran.busy + end - ran.since, completes,
            self._next_order() if completes else UNKNOWN, UNKNOWN, UNKNOWN)

    def _fails(self, dag: int, v: int, job: int) -> bool:
        load = self._load
        return len(load.fates) > 0 and load.fates[
            load.cost_base[dag] + job * load.cost_stride[dag] + v - self._first[dag]] == FAILS

    def _complete(self, what: Id, ran: _Running, now: int) -> None:
        """Deliver the messages of an execution that has ended."""
        dag, v, job = what
        delay = self._schedule.delay
        for local in self._vertices[v].successors:
            after = (dag, self._first[dag] + local, job)
            arrival = now if delay is None else \
                max(ran.first, now + delay(dag, job, v, after[1]))
            self._ready[after] = max(arrival, self._ready.get(after, arrival))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A schedule that was computed, played to observers as if it had been recorded.

Theory of operation
-------------------
The simulator and the rescheduler keep a log: which worker began, ended or preempted what, and
when.  Together with the load and with the ends of jobs that the core decided that is all that a
recording has, so every observer finds the same verdicts again and, as with a recording,
where the time went.

At one instant the ends of executions come first, each with the job that it aborts, then other jobs
that are given up, then releases, then starts.  A vertex is ready when the last message that it
needs has arrived: at the end of the execution that publishes it, or as much later (or earlier) as
``delays`` says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from mddag_executor.core import legs_of, NEVER
from mddag_executor.core.state import ABORTED, Decision, EXPIRED, JOB_END, SINK_LATE
from mddag_executor.replay.happenings import (
    Batches,
    COMPLETED,
    ENDED,
    FAILED,
    Observer,
    RAN,
    RELEASED,
    STARTED,
)
from mddag_executor.simulate import END, Load, LogEntry, SimulatedRun, START
from mddag_executor.simulate.load import as_lists, FAILS
from msg_graph import TaskSet

Delay = Callable[[int, int, int, int], int]
"""Time (ns) from the end of an execution to its message: DAG, job in the load, edge's ends."""

Id = tuple[int, int, int]
"""DAG, global vertex, job in the load."""


class ComputedRun(NamedTuple):
    """
    A schedule that was computed.

    :ivar horizon: no job is released from then on, ns.
    :ivar end: when it ended, ns; what is open then is judged if ``judged``.
    :ivar numbers: by DAG, what a job of the load is called; None: as in the load.
    :ivar delay: how long messages take; None: no time.
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

    def play(self, observers: Sequence[Observer]) -> None:
        """Give the observers everything."""
        _Player(self, observers).run()


class _Running(NamedTuple):
    """What a worker runs, and since when; `busy` is the time of the pieces before."""

    since: int
    ready: int
    first: int
    busy: int


class _Player:
    """Goes through a schedule once."""

    def __init__(self, schedule: ComputedRun, observers: Sequence[Observer]) -> None:
        task_set = schedule.task_set
        self._schedule = schedule
        self._load = as_lists(schedule.load)
        self._batches = Batches(observers)
        self._add = self._batches.add
        self._vertices = task_set.vertices
        self._last_leg = [
            max(1, len(legs_of(vertex, task_set.dags[vertex.dag].vertices))) - 1
            for vertex in self._vertices]
        self._n_dags = len(task_set.dags)
        self._first = [0]
        for dag in task_set.dags:
            self._first.append(self._first[-1] + len(dag.vertices))
        self._sources = [self._first[dag.index] + dag.source for dag in task_set.dags]
        self._callback = [place + 1 for place in task_set.places_of_vertices()]
        self._next = 0
        self._ends = self._job_ends()
        self._next_end = next(self._ends, None)
        self._ready: dict[Id, int] = {}
        self._running: dict[Id, _Running] = {}
        self._finished = 0      # executions

    def run(self) -> None:
        schedule = self._schedule
        for entry in schedule.log:
            # what ends at an instant does so before anything is released or given up there
            self._until(entry[0] - 1 if entry[1] == END else entry[0])
            self._change(entry)
            now, kind, _, dag, v, job = entry
            if kind == END and self._next_end == (now, dag, job, True, v):
                self._end_job()     # what else of it ends at that instant comes too late
            self._batches.flush_if_full()
        self._until(schedule.end)
        self._batches.finish(schedule.end, schedule.judged)

    def _number(self, dag: int, job: int) -> int:
        numbers = self._schedule.numbers
        return job if numbers is None or dag >= self._n_dags else numbers[dag][job]

    def _job_ends(self) -> Iterator[tuple[int, int, int, bool, int]]:
        """Yield when jobs end otherwise than by completing, and the vertex that aborts one."""
        late = (-1, -1, -1), -1
        for kind, dag, v, job, how, time in self._schedule.decisions:
            if kind == SINK_LATE:
                late = (dag, job, time), v
            elif kind == JOB_END and how in (ABORTED, EXPIRED) and dag < self._n_dags:
                vertex = late[1] if late[0] == (dag, job, time) else -1
                yield time, dag, job, how == ABORTED, vertex

    def _until(self, now: int) -> None:
        """Report what is released and given up to an instant."""
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
        now, dag, job, aborted, _ = self._next_end
        self._add(ENDED, dag, self._number(dag, job), int(aborted), now)
        self._next_end = next(self._ends, None)

    def _release(self, i: int, now: int) -> None:
        load = self._load
        dag, job = load.dags[i], load.jobs[i]
        if dag >= self._n_dags:
            self._ready[dag, len(self._vertices), job] = now
            return
        self._ready[dag, self._sources[dag], job] = now
        release = load.releases[i] if load.releases else now
        self._add(RELEASED, dag, self._number(dag, job), release, now)

    def _change(self, entry: LogEntry) -> None:
        now, kind, worker, dag, v, job = entry
        if v < 0:       # what starts it was noticed (see ``simulate.intakes``)
            what = (dag, ~v, job)
            self._ready[what] = max(now, self._ready.get(what, now))
            return
        declared = dag < self._n_dags
        number = self._number(dag, job)
        what = (dag, v, job)
        before = self._running.get(what)
        if kind == START:
            if before is None:
                ready = min(now, self._ready.pop(what, now))
                before = _Running(now, ready, now, 0)
            self._running[what] = before._replace(since=now)
            if declared:
                self._add(STARTED, dag, v, number, before.ready, now, self._callback[v], worker)
            return
        assert before is not None, 'what ends has begun'
        busy = before.busy + now - before.since
        self._running[what] = before._replace(busy=busy)
        if kind == END and declared and self._fails(dag, v, job):
            self._add(FAILED, dag, v, number, now)
        last = self._last_leg[v] if kind == END and declared else 0
        for leg in range(last):     # they took no time: the execution is the last one's
            self._add(COMPLETED, dag, v, number, leg, 0, now, -1, -1, -1, -1, -1, -1, 0)
        self._add(
            RAN, self._callback[v] if declared else 0, dag if declared else -1,
            v if declared else -1, number, worker, before.ready, before.since, now,
            int(before.busy == 0))
        if kind == END:
            del self._running[what]
            if declared:
                self._complete(what, last, before, now, busy)

    def _fails(self, dag: int, v: int, job: int) -> bool:
        load = self._load
        return len(load.fates) > 0 and load.fates[
            load.cost_base[dag] + job * load.cost_stride[dag] + v - self._first[dag]] == FAILS

    def _complete(self, what: Id, leg: int, ran: _Running, now: int, busy: int) -> None:
        dag, v, job = what
        vertex, number = self._vertices[v], self._number(dag, job)
        self._finished += 1
        self._add(COMPLETED, dag, v, number, leg, 1, now, ran.ready, ran.first, now, busy,
                  self._finished, -1, 0)
        delay = self._schedule.delay
        for local in vertex.successors:
            after = (dag, self._first[dag] + local, job)
            arrival = now if delay is None else \
                max(ran.first, now + delay(dag, job, v, after[1]))
            self._ready[after] = max(arrival, self._ready.get(after, arrival))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A computed schedule as the recording of a run.

Theory of operation
-------------------
The simulator and the rescheduler keep a log: the releases, starts, preemptions and ends of
executions, and the early ends of jobs, in the order in which the engine processed them.  With the
load and the core's decisions about sinks this contains all data of a recording.  So every analysis
works as on a recording and finds the same verdicts.

A vertex is ready when the last message that it
needs has arrived: at the end of the publishing execution, shifted by the delays of the load.  A
preempted execution has several pieces, like a suspended coroutine.  A sync callback runs once for
all of its legs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.analysis.paths import Paths
from mddag_executor.analysis.requirements import Requirements
from mddag_executor.core import DEFAULT_DEADLINE_NS, NEVER, processes_of, Tables
from mddag_executor.core.state import (
    Decision,
    DROP,
    EXPIRED,
    JOB_END,
    OUTDATED,
    SINK_DEMOTED,
)
from mddag_executor.recording import tables
from mddag_executor.recording.columns import Ints, Table
from mddag_executor.recording.columns import rows as table_of
from mddag_executor.recording.head import Head
from mddag_executor.recording.joins import distinct, earliest, equal, sort_by
from mddag_executor.recording.names import Names
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.run import Run
from mddag_executor.recording.tables import UNKNOWN
from mddag_executor.simulate import (
    END,
    JOB_ENDED,
    LogEntry,
    RELEASE,
    SimulatedRun,
    START,
    Workload,
)
from mddag_executor.simulate.workload import edge_numbers, FAILS
from mddag_executor.sources.executions import Numbering
from msg_graph import Process, TaskSet
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import PathsResult

_DROPS = -1, EXPIRED      # ends of jobs, in the order of the drop reasons
_REASONS = {EXPIRED: tables.EXPIRED, OUTDATED: tables.OUTDATED}
"""Reasons, in terms of a recording, why jobs ended early."""


class ComputedRun(NamedTuple):
    """
    A computed schedule.

    :ivar end: when it ended, ns; open jobs are then judged if ``judged``.
    :ivar numbers: by DAG the recorded numbers of the load's jobs; None: as in the load.
    :ivar judge_from: jobs released before are not judged; ``judged_releases``: range of judged
        releases, ns; None: all.
    :ivar processes: the nodes of each process; empty: one process.
    """

    task_set: TaskSet
    load: Workload
    log: Sequence[LogEntry]
    decisions: Sequence[Decision]
    end: int
    judged: bool = True
    numbers: Sequence[Ints] | None = None
    judge_from: int = -NEVER
    judged_releases: tuple[int, int] | None = None
    processes: Sequence[Process] = ()

    @classmethod
    def of_run(cls, task_set: TaskSet, load: Workload, run: SimulatedRun) -> ComputedRun:
        """Return a run that was simulated with its log."""
        stopped = run.settings.stop_at_first_miss and run.ended_ns < run.settings.duration_ns
        judged = run.settings.judge == 'horizon' and not stopped
        return cls(task_set, load, run.log, run.decisions, run.ended_ns, judged,
                   processes=task_set.processes if len(run.settings.pools) > 1 else ())

    def recording(self, workers: int = 0) -> Recording:
        """
        Return the schedule as a recording.

        :param workers: number of workers of all processes.
        """
        task_set, found = self.task_set, _Tables(self)
        releases, executions, job_ends = found.in_order()
        count = max(1, len(self.processes))
        run = Run(
            task_set.file, Head(0, task_set.text, task_set.file, '', workers,
                                DEFAULT_DEADLINE_NS, 0, False),
            task_set, task_set, same=False, unsent=found.unsent(),
            start=earliest(releases['release'], executions['ready']), end=self.end,
            judged=self.judged, judged_until=self.end, processes=count,
            workers_each=workers // count, placed=self.processes, judge_from=self.judge_from,
            judged_releases=self.judged_releases)
        return Recording(
            run, tables.Columns(
                releases=releases, executions=executions, job_ends=job_ends, drops=found.drops(),
                demotions=found.demotions()),
            Names(symbols={0: 'undeclared callbacks'}, drop_reasons=('newer', 'expired'),
                  process_names=tuple(each.name for each in self.processes)))

    def requirements(self) -> PathsResult:
        """Return ``paths`` and ``requirements`` of the result; nothing if nothing is required."""
        if not any(path.requirements for path in self.task_set.paths):
            return {}
        recording = self.recording()
        paths = Paths(recording, self.judge_from)
        return {'paths': paths.results(),
                'requirements': Requirements(recording, paths, self.judge_from).result()}


class _Pieces(NamedTuple):
    """
    Columns by piece of an execution, in the order of vertex, job and start.

    ``begins``, ``ends``: rows of the log, ``ends`` is -1 if it still ran; ``first``: the first
    piece of the execution; ``ended``: whether it is the last one; ``end`` is 0 if it still ran.
    """

    dag: Ints
    vertex: Ints
    job: Ints
    worker: Ints
    begins: Ints
    ends: Ints
    start: Ints
    end: Ints
    first: Ints
    ended: Any


def _columns(rows: Sequence[tuple[int, ...]]) -> Ints:
    """Return the six columns of log entries or decisions."""
    found: Ints = np.asarray(rows, dtype=np.int64).reshape(-1, 6).T
    return found


def _position(rows: Ints) -> Ints:
    """Return the positions in the order of a recording for rows of the log."""
    return 2 * rows + 2


class _Tables:
    """Makes the tables of the recording."""

    def __init__(self, schedule: ComputedRun) -> None:
        self._schedule = schedule
        self._load: Any = Workload(*(np.asarray(each, dtype=np.int64)  # type: ignore[arg-type]
                                 for each in schedule.load))
        self._tables = Tables.build(schedule.task_set)
        self._n_dags = self._tables.n_dags
        #: By vertex the number of its process; the last one is that of undeclared callbacks.
        self._process = np.array([*processes_of(
            replace(schedule.task_set, processes=tuple(schedule.processes))), 1]) - 1
        #: By vertex the number of its callback; the last one is that of undeclared callbacks.
        self._callback = np.r_[
            np.array(schedule.task_set.places_of_vertices(), dtype=np.int64) + 1, 0]
        self._log = _columns(schedule.log)
        self._decisions = _columns(schedule.decisions)

    @cached_property
    def _pieces(self) -> _Pieces:
        now, kind, worker, dag, vertex, job = self._log
        rows = np.flatnonzero(kind < RELEASE)
        # the starts and stops of each execution alternate
        rows = rows[sort_by(vertex[rows], job[rows])]
        at = np.flatnonzero(kind[rows] == START)
        after = np.r_[rows, -1][at + 1]
        ends = np.where((after >= 0) & (kind[after] != START), after, -1)
        begins = rows[at]
        dag, vertex, job, worker = (each[begins] for each in (dag, vertex, job, worker))
        new = np.r_[True, (vertex[1:] != vertex[:-1]) | (job[1:] != job[:-1])][:len(at)]
        return _Pieces(
            dag, vertex, job, worker, begins, ends, now[begins],
            np.where(ends >= 0, now[ends], 0), np.flatnonzero(new)[np.cumsum(new) - 1],
            (ends >= 0) & (kind[ends] == END))

    def _numbers(self, dag: Ints, job: Ints) -> Ints:
        """Return the recorded numbers of jobs."""
        found = job.copy()
        for number, recorded in enumerate(self._schedule.numbers or ()):
            mine = dag == number
            found[mine] = recorded[job[mine]]
        return found

    def in_order(self) -> tuple[Table, Table, Table]:
        """Return releases, executions and ends of jobs, with their positions in the log."""
        pieces, kind = self._pieces, self._log[1]
        done = np.flatnonzero(pieces.ended & (pieces.dag < self._n_dags))
        done = done[sort_by(pieces.ends[done])]
        completed = np.full(len(pieces.begins), UNKNOWN)
        completed[done] = _position(pieces.ends[done])
        return (self._releases(np.flatnonzero(kind == RELEASE)), self._executions(completed),
                self._job_ends(done[self._fails(done)], np.flatnonzero(kind == JOB_ENDED)))

    def _fails(self, done: Ints) -> Ints:
        """Return which of the completions are failures."""
        load, pieces = self._load, self._pieces
        if not len(load.fates):
            return done[:0]
        dag = pieces.dag[done]
        local = np.array(self._tables.index_in_dag)[pieces.vertex[done]]
        return np.flatnonzero(load.fates[
            load.cost_base[dag] + pieces.job[done] * load.cost_stride[dag] + local] == FAILS)

    def _releases(self, rows: Ints) -> Table:
        now, _, _, dag, release, job = self._log[:, rows]
        return table_of(
            tables.RELEASES, len(rows), process=self._process_of(dag), dag=dag,
            job=self._numbers(dag, job), release=release, noticed=now, order=_position(rows))

    def _process_of(self, dag: Ints) -> Ints:
        """Return the processes of the sources of DAGs."""
        found: Ints = self._process[np.array(self._tables.source, dtype=np.int64)[dag]]
        return found

    def _job_ends(self, failed: Ints, early: Ints) -> Table:
        """
        Return the ends of jobs before their last completions.

        :param failed: the pieces that failed; ``early``: the other ends, as rows of the log.
        """
        pieces = self._pieces
        now, _, _, dag, how, job = self._log[:, early]
        reason = np.array([_REASONS[each] for each in how.tolist()], dtype=np.int64)
        dag, job = np.r_[pieces.dag[failed], dag], np.r_[pieces.job[failed], job]
        found = table_of(
            tables.JOB_ENDS, len(dag), process=self._process_of(dag), dag=dag,
            vertex=np.r_[pieces.vertex[failed], np.full(len(early), UNKNOWN)],
            job=self._numbers(dag, job), time=np.r_[pieces.end[failed], now],
            reason=np.r_[np.full(len(failed), tables.FAILED), reason],
            # an execution that fails ends its job before it completes
            order=np.r_[_position(pieces.ends[failed]) - 1, _position(early)])
        return found[sort_by(found['order'])]

    def _executions(self, order: Ints) -> Table:
        """
        Return the executions, in the order of their ends.

        :param order: by piece its position in the log, if it completes a vertex.
        """
        each = self._pieces
        rows = sort_by(np.where(each.ends >= 0, each.ends, len(self._log[0]) + each.begins))
        first, ran, completes, declared = (
            each.first, each.ends >= 0, order >= 0, each.dag < self._n_dags)
        total = np.cumsum(np.where(ran, each.end - each.start, 0))
        before = np.r_[0, total][first]
        legs = np.where(Numbering(self._schedule.task_set).n_legs > 1, tables.ALL_LEGS, 0)
        return table_of(
            tables.EXECUTIONS, len(first), process=self._process[each.vertex],
            callback=self._callback[each.vertex],
            dag=np.where(declared, each.dag, -1), vertex=np.where(declared, each.vertex, -1),
            job=self._numbers(each.dag, each.job), leg=np.where(completes, legs[each.vertex], 0),
            piece=np.arange(len(first)) - first, thread=each.worker + 1, worker=each.worker,
            ready=self._ready()[first], began=each.start[first], start=each.start,
            end=np.where(ran, each.end, UNKNOWN), busy=np.where(ran, total - before, UNKNOWN),
            completes=np.where(completes, tables.VERTEX, tables.NOTHING), order=order,
            cpu=UNKNOWN, message=UNKNOWN)[rows]

    def _ready(self) -> Ints:
        """Return by piece when its execution became ready; valid for first pieces."""
        load, each = self._load, self._pieces
        first, vertices = np.arange(len(each.first)) == each.first, np.arange(
            1, self._tables.n_vertices + 1)
        of_vertex, ended_of = (np.split(rows, np.searchsorted(each.vertex[rows], vertices))
                               for rows in map(np.flatnonzero, (first, each.ended)))
        ready = np.full(len(first), -NEVER)
        jobs = 1 + max(int(each.job.max(initial=0)), int(load.jobs.max(initial=0)))
        for dag, source in enumerate(self._tables.source):
            mine, rows = load.dags == dag, of_vertex[source]
            times = np.full(jobs, -NEVER)
            times[load.jobs[mine]] = load.times[mine]
            ready[rows] = times[each.job[rows]]
        for (before, after), edge in edge_numbers(self._tables).items():
            ended, rows = ended_of[before], of_vertex[after]
            at = equal(each.job[rows], each.job[ended])
            ended, rows = ended[at >= 0], rows[at[at >= 0]]
            arrived = each.end[ended]
            if len(load.delay_base):
                dag = self._tables.dag_of[before]
                delay = load.delays[
                    load.delay_base[dag] + each.job[ended] * load.delay_stride[dag] + edge]
                arrived = np.maximum(each.start[each.first[ended]], arrived + delay)
            arrived = np.where(each.ends[ended] < each.begins[rows], arrived, -NEVER)
            ready[rows] = np.maximum(ready[rows], arrived)
        return np.where(ready > -NEVER, np.minimum(ready, each.start), each.start)

    def drops(self) -> Table:
        """Return the dropped executions; ``reason``: how their job had ended."""
        kind, dag, vertex, job, end, now = self._decisions
        ended: dict[tuple[int, int], int] = {}
        found, reasons = [], []
        for row in np.flatnonzero(
                (dag < self._n_dags) & ((kind == DROP) | (kind == JOB_END) & np.isin(
                    end, _DROPS))).tolist():
            if kind[row] == DROP:
                found.append(row)
                reasons.append(ended.get((dag[row], job[row]), 0))
            else:
                ended[dag[row], job[row]] = _DROPS.index(end[row])
        rows = np.array(found, dtype=np.int64)
        return table_of(
            tables.DROPS, len(rows), process=self._process[vertex[rows]],
            callback=self._callback[vertex[rows]], vertex=vertex[rows],
            job=self._numbers(dag[rows], job[rows]), time=now[rows], reason=reasons)

    def demotions(self) -> Table:
        """Return the demotions of sinks."""
        _, dag, vertex, job, _, time = self._decisions[:, self._decisions[0] == SINK_DEMOTED]
        return table_of(
            tables.DEMOTIONS, len(dag), process=self._process[vertex], dag=dag, vertex=vertex,
            job=self._numbers(dag, job), time=time)

    def unsent(self) -> dict[tuple[int, int], Ints]:
        """Return by the vertices of an edge the jobs in which nothing was published on it."""
        tables, load = self._tables, self._load
        if not len(load.delay_base) or not any(tables.is_optional):
            return {}
        found = {}
        for place, ((before, after), edge) in enumerate(edge_numbers(tables).items()):
            if tables.is_optional[place]:
                dag = tables.dag_of[before]
                jobs = distinct(load.jobs[load.dags == dag])
                delays = load.delays[
                    load.delay_base[dag] + jobs * load.delay_stride[dag] + edge]
                silent = jobs[delays >= NEVER]
                found[before, after] = self._numbers(np.full(len(silent), dag), silent)
        return found

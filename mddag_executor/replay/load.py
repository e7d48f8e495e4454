# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The load of a recorded run: releases, execution times, transport and dispatch times.

Theory of operation
-------------------
* Jobs are the released jobs, in the order of release.  A source is ready when it was in the
  recording: shortly after a timer's release, possibly long after the header stamp of a message.
* A worker notices due timers before it chooses its next execution.  A timer that was noticed right
  after the end of an execution, and was due before, is therefore known at its release: whenever
  the next execution is chosen, it takes part.  Otherwise it is known when it was noticed.  One
  worker notices nothing while it runs a callback, so whatever was due meanwhile is known.
* The execution time of a vertex is the sum of the pieces of its execution.  If it did not complete
  (dropped, expired, open at the end), it is the callback's median, otherwise the declared mean.
* A job that expired at its release never ran: its timer was noticed after its next period.  This
  depends on the machine, not on the scheduler, so the job is skipped again.
* A sync vertex has the execution time of the leg that completed it.  Earlier legs, which only
  store their message, load the workers like undeclared callbacks: each piece is a job of the
  undeclared DAG, ready when it was in the recording.  Their callback groups are ignored.
* If CPU times are recorded, the load has the CPU time and whether the GIL was held (as recorded or
  declared).  An execution that computes without the GIL takes its CPU time: for the rest of the
  time it waited for a CPU.  One that holds the GIL takes its duration without the time in which
  another callback held the GIL, too; with one worker, or in fewer processes than recorded, it
  takes its CPU time.  (The difference: other threads of its process computed.)
* *Transport* is the time from the end of the publishing execution until the successor is ready;
  negative if it published early.
* *Dispatch* is the time from when an execution could have started until it started (see
  ``dispatches``).  It occupies the worker, so it is added to the execution time.
* A time that is missing in a job is replaced by the median of the edge, or of all executions.
* Missing publications are kept: if an execution completed without publishing on a topic that its
  callback used in other jobs, and no execution followed in that job, the edge is not satisfied.
  Vertices that need it have no execution time.

Without overheads (``overheads=False``) transport and dispatch take no time, and timers are ready
at their release, as in an ideal executor on the same machine.

Within the engine a job's index is its position among the recorded jobs of its DAG; ``jobs`` has
the recorded indices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TYPE_CHECKING

from mddag_executor.core import legs_of, NEVER, quantile, Tables
from mddag_executor.recording import tables as recorded_tables
from mddag_executor.recording.tables import (
    in_parts,
    Ints,
    look_up,
    Recording,
    rows_by,
    sort_by,
    Table,
)
from mddag_executor.replay.dispatches import dispatch_times
from mddag_executor.replay.spans import crowded, Spans
from mddag_executor.replay.usage import ran
from mddag_executor.simulate import Load
from mddag_executor.simulate.deliveries import DELAY_NS
from mddag_executor.simulate.load import edge_numbers, edges_of, FAILS, RUNS, SKIPPED
from msg_graph import Dag
from msg_graph.model import topological_order
import numpy as np

_UNKNOWN = -1
_UNTOLD = -2


class RecordedLoad(NamedTuple):
    """
    A load made from a recording.

    ``jobs`` has, by DAG, the recorded index of each job; ``demand`` the execution times of all
    declared jobs, ns; ``estimated`` counts vertices of jobs without a recorded execution time,
    ``executions`` counts all; ``unknown`` names callbacks without any known time. ``dispatches``
    is the dispatch part of ``load.costs``; it is empty without overheads. ``dispatch_ns`` and
    ``transport_ns`` are measured medians, None if nothing was measured.
    """

    load: Load
    jobs: Sequence[Sequence[int]]
    demand: int
    executions: int
    estimated: int
    unknown: list[str]
    dispatch_ns: int | None = None
    transport_ns: int | None = None
    dispatches: Any = ()


_JOB, _VERTEX, _EDGE = range(3)
_COLUMNS = {
    'release': (_JOB, 'i8'), 'noticed': (_JOB, 'i8'), 'turn': (_JOB, 'i8'),
    'busy': (_JOB, 'i1'),
    'took': (_VERTEX, 'i8'), 'start': (_VERTEX, 'i8'), 'end': (_VERTEX, 'i8'),
    'cpu': (_VERTEX, 'i8'), 'dispatch': (_VERTEX, 'i4'), 'held': (_VERTEX, 'i2'),
    'arrived': (_EDGE, 'i8'), 'sent': (_EDGE, 'i1')}
"""Columns by job, by job and vertex, or by job and edge; ns or unknown (``sent``: 1)."""


class _Jobs:
    """
    The jobs of one DAG.

    Each of ``_COLUMNS`` is an attribute, a view of its part of the column of all DAGs.
    """

    def __init__(self, dag: Dag, n_edges: int, numbers: Ints) -> None:
        self.size = len(dag.vertices)
        self.widths = 1, self.size, n_edges
        self.publishers = [v.index for v in dag.vertices for _ in v.successors]     # by edge
        self.numbers = numbers

    if TYPE_CHECKING:
        def __getattr__(self, name: str) -> Any:
            """Declare the columns for type checkers."""

    def rows(self, name: str) -> Any:
        """Return a column as an array with a row for each job."""
        return getattr(self, name).reshape(
            len(self.numbers), self.widths[_COLUMNS[name][0]])


class LoadBuilder:
    """
    Makes a load from a recording.

    :param n_workers: number of workers of each recorded process.
    :param processes: by vertex the recorded process, from 1; None: one process.
    :param times: by DAG the execution times of its jobs and vertices, for a recording without
        executions; None: missing ones are estimated.
    """

    def __init__(
        self, recording: Recording, tables: Tables, n_workers: int,
        processes: Sequence[int] | None = None, times: Sequence[Any] | None = None,
    ) -> None:
        task_set = recording.task_set
        self._task_set, self._recording, self._tables = task_set, recording, tables
        self._first = tables.first_vertex
        self._process = [*(processes or [1] * tables.n_vertices), 1]
        self._times = times
        self._timer = [d.vertices[d.source].callback.kind == 'timer' for d in task_set.dags]
        # by global vertex and leg: the edge (number in its DAG) that its message satisfies
        numbers = edge_numbers(tables)
        self._edges_into = [
            [numbers[first + before, first + vertex.index]
             for _, before in legs_of(vertex, dag.vertices)]
            for dag, first in zip(task_set.dags, tables.first_vertex) for vertex in dag.vertices]
        self._failed: set[tuple[int, int]] = set()
        self._skipped: set[tuple[int, int]] = set()
        releases = recording.releases[sort_by(recording.releases['order'])]
        of_dag = [releases[mine] for mine in rows_by(releases['dag'], len(task_set.dags))]
        self._jobs = [_Jobs(dag, n, mine['job'].copy()) for dag, n, mine in zip(
            task_set.dags, edges_of(tables), of_dag)]
        # by kind of column and DAG: the values of each job, and where they begin
        self._widths = np.array(
            [jobs.widths for jobs in self._jobs], dtype=np.int64).reshape(-1, 3).T
        counts = np.array([len(jobs.numbers) for jobs in self._jobs], dtype=np.int64)
        self._begins = np.cumsum(np.pad(self._widths * counts, ((0, 0), (1, 0))), axis=1)
        # by kind of column and vertex: its place in the first job, and the step to the next job
        dag_of = np.array(tables.dag_of[:tables.n_vertices], dtype=np.int64)
        self._base, self._step = self._begins[:, dag_of], self._widths[:, dag_of]
        self._base[_VERTEX] += np.array(tables.index_in_dag[:tables.n_vertices], dtype=np.int64)
        self._whole: dict[str, Any] = {}
        for name, (by, kind) in _COLUMNS.items():
            self._whole[name] = np.full(self._begins[by, -1], _UNKNOWN, dtype=kind)
            for jobs, part in zip(self._jobs, np.split(self._whole[name], self._begins[by, 1:])):
                setattr(jobs, name, part)
        for jobs, mine in zip(self._jobs, of_dag):
            jobs.release[:] = mine['release']
            jobs.noticed[:] = np.maximum(mine['release'], mine['noticed'])
        self._job_ends()
        #: Columns of the executions; by execution the row of its job.
        self._executions = table = _contiguous(
            recording.executions, 'dag', 'vertex', 'job', 'piece', 'leg', 'completes', 'order',
            'worker', 'ready', 'start', 'began', 'end', 'busy', 'cpu', 'holds_gil')
        self._row = np.full(len(recording.executions), _UNKNOWN)
        for jobs, mine in zip(self._jobs, rows_by(table['dag'], len(self._jobs))):
            self._row[mine] = look_up(jobs.numbers, table['job'][mine])
        self._take_pieces(n_workers)
        self._take_completions()
        self._take_publications()
        del self._row, self._executions

    def _places(self, by: int, row: Any, vertex: Any) -> Ints:
        """Return the places of vertices of jobs in a kind of column (``_EDGE``: of edge 0)."""
        place: Ints = self._base[by][vertex] + row * self._step[by][vertex]
        return place

    def _job_ends(self) -> None:
        """Keep failed and skipped executions: they fail or are skipped again."""
        ends = self._recording.job_ends
        for dag, jobs in enumerate(self._jobs):
            mine = ends[ends['dag'] == dag]
            row = look_up(jobs.numbers, mine['job'])
            failed = (row >= 0) & (mine['reason'] == recorded_tables.FAILED)
            self._failed |= set(zip(mine['vertex'][failed].tolist(), row[failed].tolist()))
            skipped = (row >= 0) & (mine['reason'] == recorded_tables.EXPIRED)
            skipped[skipped] = jobs.noticed[row[skipped]] == mine['time'][skipped]
            self._skipped |= {(dag, each) for each in row[skipped].tolist()}

    def _take_pieces(self, n_workers: int) -> None:
        """Find the dispatch times of pieces; keep undeclared pieces."""
        table = self._executions
        rows = ran(table)
        vertex, piece, ready, start, end, worker, holds, cpu, completes = (
            table[name][rows] for name in (
                'vertex', 'piece', 'ready', 'start', 'end', 'worker', 'holds_gil', 'cpu',
                'completes'))
        row, first = self._row[rows], piece == 0
        process = np.array(self._process, dtype=np.int16)[vertex]
        members = [(number, np.flatnonzero(process == number))
                   for number in sorted(set(self._process))]
        for number, mine in members:
            self._find_turns(number, start[mine], end[mine])
        ready[~first] = start[~first]
        others = np.flatnonzero(vertex < 0)
        # ready, duration, dispatch or -1: undeclared callbacks, and legs that completed nothing
        self._others = [np.column_stack((ready[others], (end - start)[others], others))]
        source = np.flatnonzero((row >= 0) & np.isin(vertex, self._tables.source[:-1]))
        turn = self._whole['turn'][self._places(_JOB, row[source], vertex[source])]
        known = first[source] & (turn >= 0)
        ready[source[known]] = turn[known]
        self._late = dispatch_times(
            n_workers, worker, self._groups(rows, vertex), ready, start, end,
            [mine for _, mine in members],
            holds & (cpu >= 0) & (completes == recorded_tables.VERTEX))
        ran_as = np.full(self._tables.n_vertices + 1, _UNKNOWN)
        ran_as[vertex[::-1]] = rows[::-1]     # the first one is written last
        callback = self._recording.executions['callback']
        #: By global vertex: the address of the callback that ran as it.
        self.callback_of: dict[int, int] = {
            v: int(callback[at]) for v, at in enumerate(ran_as[:-1].tolist()) if at >= 0}
        mine = np.flatnonzero(first & (row >= 0) & (vertex >= 0))
        self._whole['dispatch'][self._places(_VERTEX, row[mine], vertex[mine])] = mine

    def _find_turns(self, process: int, start: Ints, end: Ints) -> None:
        """
        Find the timers that were noticed right after the end of an execution: ``turn``.

        ``busy`` says whether any execution ran at the release.

        :param start: of the executions of a process; ``end``: likewise, ascending.
        """
        start = np.append(np.sort(start), NEVER)
        for source, timer, jobs in zip(self._tables.source, self._timer, self._jobs):
            if not timer or self._process[source] != process or not len(end):
                continue
            ended = end[np.maximum(0, np.searchsorted(end, jobs.noticed, 'right') - 1)]
            known = (ended >= jobs.release) & (ended <= jobs.noticed) & (
                start[np.searchsorted(start, ended)] >= jobs.noticed)
            jobs.turn[known] = ended[known]
            jobs.busy[:] = np.searchsorted(start, jobs.release, 'right') > np.searchsorted(
                end, jobs.release, 'right')

    def _groups(self, rows: Ints, vertex: Ints) -> Ints:
        """Return numbers of the mutually exclusive groups of executions, or -1."""
        known = self._recording.who.groups
        callbacks, which = self._recording.callbacks()
        group_of = [known.get(each, _UNTOLD) for each in callbacks.tolist()]
        # small numbers, which are sorted fast: recorded groups, then declared ones
        numbers = {each: n for n, each in enumerate({g for g in group_of if g >= 0})}
        group = np.array([numbers.get(each, each) for each in group_of], dtype=np.min_scalar_type(
            -2 - len(numbers) - self._tables.n_groups))[which[rows]]
        unknown = np.flatnonzero(group == _UNTOLD)
        declared = np.array([*self._tables.group[:self._tables.n_vertices], -1])[vertex[unknown]]
        group[unknown] = np.where(declared >= 0, len(numbers) + declared, -1)
        return group

    def _take_completions(self) -> None:
        """Note the execution times of executions that completed a vertex."""
        table, whole = self._executions, self._whole
        rows = np.flatnonzero(
            (table['completes'] != recorded_tables.NOTHING) & (table['vertex'] >= 0)
            & (self._row >= 0) & (table['start'] >= 0))
        rows = rows[sort_by(table['order'][rows])]
        n_legs = np.array([max(1, len(each)) for each in self._edges_into])
        width = int(n_legs.max(initial=1))
        edges = np.array([[*each, *[-1] * (width - len(each))] for each in self._edges_into]
                         or [[-1]])
        together: list[Ints] = []   # rows of executions for several legs
        for part in in_parts(rows):
            row, vertex, ready, leg = self._row[part], *(
                table[name][part] for name in ('vertex', 'ready', 'leg'))
            every_leg = (leg == recorded_tables.ALL_LEGS) & (n_legs[vertex] > 1)
            leg = np.where(leg < 0, n_legs[vertex] - 1, leg)
            edge = np.where(leg < width, edges[vertex, np.minimum(leg, width - 1)], -1)
            known = edge >= 0
            whole['arrived'][self._places(_EDGE, row[known], vertex[known]) + edge[known]] = ready[
                known]
            ended = table['completes'][part] == recorded_tables.VERTEX
            others = part[~ended]
            self._others.append(np.column_stack((
                ready[~ended], table['busy'][others], np.full(len(others), _UNKNOWN))))
            together.append(part[ended & every_leg])
            place, done = self._places(_VERTEX, row[ended], vertex[ended]), part[ended]
            for name, column in (('took', 'busy'), ('cpu', 'cpu'), ('held', 'holds_gil'),
                                 ('start', 'began'), ('end', 'end')):
                whole[name][place] = table[column][done]
            source = np.flatnonzero(ended & ~known)
            place = self._places(_JOB, row[source], vertex[source])
            later = ready[source] >= whole['release'][place]
            whole['noticed'][place[later]] = ready[source[later]]
        every = np.concatenate(together) if together else rows
        vertex = table['vertex'][every]
        for v in np.unique(vertex).tolist():
            self._all_at_once(self._jobs[self._tables.dag_of[v]], self._row[every[vertex == v]],
                              self._edges_into[v])

    def _all_at_once(self, jobs: _Jobs, rows: Ints, edges: list[int]) -> None:
        """If one execution completes all legs, only the last message's time is known."""
        ends = jobs.rows('end')[rows][:, [jobs.publishers[edge] for edge in edges]]
        arrived = jobs.rows('arrived')
        for edge, end in zip(edges, ends.T):
            early = end < ends.max(axis=1)
            arrived[rows[early], edge] = end[early]

    def _take_publications(self) -> None:
        """Note which edges the publications of jobs satisfied."""
        edges_from: dict[tuple[int, str], list[int]] = {}
        numbers = edge_numbers(self._tables)
        for dag, first in zip(self._task_set.dags, self._first):
            for vertex in dag.vertices:
                for place, before in legs_of(vertex, dag.vertices):
                    edges_from.setdefault(
                        (first + before, vertex.callback.topics[place]), []).append(
                            numbers[first + before, first + vertex.index])
        table, sent = self._executions, self._recording.publications
        by = sent['execution']
        by, publisher = by[by >= 0], sent['publisher'][by >= 0]
        row, vertex_of = self._row[by], table['vertex'][by]
        known = (row >= 0) & (vertex_of >= 0)
        row, vertex_of, publisher = row[known], vertex_of[known], publisher[known]
        for number in np.unique(publisher).tolist():
            found = self._recording.who.every_publisher.get(number)
            mine = publisher == number
            for v in np.unique(vertex_of[mine]).tolist() if found is not None else ():
                places = self._places(_EDGE, row[mine & (vertex_of == v)], v)
                for edge in edges_from.get((v, found.topic), ()) if found is not None else ():
                    self._whole['sent'][places + edge] = 1

    def times(self) -> list[list[int]]:
        """Return by DAG and vertex the execution time, 0 if unknown."""
        typical = self._typical()
        return [[typical.get(vertex.callback.key, 0) for vertex in dag.vertices]
                for dag in self._task_set.dags]

    def build(
        self, overheads: bool = True, process: Sequence[int] | None = None, workers: int = NEVER,
    ) -> RecordedLoad:
        """
        Return the load.

        :param process: by vertex the process to run it in; None: as recorded.
        :param workers: workers of each process, if fewer than in the recording.
        """
        process = process or self._process
        every, usual, late = self._dispatches()
        self._take_cpu_times(workers == 1 or max(process) < max(self._process))
        unsent = self._unsent()
        delays, transport = self._transports(overheads, process)
        if unsent:
            delays[np.concatenate([each.ravel() for each in unsent])] = NEVER
        self._drop('start', 'end', 'arrived', 'sent')
        estimated, unknown = self._estimate(process, unsent)
        took, cpu, held = (self._whole.pop(name) for name in ('took', 'cpu', 'held'))
        demand, executions = int(took.sum()), len(took)
        if overheads:
            took += late
        others = np.concatenate(self._others)
        others = others[sort_by(*others.T)]
        more = np.zeros(len(others), dtype=np.int64)
        number = others[:, 2]
        costs = np.concatenate([took, np.maximum(0, others[:, 1]) + np.where(
            number >= 0, every[number], 0)])
        bases = self._begins[_VERTEX].tolist()
        columns: dict[str, Any] = {
            'holds': np.concatenate([held, more]) if held.any() else []}
        if len(self._recording.executions):
            columns |= {
                'computed': np.concatenate([cpu, more + _UNKNOWN]) if (cpu >= 0).any() else [],
                'delays': delays, 'delay_stride': self._widths[_EDGE].tolist(),
                'delay_base': self._begins[_EDGE, :-1].tolist()}
        load = self._load(costs, bases, others[:, 0], overheads, workers == 1)
        load = load._replace(
            fates=self._fates(len(costs)), **columns)
        return RecordedLoad(
            load, [jobs.numbers.tolist() for jobs in self._jobs], demand, executions, estimated,
            unknown, usual, transport, late if overheads else late[:0])

    def _drop(self, *columns: str) -> None:
        """Free columns, which are large for long runs."""
        for name in columns:
            del self._whole[name]
            for jobs in self._jobs:
                delattr(jobs, name)

    def _unsent(self) -> list[Any]:
        """Return by DAG, job and edge whether the edge was not published, as far as known."""
        found = []
        for jobs in self._jobs:
            sent, arrived, end = map(jobs.rows, ('sent', 'arrived', 'end'))
            completed = end[:, jobs.publishers] >= 0
            found.append((sent < 0) & (arrived < 0) & completed & (sent >= 0).any(axis=0))
        return found

    def _never_ready(self, dag: Dag, unsent: Any) -> Any:
        """Return by job and vertex whether it cannot run, because an earlier edge is unsent."""
        first = self._first[dag.index]
        found = np.zeros((len(unsent), len(dag.vertices)), dtype=np.bool_)
        if unsent.any():
            for v in topological_order(dag):
                edges = self._edges_into[first + v]
                found[:, v] = unsent[:, edges].any(axis=1) | found[
                    :, list(dag.vertices[v].predecessors)].any(axis=1)
        return found

    def _estimate(self, process: Sequence[int], unsent: list[Any]) -> tuple[int, list[str]]:
        """
        Fill in execution and CPU times that were not recorded.

        :param unsent: by DAG, job and edge whether the edge is not satisfied.
        :return: their number, and the callbacks without any known time.
        """
        typical = self._typical()
        unknown: dict[str, None] = {}
        estimated = 0
        for dag, jobs, edges in zip(self._task_set.dags, self._jobs, unsent):
            took, cpu, held = map(jobs.rows, ('took', 'cpu', 'held'))
            took[[row for of, row in self._skipped if of == dag.index]] = 0
            took[(took < 0) & self._never_ready(dag, edges)] = 0
            if self._times is not None:
                took[took < 0] = self._times[dag.index].reshape(took.shape)[took < 0]
            missing = took < 0
            estimated += int(missing.sum())
            held[held < 0] = 0
            for vertex in dag.vertices:
                v, key = vertex.index, vertex.callback.key
                if missing[:, v].any():
                    if key not in typical:
                        unknown[key] = None
                    took[missing[:, v], v] = typical.get(key, 0)
                known = cpu[:, v] >= 0
                if known.any():     # executions that did not complete are like the others
                    share = cpu[known, v].sum() / max(1, took[known, v].sum())
                    cpu[missing[:, v], v] = took[missing[:, v], v] * min(1.0, share)
                    held[missing[:, v], v] = held[known, v].mean() >= 0.5
                if vertex.callback.holds_interpreter is not None:
                    held[:, v] = vertex.callback.holds_interpreter
                    if vertex.callback.holds_interpreter:
                        cpu[~known, v] = took[~known, v]
                held[:, v] *= process[self._first[dag.index] + v]
        return estimated, list(unknown)

    def _fates(self, executions: int) -> list[int]:
        """Return which executions failed or were skipped; empty: none."""
        fates = [RUNS] * executions if self._failed or self._skipped else []
        for vertex, row in self._failed:
            fates[int(self._places(_VERTEX, row, vertex))] = FAILS
        for dag, row in self._skipped:
            fates[int(self._places(_VERTEX, row, self._tables.source[dag]))] = SKIPPED
        return fates

    def _dispatches(self) -> tuple[Any, int | None, Any]:
        """Return dispatch times by number (the last: the median), the median, and by execution."""
        number = self._whole['dispatch']
        known = number[number >= 0]
        usual = quantile(memoryview(np.sort(self._late[known])), 0.5) if len(known) else None
        every = np.append(self._late, usual or 0)     # number -1
        late = every[number]
        del self._late, number
        self._drop('dispatch')
        return every, usual, late

    def _take_cpu_times(self, alone: bool) -> None:
        """
        Subtract from durations the time in which others computed, down to the CPU time.

        :param alone: whether executions that hold the GIL take their CPU time.
        """
        took, cpu, held, start, end = (
            self._whole[name] for name in ('took', 'cpu', 'held', 'start', 'end'))
        known = cpu >= 0
        computes = known & np.where(held > 0, alone, 2 * cpu >= took)
        np.minimum(took, cpu, out=took, where=computes)
        holds = np.flatnonzero(known & (held > 0))
        process = np.concatenate([np.empty(0, dtype=np.int64), *(
            np.tile(self._process[first:first + jobs.size], len(jobs.numbers))
            for first, jobs in zip(self._first, self._jobs))])[holds]
        for number in np.unique(process).tolist():
            mine = holds[process == number]
            shared = Spans(*crowded(start[mine], end[mine], 2)).within(start[mine], end[mine])
            took[mine] = np.maximum(np.minimum(took[mine], cpu[mine]), took[mine] - shared)

    def _load(
        self, costs: Any, bases: list[int], others: Ints, overheads: bool, one_worker: bool
    ) -> Load:
        # ready, DAG, row of the job in its DAG, release
        parts = [np.column_stack((
            others, np.full(len(others), len(self._jobs)), np.arange(len(others)), others))]
        for dag, jobs in zip(self._task_set.dags, self._jobs):
            ideal = self._timer[dag.index] and not overheads
            ready: Any = jobs.release if ideal else np.where(
                (jobs.turn >= 0) | one_worker & (jobs.busy > 0), jobs.release, jobs.noticed)
            parts.append(np.column_stack((
                ready, np.full(len(ready), dag.index), np.arange(len(ready)), jobs.release)))
        columns = np.concatenate(parts).T
        ready, dags, rows, release = columns[:, np.lexsort(columns[::-1])]
        return Load(
            ready, dags, rows, costs, bases, [*(jobs.size for jobs in self._jobs), 1], release)

    def _transports(
        self, overheads: bool, process: Sequence[int]
    ) -> tuple[Any, int | None]:
        """
        Return the transports by job, and the median of all measured ones.

        An edge that newly crosses processes, or no longer does, gets the usual time of such edges.
        """
        delays: list[Any] = []
        measured: dict[bool, list[Any]] = {False: [np.zeros(0)], True: [np.zeros(0)]}
        changed: list[tuple[Any, bool]] = []
        for jobs, crosses in zip(self._jobs, self._crossings(process)):
            start, end, arrived = map(jobs.rows, ('start', 'end', 'arrived'))
            ended = end[:, jobs.publishers]
            found = arrived - ended
            known = (arrived >= start[:, jobs.publishers]) & (ended >= 0)
            for edge, (before, after) in enumerate(crosses):
                column = found[known[:, edge], edge]
                found[~known[:, edge], edge] = np.median(column) if len(column) else 0
                measured[before].append(column)
                if before != after:
                    changed.append((found[:, edge], after))
            delays.append(found)
        usual = {after: np.concatenate(each) for after, each in measured.items()}
        for view, after in changed:
            times = usual[after]
            view[:] = np.median(times) if len(times) else DELAY_NS * after
        flat = np.concatenate([each.ravel() for each in delays] or [np.zeros(0, dtype=np.int64)])
        everything = np.concatenate(list(usual.values()))
        return (flat if overheads else np.zeros_like(flat),
                int(np.median(everything)) if len(everything) else None)

    def _crossings(self, process: Sequence[int]) -> list[list[tuple[bool, bool]]]:
        """Return by DAG and edge whether it crossed processes, and whether it will."""
        found: list[list[tuple[bool, bool]]] = [[] for _ in self._jobs]
        was = self._process
        for a, b in edge_numbers(self._tables):
            found[self._tables.dag_of[a]].append((was[a] != was[b], process[a] != process[b]))
        return found

    def _typical(self) -> dict[str, int]:
        """Return by callback the median of its recorded times, otherwise the declared mean."""
        recorded: dict[str, list[Any]] = {}
        for dag, jobs in zip(self._task_set.dags, self._jobs):
            for vertex in dag.vertices:
                recorded.setdefault(vertex.callback.key, []).append(
                    np.array(jobs.took[vertex.index::jobs.size]))
        typical = {
            c.key: c.execution_time.mean_ns
            for c in self._task_set.callbacks if c.execution_time is not None}
        for key, parts in recorded.items():
            times = np.sort(np.concatenate(parts))
            times = times[times >= 0]
            if len(times):
                typical[key] = quantile(memoryview(times), 0.5)
        return typical


def _contiguous(table: Table, *names: str) -> dict[str, Any]:
    """Return copies of columns, which are faster to read than those of a table."""
    found = {name: np.empty(len(table), dtype=table.dtype[name]) for name in names}
    for part, *columns in zip(in_parts(table), *map(in_parts, found.values())):
        for name, column in zip(names, columns):
            column[:] = part[name]
    return found

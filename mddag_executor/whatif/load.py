# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The load of a recorded run: releases, execution times, transport and dispatch times.

Theory of operation
-------------------
* Jobs are the released jobs, in the order of release.  A source is ready when it was in the
  recording: shortly after a timer's release, possibly long after the header stamp of a message.
* A worker notices due timers before it chooses its next execution.  If a timer was noticed right
  after the end of an execution, and was due before that, a worker that had become idle earlier
  would have noticed it earlier.  So it counts as known from its release.  Any other timer is known
  from the time at which it was noticed.  A single worker notices nothing while it runs a callback,
  so all timers that became due meanwhile count as known from their releases.
* The execution time of a vertex is the sum of the pieces of its execution.  If it did not complete
  (dropped, expired, open at the end), it is the callback's median, otherwise the declared mean,
  and at least as long as it has run.  A failed execution has the time until it failed.
* A callback without any known time whose messages arrived ran elsewhere, in a process that is not
  recorded.  It takes no time, and its messages arrive as long after the one before as they did.
* Another callback without any known time never ran, so it does not run here either: its messages
  never arrive, and jobs that begin with it are skipped.
* A job that expired at its release never ran: its timer was noticed after its next period.  This
  depends on the machine, not on the scheduler, so the job is skipped again.
* A sync vertex has the execution time of the leg that completed it.  Earlier legs, which only
  store their message, load the workers like undeclared callbacks: each piece is a job of the
  undeclared DAG, ready when it was in the recording.  Their callback groups are ignored.
* If CPU times are recorded, the load has the CPU time and whether the GIL was held (as recorded or
  declared).  An execution that computes without the GIL takes its CPU time: for the rest of the
  time it waited for a CPU.  One that holds the GIL takes its duration without the time in which
  another callback also held the GIL; with one worker, or in fewer processes than recorded, it
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
from typing import Any, NamedTuple

from mddag_executor.analysis.spans import crowded, Spans
from mddag_executor.analysis.usage import ran
from mddag_executor.core import legs_of, NEVER, quantile, Tables
from mddag_executor.recording import tables as recorded_tables
from mddag_executor.recording.columns import Ints, Mask
from mddag_executor.recording.joins import as_of, distinct, sort_by
from mddag_executor.recording.recording import Recording
from mddag_executor.simulate import Workload
from mddag_executor.simulate.deliveries import DELAY_NS
from mddag_executor.simulate.workload import edge_numbers, FAILS, RUNS, SKIPPED
from mddag_executor.whatif.dispatches import dispatch_times
from msg_graph import Dag
from msg_graph.model import optional_edges, topological_order
import numpy as np

_UNKNOWN = -1
_NOT_RECORDED = -2


class RecordedLoad(NamedTuple):
    """
    A load made from a recording.

    ``jobs`` has, by DAG, the recorded index of each job; ``demand`` the execution times of all
    declared jobs, ns; ``estimated`` counts vertices of jobs without a recorded execution time,
    ``executions`` counts all; ``silent`` names callbacks that never ran, ``elsewhere`` those that
    ran where nothing was recorded. ``dispatches`` is the dispatch part of ``load.costs``; it is
    empty without overheads. ``dispatch_ns`` and ``transport_ns`` are measured medians, None if
    nothing was measured.
    """

    load: Workload
    jobs: Sequence[Ints]
    demand: int
    executions: int
    estimated: int
    silent: list[str]
    elsewhere: list[str]
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
"""
Columns by job, by job and vertex, or by job and edge.  Times are in ns, or ``_UNKNOWN``.

``turn``: when a timer was noticed, if right after an execution; ``busy``: 1 if its worker was
busy; ``dispatch``: the index of the dispatch time in ``_dispatch_ns``; ``held``: 1 if the
execution held the interpreter, 0 if not; ``sent``: 1 if the message was published.
"""
_ALWAYS = ('release', 'noticed', 'took', 'cpu', 'held')
"""The columns that are not all unknown if the recording has no executions."""
_PIECES = ['vertex', 'piece', 'ready', 'start', 'end', 'worker', 'holds_gil', 'cpu', 'completes',
           'inherited']
"""The columns of executions that dispatch times need."""
_BUILT = 'took', 'cpu', 'held'
"""The columns that become those of a load."""


class LoadBuilder:
    """
    Makes a load from a recording.

    :param workers: by recorded process its number of workers.
    :param processes: by vertex the recorded process, from 1; None: one process.
    :param times: by DAG the execution times of its jobs and vertices, for a recording without
        executions; None: missing ones are estimated.
    """

    def __init__(
        self, recording: Recording, tables: Tables, workers: Sequence[int],
        processes: Sequence[int] | None = None, times: Sequence[Any] | None = None,
    ) -> None:
        task_set = recording.task_set
        self._task_set, self._recording, self._tables = task_set, recording, tables
        self._first = tables.first_vertex
        #: Number of runs of undeclared callbacks in other processes than the first.
        self.left_out = 0
        self._process = [*(processes or [1] * tables.n_vertices), 1]
        self._workers = workers
        self._times = times
        self._timer = [d.vertices[d.source].callback.kind == 'timer' for d in task_set.dags]
        # by global vertex and leg: the edge (number in its DAG) that its message satisfies
        numbers = edge_numbers(tables)
        self._edges_into = [
            [numbers[first + before, first + vertex.index]
             for _, before in legs_of(vertex, dag.vertices)]
            for dag, first in zip(task_set.dags, tables.first_vertex) for vertex in dag.vertices]
        # by DAG and edge: the vertex that publishes
        self._publishers = [[v.index for v in dag.vertices for _ in v.successors]
                            for dag in task_set.dags]
        self._failed: set[tuple[int, int]] = set()
        self._skipped: set[tuple[int, int]] = set()
        jobs = recording.jobs
        of_dag = [jobs.of_dag(dag.index) for dag in task_set.dags]
        # by DAG: the recorded numbers of its jobs; they are kept, so in little memory
        kind: Any = np.int32 if jobs.number.max(initial=0) < 2 ** 31 else np.int64
        self._numbers = [jobs.number[mine].astype(kind) for mine in of_dag]
        # by kind of column and DAG: the values of each job, and where they begin
        self._widths = np.array(
            [(1, len(dag.vertices), len(edges)) for dag, edges in zip(
                task_set.dags, self._publishers)], dtype=np.int64).reshape(-1, 3).T
        counts = np.diff(jobs.first)
        self._begins = np.cumsum(np.pad(self._widths * counts, ((0, 0), (1, 0))), axis=1)
        # by kind of column and vertex: its place in the first job, and the step to the next job
        dag_of = np.array(tables.dag_of[:tables.n_vertices], dtype=np.int64)
        self._base, self._step = self._begins[:, dag_of], self._widths[:, dag_of]
        self._base[_VERTEX] += np.array(tables.index_in_dag[:tables.n_vertices], dtype=np.int64)
        self._columns: dict[str, Any] = {
            name: np.full(self._begins[by, -1], _UNKNOWN, dtype=kind)
            if len(recording.executions) or name in _ALWAYS
            else np.broadcast_to(np.array(_UNKNOWN, dtype=kind), self._begins[by, -1])
            for name, (by, kind) in _COLUMNS.items()}
        for dag, mine in enumerate(of_dag):
            release, noticed = self._of(dag, 'release', 'noticed')
            release[:] = jobs.release[mine]
            noticed[:] = np.maximum(jobs.release[mine], jobs.noticed[mine])
        self._note_ends()
        self._others, self._dispatch_ns = [np.empty((0, 4), dtype=np.int64)], np.empty(
            0, dtype=np.int64)
        # places of optional messages that were published, and that no callback ran for
        self._unheard: list[Ints] = []
        #: The median of the dispatch times of the declared executions; None: there are none.
        self._usual_dispatch: int | None = None
        #: Callbacks that ran where nothing was recorded.
        self._elsewhere = dict[str, None]()
        #: By place of an execution that did not complete: how long it has run, ns.
        self._so_far = dict[int, int]()
        #: By global vertex: the address of the callback that ran as it.
        self.callback_of: dict[int, int] = {}
        if not len(recording.executions):
            return
        self._executions = table = recording.executions
        places = recording.job_places
        #: By execution the row of its job.
        self._row = np.where(places >= 0, places - jobs.first[table['dag']], _UNKNOWN)
        # by execution the place of its vertex in its job, _UNKNOWN if it has no job
        self._place = np.where((self._row >= 0) & (table['vertex'] >= 0), self._places(
            _VERTEX, self._row, table['vertex']), _UNKNOWN)
        self._note_pieces()
        self._note_completions()
        self._note_incomplete()
        self._note_elsewhere()
        self._note_publications()
        del self._row, self._place, self._executions

    def _of(self, dag: int, *names: str) -> list[Any]:
        """Return the columns of a DAG as views; those of vertices and edges have a row a job."""
        found = []
        for name in names:
            by, _ = _COLUMNS[name]
            begin, end = self._begins[by, dag:dag + 2]
            shape = len(self._numbers[dag]), self._widths[by, dag]
            found.append(self._columns[name][begin:end].reshape(shape[:1 + (by != _JOB)]))
        return found

    def _places(self, by: int, row: Any, vertex: Any) -> Ints:
        """Return the places of vertices of jobs in a kind of column (``_EDGE``: of edge 0)."""
        place: Ints = self._base[by][vertex] + row * self._step[by][vertex]
        return place

    def _note_ends(self) -> None:
        """Keep failed and skipped executions: they fail or are skipped again."""
        ends = self._recording.job_ends
        for dag in range(len(self._numbers)):
            mine = ends[ends['dag'] == dag]
            row = self._recording.jobs.rows_of(dag, mine['job'])
            failed = (row >= 0) & (mine['reason'] == recorded_tables.FAILED)
            self._failed |= set(zip(mine['vertex'][failed].tolist(), row[failed].tolist()))
            skipped = (row >= 0) & (mine['reason'] == recorded_tables.EXPIRED)
            noticed, = self._of(dag, 'noticed')
            skipped[skipped] = noticed[row[skipped]] == mine['time'][skipped]
            self._skipped |= {(dag, each) for each in row[skipped].tolist()}

    def _note_pieces(self) -> None:
        """Find the dispatch times of pieces; keep undeclared pieces."""
        table = self._executions
        rows = ran(table)
        if self._recording.run.imported:    # others have interpreters and threads of their own
            process = self._recording.executions['process'][rows]
            other = (table['vertex'][rows] < 0) & (process > 0)
            self.left_out = int((other & (process < len(self._recording.run.placed))).sum())
            rows = rows[~other]
        row, place = self._row, self._place
        if len(rows) < len(table) or (rows[1:] < rows[:-1]).any():
            table, row, place = table[_PIECES][rows], row[rows], place[rows]
        vertex, ready, start, end, cpu = table.columns('vertex', 'ready', 'start', 'end', 'cpu')
        first = table['piece'] == 0
        members: list[tuple[int, Ints | slice]] = [(self._process[0], slice(None))]
        if len(set(self._process)) > 1:
            process = np.array(self._process, dtype=np.int16)[vertex]
            members = [(number, np.flatnonzero(process == number))
                       for number in sorted(set(self._process))]
        for number, mine in members:
            self._find_turns(number, start[mine], end[mine])
        ready = np.where(first, ready, start)
        others = np.flatnonzero(vertex < 0)
        # ready, duration, index of the dispatch time or -1, inherited deadline or 0: undeclared
        # callbacks, and legs that completed nothing
        self._others = [np.column_stack((
            ready[others], (end - start)[others], others, table['inherited'][others]))]
        source = np.flatnonzero((row >= 0) & np.isin(vertex, self._tables.source[:-1]))
        turn = self._columns['turn'][self._places(_JOB, row[source], vertex[source])]
        known = first[source] & (turn >= 0)
        ready[source[known]] = turn[known]
        self._dispatch_ns = dispatch_times(
            table['worker'], self._groups(rows, vertex), ready, start, end,
            [(self._workers[number - 1], mine) for number, mine in members],
            table['holds_gil'] & (cpu >= 0) & (table['completes'] == recorded_tables.VERTEX))
        ran_as = np.full(self._tables.n_vertices + 1, _UNKNOWN)
        ran_as[vertex[::-1]] = rows[::-1]     # the first one is written last
        callback = self._recording.executions['callback']
        self.callback_of = {
            v: int(callback[at]) for v, at in enumerate(ran_as[:-1].tolist()) if at >= 0}
        begun = np.flatnonzero(first & (place >= 0))
        number = self._columns['dispatch']
        number[place[begun]] = begun
        known = number[number >= 0]
        if len(known):
            self._usual_dispatch = quantile(
                memoryview(np.sort(self._dispatch_ns[known])), 0.5)

    def _find_turns(self, process: int, start: Ints, end: Ints) -> None:
        """
        Find the timers that were noticed right after the end of an execution: ``turn``.

        ``busy`` says whether any execution ran at the release.

        :param start: of the executions of a process; ``end``: likewise, ascending.
        """
        start = np.append(np.sort(start, kind='stable'), NEVER)     # almost sorted
        for dag, source in enumerate(self._tables.source[:-1]):
            if not self._timer[dag] or self._process[source] != process or not len(end):
                continue
            release, noticed, turn, busy = self._of(dag, 'release', 'noticed', 'turn', 'busy')
            ended = end[np.maximum(0, as_of(end, noticed))]
            known = (ended >= release) & (ended <= noticed) & (
                start[np.searchsorted(start, ended)] >= noticed)
            turn[known] = ended[known]
            busy[:] = np.searchsorted(start, release, 'right') > np.searchsorted(
                end, release, 'right')

    def _groups(self, rows: Ints, vertex: Ints) -> Ints:
        """Return numbers of the groups of executions that exclude each other, or -1."""
        known = self._recording.exclusive_groups()
        callbacks, which = self._recording.callbacks()
        group_of = [known.get(each, _NOT_RECORDED) for each in callbacks.tolist()]
        # small numbers, which are sorted fast: recorded groups, then declared ones
        numbers = {each: n for n, each in enumerate({g for g in group_of if g >= 0})}
        group = np.array([numbers.get(each, each) for each in group_of], dtype=np.min_scalar_type(
            -2 - len(numbers) - self._tables.n_groups))[which[rows]]
        unknown = np.flatnonzero(group == _NOT_RECORDED)
        declared = np.array([*self._tables.group[:self._tables.n_vertices], -1])[vertex[unknown]]
        group[unknown] = np.where(declared >= 0, len(numbers) + declared, -1)
        return group

    def _note_completions(self) -> None:
        """Note the execution times of executions that completed a vertex."""
        table, columns = self._executions, self._columns
        rows = np.flatnonzero(
            (table['completes'] != recorded_tables.NOTHING) & (self._place >= 0)
            & (table['start'] >= 0))
        rows = rows[sort_by(table['order'][rows])]
        row, vertex, ready, leg, completes = self._row[rows], *(
            table[name][rows] for name in ('vertex', 'ready', 'leg', 'completes'))
        n_legs = np.array([max(1, len(each)) for each in self._edges_into])
        width = int(n_legs.max(initial=1))
        edges = np.array([[*each, *[-1] * (width - len(each))] for each in self._edges_into]
                         or [[-1]])
        ended = completes == recorded_tables.VERTEX
        every_leg = ended & (leg == recorded_tables.ALL_LEGS) & (n_legs[vertex] > 1)
        leg = np.where(leg < 0, n_legs[vertex] - 1, leg)
        edge = np.where(leg < width, edges[vertex, np.minimum(leg, width - 1)], -1)
        known = edge >= 0
        columns['arrived'][self._places(_EDGE, row[known], vertex[known]) + edge[known]] = ready[
            known]
        self._others.append(np.column_stack((
            ready[~ended], table['busy'][rows[~ended]], np.full(int((~ended).sum()), _UNKNOWN),
            np.zeros(int((~ended).sum()), dtype=np.int64))))
        done = rows[ended]
        place = self._place[done]
        for name, column in (('took', 'busy'), ('cpu', 'cpu'), ('held', 'holds_gil'),
                             ('start', 'began'), ('end', 'end')):
            columns[name][place] = table[column][done]
        source = ended & ~known
        place = self._places(_JOB, row[source], vertex[source])
        columns['noticed'][place] = np.maximum(ready[source], columns['release'][place])
        for v in distinct(vertex[every_leg]).tolist():
            self._split_legs(self._tables.dag_of[v], row[every_leg & (vertex == v)],
                             self._edges_into[v])

    def _note_incomplete(self) -> None:
        """Note how long executions ran that did not complete: open ones until the end at least."""
        table = self._executions
        rows = np.flatnonzero((self._place >= 0) & (table['start'] >= 0))
        place = self._place[rows]
        missing = self._columns['took'][place] < 0
        rows, place = rows[missing], place[missing]
        start, end = table['start'][rows], table['end'][rows]
        took = np.where(end < 0, self._recording.end + 1, end) - start
        for at, time in zip(place.tolist(), took.tolist()):
            self._so_far[at] = self._so_far.get(at, 0) + time

    def _note_elsewhere(self) -> None:
        """Let callbacks that ran elsewhere end when their first message arrived."""
        known = {*self._declared_times(), *self._recorded_times(), *self._longest_incomplete()}
        for dag, publishers in zip(self._task_set.dags, map(np.array, self._publishers)):
            took, start, end, arrived, noticed = self._of(
                dag.index, 'took', 'start', 'end', 'arrived', 'noticed')
            for v in reversed(topological_order(dag)):
                first = np.where(arrived >= 0, arrived, NEVER)[:, publishers == v].min(
                    axis=1, initial=NEVER)
                rows = np.flatnonzero(first < NEVER)
                key = dag.vertices[v].callback.key
                if key in known or not len(rows):
                    continue
                self._elsewhere[key] = None
                took[rows, v] = 0
                for edge in self._edges_into[self._first[dag.index] + v]:
                    arrived[rows, edge] = first[rows]
                start[rows, v] = end[rows, v] = (
                    noticed[rows] if v == dag.source else first[rows])

    def _split_legs(self, dag: int, rows: Ints, edges: list[int]) -> None:
        """If one execution completed all legs, only the last message's time is known."""
        end, arrived = self._of(dag, 'end', 'arrived')
        ends = end[rows][:, [self._publishers[dag][edge] for edge in edges]]
        for edge, published in zip(edges, ends.T):
            early = published < ends.max(axis=1)
            arrived[rows[early], edge] = published[early]

    def _note_publications(self) -> None:
        """
        Note which edges the publications of jobs satisfied.

        A sync may have several topics of one publisher, so its edge needs several messages.  Those
        that are published each time need not be checked if others are published only sometimes.
        """
        edges_from: dict[tuple[int, str | None], list[tuple[int, int]]] = {}
        needed: dict[tuple[int, int], int] = {}
        for dag, first in zip(self._task_set.dags, self._first):
            for vertex in dag.vertices:
                optional = {
                    (before, topic): place for before in vertex.predecessors
                    for place, (after, topic) in enumerate(optional_edges(
                        dag.vertices[before], dag.vertices)) if after == vertex.index}
                several = {before for before, _ in optional}
                for (place, before), edge in zip(
                        legs_of(vertex, dag.vertices), self._edges_into[first + vertex.index]):
                    topic = vertex.callback.topics[place]
                    bit = 1 << min(7, optional.get((before, topic), 0))
                    if before not in several or (before, topic) in optional:
                        edges_from.setdefault((first + before, topic), []).append((edge, bit))
                        needed[dag.index, edge] = needed.get((dag.index, edge), 0) | bit
        table, sent = self._executions, self._recording.publications
        by = sent['execution']
        by, publisher = by[by >= 0], sent['publisher'][by >= 0]
        row, vertex_of = self._row[by], table['vertex'][by]
        known = (row >= 0) & (vertex_of >= 0)
        row, vertex_of, publisher = row[known], vertex_of[known], publisher[known]
        publishers = self._recording.names.publishers
        found = np.zeros(len(self._columns['sent']), dtype=np.uint8)
        for number in distinct(publisher).tolist():
            name = publishers[number].topic if number in publishers else None
            mine = publisher == number
            for v in distinct(vertex_of[mine]).tolist():
                places = self._places(_EDGE, row[mine & (vertex_of == v)], v)
                for edge, bit in edges_from.get((v, name), ()):
                    found[places + edge] |= bit
        for (dag_index, edge), bits in needed.items():
            begin, end = self._begins[_EDGE, dag_index:dag_index + 2]
            step = int(self._widths[_EDGE, dag_index])
            sent = self._columns['sent'][begin:end][edge::step]
            sent[found[begin:end][edge::step] == bits] = 1

    def times(self) -> list[list[int]]:
        """Return by DAG and vertex the execution time, 0 if unknown."""
        typical = self._typical()
        return [[typical.get(vertex.callback.key, 0) for vertex in dag.vertices]
                for dag in self._task_set.dags]

    def __getstate__(self) -> dict[str, Any]:
        """Return the state of a copy, which builds another load of the same recording."""
        columns = {name: column.copy() if name in _BUILT else column
                   for name, column in self._columns.items()}
        return {**self.__dict__, '_columns': columns, '_skipped': set(self._skipped),
                '_unheard': list(self._unheard)}

    def build(
        self, overheads: bool = True, process: Sequence[int] | None = None,
        workers: Sequence[int] | None = None,
    ) -> RecordedLoad:
        """
        Return the load; it replaces the state of the builder, so copy a builder of several loads.

        :param process: by vertex the process to run it in, from 1; None: as recorded.
        :param workers: by such a process its number of workers; None: as recorded.
        """
        process = process or self._process
        # by vertex: whether it has the only worker of its process, which had several
        only_one = np.array([
            workers is not None and workers[new - 1] == 1 < self._workers[old - 1]
            for old, new in zip(self._process, process)], dtype=np.bool_)
        every, usual, late = self._dispatches()
        if not overheads:
            late = late[:0].copy()
        self._subtract_others(only_one | (max(process) < max(self._process)))
        typical = self._typical()
        unsent, delays, transport = self._unsent(), None, None
        silent = self._silence(typical, unsent)
        ran = len(self._recording.executions) > 0 or silent
        if ran:
            delays, transport = self._transports(overheads, process)
            if unsent:
                delays[np.concatenate([each.ravel() for each in unsent])] = NEVER
            for places in self._unheard:
                delays[places] = NEVER - 1
        for name in ('start', 'end', 'arrived', 'sent'):    # they are large for long runs
            del self._columns[name]
        estimated = self._estimate(process, typical, unsent)
        del unsent
        took, cpu, held = (self._columns.pop(name) for name in ('took', 'cpu', 'held'))
        demand, executions = int(took.sum()), len(took)
        if overheads:
            took += late
        others = np.concatenate(self._others)
        others = others[sort_by(*others.T)]
        more = np.zeros(len(others), dtype=np.int64)
        number = others[:, 2]
        costs = took if not len(others) else np.concatenate([
            took, np.maximum(0, others[:, 1]) + np.where(
                (number >= 0) & overheads, every[number], 0)])
        columns: dict[str, Any] = {
            'holds': np.concatenate([held, more]) if held.any() else []}
        if ran:
            columns |= {
                'computed': np.concatenate([cpu, more + _UNKNOWN]) if (cpu >= 0).any() else [],
                'delays': delays, 'delay_stride': self._widths[_EDGE].tolist(),
                'delay_base': self._begins[_EDGE, :-1].tolist()}
        if others[:, 3].any():
            columns |= self._inherited(others[:, 0], others[:, 3])
        del took, cpu, held
        load = self._load(costs, others[:, 0], overheads, only_one)
        return RecordedLoad(
            load._replace(fates=self._fates(len(costs)), **columns),
            self._numbers, demand, executions, estimated, silent,
            list(self._elsewhere), usual, transport, late)

    def _inherited(self, ready: Ints, deadline: Ints) -> dict[str, Any]:
        """
        Return what undeclared executions inherit (see ``Workload``).

        A recording has only the deadline.  It is of a vertex whose relative deadline is not
        shorter than the rest of it was.
        """
        offsets = np.array(self._tables.rad_offset[:-1], dtype=np.int64)
        order = np.argsort(offsets, kind='stable')
        at = np.searchsorted(offsets[order], deadline - ready)
        return {'inherited': np.where(deadline > 0, deadline, NEVER),
                'inherits_from': order[np.minimum(at, len(order) - 1)]}

    def _unsent(self) -> list[Any]:
        """Return by DAG, job and edge whether the edge was not published, as far as known."""
        found = []
        for dag, publishers in enumerate(self._publishers):
            sent, arrived, end = self._of(dag, 'sent', 'arrived', 'end')
            completed = end[:, publishers] >= 0
            optional = self._optional(dag)
            known = (sent >= 0).any(axis=0) | optional & (len(self._recording.publications) > 0)
            found.append((sent < 0) & ((arrived < 0) | optional) & completed & known)
        return found

    def _optional(self, dag: int) -> Mask:
        """Return by edge of a DAG whether its message is published only sometimes."""
        first = self._tables.first_successor[self._first[dag]]
        return np.array(self._tables.is_optional[first:first + len(self._publishers[dag])],
                        dtype=np.bool_)

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

    def _silence(self, typical: dict[str, int], unsent: list[Any]) -> list[str]:
        """
        Let callbacks without any known time not run; return them.

        :param unsent: by DAG, job and edge whether the edge is not satisfied.
        """
        silent: dict[str, None] = {}
        for dag, edges in zip(self._task_set.dags, unsent if self._times is None else ()):
            took, = self._of(dag.index, 'took')
            missing = (took < 0) & ~self._never_ready(dag, edges)
            for vertex in dag.vertices:
                if vertex.callback.key not in typical and missing[:, vertex.index].any():
                    silent[vertex.callback.key] = None
                    into = self._edges_into[self._first[dag.index] + vertex.index]
                    for edge in into:
                        if self._optional(dag.index)[edge]:
                            begin, step = (each[_EDGE, dag.index] for each in (
                                self._begins, self._widths))
                            self._unheard.append(
                                begin + edge + step * np.flatnonzero(~edges[:, edge]))
                    edges[:, into] = True
                    if vertex.index == dag.source:
                        self._skipped |= {(dag.index, row) for row in range(len(took))}
        return list(silent)

    def _estimate(
        self, process: Sequence[int], typical: dict[str, int], unsent: list[Any]
    ) -> int:
        """
        Fill in execution and CPU times that were not recorded; return their number.

        :param unsent: by DAG, job and edge whether the edge is not satisfied.
        """
        estimated = 0
        for dag, edges in zip(self._task_set.dags, unsent):
            took, cpu, held = self._of(dag.index, 'took', 'cpu', 'held')
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
                    took[missing[:, v], v] = typical.get(key, 0)
                    self._extend(self._first[dag.index] + v, took[:, v], missing[:, v])
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
        return estimated

    def _extend(self, vertex: int, took: Ints, missing: Mask) -> None:
        """Let executions that did not complete take the time that they ran, or longer."""
        for row in np.flatnonzero(missing).tolist() if self._so_far else ():
            so_far = self._so_far.get(int(self._places(_VERTEX, row, vertex)))
            if so_far is not None:
                took[row] = so_far if (vertex, row) in self._failed else max(so_far, took[row])

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
        every = np.append(self._dispatch_ns, self._usual_dispatch or 0)     # number -1
        return every, self._usual_dispatch, every[self._columns.pop('dispatch')]

    def _subtract_others(self, alone: Mask) -> None:
        """
        Subtract from durations the time in which others computed, down to the CPU time.

        :param alone: by vertex whether executions that hold the GIL take their CPU time.
        """
        took, cpu, held, start, end = (
            self._columns[name] for name in ('took', 'cpu', 'held', 'start', 'end'))
        known = cpu >= 0
        computes = known & np.where(
            held > 0, self._of_vertices(alone) if alone.any() else False, 2 * cpu >= took)
        np.minimum(took, cpu, out=took, where=computes)
        holds = np.flatnonzero(known & (held > 0))
        process = self._of_vertices(np.array(self._process, dtype=np.int16))[holds]
        for number in distinct(process).tolist():
            mine = holds[process == number]
            shared = Spans(*crowded(start[mine], end[mine], 2)).within(start[mine], end[mine])
            took[mine] = np.maximum(np.minimum(took[mine], cpu[mine]), took[mine] - shared)

    def _of_vertices(self, values: Any) -> Any:
        """Return values by vertex as those of each vertex of each job."""
        return np.concatenate([values[:0], *(
            np.tile(values[first:after], len(jobs))
            for first, after, jobs in zip(self._first, self._first[1:], self._numbers))])

    def _load(self, costs: Any, others: Ints, overheads: bool, only_one: Mask) -> Workload:
        n_dags, times = len(self._numbers), list[Any]()
        for dag in range(n_dags):
            release, noticed, turn, busy = self._of(dag, 'release', 'noticed', 'turn', 'busy')
            times.append(release if self._timer[dag] and not overheads else np.where(
                (turn >= 0) | only_one[self._tables.source[dag]] & (busy > 0), release, noticed))
        ready = np.concatenate([*times, others])
        times.clear()
        order = sort_by(ready)      # equal ones stay in the order of DAGs and jobs
        counts = [*map(len, self._numbers), len(others)]
        releases = [release for dag in range(n_dags) for release in self._of(dag, 'release')]
        columns: list[Any] = [ready[order]]
        del ready
        columns.append(np.repeat(np.arange(n_dags + 1), counts)[order])
        columns.append(np.concatenate([np.arange(count) for count in counts])[order])
        released = np.concatenate([*releases, others])[order]
        columns += [costs, self._begins[_VERTEX].tolist(), [*self._widths[_VERTEX].tolist(), 1],
                    [] if np.array_equal(released, columns[0]) else released]
        return Workload(*columns)

    def _transports(self, overheads: bool, process: Sequence[int]) -> tuple[Any, int | None]:
        """
        Return the transports by job, and the median of all measured ones.

        An edge that newly crosses processes, or no longer does, gets the usual time of such edges.
        """
        delays: list[Any] = []
        measured: dict[bool, list[Any]] = {False: [np.zeros(0)], True: [np.zeros(0)]}
        changed: list[tuple[Any, bool]] = []
        for dag, crosses in enumerate(self._crossings(process)):
            start, end, arrived = self._of(dag, 'start', 'end', 'arrived')
            ended = end[:, self._publishers[dag]]
            found = arrived - ended
            known = (arrived >= start[:, self._publishers[dag]]) & (ended >= 0)
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
        found: list[list[tuple[bool, bool]]] = [[] for _ in self._numbers]
        was = self._process
        for a, b in edge_numbers(self._tables):
            found[self._tables.dag_of[a]].append((was[a] != was[b], process[a] != process[b]))
        return found

    def _typical(self) -> dict[str, int]:
        """
        Return by callback the median of its recorded times, otherwise the declared mean.

        Otherwise it is the longest time of an execution that did not complete.
        """
        typical = self._declared_times()
        for key, parts in self._recorded_times().items():
            typical[key] = quantile(memoryview(np.sort(np.concatenate(parts))), 0.5)
        for key, so_far in self._longest_incomplete().items():
            typical.setdefault(key, so_far)
        return typical

    def _declared_times(self) -> dict[str, int]:
        """Return by callback its mean execution time, if that is declared."""
        return {c.key: c.execution_time.mean_ns
                for c in self._task_set.callbacks if c.execution_time is not None}

    def _recorded_times(self) -> dict[str, list[Ints]]:
        """Return by callback its known execution times, without callbacks that have none."""
        recorded: dict[str, list[Ints]] = {}
        for dag in self._task_set.dags:
            took, = self._of(dag.index, 'took')
            for vertex in dag.vertices:
                times = took[:, vertex.index]
                times = times[times >= 0]
                if len(times):
                    recorded.setdefault(vertex.callback.key, []).append(times)
        return recorded

    def _longest_incomplete(self) -> dict[str, int]:
        """Return by callback the longest time of an execution that did not complete."""
        longest: dict[str, int] = {}
        places = np.array(list(self._so_far), dtype=np.int64)
        for dag, begin in zip(self._task_set.dags, self._begins[_VERTEX].tolist()):
            width = len(dag.vertices)
            mine = places[(places >= begin) & (places < self._begins[_VERTEX, dag.index + 1])]
            for place in mine.tolist():
                key = dag.vertices[(place - begin) % width].callback.key
                longest[key] = max(longest.get(key, 0), self._so_far[place])
        return longest

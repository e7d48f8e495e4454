# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A recording: tables with named columns, and the nodes and callbacks that they refer to.

Theory of operation
-------------------
1. Every recording has the same tables of named columns (``columns``).  A reader (``own``,
   ``sources.imported_run``, …) builds them once; an analysis is a function of them and does
   not depend on the reader.
2. Times are int64 nanoseconds on the clock of the recording.  ``UNKNOWN`` (-1) is a time or number
   that is not recorded.
3. DAGs and vertices are those of ``Recording.task_set``.  Vertices are numbered over all DAGs; -1
   is an undeclared callback.  ``mapping.judged_by`` converts a recording to another task set.
4. A row of ``executions`` is one run of a callback on a thread.  A suspended coroutine has several
   rows: ``piece`` counts them, ``began`` is the start of the first, ``busy`` the total time up to
   this row.  So the row that completes a vertex has the values of the whole execution.
5. ``leg`` is the message of a sync callback that the execution processed; ``ALL_LEGS`` if it
   processed all.  ``completes`` says whether it completed a leg or the vertex.
6. ``order`` is the position in the sequence in which the executor's core processed releases,
   completions and ends of jobs.  It decides between equal times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TYPE_CHECKING

from mddag_executor.core import NEVER
from mddag_executor.recording.columns import in_parts, rows, Table
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from mddag_executor.recording.entities import Entities
    from mddag_executor.recording.head import Head
    from msg_graph import Process, TaskSet

Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Places = npt.NDArray[np.int32]

UNKNOWN = -1
"""A time or number that is not recorded."""
ALL_LEGS = -1
"""One execution for all legs of a sync callback."""

# What an execution completes.
NOTHING, LEG, VERTEX = range(3)

EXPIRED, ABORTED, FAILED, WITHDRAWN, OUTDATED = range(5)
REASONS = ('expired', 'aborted', 'failed', 'withdrawn', 'dropped')
"""Why a job ended: names of the values of ``job_ends['reason']``."""


def _table(**columns: str) -> np.dtype[Any]:
    return np.dtype(list(columns.items()))


RELEASES = _table(
    process='i2', dag='i4', job='i8', release='i8', noticed='i8', order='i8')
EXECUTIONS = _table(
    process='i2', callback='i8', dag='i2', vertex='i4', job='i8', leg='i2', piece='i4',
    thread='i4', worker='i2', ready='i8', began='i8', start='i8', end='i8', busy='i8', cpu='i8',
    holds_gil='?', completes='i1', guessed='?', message='i4', order='i4')
PUBLICATIONS = _table(
    process='i2', publisher='i8', execution='i8', vertex='i4', time='i8', source_timestamp='i8',
    header_stamp='i8')
TAKES = _table(execution='i8', message='i8', time='i8')
JOB_ENDS = _table(
    process='i2', dag='i4', vertex='i4', job='i8', time='i8', reason='i1', order='i8')
DROPS = _table(process='i2', vertex='i4', job='i8', time='i8', reason='i2')
LOSSES = _table(process='i2', callback='i8', time='i8', count='i8')
DEMOTIONS = _table(process='i2', dag='i4', vertex='i4', job='i8', time='i8')
MISSES = _table(dag='i4', vertex='i4', job='i8', deadline='i8', completed='i8')
STOPS = _table(process='i2', start='i8', end='i8')

TABLES = {
    'releases': RELEASES, 'executions': EXECUTIONS, 'publications': PUBLICATIONS,
    'job_ends': JOB_ENDS, 'stops': STOPS, 'takes': TAKES, 'drops': DROPS,
    'losses': LOSSES, 'demotions': DEMOTIONS, 'misses': MISSES}
"""The tables of a recording with the types of their columns."""


@dataclass
class Recording:
    """
    A recording in memory.

    :ivar name: its name in messages.
    :ivar head: settings of the recorded run: policy, workers, …
    :ivar task_set: numbers DAGs and vertices.
    :ivar recorded_set: the recorded DAG tasks.
    :ivar declared: whether the recording contains a declaration.
    :ivar imported: whether another executor ran it.
    :ivar same: whether the run itself was judged by ``task_set``.
    :ivar start: the first release, or when the first execution became ready, ns; None: neither.
    :ivar end: the end of the run, ns.
    :ivar judged_until: when the run was judged, ns: what was open then and past its deadline
        missed it.
    :ivar judge_from: the first judged release, ns; -NEVER: all are judged.
    :ivar judged_releases: range of judged releases, ns; None: all.
    :ivar hosted: changes of the vertices of a DAG that the process runs, by position in the order.
    :ivar drop_reasons: names of the values of ``drops['reason']``.
    :ivar lost: number of events that the recorder or tracer lost.
    :ivar notices_stops: from this time on stops are recorded, ns; None: they are not.
    :ivar processes: number of processes, each with ``workers_each`` workers.
    :ivar placed: nodes of each process; empty: one process.
    :ivar process_names: in a recording of another executor by process id a name.
    :ivar worker_names: names of workers, if they are more than a number.
    :ivar links: whether ``message`` is the publication that started an execution; otherwise the
        job links them.
    :ivar unsent: if no publishers are recorded: by the vertices of an edge the jobs in which the
        message of ``may_publish`` that joins them was not published.
    :ivar callback_vertex: by callback a vertex of its declared callback, for executions without
        job.
    :ivar messages: number of messages of an ordinary bag; None: it is a trace.
    :ivar whole: the recording that it is a part of; None: it is a whole one.
    :ivar notes: assumptions, one line each; ``warnings``: missing or doubtful data.
    """

    name: str
    head: Head
    task_set: TaskSet
    recorded_set: TaskSet
    who: Entities
    declared: bool = True
    imported: bool = False
    same: bool = True
    releases: Table = field(default_factory=lambda: rows(RELEASES))
    executions: Table = field(default_factory=lambda: rows(EXECUTIONS))
    publications: Table = field(default_factory=lambda: rows(PUBLICATIONS))
    job_ends: Table = field(default_factory=lambda: rows(JOB_ENDS))
    stops: Table = field(default_factory=lambda: rows(STOPS))
    takes: Table = field(default_factory=lambda: rows(TAKES))
    drops: Table = field(default_factory=lambda: rows(DROPS))
    losses: Table = field(default_factory=lambda: rows(LOSSES))
    demotions: Table = field(default_factory=lambda: rows(DEMOTIONS))
    misses: Table = field(default_factory=lambda: rows(MISSES))
    start: int | None = None
    end: int = 0
    shut_down: bool = False
    judged: bool = True
    judged_until: int = 0
    judged_order: int = 2 ** 62 - 1
    judge_from: int = -NEVER
    judged_releases: tuple[int, int] | None = None
    hosted: Sequence[tuple[int, int, frozenset[int]]] = ()
    drop_reasons: Sequence[str] = ()
    lost: int = 0
    notices_stops: int | None = None
    processes: int = 1
    workers_each: int = 0
    placed: Sequence[Process] = ()
    process_names: Mapping[int, str] = field(default_factory=dict)
    worker_names: Sequence[str] = ()
    links: bool = False
    unsent: Mapping[tuple[int, int], Ints] = field(default_factory=dict)
    callback_vertex: dict[int, int] = field(default_factory=dict)
    messages: int | None = None
    whole: Recording | None = field(default=None, repr=False)
    notes: Sequence[str] = ()
    warnings: list[str] = field(default_factory=list)
    _keys: dict[int, str] | None = field(default=None, init=False, repr=False)
    _callbacks: tuple[Ints, Ints] | None = field(default=None, init=False, repr=False)

    def __repr__(self) -> str:
        """Return one line: the name, and how much is recorded."""
        length = self.end - self.begin
        return (f'<Recording {self.name}: {length / 1e9:.3f} s, {len(self.releases)} jobs, '
                f'{len(self.executions)} executions>')

    @property
    def begin(self) -> int:
        """Return ``start``, or the end if nothing is recorded."""
        return self.end if self.start is None else self.start

    @property
    def dropped(self) -> Counter[str]:
        """Return the number of dropped executions by reason."""
        counts = np.bincount(self.drops['reason'], minlength=len(self.drop_reasons))
        return Counter({
            name: n for name, n in zip(self.drop_reasons, counts.tolist()) if n})

    @property
    def messages_lost(self) -> dict[str, int]:
        """Return by callback the number of messages that the middleware lost."""
        counts: Counter[str] = Counter()
        for callback, count in zip(*(self.losses[each].tolist() for each in (
                'callback', 'count'))):
            counts[self.callback_name(callback)] += count
        return dict(counts)

    @property
    def guessed(self) -> dict[str, int]:
        """Return by sync the number of results of which the driving message is a guess."""
        vertex, count = np.unique(
            self.executions['vertex'][self.executions['guessed']], return_counts=True)
        return {self.task_set.vertices[v].callback.key: n for v, n in zip(
            vertex.tolist(), count.tolist()) if v >= 0}

    @property
    def unjudged(self) -> dict[int, int] | None:
        """Return by DAG the number of withdrawn jobs; None: none can be."""
        if not self.links:
            return None
        ends, released = self.job_ends, self.releases['release']
        begin, end = self.judged_releases or (-NEVER, NEVER)
        judged = self.jobs.marked((released >= begin) & (released < end))[self.jobs.places(ends)]
        dags, counts = np.unique(
            ends['dag'][judged & (ends['reason'] == WITHDRAWN)], return_counts=True)
        return dict(zip(dags.tolist(), counts.tolist()))

    @cached_property
    def jobs(self) -> Jobs:
        """Return the jobs."""
        return Jobs(len(self.task_set.dags), self.releases)

    @cached_property
    def job_places(self) -> Places:
        """Return by execution the place of its job in ``jobs``; -1: none."""
        return self.jobs.places(self.executions)

    def callbacks(self) -> tuple[Ints, Ints]:
        """Return the numbers of the callbacks that ran, and by execution the callback's index."""
        if self._callbacks is None:
            self._callbacks = different(self.executions['callback'])
        return self._callbacks

    def vertices_of_callbacks(self, which: Any = slice(None)) -> Ints:
        """Return by index of a callback the vertex it ran as last (in ``which``); -1: none."""
        numbers, index = self.callbacks()
        vertex, index = self.executions['vertex'][which], index[which]
        found = np.full(len(numbers), UNKNOWN)
        declared = vertex >= 0
        found[index[declared]] = vertex[declared]
        return found

    def callback_name(self, number: int) -> str:
        """Return the declared name of a callback, otherwise its node and trigger."""
        if self._keys is None:
            numbers, _ = self.callbacks()
            self._keys = {
                each: self.task_set.vertices[vertex].callback.key
                for each, vertex in zip(numbers.tolist(), self.vertices_of_callbacks().tolist())
                if vertex >= 0}
        return self._keys.get(number) or self.who.name(number)

    def cut(self, begin: int, end: int) -> Recording:
        """
        Return a time range; see ``recording.cut``.

        :param begin: begin of the range, ns after the start of the recording; ``end``: likewise.
        :raises ValueError: if the range is empty or begins before the recording.
        """
        from mddag_executor.recording.cut import cut
        return cut(self, begin, end)

    def to_arrow(self, name: str) -> Any:
        """Return one of ``TABLES`` as an Arrow table, with names instead of numbers."""
        from mddag_executor.recording.frames import arrow_table
        return arrow_table(self, name)

    def to_pandas(self, name: str) -> Any:
        """Return one of ``TABLES`` as a pandas data frame, with names instead of numbers."""
        from mddag_executor.recording.frames import pandas_frame
        return pandas_frame(self, name)


class Jobs:
    """
    The jobs of a recording: by DAG, those of a DAG in the order of their releases.

    A *place* is the position of a job among all jobs, -1 for an unknown job.  It indexes the
    columns, and any array that has a value for each job (and one more for unknown jobs).

    :ivar rows: by place the row of ``releases``; ``number``, ``release``: columns of it.
    :ivar first: by DAG the place of its first job; at the end the number of all jobs.
    """

    def __init__(self, n_dags: int, releases: Table) -> None:
        rows = np.flatnonzero((releases['dag'] >= 0) & (releases['dag'] < n_dags))
        rows = rows[sort_by(releases['dag'][rows], releases['order'][rows])]
        self.rows: Ints = rows
        self.number, self.release, self.noticed, self.order = (
            releases[name][rows] for name in ('job', 'release', 'noticed', 'order'))
        self.first: Ints = np.searchsorted(releases['dag'][rows], np.arange(n_dags + 1))
        # if the jobs of a DAG are numbered one after the other, a place need not be searched for
        self._searched = [
            dag for dag in range(n_dags) if (np.diff(self.number[self.of_dag(dag)]) != 1).any()]
        self._least = np.append(self.number, 0)[self.first[:-1]]
        self._counts = np.diff(self.first)
        self._counts[self._searched] = 0

    def __len__(self) -> int:
        return len(self.rows)

    def of_dag(self, dag: int) -> slice:
        """Return the places of the jobs of a DAG."""
        return slice(int(self.first[dag]), int(self.first[dag + 1]))

    def places(self, table: Table) -> Places:
        """Return by row the place of its job."""
        return self.places_of(table['dag'], table['job'])

    def places_of(self, dag: Any, job: Any) -> Places:
        """Return the places of jobs, by their DAGs and numbers."""
        found = np.full(len(job), UNKNOWN, dtype=np.int32)
        if len(self):
            for part, dags, jobs in zip(*map(in_parts, (found, dag, job))):
                at = np.where((dags >= 0) & (dags < len(self._counts)), dags, 0)
                away = jobs - self._least[at]
                known = (away >= 0) & (away < self._counts[at]) & (at == dags)
                part[known] = (self.first[at] + away)[known]
        for each in self._searched:
            mine, jobs = np.flatnonzero(dag == each), self.of_dag(each)
            at = look_up(self.number[jobs], job[mine])
            found[mine] = np.where(at >= 0, at + jobs.start, UNKNOWN)
        return found

    def rows_of(self, dag: int, job: Any) -> Ints:
        """Return the positions of jobs among those of their DAG, -1 for unknown jobs."""
        places = self.places_of(np.broadcast_to(dag, len(job)), job)
        return np.where(places >= 0, places - self.first[dag], UNKNOWN)

    def marked(self, which: Mask) -> Mask:
        """Return by place whether the job is one of the chosen releases; at the end False."""
        return np.append(which[self.rows], False)


class RowNumbers:
    """New row numbers after all rows but the kept ones were dropped."""

    def __init__(self, kept: Mask) -> None:
        self._new = np.append(np.where(kept, np.cumsum(kept) - 1, UNKNOWN), UNKNOWN)

    def new(self, rows: Any) -> Ints:
        """Return the new numbers; ``UNKNOWN`` for dropped or unknown rows."""
        found: Ints = self._new[rows]
        return found

    def has(self, rows: Any) -> Mask:
        """Return which rows are kept."""
        kept: Mask = self._new[rows] >= 0
        return kept


def later_pieces(executions: Table) -> tuple[Ints, Ints]:
    """Return the rows of later pieces of executions, and of their first ones or themselves."""
    later = np.flatnonzero(executions['piece'] > 0)
    if not len(later):
        return later, later
    names = ['callback', 'vertex', 'job', 'ready', 'began']
    several = np.unique(executions['callback'][later])
    first = np.flatnonzero(
        (executions['piece'] == 0) & np.isin(executions['callback'], several))
    of = dict(zip(executions[names][first].tolist(), first.tolist()))
    return later, np.array([of.get(key, row) for key, row in zip(
        executions[names][later].tolist(), later.tolist())], dtype=np.int64)


def sort_by(*columns: Any) -> Ints:
    """Return the stable order of rows by several columns of integers, the first one first."""
    if len(columns) > 1:
        order: Ints = np.lexsort(columns[::-1])
        return order
    column, = columns
    least = column.min() if len(column) else 0
    if len(column) and int(column.max()) - int(least) < 2 ** 15:    # 16 bits are sorted faster
        column = np.subtract(column, least, dtype=np.int64).astype(np.int16)
    order = np.argsort(column, kind='stable')
    return order


def different(column: Any) -> tuple[Ints, Ints]:
    """
    Return the different values, ascending, and by row the index of its value.

    It is faster than numpy's own inverse, which sorts all rows, if few values differ.
    """
    values = np.unique(column)
    return values, np.searchsorted(values, column).astype(np.int32)


def earliest(*columns: Ints) -> int | None:
    """Return the earliest time in columns; None if all are empty."""
    return min((int(each.min()) for each in columns if len(each)), default=None)


def last_of(which: Mask, group: Any, before: bool = False) -> Ints:
    """
    Return by row the last chosen row of its group up to it, or ``before`` it; -1: none.

    :param group: a sorted column.
    """
    last = np.maximum.accumulate(np.where(which, np.arange(len(which)), -1))
    if before:
        last = np.append(-1, last)[:len(which)]
    found: Ints = np.where((last >= 0) & (group[last] == group), last, -1)
    return found


def rows_by(numbers: Any, n: int) -> list[Ints]:
    """Return the rows of each number from 0 to n - 1."""
    order = sort_by(numbers)
    borders = np.searchsorted(numbers[order], np.arange(n + 1))
    return np.split(order, borders)[1:-1]


def look_up(numbers: Ints, wanted: Any) -> Ints:
    """Return the first positions of wanted numbers; ``UNKNOWN`` for missing ones."""
    order = np.append(sort_by(numbers), UNKNOWN)
    at = order[np.searchsorted(numbers, wanted, sorter=order[:-1])]
    found: Ints = np.where(np.append(numbers, 0)[at] == wanted, at, UNKNOWN)
    return found


def find_pairs(known: tuple[Ints, Ints], wanted: tuple[Ints, Ints]) -> tuple[Ints, Ints]:
    """Return by wanted pair the first known one, ``UNKNOWN`` without, and their number."""
    values, second = np.unique(np.append(known[1], wanted[1]), return_inverse=True)
    keys = np.append(known[0], wanted[0]) * len(values) + second
    n = len(known[0])
    keys, wanted_keys = keys[:n], keys[n:]
    keys, first, count = np.unique(keys, return_index=True, return_counts=True)
    at = look_up(keys, wanted_keys)
    return np.append(first, UNKNOWN)[at], np.append(count, 0)[at]


def groups(values: Any) -> tuple[Ints, Ints]:
    """Return the begin and end of each run of equal values in a sorted column."""
    if not len(values):
        none = np.empty(0, dtype=np.int64)
        return none, none
    begins = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    return begins, np.r_[begins[1:], len(values)]

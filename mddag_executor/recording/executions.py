# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Makes executions of the events in a trace of this executor.

Theory of operation
-------------------
1. The events of an execution are ``dispatch``, ``callback_end`` and, unless it was suspended or
   is undeclared, ``complete``; a sync callback that the simulator ran once has a ``complete`` for
   each leg.  ``callback_start``, which other tools read, has the time of ``dispatch``.
2. Each event belongs to the last dispatch of its thread, in the order of the file.  The first end
   ends the execution, if its callback is the dispatched one.
3. A ``complete`` completes an ended execution of the same DAG, vertex and job.  Otherwise it is a
   row without start.  A dispatch without end is a row without end: it ran at the end of the run,
   or waited (then its worker is -1, its start the run's end).
4. What was dispatched last in each thread, and its events, wait for the next batch of events.
5. Rows with the same vertex, job and ready time, up to the completing one, are pieces of one
   execution, in the order of their starts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from mddag_executor.core import legs_of
from mddag_executor.recording.tables import (
    ALL_LEGS,
    EXECUTIONS,
    groups,
    Growing,
    Ints,
    last_of,
    LEG,
    Mask,
    NOTHING,
    pick,
    rows,
    sort_by,
    Table,
    UNKNOWN,
    VERTEX,
)
from msg_graph import TaskSet
import numpy as np

PARTS = DISPATCH, END, COMPLETE = ('mddag:dispatch', 'ros2:callback_end', 'mddag:complete')
COMPLETED = np.dtype([('place', 'i8'), ('time', 'i8')])
"""By row of ``executions``: position and time of its completion in the file; -1: none."""


class Numbering:
    """Converts a DAG and the local number of a vertex to the global vertex."""

    def __init__(self, task_set: TaskSet) -> None:
        self._sizes = np.array([*(len(dag.vertices) for dag in task_set.dags), 0])
        self._first = np.r_[0, np.cumsum(self._sizes)[:-1]]
        #: By vertex the number of its legs; the last entry is for none.
        self.n_legs = np.array([
            *(max(1, len(legs_of(vertex, dag.vertices)))
              for dag in task_set.dags for vertex in dag.vertices), 1])

    def of(self, dag: Any, vertex: Any) -> tuple[Ints, Ints]:
        """Return DAGs and global vertices; -1 for unknown vertices."""
        known = (dag >= 0) & (dag < len(self._sizes) - 1)
        at = np.where(known, dag, -1)
        known &= (vertex >= 0) & (vertex < self._sizes[at])
        return np.where(known, dag, -1), np.where(known, self._first[at] + vertex, -1)

    def one(self, dag: int, vertex: int) -> int:
        """Return a global vertex; -1 if unknown."""
        return int(self.of(np.array(dag), np.array(vertex))[1])


class ExecutionJoin:
    """
    Joins the events of executions, batch by batch.

    :param kinds: by name in ``PARTS`` the type of its rows of events.
    :param strange: receives the number of senseless events by reason.
    :ivar orphans: number of completions without execution.
    :ivar last: the last time of a completion, ns.
    """

    def __init__(
        self, kinds: dict[str, np.dtype[Any]], numbering: Numbering, strange: Counter[str]
    ) -> None:
        self.orphans = self.last = 0
        self._numbering, self._strange = numbering, strange
        self._pending = {name: rows(kinds[name]) for name in PARTS}
        self._executions, self._completed = Growing(EXECUTIONS), Growing(COMPLETED)

    def tables(self) -> tuple[Table, Table]:
        """Return ``executions``, and ``COMPLETED``; no events can be added afterwards."""
        self.add({}, at_end=True)
        table = self._executions.table()
        _pieces(table)
        return table, self._completed.table()

    def add(self, events: dict[str, list[Table]], at_end: bool = False) -> None:
        """Add rows of events by name, of each kind in the order of the file."""
        tables = [_in_order([self._pending[name], *events.get(name, ())]) for name in PARTS]
        owners, is_last = _owners(tables)
        waits = [is_last[owner] & (not at_end) for owner in owners]
        self._pending = {name: pick(table, which)
                         for name, table, which in zip(PARTS, tables, waits)}
        dispatch, end, complete = tables
        n = len(dispatch)
        ended = len(end) - 1 - _last_positions(owners[1][::-1], n)      # the first one of each
        end = np.append(end, rows(end.dtype, 1, timestamp=UNKNOWN))
        good = (ended < len(end) - 1) & (end['callback'][ended] == dispatch['callback'])
        ended[~good] = -1
        strange = int(np.count_nonzero(~waits[1]) - np.count_nonzero(good & ~waits[0]))
        if strange:
            self._strange[f'{END} of an execution that was not dispatched'] += strange
        done = np.flatnonzero(~waits[0])
        row = np.append(_last_positions(done, n), -1)
        self._store(
            self._rows(pick(dispatch, done), end['timestamp'][ended[done]]),
            pick(complete, ~waits[2]), row[owners[2][~waits[2]]])

    def _rows(self, dispatch: Table, end: Ints) -> Table:
        """Return rows of dispatched executions."""
        ready, start = dispatch['ready'], dispatch['timestamp']
        strange = (ready < 0) | (ready > start)
        if strange.any():
            self._strange[f'{DISPATCH} before it was ready'] += int(strange.sum())
            ready = np.where(strange, start, ready)
        dag, vertex = self._numbering.of(dispatch['dag'], dispatch['vertex'])
        return rows(
            EXECUTIONS, len(dispatch), callback=dispatch['callback'], dag=dag, vertex=vertex,
            job=dispatch['job'], thread=dispatch['vtid'], worker=dispatch['worker'], ready=ready,
            began=start, start=start, end=end, busy=np.where(end < 0, UNKNOWN, end - start),
            cpu=UNKNOWN, message=UNKNOWN, order=UNKNOWN)

    def _store(self, table: Table, complete: Table, of: Ints) -> None:
        """Store executions with their completions; those without execution are rows, too."""
        completed = rows(COMPLETED, len(table), place=UNKNOWN, time=UNKNOWN)
        rest = self._assigned(table, completed, complete, of)
        self._executions.add(table)
        self._completed.add(completed)
        self.last = max(self.last, int(complete['timestamp'].max(initial=0)))
        if not len(rest):
            return
        dag, vertex = self._numbering.of(rest['dag'], rest['vertex'])
        more = rows(
            EXECUTIONS, len(rest), callback=rest['callback'], dag=dag, vertex=vertex,
            job=rest['job'], thread=rest['vtid'], worker=UNKNOWN, ready=UNKNOWN, began=UNKNOWN,
            start=UNKNOWN, end=rest['completed'], busy=UNKNOWN, message=UNKNOWN)
        _fill(more, rest)
        self._executions.add(more)
        self._completed.add(rows(
            COMPLETED, len(rest), place=rest['place'], time=rest['timestamp']))

    def _assigned(self, table: Table, completed: Table, complete: Table, of: Ints) -> Table:
        """
        Assign completions to executions; return those without execution.

        :param of: by completion the row that was dispatched before; -1: none.
        """
        dag, vertex = self._numbering.of(complete['dag'], complete['vertex'])
        known = dag >= 0
        if not known.all():
            self._strange[f'{COMPLETE} of a vertex that is not declared'] += int((~known).sum())
        good = known & (of >= 0)
        row = of[good]
        good[good] = (table['end'][row] >= 0) & (table['vertex'][row] == vertex[good]) & (
            table['job'][row] == complete['job'][good])
        self.orphans += int((known & ~good).sum())
        mine = np.flatnonzero(good)
        mine = mine[np.argsort(of[mine], kind='stable')]
        begins, until = groups(of[mine])
        row, last_leg = of[mine[begins]], mine[until - 1]
        rest = known
        rest[last_leg] = False
        changed = pick(table, row)
        _fill(changed, pick(complete, last_leg))
        if len(row) < len(mine):    # one execution may complete several legs
            legs = np.add.reduceat(
                1 << np.clip(complete['leg'][mine], 0, 62).astype(np.int64), begins)
            n_legs = self._numbering.n_legs[changed['vertex']]
            every = (until - begins > 1) & (until - begins == n_legs) & (
                legs == (1 << np.minimum(n_legs, 62)) - 1)
            changed['leg'][every] = ALL_LEGS
            rest[mine] &= ~np.repeat(every, until - begins)
        table[row] = changed
        completed['place'][row] = complete['place'][last_leg]
        completed['time'][row] = complete['timestamp'][last_leg]
        return pick(complete, rest)


def _in_order(parts: list[Table]) -> Table:
    """Return rows of events in the order of the file; those of one channel are."""
    table = np.concatenate(parts)
    place = table['place']
    return pick(table, sort_by(place)) if (place[1:] < place[:-1]).any() else table


def _owners(tables: Sequence[Table]) -> tuple[list[Ints], Mask]:
    """
    Find the last dispatch of their thread for events.

    :param tables: events in the order of ``PARTS``.
    :return: by table the rows of dispatches, -1: none; and whether a dispatch is the last one of
        its thread, with an entry for none.
    """
    place, thread = (np.concatenate([table[name] for table in tables])
                     for name in ('place', 'vtid'))
    n = len(tables[0])
    owner, is_last = np.full(len(thread), -1), np.zeros(n + 1, dtype=np.bool_)
    if not n:
        return np.split(owner, np.cumsum([len(table) for table in tables])[:-1]), is_last
    order = sort_by(place)
    thread -= thread.min()
    if thread.max() < 2 ** 15:      # numbers of 16 bits are sorted much faster
        thread = thread.astype(np.int16)
    order = order[sort_by(thread[order])]
    thread = thread[order]
    last = last_of(order < n, thread)
    owner[order] = np.where(last >= 0, order[last], -1)
    at = np.flatnonzero(order < n)
    is_last[order[at]] = np.r_[thread[at[1:]] != thread[at[:-1]], True]
    return np.split(owner, np.cumsum([len(table) for table in tables])[:-1]), is_last


def _last_positions(numbers: Ints, n: int) -> Ints:
    """Return by number from 0 to n - 1 its last position among the numbers, -1: none."""
    found = np.full(n + 1, -1)      # -1 is a number, too
    found[numbers] = np.arange(len(numbers))
    return found[:-1]


def _fill(table: Table, complete: Table) -> None:
    """Fill in the columns about completions."""
    table['leg'] = complete['leg']
    table['completes'] = np.where(complete['last_leg'], VERTEX, LEG)
    table['cpu'] = complete['cpu_time']
    table['holds_gil'] = complete['held_interpreter']


def _pieces(table: Table) -> None:
    """Count the pieces of executions that were suspended (rule 5)."""
    suspended = (table['completes'] == NOTHING) & (table['vertex'] >= 0)
    undeclared = table['vertex'] < 0
    if suspended.any():
        mine = np.flatnonzero(table['vertex'] >= 0)
        keys = _hashed(table['vertex'][mine], table['job'][mine], table['ready'][mine])
        some = np.unique(_hashed(*(table[name][suspended] for name in ('vertex', 'job', 'ready'))))
        number_pieces(table, mine[np.isin(keys, some)], 'job')
    if undeclared.any():
        number_pieces(table, np.flatnonzero(undeclared), 'callback')


def _hashed(vertex: Any, job: Any, ready: Any) -> Ints:
    found: Ints = (vertex.astype(np.int64) * 31 + job) * 0x9E3779B97F4A7C1 + ready
    return found


def number_pieces(table: Table, mine: Ints, of: str) -> None:
    """Count pieces among rows; pieces of an execution agree in vertex, ready time and a column."""
    columns = [table[name][mine] for name in (of, 'vertex', 'ready')]
    order = sort_by(*columns, table['start'][mine])
    mine = mine[order]
    same = np.zeros(len(mine), dtype=np.bool_)
    same[1:] = table['completes'][mine[:-1]] == NOTHING
    for column in columns:
        values = column[order]
        same[1:] &= values[1:] == values[:-1]
    if not same.any():
        return
    begin = np.maximum.accumulate(np.where(same, 0, np.arange(len(mine))))
    table['piece'][mine] = np.arange(len(mine)) - begin
    table['began'][mine] = table['start'][mine[begin]]
    total = np.cumsum(table['busy'][mine])
    ended = table['end'][mine] >= 0     # a running piece is the last one
    table['busy'][mine[ended]] = (total - total[begin] + table['busy'][mine[begin]])[ended]


def running_at(
    executions: Table, completed: Table, thread: Ints, time: Ints, place: Ints
) -> Ints:
    """
    Return the rows of the executions that ran in threads at given times; -1: none.

    If one ended when the next one started, it is the first one whose completion comes later in the
    file: in virtual time a callback publishes when it ends.

    :param completed: see ``COMPLETED``.
    :param time: ascending.
    :param place: positions in the file.
    """
    found = np.full(len(time), UNKNOWN)
    ran = np.flatnonzero((executions['end'] >= 0) & (executions['start'] >= 0))
    threads = executions['thread'][ran]
    for number in np.unique(thread).tolist():
        asked, mine = np.flatnonzero(thread == number), ran[threads == number]
        if not len(mine):
            continue
        start, end = executions['start'][mine], executions['end'][mine]
        if (start[1:] <= start[:-1]).any():
            order = sort_by(start, -end)
            mine, start, end = mine[order], start[order], end[order]
        at = np.searchsorted(start, time[asked], 'right') - 1
        # a nested execution may have ended before
        for _ in range(32):
            outer = (at >= 0) & (end[np.maximum(at, 0)] < time[asked])
            if not outer.any():
                break
            at[outer] -= 1
        later = completed['place'][mine]
        for _ in range(len(mine)):
            one = np.maximum(at - 1, 0)
            before = (at > 0) & (end[one] == time[asked]) & (later[one] > place[asked])
            if not before.any():
                break
            at[before] -= 1
        good = (at >= 0) & (end[np.maximum(at, 0)] >= time[asked])
        found[asked[good]] = mine[at[good]]
    return found

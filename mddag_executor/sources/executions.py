# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Makes executions of the events in a trace of this executor.

Theory of operation
-------------------
1. The events of an execution are ``dispatch``, ``callback_end`` and, unless it was suspended or
   is undeclared, ``complete``; a sync callback that the simulator ran once has a ``complete`` for
   each leg.  ``callback_start``, which other tools read, has the time of ``dispatch``.
2. A dispatch is a row.  Each other event belongs to the last dispatch of its thread, in the order
   of the file.  The first end of the dispatched callback ends the execution.
3. A ``complete`` completes an ended execution of the same DAG, vertex and job.  Otherwise it is a
   row without start.  A dispatch without end is a row without end: it waited at the end of the
   run (its worker is -1, its start the run's end).
4. Events come in batches.  Completions of the newest row of a thread wait for the next batch,
   which may have those of other legs.
5. Rows with the same vertex, job and ready time, up to the completing one, are pieces of one
   execution, in the order of their starts.  Executions of an undeclared callback may have been
   ready at the same time (in virtual time), so a piece that was suspended says so: ``GOES_ON``.
6. ``unfinished`` is recorded of an execution that has run for long, or runs at the end of the run,
   and of a suspended coroutine, since when it waits.  If it was not dispatched with the same start
   (the coroutine: not again), it has not ended: it is a row that ends with the recording.  The
   last of several events counts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mddag_executor.core import legs_of
from mddag_executor.core.driven import ANSWERED, GUESSED
from mddag_executor.recording.columns import Growing, Ints, Mask, rows, Table
from mddag_executor.recording.joins import (
    as_of,
    different,
    equal,
    groups,
    last_before,
    rows_by,
    sort_by,
)
from mddag_executor.recording.tables import (
    ALL_LEGS,
    EXECUTIONS,
    LEG,
    NOTHING,
    UNFINISHED,
    UNKNOWN,
    VERTEX,
)
from mddag_executor.sources.entities import signed
from mddag_executor.trace.events import Event
from mddag_executor.trace.schema import GOES_ON
from msg_graph import TaskSet
import numpy as np

PARTS = DISPATCH, END, COMPLETE = ('mddag:dispatch', 'ros2:callback_end', 'mddag:complete')
COMPLETED = np.dtype([('place', 'i8'), ('time', 'i8'), ('row', 'i4')])
"""Completions: position in the file, time, row of the execution."""
_MOST_NESTED = 32
"""This many executions in a row may have ended while an earlier one ran in their thread."""
_FAR = 1 << 40
"""More than any position in a file."""


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
        at = dag if known.all() else np.where(known, dag, -1)
        known &= (vertex >= 0) & (vertex < self._sizes[at])
        numbers = self._first[at] + vertex
        if known.all():
            return at, numbers
        return np.where(known, dag, -1), np.where(known, numbers, -1)

    def one(self, dag: int, vertex: int) -> int:
        """Return a global vertex; -1 if unknown."""
        known = 0 <= dag < len(self._sizes) - 1 and 0 <= vertex < self._sizes[dag]
        return int(self._first[dag]) + vertex if known else -1


class Batches:
    """
    The fields of events of one kind, in the order of the file.

    :param parts: structured arrays with their fields, and the positions of their rows in the file,
        ascending.
    """

    def __init__(self, parts: Sequence[tuple[Table, Ints]] = ()) -> None:
        self._tables = [table for table, _ in parts]
        #: Positions in the file.
        self.place = np.concatenate([np.empty(0, dtype=np.int64), *(at for _, at in parts)])
        self._order: Any = slice(None)
        if (self.place[1:] < self.place[:-1]).any():
            self._order = sort_by(self.place)
            self.place = self.place[self._order]

    def __len__(self) -> int:
        return len(self.place)

    def __getitem__(self, field: str) -> Ints:
        """Return a field as 64-bit numbers."""
        if not self._tables:
            return self.place
        values = [table[field] for table in self._tables]
        found: Ints = np.concatenate(values, dtype=np.int64, casting='unsafe')[self._order]
        return found

    def chosen(self, which: Ints) -> Batches:
        """Return some of the events; only their fields are converted."""
        place = self.place[which]
        at = which if isinstance(self._order, slice) else self._order[which]
        parts, begin = [], 0
        for table in self._tables:
            mine = (at >= begin) & (at < begin + len(table))
            parts.append((table[at[mine] - begin], place[mine]))
            begin += len(table)
        return Batches(parts)

    def rows(self, kind: np.dtype[Any]) -> Table:
        """Return the events as rows of a type, which also has a column ``place``."""
        return rows(kind, len(self), place=self.place, **{
            name: self[name] for name in kind.names or () if name != 'place'})


class _Dispatches:
    """
    The dispatches of a batch, and the last ones before it, by thread and position in the file.

    :ivar row: the rows of the executions; ``is_newest``: whether it is the last one of its thread.
    """

    def __init__(self) -> None:
        self._numbers = self._thread = self._key = self.row = np.empty(0, dtype=np.int64)
        self.is_newest: Mask = np.empty(0, dtype=np.bool_)

    def add(self, thread: Ints, place: Ints, row: Ints) -> None:
        """Add the dispatches of a batch; forget older ones than the last of each thread."""
        thread = np.append(self._thread[self.is_newest], thread)
        row = np.append(self.row[self.is_newest], row)
        place = np.append(np.full(len(thread) - len(place), UNKNOWN), place)
        self._numbers, number = different(thread)
        order = sort_by(number)
        self._thread, self.row, number = thread[order], row[order], number[order]
        self._key = number.astype(np.int64) * _FAR + place[order]
        self.is_newest = np.append(number[1:] != number[:-1], True)[:len(number)]

    def before(self, thread: Ints, place: Ints) -> Ints:
        """Return the last dispatches of threads before positions in the file; -1: none."""
        if not len(self._key):
            return np.full(len(thread), -1)
        key = np.searchsorted(self._numbers, thread) * _FAR + place
        at = last_before(self._key, key)
        return np.where((at >= 0) & (self._thread[at] == thread), at, -1)


class ExecutionJoin:
    """
    Joins the events of executions, batch by batch.

    :param completion: type of the rows of completions that wait.
    :param strange: receives the number of senseless events by reason.
    :ivar orphans: number of completions without execution.
    :ivar last: the last time of a completion, ns.
    """

    def __init__(
        self, completion: np.dtype[Any], numbering: Numbering, strange: Counter[str]
    ) -> None:
        self.orphans = self.last = 0
        self._numbering, self._strange = numbering, strange
        self._waiting = rows(completion)
        self._dispatches = _Dispatches()
        self._executions = Growing(EXECUTIONS, **dict.fromkeys((
            'worker', 'ready', 'start', 'end', 'busy', 'cpu', 'order'), UNKNOWN))
        self._completed = Growing(COMPLETED)

    def expect(self, share: float) -> None:
        """Expect that the executions with the next events are a share of all."""
        self._executions.expect(share)
        self._completed.expect(share)

    def tables(self) -> tuple[Table, Table]:
        """Return ``executions``, and ``COMPLETED``; no events can be added afterwards."""
        self.add({}, at_end=True)
        table = self._executions.table()
        # Only imported messages are linked, and only later pieces began before they started. So
        # these two columns take no memory of their own.
        table.replace('message', np.broadcast_to(np.int32(UNKNOWN), len(table)))
        table.replace('began', table['start'].view())
        table['began'].flags.writeable = False
        _pieces(table)
        return table, self._completed.table()

    def add_unfinished(self, several: Iterable[Event], end: int) -> list[Event]:
        """
        Add executions that have not ended (rule 6).

        :param several: events in the order of the file; ``end``: of the recording.
        :return: the events of those that were added.
        """
        self.add({}, at_end=True)
        last = {(event[3], signed(event[4]), event[10]): event for event in several
                if 0 < event[10] < end}
        if not last:
            return []
        table = self._executions.rows()
        mine = np.isin(table['callback'], [callback for _, callback, _ in last])
        dispatched = set(table[['thread', 'callback', 'start']][mine].tolist())
        resumed: dict[tuple[int, int], int] = {}    # by callback and ready time the last start
        if any(not thread for thread, _, _ in last):
            for callback, ready, start in table[['callback', 'ready', 'start']][mine].tolist():
                resumed[callback, ready] = max(start, resumed.get((callback, ready), 0))
        found = {
            key: event for key, event in last.items() if key not in dispatched and (
                key[0] or resumed.get((key[1], event[9]), 0) < key[2])}
        for (thread, callback, start), event in found.items():
            _, _, _, _, _, dag, vertex, job, worker, ready, _, _ = event
            dag, vertex = (int(each[0]) for each in self._numbering.of(
                np.array([dag]), np.array([vertex])))
            self._executions.more(
                1, callback=callback, dag=dag, vertex=vertex, job=job if vertex >= 0 else UNKNOWN,
                worker=worker, thread=thread, ready=min(max(0, ready), start), start=start,
                end=end, busy=end - start)
        return [*found.values()]

    def add(
        self, parts: Mapping[str, Sequence[tuple[Table, Ints]]], at_end: bool = False
    ) -> None:
        """Add events by name; see ``Batches``."""
        dispatch, end = (Batches(parts.get(name, ())) for name in (DISPATCH, END))
        complete = Batches([
            (self._waiting, self._waiting['place']), *parts.get(COMPLETE, ())])
        self._dispatch(dispatch)
        self._end(end, *self._owned(end))
        event, at = self._owned(complete)
        waits = (at >= 0) & (not at_end)
        waits[waits] = self._dispatches.is_newest[at[waits]]
        self._complete(complete, event[~waits], at[~waits])
        self._waiting = complete.chosen(np.sort(event[waits])).rows(self._waiting.dtype)

    def _dispatch(self, dispatch: Batches) -> None:
        """Add dispatched executions."""
        ready, start = dispatch['ready'], dispatch['timestamp']
        strange = (ready < 0) | (ready > start)
        if strange.any():
            self._strange[f'{DISPATCH} before it was ready'] += int(strange.sum())
            ready = np.where(strange, start, ready)
        dag, vertex = self._numbering.of(dispatch['dag'], dispatch['vertex'])
        thread, before = dispatch['vtid'], len(self._executions)
        table = self._executions.more(
            len(dispatch), callback=dispatch['callback'], dag=dag, vertex=vertex,
            job=dispatch['job'], worker=dispatch['worker'], thread=thread, ready=ready,
            start=start, cpu=dispatch['cpu_time'], holds_gil=dispatch['held_interpreter'])
        undeclared = dag < 0
        if undeclared.any():
            table['inherited'] = np.where(undeclared, dispatch['reference_deadline'], 0)
        self._dispatches.add(thread, dispatch.place, np.arange(before, len(self._executions)))

    def _owned(self, events: Batches) -> tuple[Ints, Ints]:
        """
        Return events by execution, those of one in the order of the file, and their dispatches.

        The latter are the last ones of the thread before the event; -1: none.
        """
        at = self._dispatches.before(events['vtid'], events.place)
        order = sort_by(at)
        return order, at[order]

    def _end(self, end: Batches, event: Ints, at: Ints) -> None:
        """End executions; the events are by dispatch."""
        table = self._executions.rows()
        event, row = event[at >= 0], self._dispatches.row[at[at >= 0]]
        good = (table['end'][row] < 0) & (table['callback'][row] == end['callback'][event])
        event, row = event[good], row[good]
        begins, _ = groups(row)
        event, row = event[begins], row[begins]
        time = end['timestamp'][event]
        table['end'][row] = time
        table['busy'][row] = np.where(time < 0, UNKNOWN, time - table['start'][row])
        if len(row) < len(end):
            self._strange[f'{END} of an execution that was not dispatched'] += len(end) - len(row)

    def _complete(self, complete: Batches, event: Ints, at: Ints) -> None:
        """Complete executions; completions without execution become rows."""
        dag, vertex = (each[event] for each in self._numbering.of(
            complete['dag'], complete['vertex']))
        job, time, leg = (complete[name][event] for name in ('job', 'timestamp', 'leg'))
        self.last = max(self.last, int(time.max(initial=0)))
        rest = dag >= 0
        if not rest.all():
            self._strange[f'{COMPLETE} of a vertex that is not declared'] += int((~rest).sum())
        never = rest & (complete['completed'][event] < 0)
        if never.any():
            self._strange[f'{COMPLETE} at an impossible time'] += int(never.sum())
            rest &= ~never
        table, good = self._executions.rows(), rest & (at >= 0)
        row = self._dispatches.row[at[good]]
        good[good] = fits = (table['end'][row] >= 0) & (table['vertex'][row] == vertex[good]) & (
            table['job'][row] == job[good])
        self.orphans += int((rest & ~good).sum())
        mine, row = np.flatnonzero(good), row[fits]
        begins, until = groups(row)
        row, last_leg = row[begins], mine[until - 1]
        rest[last_leg] = False
        if len(row) < len(mine):     # one execution may complete several legs
            legs = np.bitwise_or.reduceat(1 << np.clip(leg[mine], 0, 62), begins)
            n_legs = self._numbering.n_legs[table['vertex'][row]]
            every = (until - begins > 1) & (until - begins == n_legs) & (
                legs == (1 << np.minimum(n_legs, 62)) - 1)
            leg[last_leg[every]] = ALL_LEGS
            rest[mine] &= ~np.repeat(every, until - begins)
        more = np.flatnonzero(rest)[sort_by(event[rest])]
        first = len(self._executions)
        if len(more):
            self._executions.more(
                len(more), dag=dag[more], vertex=vertex[more], job=job[more], **{
                    name: complete[field][event[more]] for name, field in (
                        ('callback',) * 2, ('thread', 'vtid'), ('end', 'completed'))})
        row = np.append(row, np.arange(first, first + len(more)))
        # fill in the columns about completions, in the order of the file
        which = np.append(last_leg, more)
        in_file = sort_by(event[which])
        which, row = which[in_file], row[in_file]
        table, event = self._executions.rows(), event[which]
        # no leg: see ``core.driven``
        guessed = (leg[which] == GUESSED) & (self._numbering.n_legs[table['vertex'][row]] == 1)
        table['leg'][row] = np.where(guessed, ANSWERED, leg[which])
        table['guessed'][row[guessed]] = True
        table['cpu'][row] = complete['cpu_time'][event]
        table['holds_gil'][row] = complete['held_interpreter'][event]
        table['completes'][row] = np.where(complete['last_leg'][event], VERTEX, LEG)
        self._completed.add(rows(
            COMPLETED, len(row), place=complete.place[event], time=time[which], row=row))


def unfinished_rows(
    several: Sequence[tuple[int, int, str, int]]
) -> tuple[Table, Sequence[str]]:
    """
    Return unfinished executions and the names of the places where they were.

    :param several: callback, start, place and process of each.
    """
    places = list(dict.fromkeys(place for _, _, place, _ in several))
    callback, start, where, process = zip(*several) if several else ((), (), (), ())
    return rows(UNFINISHED, len(several), process=process, callback=callback, start=start,
                where=[places.index(each) for each in where]), tuple(places)


def _pieces(table: Table) -> None:
    """Count the pieces of executions that were suspended (rule 5)."""
    vertex = table['vertex']
    suspended = np.flatnonzero((table['completes'] == NOTHING) & (vertex >= 0))
    if len(suspended):
        mine = np.flatnonzero(np.isin(vertex, vertex[suspended]))
        keys, some = (_hashed(*(table[name][which] for name in ('vertex', 'job', 'ready')))
                      for which in (mine, suspended))
        mine = mine[np.isin(keys, some)]
        number_pieces(table, mine, 'job', table['completes'][mine] == NOTHING)
    undeclared = np.flatnonzero(vertex < 0)
    if len(undeclared):
        number_pieces(table, undeclared, 'callback', table['job'][undeclared] == GOES_ON)
        table['job'][undeclared] = UNKNOWN


def _hashed(vertex: Any, job: Any, ready: Any) -> Ints:
    found: Ints = (vertex.astype(np.int64) * 31 + job) * 0x9E3779B97F4A7C1 + ready
    return found


def number_pieces(table: Table, mine: Ints, of: str, goes_on: Mask) -> None:
    """
    Count pieces among rows; pieces of an execution agree in vertex, ready time and a column.

    :param goes_on: by row of ``mine`` whether another piece may follow.
    """
    columns = [table[name][mine] for name in (of, 'vertex', 'ready')]
    order = sort_by(columns[0])
    group, ready = columns[0][order], columns[2][order]
    if ((group[1:] != group[:-1]) | (ready[1:] > ready[:-1])).all():
        return      # in the order of the table each was ready later than the one before
    order = sort_by(*columns, table['start'][mine])
    mine = mine[order]
    same = np.zeros(len(mine), dtype=np.bool_)
    same[1:] = goes_on[order][:-1]
    for column in columns:
        values = column[order]
        same[1:] &= values[1:] == values[:-1]
    if not same.any():
        return
    begin = np.maximum.accumulate(np.where(same, 0, np.arange(len(mine))))
    table['piece'][mine] = np.arange(len(mine)) - begin
    began = table['began'].copy()
    began[mine] = table['start'][mine[begin]]
    table.replace('began', began)
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
    if not len(time):
        return found
    completed_at = np.full(len(executions), UNKNOWN)
    completed_at[completed['row']] = completed['place']
    ran = np.flatnonzero((executions['end'] >= 0) & (executions['start'] >= 0))
    numbers, which = different(executions['thread'][ran])
    for asked, mine in zip(*(rows_by(each, len(numbers)) for each in (
            equal(numbers, thread), which))):
        if not len(asked):
            continue
        mine = ran[mine]
        start, end = executions['start'][mine], executions['end'][mine]
        if (start[1:] <= start[:-1]).any():
            order = sort_by(start, -end)
            mine, start, end = mine[order], start[order], end[order]
        at = as_of(start, time[asked])
        # a nested execution, or one that took no time, may have ended before
        for _ in range(_MOST_NESTED):
            outer = (at >= 0) & (end[np.maximum(at, 0)] < time[asked])
            if not outer.any():
                break
            at[outer] -= 1
        later, one, over = completed_at[mine], at.copy(), np.zeros(len(at), dtype=np.int64)
        goes_on = (at > 0) & (start[np.maximum(at, 0)] == time[asked])
        while goes_on.any():
            one[goes_on] -= 1
            found_one = goes_on & (end[one] == time[asked]) & (later[one] > place[asked])
            at[found_one] = one[found_one]
            over = np.where(found_one, 0, over + 1)
            goes_on &= (one > 0) & (found_one | (end[one] < time[asked]) & (over < _MOST_NESTED))
        good = (at >= 0) & (end[np.maximum(at, 0)] >= time[asked])
        found[asked[good]] = mine[at[good]]
    return found

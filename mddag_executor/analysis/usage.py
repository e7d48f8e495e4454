# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How much time callbacks and workers used: executions, busy time, waiting, CPU time.

Theory of operation
-------------------
1. An execution of a declared callback counts when it completes; its time so far always counts.
2. A callback uses the whole time of its executions, even if the recording is a part of a longer
   one and they began before it or ended after it.
3. The workers are busy while they run callbacks, within the span of the recording: each at most
   all of the time.  A callback that another one runs while it waits (an imported one that spins)
   uses the time of the same worker.  A callback that has lent its worker (``Client.call``) uses
   none.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, cast, NamedTuple, TYPE_CHECKING

from mddag_executor.analysis.spans import crowded, Spans
from mddag_executor.recording.columns import in_parts, Ints, Table
from mddag_executor.recording.columns import rows as table_of
from mddag_executor.recording.joins import different, distinct, later_pieces, rows_by, sort_by
from mddag_executor.recording.recording import Recording
from mddag_executor.recording.tables import NOTHING, UNKNOWN
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import CallbackUse, OverTime, WorkerUse

_ALWAYS = ('executions', 'busy_ns', 'longest_ns', 'waiting_ns', 'longest_wait_ns',
           'waiting_group_ns', 'waiting_program_ns')
_MEASURED = 'measured', 'measured_busy_ns', 'cpu_ns', 'held_interpreter'
USAGE = np.dtype([(name, 'i8') for name in (*_ALWAYS, *_MEASURED)])
"""The columns of a callback; the last four are of executions with known CPU time."""
# Columns of executions that are summed: of all pieces, and of completed executions.
_TIMES = ['vertex', 'piece', 'ready', 'start', 'end']
_TOTALS = ['vertex', 'busy', 'cpu', 'holds_gil']


def ran(table: Table) -> Ints:
    """Return the rows of ``executions`` that have a start and an end, in order of their ends."""
    rows = np.flatnonzero((table['start'] >= 0) & (table['end'] >= 0))
    end = table['end'][rows]
    if (end[1:] < end[:-1]).any():
        rows = rows[sort_by(end)]
    return rows


def _has_groups(recording: Recording) -> bool:
    return max(recording.names.groups.values(), default=UNKNOWN) >= 0


def in_groups(recording: Recording) -> Iterator[tuple[int, Ints, Ints, Ints]]:
    """
    Yield mutually exclusive groups, and rows, starts and ends of their executions that started.

    They are in the order of ends; open ones come last, and end with the recording.
    """
    if not _has_groups(recording):
        return
    table, known = recording.executions, recording.names.groups
    rows = np.r_[ran(table), np.flatnonzero((table['start'] >= 0) & (table['end'] < 0))]
    callbacks, which = recording.callbacks()
    group = np.array([known.get(each, UNKNOWN) for each in callbacks.tolist()], np.int64)[
        which[rows]]
    numbers, which = different(group)
    for number, mine in zip(numbers.tolist(), rows_by(which, len(numbers))):
        if number >= 0:
            members = rows[mine]
            end = table['end'][members]
            yield number, members, table['start'][members], np.where(
                end < 0, recording.end, end)


def group_waits(recording: Recording) -> Ints:
    """
    Return by execution how long its group was busy while it waited, ns.

    Only callbacks of mutually exclusive groups wait for them.  The first piece of an execution
    waits; all of its rows have the value.
    """
    table = recording.executions
    if not _has_groups(recording):
        return np.broadcast_to(np.int64(0), len(table))     # which takes no memory
    waited = np.zeros(len(table), dtype=np.int64)
    for _, rows, starts, ends in in_groups(recording):
        ready = table['ready'][rows]
        # only if the previous one ended after this one was ready
        late = np.flatnonzero((np.r_[-1, ends[:-1]] > ready) & (table['piece'][rows] == 0))
        if len(late):
            waited[rows[late]] = Spans(starts, ends).within(ready[late], starts[late])
    later, first = later_pieces(table)
    waited[later] = waited[first]
    return waited


def program_waits(recording: Recording, in_group: Ints) -> Ints:
    """
    Return by execution how long it waited for its program, ns.

    Other callbacks of the program ran, and it runs them one at a time, or it did not spin.  Time
    in which it waited for its callback group (``in_group``) does not count a second time.
    """
    table = recording.executions
    closed = [*recording.closed_times()]
    if not closed:
        return np.broadcast_to(np.int64(0), len(table))     # which takes no memory
    waited = np.zeros(len(table), dtype=np.int64)
    for each in closed:
        rows = np.flatnonzero(each.executions & (table['piece'] == 0) & (table['start'] >= 0))
        occupied = Spans(*crowded(*each.times, 1)).within(
            table['ready'][rows], table['start'][rows])
        waited[rows] = np.maximum(0, occupied - in_group[rows])
    later, first = later_pieces(table)
    waited[later] = waited[first]
    return waited


class OtherWaits(NamedTuple):
    """By execution how long it waited for its callback ``group``, and for its ``program``, ns."""

    group: Ints
    program: Ints

    @classmethod
    def of(cls, recording: Recording) -> OtherWaits:
        """Return the waits of a recording's executions; all pieces of one have the same."""
        in_group = group_waits(recording)
        return cls(in_group, program_waits(recording, in_group))


def worker_spans(
    recording: Recording, begin: int, end: int, which: Any = True
) -> dict[int, tuple[Ints, Ints]]:
    """
    Return by worker when it ran callbacks from ``begin`` to ``end``: starts and ends, ns (rule 3).

    :param which: the executions that count.
    """
    table = recording.executions[['worker', 'start', 'end']]
    counts = (table['worker'] >= 0) & (table['start'] >= 0) & (table['end'] > begin) & (
        table['start'] < end) & which
    found = {}
    for worker in distinct(table['worker']).tolist():
        # of one after the other, which takes less memory than sorting all rows by worker
        mine = np.flatnonzero(counts & (table['worker'] == worker))
        if not len(mine):
            continue
        starts, ends = np.maximum(table['start'][mine], begin), np.minimum(table['end'][mine], end)
        if (starts[1:] < starts[:-1]).any():
            order = sort_by(starts)
            starts, ends = starts[order], ends[order]
        starts[1:] = np.maximum(starts[1:], np.maximum.accumulate(ends)[:-1])
        found[worker] = starts[starts < ends], ends[starts < ends]
    return found


class PoolUse:
    """
    The load of the pool over time: in each step the busy time of all workers together.

    Steps begin at multiples of their length.  With more than ``MOST_STEPS`` the length is doubled.

    :param spans: starts and ends of the times in which a worker was busy, several arrays of each.
    :param step: initial length, ns.
    :param begin: when the recording begins, ns: if no worker was busy, the only step is there.
    """

    FIRST_STEP_NS = 100_000_000
    MOST_STEPS = 600

    def __init__(
        self, spans: Collection[tuple[Ints, Ints]], step: int = FIRST_STEP_NS,
        begin: int | None = None,
    ) -> None:
        self.step = step
        self.start: int | None = None
        self.busy: list[int] = []
        bounds = [(int(start.min()), int(end.max())) for start, end in _parts(spans)]
        if not bounds:
            if begin is not None:
                self.start, self.busy = begin // step * step, [0]
            return
        first = min(start for start, _ in bounds)
        last = max(end for _, end in bounds) - 1
        while last // self.step - first // self.step >= self.MOST_STEPS:
            self.step *= 2
        number = first // self.step
        self.start = number * self.step
        steps = (number + np.arange(last // self.step - number + 2)) * self.step
        busy = np.zeros(len(steps) - 1, dtype=np.int64)
        for each in _parts(spans):
            busy += Spans(*each).within(steps[:-1], steps[1:])
        self.busy = busy.tolist()

    def result(self) -> OverTime:
        """Return the length of steps, the first begin, and the busy time of each, ns."""
        return {'step_ns': self.step, 'start_ns': self.start, 'busy_ns': self.busy}


def _parts(spans: Collection[tuple[Ints, Ints]]) -> Iterator[tuple[Ints, Ints]]:
    """Yield parts of the spans that are known and not empty."""
    for starts, ends in spans:
        for start, end in zip(in_parts(starts), in_parts(ends)):
            some = (start >= 0) & (start < end)
            if some.any():
                yield start[some], end[some]


class Usage:
    """
    The time that callbacks and workers used in a recording.

    :param waited: what the executions waited for.
    :param begin: the span of the workers' time begins; ``end``: ends.
    """

    def __init__(
        self, recording: Recording, waited: OtherWaits, begin: int, end: int
    ) -> None:
        task_set = recording.task_set
        self._places = task_set.callback_indices()
        # by global vertex the index of its callback; the last entry is for undeclared ones
        self._place = np.array([*task_set.places_of_vertices(), len(self._places)])
        #: By callback its usage, a table of ``USAGE``; the last row is for undeclared ones.
        self.table = table_of(USAGE, len(self._places) + 1)
        self._duration = end - begin
        table = recording.executions
        for part, *waits in zip(in_parts(table), *map(in_parts, waited)):
            ran = (part['start'] >= 0) & (part['end'] >= 0)
            self._ran(part[_TIMES][ran], OtherWaits(*(each[ran] for each in waits)))
            self._completed(part[_TOTALS][ran & (part['completes'] != NOTHING) & (
                part['vertex'] >= 0)])
        spans = worker_spans(recording, begin, end)
        #: By worker how long it ran callbacks, ns.
        self.by_worker = _busy(spans)
        self.pool = PoolUse(spans.values(), begin=begin)
        del spans
        declared = table['vertex'] >= 0
        #: How long workers ran declared callbacks, ns.
        self.busy = sum((self.by_worker if declared.all() else _busy(
            worker_spans(recording, begin, end, declared))).values())
        lent = np.flatnonzero((table['worker'] < 0) & (table['start'] >= 0))
        self._lent = int(np.maximum(0, np.minimum(table['end'][lent], end) - np.maximum(
            table['start'][lent], begin)).sum())

    def _ran(self, table: Table, waited: OtherWaits) -> None:
        vertex, start = table['vertex'], table['start']
        took, place = table['end'] - start, self._place[vertex]
        self._add('busy_ns', place, took)
        first, undeclared = table['piece'] == 0, vertex < 0
        self._add('executions', place[undeclared & first])
        self._most('longest_ns', place[undeclared], took[undeclared])
        place, wait = place[first], (start - table['ready'])[first]
        self._add('waiting_ns', place, wait)
        self._most('longest_wait_ns', place, wait)
        self._add('waiting_group_ns', place, waited.group[first])
        self._add('waiting_program_ns', place, waited.program[first])

    def _completed(self, table: Table) -> None:
        place, busy = self._place[table['vertex']], table['busy']
        self._add('executions', place)
        self._most('longest_ns', place, busy)
        known = table['cpu'] >= 0
        if known.any():
            place, table = place[known], table[known]
            self._add('measured', place)
            self._add('measured_busy_ns', place, table['busy'])
            self._add('cpu_ns', place, table['cpu'])
            self._add('held_interpreter', place, table['holds_gil'])

    def _add(self, name: str, places: Ints, values: Any = None) -> None:
        """Add values to callbacks by index; without values count them."""
        column = self.table[name]
        if values is None:
            column += np.bincount(places, minlength=len(column))
        else:
            np.add.at(column, places, values)

    def _most(self, name: str, places: Ints, times: Ints) -> None:
        """Update the longest times of callbacks by index."""
        np.maximum.at(self.table[name], places, times)

    def callbacks(self) -> dict[str, CallbackUse]:
        """Return the usage of each declared callback, in file order."""
        return {key: self._result(place) for key, place in self._places.items()}

    def undeclared(self) -> CallbackUse:
        """Return the usage of all undeclared callbacks together."""
        return self._result(-1)

    def _result(self, place: int) -> CallbackUse:
        names = (*_ALWAYS, *_MEASURED) if self.table['measured'][place] else _ALWAYS
        return cast('CallbackUse', {name: int(self.table[name][place]) for name in names})

    def workers(self, count: int) -> WorkerUse:
        """Return how busy the workers were; ``lent`` is the time of blocking calls."""
        return {
            'busy_ns': {str(w): busy for w, busy in sorted(self.by_worker.items())},
            'lent_ns': self._lent,
            'use': share(sum(self.by_worker.values()), count, self._duration),
            'over_time': self.pool.result()}


def _busy(spans: Mapping[int, tuple[Ints, Ints]]) -> dict[int, int]:
    return {worker: int((ends - starts).sum()) for worker, (starts, ends) in spans.items()}


def share(busy: int, workers: int, duration: int) -> float | None:
    """Return the busy share of the workers' time, None if there is no time."""
    if workers < 1 or duration <= 0:
        return None
    return busy / (workers * duration)

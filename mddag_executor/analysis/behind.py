# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The callbacks that ran while a part of a missed job waited.

Only those count that can have kept it waiting: in the same process (or thread, see
``causes.Pool``), for a callback group or program those that belong to it, and for a worker those
that occupied one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from mddag_executor.analysis.causes import (
    Found,
    GROUP,
    NEVER_ENDED,
    ON_WORKERS,
    PROGRAM,
    SKIPPED,
    WAITS,
)
from mddag_executor.analysis.spans import Spans
from mddag_executor.recording.columns import concatenate, Ints, rows, Table
from mddag_executor.recording.joins import different, distinct, rows_by, sort_by
import numpy as np

BEHIND = np.dtype([('part', 'i8'), ('callback', 'i8'), ('ns', 'i8')])
"""
Columns: a part of a miss (row of ``Found.parts``), a callback, and how long it ran meanwhile.

Those of a part come one after the other, the longest first.
"""
_MOST = 5
"""This many callbacks are named for a part."""
_AT_ONCE = 1 << 22
"""At most this many times are computed at once, for some parts and all callbacks."""


class Members(NamedTuple):
    """Which callbacks exclude each other, by vertex and by callback a number; -1: none."""

    of_vertex: dict[int, int]
    of_callback: dict[int, int]

    def share(self, vertex: int, callback: int) -> bool:
        """Return whether a vertex and a callback exclude each other."""
        number = self.of_vertex.get(vertex, -1)
        return number >= 0 and number == self.of_callback.get(callback, -1)


class Ran(NamedTuple):
    """When a callback ran at a place, and when its executions there occupied a worker."""

    callback: int
    always: Spans
    on_workers: Spans


def ran_at(executions: Table, which: Ints, place: Ints) -> dict[int, list[Ran]]:
    """
    Return by place when each callback ran there.

    :param which: the executions that count; ``place``: by execution (see ``causes.Pool``).
    """
    found: dict[int, list[Ran]] = {}
    callbacks, number = different(executions['callback'][which])
    for callback, at in zip(callbacks.tolist(), rows_by(number, len(callbacks))):
        places = place[which[at]]
        for each in distinct(places).tolist():
            mine = which[at[places == each]]
            found.setdefault(each, []).append(Ran(callback, *(
                Spans(executions['start'][runs], executions['end'][runs])
                for runs in (mine, mine[executions['worker'][mine] >= 0]))))
    return found


def behind(
    found: Found, ran: dict[int, list[Ran]], group_of: Members, program_of: Members
) -> Table:
    """
    Return the callbacks that ran longest while parts of misses waited: ``BEHIND``.

    :param ran: by place the callbacks that ran there.
    :param group_of: the callback groups, ``program_of``: the programs that run one at a time.
    """
    every, misses = found.parts, found.misses
    share = 10 * every['ns'] >= (misses['until'] - misses['release'])[every['miss']]
    # a skipped release waited for what the execution before it waited for
    cause = np.where(every['cause'] == SKIPPED, found.causes[every['miss']], every['cause'])
    chosen = np.flatnonzero(np.isin(cause, WAITS) & share)
    tables = [rows(BEHIND)]
    for place in distinct(every['place'][chosen]).tolist():
        callbacks = ran.get(place, [])
        mine = chosen[every['place'][chosen] == place] if callbacks else chosen[:0]
        step = max(1, _AT_ONCE // max(1, len(callbacks)))
        for begin in range(0, len(mine), step):
            parts = mine[begin:begin + step]
            times = _times(every[parts], cause[parts], callbacks, (
                (group_of, (GROUP, NEVER_ENDED)), (program_of, (PROGRAM,))))
            tables += _longest(parts, np.array([each.callback for each in callbacks]), times)
    waits = concatenate(tables)
    return waits[sort_by(waits['part'])]


def _times(
    parts: Table, cause: Ints, callbacks: list[Ran],
    exclusive: tuple[tuple[Members, tuple[int, ...]], ...],
) -> Ints:
    """Return by callback and part how long the callback ran during the part and kept it."""
    begins, ends = parts['begin'], parts['end']
    times = np.empty((len(callbacks), len(parts)), dtype=np.int64)
    waited = np.isin(cause, ON_WORKERS)
    for row, each in zip(times, callbacks):
        for which, spans in ((waited, each.on_workers), (~waited, each.always)):
            row[which] = spans.within(begins[which], ends[which])
    for members, causes in exclusive:
        among = np.isin(cause, causes)
        for vertex in distinct(parts['vertex'][among]).tolist():
            others = [i for i, each in enumerate(callbacks)
                      if not members.share(vertex, each.callback)]
            times[np.ix_(others, np.flatnonzero(among & (parts['vertex'] == vertex)))] = 0
    return times


def _longest(parts: Ints, callbacks: Ints, times: Ints) -> Iterator[Table]:
    """Yield for each part the callback with the longest time, then those with the next one."""
    every = np.arange(len(parts))
    for _ in range(min(_MOST, len(callbacks))):
        longest = times.argmax(axis=0)
        took = times[longest, every]
        some = np.flatnonzero(took > 0)
        if not len(some):
            return
        yield rows(BEHIND, len(some), part=parts[some], callback=callbacks[longest[some]],
                   ns=took[some])
        times[longest, every] = 0

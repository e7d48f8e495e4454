# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A trace of this executor without declaration, judged by a declaration that is given later.

Theory of operation
-------------------
Such a trace names no jobs, so jobs are made as for imported recordings (``imported_run``), from
the causes of executions.  Differences:

1. *Messages to executions.*  ``rmw_take`` is recorded when any thread takes a message;
   ``dispatch`` has the ready time, which is right after it.  So an execution belongs to the last
   message that its subscription took until then.
2. *Publications to messages.*  A publication is recorded just before sending; its source timestamp
   is not recorded.  A timestamp belongs to a publication of its topic that was being sent then: it
   had begun, and its thread had neither published again nor ended its callback.  Each publication
   has one timestamp.  If several publications fit, the publication is unknown.
3. *Ready* is recorded.  A timer's release is the last time on its period's grid.  The grid's
   origin is not recorded.  It is the earliest time at which the timer was noticed, if half of the
   releases on that grid were noticed shortly after they were due; otherwise a release is the time
   at which it was noticed.
4. The pieces of a coroutine became ready at the same time.  They are one execution, which
   completes at the end of the last piece.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable as Function

from mddag_executor.recording.entities import Callback, INIT_EVENTS
from mddag_executor.recording.head import Head, no_end
from mddag_executor.recording.mapping import Target
from mddag_executor.recording.tables import DROPS, Ints, Recording, rows, UNKNOWN
from mddag_executor.replay.imported_events import (
    END,
    KINDS,
    OWN_KINDS,
    READY,
    SHUTDOWN,
    START,
    TAKE,
)
from mddag_executor.replay.imported_run import ImportedRun
from mddag_executor.replay.links import Links
from mddag_executor.trace import TraceReader
from mddag_executor.trace.times import NEVER
from msg_graph import Dag, TaskSet
import numpy as np

_DROP = 'mddag:drop'
_ROUNDING_NS = 1_000        # of the two clocks that stamp and publication are read from
_UNSENT = 256               # publications of a topic without a timestamp that are compared
# A timer is noticed shortly after its release within both: a time, and a part of its period.
_SOON_NS, _SOON_PART = 1_000_000, 10


class _OwnLinks(Links):
    """The executions and messages of this executor (rules 1 and 2)."""

    def _stamp_messages(self) -> None:
        """Find the source timestamps of publications (rule 2)."""
        #: Topics and timestamps of several possible publications.
        self._ambiguous: set[tuple[str, int]] = set()
        table, found = self.events, self.messages
        kind = table['kind']
        sent = np.zeros(len(table), dtype=np.bool_)
        sent[found['at']] = True
        # a publication is being sent until the next one, or until the callback ends
        ends = np.full(len(found), NEVER)
        stops = sent | (kind <= END)
        before = self._last(stops, stops)
        at = np.flatnonzero(stops)
        mine = (before >= 0) & sent[before]
        ends[self._row[before[mine]]] = table['time'][at[mine]]
        topics: dict[str, list[int]] = {}
        for row in range(len(found)):
            topics.setdefault(self.topic(row), []).append(row)
        times = {topic: found['time'][mine].tolist() for topic, mine in topics.items()}
        takes = np.flatnonzero((kind == TAKE) & (self._subscription >= 0))
        known: set[tuple[str, int]] = set()
        for number, stamp in zip(self._subscription[takes].tolist(), table['b'][takes].tolist()):
            topic = self.taken[number][0].start
            if (topic, stamp) in known or topic not in topics:
                continue
            last = bisect_right(times[topic], stamp + _ROUNDING_NS)
            fits = [row for row in topics[topic][max(0, last - _UNSENT):last]
                    if not found['stamp'][row] and stamp <= ends[row] + _ROUNDING_NS]
            if fits:
                known.add((topic, stamp))
            if len(fits) == 1:
                found['stamp'][fits[0]] = stamp
            elif fits:
                self._ambiguous.add((topic, stamp))

    def _messages_by_stamp(self) -> dict[tuple[str, int], int]:
        return {**super()._messages_by_stamp(), **dict.fromkeys(self._ambiguous, -1)}

    def _takes(self) -> list[tuple[int, int, int]]:
        return []       # the executor takes messages in the threads of callbacks

    def _arrivals(self) -> Ints:
        """Find the taken message of each execution (rule 1)."""
        table = self.events
        kind, time = table['kind'], table['time']
        takes, ready = kind == TAKE, kind == READY
        #: By event of a dispatch the event of the taken message, or -1.
        self._taken_at = np.full(len(table), -1)
        for number, callback in enumerate(self.callbacks):
            subscriptions = [i for i, each in enumerate(self.taken) if callback in each]
            mine = np.flatnonzero(takes & np.isin(self._subscription, subscriptions))
            these = np.flatnonzero(ready & (self._callback == number)) if len(mine) else mine
            place = np.searchsorted(time[mine], table['b'][these], 'right') - 1
            these, place = these[place >= 0], place[place >= 0]
            # a message starts one execution; its pieces have the same ready time
            _, first, which = np.unique(place, return_index=True, return_inverse=True)
            same = table['b'][these] == table['b'][these[first[which]]]
            self._taken_at[these[same]] = mine[place[same]]
        starts = kind == START
        last = self._last(ready, starts)
        self.runs['ready'] = np.where(last >= 0, table['b'][last], self.runs['start'])
        last = self._last(ready | starts, starts)
        found: Ints = np.where((last >= 0) & ready[last], self._taken_at[last], -1)
        return found


class UndeclaredRun(ImportedRun):
    """
    A run of this executor that was recorded without a declaration.

    :param head: head of the trace.
    :param task_set: the declaration to judge by.
    """

    kinds = {**KINDS, **OWN_KINDS}
    others = (*INIT_EVENTS, _DROP)
    links_type = _OwnLinks

    def __init__(
        self, reader: TraceReader, name: str, head: Head, task_set: TaskSet,
        progress: Function[[int], None] | None = None,
    ) -> None:
        super().__init__(reader, name, task_set, head, progress)
        runs = self.links.runs
        # by callback and ready time: number of remaining pieces; and their execution so far
        self._to_come: dict[tuple[int, int], int] = {}
        self._pieces: dict[tuple[int, int], _Pieces] = {}
        for number, callback in enumerate(self.links.callbacks):
            times = runs['ready'][runs['callback'] == number]
            if callback.kind == 'timer' and len(times):
                callback.grid = _grid(np.unique(times), callback.period)
            different, counts = np.unique(times, return_counts=True)
            for time, count in zip(different[counts > 1].tolist(), counts[counts > 1].tolist()):
                self._to_come[number, time] = count

    def read(self) -> Recording:
        """Return the recording."""
        found = super().read()
        found.shut_down = bool((self._events.table['kind'] == SHUTDOWN).any())
        if not found.shut_down:
            found.warnings.append(no_end(self.name))
        reasons = Counter(str(event[4 + event[0].fields.index('reason')])
                          for event in self._events.others if event[0].name == _DROP
                          and 'reason' in event[0].fields)
        found.drop_reasons = tuple(reasons)
        found.drops = rows(
            DROPS, reasons.total(), vertex=UNKNOWN, job=UNKNOWN, time=UNKNOWN,
            reason=[number for number, n in enumerate(reasons.values()) for _ in range(n)])
        return found

    def _judged_until(self) -> int:
        table = self._events.table
        ends = table['a'][table['kind'] == SHUTDOWN]
        return int(ends[-1]) if len(ends) else self.end

    def _ready(self, run: int, callback: Callback) -> int:
        return self._ready_of[run]      # the executor records it

    def _release(self, run: int, callback: Callback, dag: Dag, target: Target) -> int:
        ready = self._ready_of[run]
        if callback.kind == 'service':
            return ready        # the time at which a request was taken is not recorded
        if callback.kind != 'timer':
            return super()._release(run, callback, dag, target)
        if callback.grid is None:
            self._timers.odd.count('off', callback.label)
            return ready
        return self._timers.release(callback, ready)

    def _assign(self, run: int, callback: Callback, target: Target) -> None:
        key = self._runs[run][0], self._ready_of[run]
        if key in self._pieces:
            self._of[run], self._leg_of[run] = self._pieces[key].of, self._pieces[key].leg
            return
        super()._assign(run, callback, target)
        if key in self._to_come:
            self._pieces[key] = _Pieces(self._of[run], self._leg_of[run], self._runs[run][1])

    def _ends_with(self, run: int) -> bool:
        key = self._runs[run][0], self._ready_of[run]
        pieces = self._pieces.get(key)
        if pieces is None:
            return True
        self._to_come[key] -= 1
        row = self._executions[run]
        pieces.busy += int(row['busy'])
        row['piece'], row['began'], row['busy'] = pieces.count, pieces.start, pieces.busy
        pieces.count += 1
        if self._to_come[key]:
            return False
        del self._to_come[key], self._pieces[key]
        return True


class _Pieces:
    """
    An execution of a coroutine with remaining pieces.

    :ivar of: DAG, vertex and job; ``leg``: of a sync.
    :ivar start: start of the first piece; ``count``: pieces so far; ``busy``: their total time.
    """

    __slots__ = ('of', 'leg', 'start', 'count', 'busy')

    def __init__(self, of: tuple[int, int, int] | None, leg: int, start: int) -> None:
        self.of, self.leg, self.start, self.count, self.busy = of, leg, start, 0, 0


def _grid(ready: Ints, period: int) -> int | None:
    """
    Return a time on the grid of a timer's releases, before them; None: no grid (rule 3).

    :param ready: when it was noticed.
    """
    if period <= 0:
        return None

    def late(since: int) -> Ints:
        found: Ints = (ready - since + period // 2) % period - period // 2
        return found

    usual = int(ready[0]) + int(np.median(late(int(ready[0]))))
    first = usual + int(late(usual).min())
    soon = (ready - first) % period <= min(_SOON_NS, period // _SOON_PART)
    return first - 2 * period if 2 * soon.sum() >= len(ready) else None

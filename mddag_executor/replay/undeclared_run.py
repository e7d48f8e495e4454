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

from array import array
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from mddag_executor.recording.entities import Address
from mddag_executor.recording.head import Head, no_end
from mddag_executor.recording.mapping import Target
from mddag_executor.recording.tables import DROPS, Ints, Recording, rows, UNKNOWN
from mddag_executor.replay.imported_run import Ended, ImportedRun
from mddag_executor.replay.linker import (
    Event,
    Execution,
    Linker,
    Publication,
    Thread,
)
from mddag_executor.trace import TraceReader
from msg_graph import Dag, TaskSet
import numpy as np

_DISPATCH, _DROP, _SHUTDOWN = 'mddag:dispatch', 'mddag:drop', 'mddag:shutdown'
_OPEN = 2 ** 62
_ROUNDING_NS = 1_000        # of the two clocks that stamp and publication are read from
_WAITING = 1024             # messages of a subscription that are remembered
_UNSENT = 256               # publications of a topic without a timestamp that are remembered
# A timer is noticed shortly after its release within both: a time, and a part of its period.
_SOON_NS, _SOON_PART = 1_000_000, 10


class _Window:
    """A publication without a timestamp, and the time range in which it may have been sent."""

    __slots__ = ('publication', 'end')

    def __init__(self, publication: Publication) -> None:
        self.publication, self.end = publication, _OPEN

    def holds(self, stamp: int) -> bool:
        """Return whether the timestamp may be that of the publication."""
        return self.publication.time - _ROUNDING_NS <= stamp <= self.end + _ROUNDING_NS


class _OwnLinker(Linker):
    """Links the events of this executor (rules 1 and 2)."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        #: Number of dropped messages by reason.
        self.dropped: Counter[str] = Counter()
        #: End of the run, and end of its judged part; None: not recorded.
        self.ended: tuple[int, int] | None = None
        # by callback its taken messages: times; and their timestamps with the ready time of the
        # execution that each started, 0: none so far
        self._taken: dict[int, tuple[list[int], list[tuple[int, int]]]] = {}
        self._windows: dict[str, deque[_Window]] = {}
        self._sending: dict[Thread, _Window] = {}
        self._ready: dict[Thread, int] = {}
        self._handlers.update({
            'ros2:rmw_take': self._was_taken, _DISPATCH: self._dispatched, _DROP: self._drop,
            _SHUTDOWN: self._shut_down})
        self.events = frozenset(self._handlers)

    def _was_taken(self, event: Event, thread: Thread, state: Any) -> None:
        stamp = self._get(event, 'source_timestamp')
        callbacks = self._entities.taken.latest(
            thread[0], self._get(event, 'rmw_subscription_handle'), event[1])
        for callback in callbacks or ():
            times, messages = self._taken.setdefault(callback.number, ([], []))
            times.append(event[1])
            messages.append((stamp, 0))
            del times[:-_WAITING], messages[:-_WAITING]
            self._find_publication(callback.start, stamp)

    def _find_publication(self, topic: str, stamp: int) -> None:
        """Find the publication of a timestamp."""
        windows = self._windows.get(topic)
        if windows is None or stamp in self._by_stamp.get(topic, ()):
            return
        fits = [window for window in windows if window.holds(stamp)]
        if len(fits) == 1:
            fits[0].publication.stamp = stamp
            windows.remove(fits[0])
        if fits:
            self._know(topic, stamp, fits[0].publication if len(fits) == 1 else None)

    def _publication(self, event: Event, thread: Thread, state: Any) -> Publication:
        message = super()._publication(event, thread, state)
        self._sent(thread, event[1])
        window = self._sending[thread] = _Window(message)
        self._windows.setdefault(message.topic, deque(maxlen=_UNSENT)).append(window)
        return message

    def _sent(self, thread: Thread, now: int) -> None:
        """End the sending of a thread's last publication."""
        window = self._sending.pop(thread, None)
        if window is not None:
            window.end = now

    def _dispatched(self, event: Event, thread: Thread, state: Any) -> None:
        callback = self._entities.callback(thread[0], self._get(event, 'callback'), event[1])
        ready = self._ready[thread] = self._get(event, 'ready')
        times, messages = self._taken.get(callback.number, ([], []))
        place = bisect_right(times, ready) - 1
        state.take = None
        if place >= 0 and messages[place][1] in (0, ready):
            stamp = messages[place][0]
            messages[place] = stamp, ready
            state.take = callback, None, stamp, 0, None, times[place]

    def _start(self, event: Event, thread: Thread, state: Any) -> None:
        self._sent(thread, event[1])
        super()._start(event, thread, state)
        state.stack[-1].ready = self._ready.get(thread, event[1])

    def _end(self, event: Event, thread: Thread, state: Any) -> None:
        self._sent(thread, event[1])
        super()._end(event, thread, state)

    def _drop(self, event: Event, thread: Thread, state: Any) -> None:
        place = self._fields.get('reason')
        if place is not None:
            self.dropped[str(event[place])] += 1

    def _shut_down(self, event: Event, thread: Thread, state: Any) -> None:
        self.ended = event[1], self._get(event, 'end')


class UndeclaredRun(ImportedRun):
    """
    A run of this executor that was recorded without a declaration.

    :param head: head of the trace.
    :param task_set: the declaration to judge by.
    """

    def __init__(self, reader: TraceReader, name: str, head: Head, task_set: TaskSet) -> None:
        ready: dict[Address, array[int]] = {}
        for event in reader.events({_DISPATCH}, sorted=True):
            if None in event:
                continue
            ready.setdefault((event[2], event[4]), array('q')).append(event[9])
        super().__init__(reader, name, task_set, head, _OwnLinker)
        # by address and ready time: number of remaining pieces; and their execution so far
        self._to_come: dict[tuple[Address | None, int], int] = {}
        self._pieces: dict[tuple[Address | None, int], _Pieces] = {}
        for address, times in ready.items():
            callback = self.who.callbacks.latest(*address, times[0])
            if callback is not None and callback.kind == 'timer':
                callback.grid = _grid(np.unique(times), callback.period)
            different, counts = np.unique(times, return_counts=True)
            for time, count in zip(different[counts > 1].tolist(), counts[counts > 1].tolist()):
                self._to_come[address, time] = count

    def read(self, progress: Callable[[int], None] | None = None) -> Recording:
        """Return the recording; ``progress`` is called regularly with the number of events."""
        found = super().read(progress)
        assert isinstance(self._linker, _OwnLinker)
        found.shut_down = self._linker.ended is not None
        if not found.shut_down:
            found.warnings.append(no_end(self.name))
        reasons = self._linker.dropped
        found.drop_reasons = tuple(reasons)
        found.drops = rows(
            DROPS, reasons.total(), vertex=UNKNOWN, job=UNKNOWN, time=UNKNOWN,
            reason=[number for number, n in enumerate(reasons.values()) for _ in range(n)])
        return found

    def _judged_until(self) -> int:
        assert isinstance(self._linker, _OwnLinker)
        return self.end if self._linker.ended is None else self._linker.ended[1]

    def _ready(self, run: Execution, message: Publication | None) -> int:
        return run.ready        # the executor records it

    def _release(self, run: Execution, dag: Dag, target: Target) -> int:
        callback = run.callback
        if callback.kind == 'service':
            return run.ready        # the time at which a request was taken is not recorded
        if callback.kind != 'timer':
            return super()._release(run, dag, target)
        if callback.grid is None:
            self._timers.odd.count('off', callback.label)
            return run.ready
        return self._timers.release(callback, run.ready)

    def _assign(self, run: Execution, target: Target, message: Publication | None) -> None:
        key = run.callback.address, run.ready
        if key in self._pieces:
            run.of, run.leg = self._pieces[key].of, self._pieces[key].leg
            return
        super()._assign(run, target, message)
        if key in self._to_come:
            self._pieces[key] = _Pieces(run.of, run.leg, run.start)

    def _ended(self, run: Execution) -> Ended:
        key = run.callback.address, run.ready
        pieces = self._pieces.get(key)
        if pieces is None:
            return super()._ended(run)
        self._to_come[key] -= 1
        piece = pieces.count
        pieces.count += 1
        pieces.busy += run.end - run.start
        if not self._to_come[key]:
            del self._to_come[key], self._pieces[key]
        return Ended(piece, key not in self._to_come, pieces.start, pieces.busy)


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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What happened in a run, many things at once, and who gets it.

Theory of operation
-------------------
A run of any source (see ``run``) gives *batches* of what happened, in order.  Everything is in
terms of the declaration that judges: DAG and vertex are -1 for what it does not declare, a vertex
is counted over all DAGs.  Of each kind there are rows, and the same as columns for numpy; each is
made of the other when it is asked for.

One run of a callback in a thread is a *piece*.  An execution is one piece, or several where a
coroutine was suspended in between; they have the same vertex, job and ready time.  A completion
ends an execution of a declared callback; several in a row end the legs of a sync callback that ran
only once (a simulator's).

The judge (see ``judge``) is first; what its core decides is put into the batch, for the
others.  An observer overrides the methods of ``Observer`` to get one thing after the other, or its
``take`` to get a whole batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mddag_executor.core.state import Decision
import numpy as np
import numpy.typing as npt

Event = tuple[Any, ...]
Ints = npt.NDArray[np.int64]
Row = Sequence[Any]
Numbers = tuple[Ints, Ints]
"""Places in a batch, and the columns of the events of a kind that stand there."""
BATCH = 16_384
# Columns that all events have; the fields follow.
NOW, PROCESS, THREAD, FIELD = range(4)

#: Kinds of what happens; ``Observer`` has a method for each, and says what is in a row.
KINDS = ('released', 'started', 'completed', 'ended', 'withdrawn', 'failed', 'missed',
         'ran', 'published', 'began', 'over', 'sent', 'took')
# Those before ``RAN`` concern the core.
(RELEASED, STARTED, COMPLETED, ENDED, WITHDRAWN, FAILED, MISSED,
 RAN, PUBLISHED, BEGAN, OVER, SENT, TOOK) = range(len(KINDS))
_WIDTHS = (4, 7, 13, 4, 2, 4, 5, 9, 7, 7, 4, 5, 4)


class Piece(NamedTuple):
    """One run of a callback in a thread; `first` marks the first piece of an execution."""

    callback: int
    dag: int
    vertex: int
    job: int
    worker: int
    ready: int
    start: int
    end: int
    first: bool


class Batch:
    """
    What happened in a stretch of a run.

    :param order: the kinds of what happened, in order.
    :param rows: by kind its rows, or its columns as an array with a row for each.
    :ivar decisions: what the core decided, and in ``decided_at`` at which place of the order.
    :ivar events: of a trace of this executor, the numbers of its events by name.
    """

    def __init__(
        self, order: Sequence[int] | Ints, rows: dict[int, Any],
        events: dict[str, Numbers] | None = None,
    ) -> None:
        self.order = np.asarray(order, dtype=np.int64)
        self._given = rows
        self._rows: dict[int, list[Row]] = {}
        self._columns: dict[int, Ints] = {}
        self.events = events or {}
        self.decisions: list[Decision] = []
        self.decided_at: list[int] = []

    def rows(self, kind: int) -> list[Row]:
        """Return the rows of a kind."""
        found = self._rows.get(kind)
        if found is None:
            given = self._given.get(kind, ())
            found = given.tolist() if isinstance(given, np.ndarray) else list(given)
            self._rows[kind] = found
        return found

    def columns(self, kind: int) -> Ints:
        """Return the same as an array with a row for each."""
        found = self._columns.get(kind)
        if found is None:
            given = self._given.get(kind, ())
            found = given if isinstance(given, np.ndarray) else np.array(
                given, dtype=np.int64).reshape(-1, _WIDTHS[kind])
            self._columns[kind] = found
        return found

    def places(self, kind: int) -> Ints:
        """Return the places of a kind's rows in the order."""
        found: Ints = np.flatnonzero(self.order == kind)
        return found


class Observer:
    """Gets what happened, and does nothing with it."""

    def take(self, batch: Batch) -> None:
        """Look at a batch; here: one thing after the other."""
        taking: list[Any] = [None] * len(KINDS)
        for kind, name in enumerate(KINDS):
            if getattr(type(self), name) is not getattr(Observer, name):
                taking[kind] = getattr(self, name), iter(batch.rows(kind))
        at, decided = 0, batch.decided_at
        wants = type(self).decided is not Observer.decided
        if not wants and not any(taking):
            return
        for place, kind in enumerate(batch.order.tolist()):
            if wants and at < len(decided) and decided[at] == place:
                first = at
                while at < len(decided) and decided[at] == place:
                    at += 1
                self.decided(batch.decisions[first:at])
            if taking[kind] is not None:
                method, rows = taking[kind]
                method(*next(rows))
        if wants and at < len(decided):
            self.decided(batch.decisions[at:])

    def hosted(self, dag: int, vertices: set[int]) -> None:
        """Note that from here on the process has these (global) vertices of a DAG."""

    def judging(self, release: int) -> None:
        """Note that from here on only jobs released at a time or later are judged."""

    def was_dropped(self, vertex: int, job: int, reason: str) -> None:
        """Note that an execution of a (global) vertex was dropped before it ran."""

    def released(self, dag: int, job: int, release: int, now: int) -> None:
        """Note that a job was released; `now` is when the executor noticed it."""

    def started(
        self, dag: int, vertex: int, job: int, ready: int, start: int, callback: int, worker: int
    ) -> None:
        """Note that an execution was dispatched (or a coroutine went on); worker -1: not known."""

    def ran(
        self, callback: int, dag: int, vertex: int, job: int, worker: int, ready: int, start: int,
        end: int, first: int,
    ) -> None:
        """Note that a callback ran; see ``Piece``."""

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int, ready: int,
        start: int, ended: int, busy: int, number: int, cpu: int, held: int,
    ) -> None:
        """
        Note that an execution of a vertex has completed.

        :param whole: whether that completed the vertex, as the executor saw it.
        :param ready: of the execution, as its first ``start`` and when it ``ended``.
        :param busy: the time that its pieces took, ns.
        :param number: identifies it, -1: its times are not recorded; the same number again for
            further legs that one execution completes.
        :param cpu: its CPU time, ns; -1: not known.
        :param held: whether it held the interpreter.
        """

    def ended(self, dag: int, job: int, aborted: bool, now: int) -> None:
        """Note that a job was aborted or, else, has expired."""

    def withdrawn(self, dag: int, job: int) -> None:
        """Note that it is not known what became of a job: it is not to be judged."""

    def failed(self, dag: int, vertex: int, job: int, now: int) -> None:
        """Note that an execution of a vertex failed, and with it its job, before it completes."""

    def missed(self, dag: int, vertex: int, job: int, deadline: int, completed: int) -> None:
        """Note a miss as the executor saw it; `completed` is -1 where it never did."""

    def published(
        self, publisher: int, callback: int, dag: int, vertex: int, job: int, ready: int, now: int
    ) -> None:
        """Note a publication; the DAG is -1 where no declared callback did it."""

    # What the linker of an imported recording found.  Executions (runs) and messages have numbers,
    # -1: there is none; the vertex is any of the declared callback that ran.

    def began(
        self, callback: int, vertex: int, run: int, start: int, message: int, publisher: int,
        sent: int,
    ) -> None:
        """Note that an execution began, and for which message, by whom and when it was sent."""

    def over(self, callback: int, vertex: int, run: int, end: int) -> None:
        """Note that an execution ended."""

    def sent(self, publisher: int, vertex: int, run: int, message: int, time: int) -> None:
        """Note a publication; the vertex is that of a callback of the publisher's node."""

    def took(self, callback: int, vertex: int, run: int, message: int) -> None:
        """Note that a running callback took a message itself."""

    def decided(self, decisions: Sequence[Decision]) -> None:
        """Note what the judge's core has decided."""

    def finished(self, now: int, batch: Batch) -> None:
        """
        Note that the run has ended; what it had begun may still complete.

        :param batch: comes after it; the judge adds what the core decides.
        """


def tell_end(observers: Sequence[Observer], now: int) -> None:
    """Tell observers that the run has ended."""
    batch = Batch((), {})
    for observer in observers:
        observer.finished(now, batch)
        observer.take(batch)


class Batches:
    """Collects what happens, one thing after the other, and passes it on in batches."""

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._observers = observers
        self._order: list[int] = []
        self._rows: dict[int, list[tuple[int, ...]]] = {}

    def add(self, kind: int, *row: int) -> None:
        """Add what happened."""
        self._order.append(kind)
        self._rows.setdefault(kind, []).append(row)

    def flush_if_full(self) -> None:
        """Feed the observers if there is much; the caller is between two happenings."""
        if len(self._order) >= BATCH:
            self.flush()

    def flush(self) -> None:
        """Feed the observers what happened so far."""
        batch = Batch(self._order, self._rows)
        self._order, self._rows = [], {}
        for observer in self._observers:
            observer.take(batch)

    def finish(self, now: int, judged: bool = True) -> None:
        """Pass on the rest and, where what is open is judged, the end of the run."""
        self.flush()
        if judged:
            tell_end(self._observers, now)


def different(values: Ints) -> list[int]:
    """Return the values that occur, ascending: what ``np.unique`` does, in a tenth of the time."""
    ordered = np.sort(values)
    found: list[int] = ordered[np.diff(ordered, prepend=ordered[:1] - 1) != 0].tolist()
    return found


def sums(places: Ints, values: Ints, length: int) -> list[int]:
    """Return the sum of the values at each place, exact whatever the values are."""
    low, high = values & 0x7FFFFFFF, values >> 31
    return [int(upper) * (1 << 31) + int(lower) for upper, lower in zip(
        *(np.bincount(places, each, length).tolist() for each in (high, low)))]

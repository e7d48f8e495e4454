# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether the execution that holds the interpreter computes, while something waits for it.

An execution that waits for anything else gives the interpreter up (``gil``, 4).  While a thread
is paused, that thread checks the execution (``pausing``), and no other one does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from mddag_executor.core import NEVER
from mddag_executor.executor.agenda import Agenda
from mddag_executor.executor.bounds import SHORT_CALLBACK_NS
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.gil_check import CHECK_NS, CHECK_PART, GilCheck, LAST_CHECK_NS
from mddag_executor.executor.pausing import Pauses
from mddag_executor.executor.work import Work


class Thread(Protocol):
    """A thread of the pool."""

    ident: int
    vtid: int


class Threads(Protocol):
    """The worker pool, as the check sees it: see ``workers.WorkerPool``."""

    engine: Engine
    agenda: Agenda
    pauses: Pauses
    now: int

    def thread_of(self, work: Work) -> Thread | None:
        """Return the thread that runs an execution."""


class HolderCheck:
    """
    The appointment of the next check, or of the time at which what waits may overtake.

    All methods need the engine's lock.  Times are monotonic ns.

    :param offset: of the trace's clock.
    :param arm_by: lets a thread wake up at a time.
    """

    def __init__(self, pool: Threads, offset: int, arm_by: Callable[[int], None]) -> None:
        self.entry: list[Any] | None = None
        self._at = NEVER
        self._pool = pool
        self._interpreter = pool.engine.interpreter
        self._offset = offset
        self._arm_by = arm_by
        self._check = GilCheck()

    def note(self, now: int) -> None:
        """Set or cancel the appointment."""
        if self._interpreter.is_wanted():
            self._watch(now)
            self._set(now)
        elif self._check.at < NEVER or self._at < NEVER:
            self._check.end()
            self._cancel()

    def begin(self, now: int, is_late: bool = False) -> None:
        """
        Begin to check, as something waits.

        :param is_late: what holds the interpreter is short, but runs longer than expected.
        """
        self._watch(now, is_late)
        if is_late:
            self._act(now)  # the first reading, with which the next one is compared
        self._arm_by(self._set(now))

    def begin_if_wanted(self, now: int) -> None:
        """Begin to check if anything waits while an execution holds the interpreter."""
        if self._interpreter.is_wanted():
            self.begin(now)

    def begin_late(self, now: int) -> None:
        """Begin at once, if what holds the interpreter has held it for longer than usual."""
        holder = self._interpreter.holder
        if (holder is not None
                and self._interpreter.usual_end(holder) < now + self._offset
                and not self._pool.pauses.is_watched and not self._check.has_begun(holder)):
            self.begin(now, is_late=True)

    def come_due(self) -> None:
        """Check; if what waits may overtake now, the calling thread finds that."""
        self._at = NEVER
        now = self._pool.now - self._offset
        if self._check.at <= now:
            self._act(now)

    def _set(self, now: int) -> int:
        """Set the appointment to the time at which what waits may start; return it."""
        at = NEVER
        if self._interpreter.holders:
            at = self._interpreter.overtaking_at() - self._offset
            at = min(at if at > now else NEVER,
                     NEVER if self._pool.pauses.is_watched else self._check.at)
        if at == NEVER:
            self._cancel()
        elif at != self._at:
            self._at = at
            self._pool.agenda.set(self, at, at)
        return at

    def _cancel(self) -> None:
        self._at = NEVER
        self._pool.agenda.cancel(self)

    def _watch(self, now: int, is_late: bool = False) -> None:
        interpreter = self._interpreter
        holder = interpreter.holder
        if holder is None:
            return
        after, step = LAST_CHECK_NS, min(CHECK_NS, interpreter.patience() // CHECK_PART)
        if is_late or holder.entity.wall_ns > SHORT_CALLBACK_NS:
            after = max(step, interpreter.usual_end(holder) - self._offset - now)
        self._check.begin(holder, now, after, step)

    def _act(self, now: int) -> None:
        """Take the interpreter from an execution that waits for anything else."""
        holder = self._interpreter.holder
        thread = None if holder is None else self._pool.thread_of(holder)
        if holder is None or thread is None:
            self._check.end()
        elif holder is not self._check.subject:  # one of several short callbacks in a row
            self._watch(now)
        elif self._check.waits(thread.ident, thread.vtid, now):
            self._check.end()
            self._pool.engine.stop_holding(holder)
            self._pool.pauses.end()

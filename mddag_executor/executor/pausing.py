# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Callbacks that compute in Python pause for more urgent ones.

Theory of operation
-------------------
A callback that is overtaken (rule 10 of ``core.rules``) would share the GIL with the more urgent
one: each time that one gives it away, for example in numpy, the overtaken one keeps it for a
switch interval.  Instead it pauses at the next line or jump of its own code: ``sys.monitoring``
(Python 3.12) calls a function there, which waits for a lock.  With an older Python, and if other
tools use all of its identifiers, the two share the GIL.

1.  Only code that the overtaken thread executes at that moment is instrumented, and only until it
    pauses.  The thread of the urgent callback waits for that, but at most ``PAUSES_BY_S``.  A
    thread that is in C code meanwhile pauses when that returns.
2.  It pauses in code of the user's own only: never in this package, in rclpy or in Python's
    library, which may own locks that others need at once.
3.  A callback may pause while it owns a lock that the urgent one needs.  So the paused thread
    checks every ``CHECK_S``, by a ``GilCheck`` of its own, whether the execution that holds the
    GIL computes.  If it waits, or polls for what it waits for, it gives the GIL up, and the paused
    one goes on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import os
import sys
import sysconfig
import threading
from time import monotonic_ns
from types import CodeType, FrameType
from typing import Any, Protocol

import mddag_executor
from mddag_executor.executor.gil_check import GilCheck, LAST_CHECK_NS
import rclpy

PAUSES_BY_S = 0.001
CHECK_S = 0.002

_monitoring: Any = getattr(sys, 'monitoring', None)
_LIBRARY = os.path.join(sysconfig.get_path('stdlib'), '')
_FOREIGN = ('site-packages', 'dist-packages')
_KEPT_OUT = tuple(
    os.path.join(os.path.dirname(module.__file__ or ''), '') for module in (mddag_executor, rclpy))


class Holding(Protocol):
    """The worker pool, as pauses see it: see ``workers.WorkerPool``."""

    engine: Any
    lock: Any
    offset: int
    now: int

    def tick(self) -> int:
        """Return the engine's time now."""

    def thread_of(self, work: Any) -> Any:
        """Return the thread that runs an execution."""

    def wake_for_more(self) -> None:
        """Wake a thread if an idle worker may start an execution."""


class Pauses:
    """
    The callbacks that were overtaken, and pause; most methods need the engine's lock.

    :ivar paused: the pauses, by their executions.
    """

    def __init__(self, pool: Holding) -> None:
        self._pool = pool
        self.paused: dict[Any, Pause] = {}

    def begin(self, overtaken: Sequence[Any], me: Any) -> None:
        """
        Let the callbacks pause that are overtaken, and those continue that are not any more.

        :param me: the thread whose execution overtakes them; None: a paused one was urged.
        """
        self.end()
        for work in overtaken:
            thread = None if work in self.paused else self._pool.thread_of(work)
            if thread is not None:  # else it has just ended
                pause = self.paused[work] = Pause(thread)
                if me is not None:
                    me.pause = pause

    def end(self) -> None:
        """Let those executions continue that are no longer overtaken."""
        pool = self._pool
        overtaken = pool.engine.interpreter.overtaken
        for work in [each for each in self.paused if each not in overtaken]:
            pause = self.paused.pop(work)
            work.paused_ns += pool.now - pool.offset - pause.since
            pause.end()

    @property
    def is_watched(self) -> bool:
        """Return whether a paused thread checks the execution that holds the GIL."""
        return any(pause.is_watching for pause in self.paused.values())

    def check(self, check: GilCheck) -> None:
        """
        Take the GIL from the execution that holds it, if that does not compute; without the lock.

        The lock is locked meanwhile, so the thread that is checked does not end.
        """
        pool = self._pool
        with pool.lock:
            now = pool.tick() - pool.offset
            holder = pool.engine.interpreter.holder
            thread = None if holder is None else pool.thread_of(holder)
            if thread is None:
                return
            if check.subject is not holder:
                check.begin(holder, now, LAST_CHECK_NS, LAST_CHECK_NS)
            if check.waits(thread.ident, thread.vtid, now):  # it may need a lock of the paused one
                pool.engine.stop_holding(holder)
                self.end()
                pool.wake_for_more()


class Pause:
    """
    One pause of a thread; all but ``wait_for_it`` and ``pause_here`` need the engine's lock.

    :param thread: the ``WorkerThread`` that pauses.
    :ivar is_watching: whether the thread checks that while it pauses, or as soon as it does.
    :ivar since: when it was asked to pause (monotonic ns).
    """

    __slots__ = ('_thread', 'ident', '_may_go_on', '_has_begun', '_codes', '_is_reached',
                 'is_watching', 'since')

    def __init__(self, thread: Any) -> None:
        self._thread = thread
        self.ident = thread.ident
        self._may_go_on = threading.Lock()
        self._may_go_on.acquire()
        self._has_begun = threading.Lock()
        self._has_begun.acquire()
        self._is_reached = False
        self.since = monotonic_ns()
        self._codes = [*_own_code(sys._current_frames().get(self.ident))]
        self.is_watching = bool(self._codes)
        if self._codes:
            _monitor.begin(self, self._codes)

    def wait_for_it(self) -> None:
        """Wait in the thread of the urgent callback until the other one has paused."""
        if self._codes:
            self._has_begun.acquire(timeout=PAUSES_BY_S)

    def pause_here(self) -> None:
        """Pause; called by the thread itself."""
        if self._is_reached or self._thread.pool.is_inside():  # in a finalizer of the user's
            return
        self._is_reached = True
        _monitor.end(self, self._codes)
        measurement = self._thread.measurement
        if measurement is not None:
            measurement.pause()
        begun = monotonic_ns()
        try:
            self._has_begun.release()
            self._wait()
        finally:  # also after an interrupt
            self.is_watching = False
            self._thread.paused_ns += monotonic_ns() - begun
            if measurement is not None:
                measurement.resume()

    def _wait(self) -> None:
        """Wait for ``end``, which a check also calls if what holds the GIL does not compute."""
        pauses, check = self._thread.pool.pauses, GilCheck()
        while True:
            pauses.check(check)
            if self._may_go_on.acquire(timeout=CHECK_S):
                return

    def end(self) -> None:
        """Let the thread go on."""
        _monitor.end(self, self._codes)
        self._may_go_on.release()


VARIABLE = 'MDDAG_PAUSE'
"""Callbacks share the GIL instead if this variable of the environment is 0."""


class _Monitor:
    """This process's use of ``sys.monitoring``, for all executors."""

    def __init__(self) -> None:
        self._pauses: dict[int, Pause] = {}
        # by id, as different code may be equal; a pause keeps its code alive
        self._users: dict[int, int] = {}
        self._lock = threading.RLock()
        self._tool = -1

    def is_available(self) -> bool:
        """Return whether callbacks can pause."""
        if _monitoring is None or os.environ.get(VARIABLE) == '0':
            return False
        with self._lock:
            if self._tool < 0:
                self._tool = next((i for i in (4, 3) if _monitoring.get_tool(i) is None), -1)
                if self._tool < 0:
                    return False
                _monitoring.use_tool_id(self._tool, 'mddag_executor')
                for event in (_monitoring.events.LINE, _monitoring.events.JUMP):
                    _monitoring.register_callback(self._tool, event, self._at_event)
        return True

    def _at_event(self, *_: Any) -> None:
        pause = self._pauses.get(threading.get_ident())
        if pause is not None:
            pause.pause_here()

    def begin(self, pause: Pause, codes: list[CodeType]) -> None:
        """Let a thread pause in some code."""
        events = _monitoring.events.LINE | _monitoring.events.JUMP
        with self._lock:
            self._pauses[pause.ident] = pause
            for code in codes:
                users = self._users[id(code)] = self._users.get(id(code), 0) + 1
                if users == 1:
                    _monitoring.set_local_events(self._tool, code, events)

    def end(self, pause: Pause, codes: list[CodeType]) -> None:
        """End ``begin``; further calls do nothing."""
        with self._lock:
            if self._pauses.get(pause.ident) is not pause:
                return
            del self._pauses[pause.ident]
            for code in codes:
                self._users[id(code)] -= 1
                if not self._users[id(code)]:
                    del self._users[id(code)]
                    _monitoring.set_local_events(self._tool, code, 0)


_monitor = _Monitor()
can_pause = _monitor.is_available


def _own_code(frame: FrameType | None) -> Iterator[CodeType]:
    """Yield the code of a callback, and of what it has called, that it may pause in."""
    seen = set()
    while frame is not None and frame.f_globals.get('__name__') != 'mddag_executor.executor.work':
        code = frame.f_code
        path = code.co_filename
        in_library = path.startswith(_LIBRARY) and not any(name in path for name in _FOREIGN)
        is_kept_out = in_library or path.startswith((*_KEPT_OUT, '<frozen'))
        if id(code) not in seen and not is_kept_out:
            seen.add(id(code))
            yield code
        frame = frame.f_back

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Callbacks that compute in Python pause for more urgent ones (``preempt=True``).

Theory of operation
-------------------
A callback that is overtaken (rule 11 of ``core.rules``) would share the interpreter with the more
urgent one.  Instead it pauses at the next line or jump of its own code: ``sys.monitoring`` (Python
3.12) calls a function there, which waits for a lock.

1.  Only code that the overtaken thread executes at that moment is instrumented, and only until it
    pauses, so nobody else is slowed down for long.  Where another thread executes the same code,
    the function returns at once.
2.  It pauses in code of its own only: never in this package, in rclpy or in Python's library,
    which may keep locks that others need at once.
3.  A callback may pause while it keeps a lock that the urgent one needs.  While anybody pauses,
    ``interpreter`` looks after the urgent one every 2 ms.  When that does not compute it gives the
    interpreter back, and who pauses goes on.
4.  What calls C code that takes long, or has called code that was not executing yet when it was
    overtaken, pauses later: when it returns to code that was.  At each look what it executes by
    then is instrumented, too.

Debuggers, profilers and coverage use identifiers of their own of ``sys.monitoring``.  Where no
identifier is left, or Python is older, preemption is off and ``reason`` says why.
"""

from __future__ import annotations

from collections.abc import Iterable
import os
import sys
import sysconfig
import threading
from types import CodeType, FrameType
from typing import Any

import mddag_executor
from mddag_executor.live.seat import Seat
from mddag_executor.live.work import Work
import rclpy

_monitoring: Any = getattr(sys, 'monitoring', None)
_NAME = 'mddag_executor'
_LIBRARY = sysconfig.get_path('stdlib')
_FOREIGN = ('site-packages', 'dist-packages')
_KEPT_OUT = tuple(os.path.dirname(module.__file__ or '') for module in (mddag_executor, rclpy))


class _Pause:
    """A thread that is to pause, and the code in which it does."""

    __slots__ = ('lock', 'codes', 'has_begun')

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.lock.acquire()
        self.codes: dict[int, CodeType] = {}
        self.has_begun = False


class _Monitor:
    """
    This process' use of ``sys.monitoring``, for all executors.

    :ivar pauses: by thread.
    """

    def __init__(self) -> None:
        self.pauses: dict[int, _Pause] = {}
        self._lock = threading.Lock()
        self._users = 0
        self._tool = -1
        self._instrumented: dict[int, int] = {}

    def begin(self) -> str:
        """Take an identifier; return why that is impossible, or nothing."""
        if _monitoring is None:
            return 'it takes Python 3.12 or newer'
        with self._lock:
            if self._users == 0:
                self._tool = next((i for i in (4, 3) if _monitoring.get_tool(i) is None), -1)
                if self._tool < 0:
                    return 'others use all identifiers of sys.monitoring'
                _monitoring.use_tool_id(self._tool, _NAME)
                for event in (_monitoring.events.LINE, _monitoring.events.JUMP):
                    _monitoring.register_callback(self._tool, event, self._at_event)
            self._users += 1
        return ''

    def end(self) -> None:
        """Give the identifier back when nobody uses it any more."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                for event in (_monitoring.events.LINE, _monitoring.events.JUMP):
                    _monitoring.register_callback(self._tool, event, None)
                _monitoring.free_tool_id(self._tool)

    def _at_event(self, *_: Any) -> None:
        pause = self.pauses.get(threading.get_ident())
        if pause is not None:
            pause.has_begun = True
            self.restore(pause)
            pause.lock.acquire()
            pause.lock.release()

    def instrument(self, pause: _Pause, codes: Iterable[CodeType]) -> None:
        """Have the function called in some code, too."""
        events = _monitoring.events.LINE | _monitoring.events.JUMP
        with self._lock:
            for code in codes:
                if id(code) not in pause.codes:
                    pause.codes[id(code)] = code
                    users = self._instrumented.get(id(code), 0)
                    self._instrumented[id(code)] = users + 1
                    if not users:
                        _monitoring.set_local_events(self._tool, code, events)

    def restore(self, pause: _Pause) -> None:
        """Have it called there no longer, unless others pause there."""
        with self._lock:
            while pause.codes:
                key, code = pause.codes.popitem()
                self._instrumented[key] -= 1
                if not self._instrumented[key]:
                    del self._instrumented[key]
                    _monitoring.set_local_events(self._tool, code, 0)


_monitor = _Monitor()


class Preemption:
    """
    Has the executions of one executor pause that are overtaken.

    All methods are to be called under the engine's lock.

    :ivar reason: why it is off; empty where it is on.
    :ivar count: how many times one was to pause.
    """

    def __init__(self) -> None:
        self.reason = _monitor.begin()
        self.count = 0
        self._closed = bool(self.reason)
        self._paused: dict[Work, int] = {}

    def update(self, overtaken: Iterable[tuple[Work, Seat]]) -> bool:
        """Have these pause, and all others go on; return whether any is to pause."""
        if self._closed:
            return False
        wanted = dict(overtaken)
        for work in [work for work in self._paused if work not in wanted]:
            self._go_on(self._paused.pop(work))
        for work, seat in wanted.items():
            if work not in self._paused and seat.thread is not None and seat.thread.ident:
                self._paused[work] = seat.thread.ident
                _monitor.pauses[seat.thread.ident] = _Pause()
                self.count += 1
        running = [thread for thread in self._paused.values()
                   if not _monitor.pauses[thread].has_begun]
        if running:
            frames = sys._current_frames()
            for thread in running:
                _monitor.instrument(_monitor.pauses[thread], _own_code(frames.get(thread)))
        return bool(self._paused)

    @staticmethod
    def _go_on(thread: int) -> None:
        pause = _monitor.pauses.pop(thread)
        _monitor.restore(pause)
        pause.lock.release()

    def close(self) -> None:
        """Have all go on, and pause nobody any more."""
        self.update(())
        if not self._closed:
            self._closed = True
            _monitor.end()


def _own_code(frame: FrameType | None) -> Iterable[CodeType]:
    """Return the code of a callback, and of what it has called, that it may pause in."""
    while frame is not None and frame.f_globals.get('__name__') != Work.__module__:
        path = frame.f_code.co_filename
        in_library = path.startswith(_LIBRARY) and not any(name in path for name in _FOREIGN)
        if not in_library and not path.startswith(_KEPT_OUT) and not path.startswith('<frozen'):
            yield frame.f_code
        frame = frame.f_back

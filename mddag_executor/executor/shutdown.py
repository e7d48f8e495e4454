# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What ends or wakes executors when a context, or the interpreter, comes to its end.

A daemon thread that wants the interpreter back while that ends is ended by it.  Where it is in
native code then (in a wait of rcl, a sleep of a clock), C++ calls ``terminate``: the process
aborts after its work was done.  (rclpy's own executors do so when a daemon thread spins one.)
"""

from __future__ import annotations

import atexit
from functools import partial
import os
import threading
import time
from typing import Any
import weakref

from mddag_executor.executor.bounds import AGAIN_NS, END_S
from mddag_executor.executor.compat import on_end
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle

LAST_LOOK_NS = 500_000_000
_now = time.monotonic_ns


_Kept = dict[weakref.ref[Any], Any]
_started: _Kept = {}
_executors: _Kept = {}
_by_context: weakref.WeakKeyDictionary[Context, _Kept] = weakref.WeakKeyDictionary()
_kept: weakref.WeakKeyDictionary[Context, object] = weakref.WeakKeyDictionary()
_ended: weakref.WeakSet[Context] = weakref.WeakSet()
"""Contexts that are shut down, or just going to be."""


def _keep(kept: _Kept, owner: Any, value: Any = None) -> None:
    """
    Keep something of an object for as long as that lives.

    What forgets it is no Python code: in there a KeyboardInterrupt would be printed and lost,
    and executors die right when a program is interrupted.
    """
    kept[weakref.ref(owner, kept.pop)] = value


def _living(kept: _Kept) -> list[tuple[Any, Any]]:
    return [(owner, value) for reference, value in list(kept.items())
            if (owner := reference()) is not None]


def is_over(context: Context) -> bool:
    """Return whether a context has ended: that it was shut down, or destroyed."""
    try:
        return context in _ended or not context.ok()
    except InvalidHandle:
        return True


def stop_at_exit(thing: Any) -> None:
    """
    Have what has threads stopped before the interpreter and the middleware end, if they run then.

    A thread that is in the middleware meanwhile can crash the process.
    """
    _keep(_started, thing)


def join(thread: threading.Thread, seconds: float | None = None) -> None:
    """Wait for the end of a thread that has been asked to end; never for the calling one."""
    if thread is threading.current_thread():
        return
    try:
        thread.join(seconds)
    except RuntimeError:
        pass  # it is just being started, or that was interrupted; it finds out by itself


def halt_at_exit(executor: Any) -> None:
    """Have an executor stopped before the interpreter ends, in whichever thread it spins."""
    _keep(_executors, executor)


@atexit.register
def _stop_all() -> None:
    executors = [executor for executor, _ in _living(_executors)]
    for executor in executors:
        executor.halt()
    end = _now() + int(END_S * 1e9)
    for executor in executors:
        executor.wait_halted(max(0.0, (end - _now()) / 1e9))
    for thing, _ in _living(_started):
        thing.stop()


def _forget() -> None:
    """Forget all in a forked child: it has none of the threads, and locks may be held for ever."""
    _executors.clear()
    _started.clear()


os.register_at_fork(after_in_child=_forget)


def call_at_shutdown(context: Context, method: Any) -> None:
    """
    Have a method called when a context is shut down, as long as its object is alive.

    A context never forgets a callback whose object is alive, and a program can make many
    executors; so the context gets only one callback for all.

    :param method: must not wait for a lock: the thread that ends the context may hold it.  Of an
        object it can be only one.
    """
    methods = _by_context.get(context)
    if methods is None:
        methods = _by_context[context] = {}
        _kept[context] = on_end(context, partial(_call_all, weakref.ref(context), methods))
    _keep(methods, method.__self__, method.__func__)


def _call_all(reference: weakref.ref[Context], methods: _Kept) -> None:
    context = reference()
    if context is not None:
        _ended.add(context)
    for owner, function in _living(methods):
        function(owner)


class ContextChecks:
    """
    When to look again whether a context has ended, after something could have been a signal.

    On a signal rclpy wakes everybody first and shuts the contexts down then, in another thread:
    who is quick still finds the context well, and nobody wakes him again.
    """

    def __init__(self) -> None:
        self.at: int | None = None
        self._step = 0

    def begin(self) -> None:
        """Look again, in steps that grow from 5 ms to half a second."""
        self._step = AGAIN_NS
        self.at = _now() + self._step

    def due(self) -> bool:
        """Return whether it is time to; if so, the next time is the next step's."""
        if self.at is None or _now() < self.at:
            return False
        self._step *= 4
        self.at = _now() + self._step if self._step <= LAST_LOOK_NS else None
        return True

    def seconds(self) -> float:
        """Return how long it is until the next look."""
        return 0.0 if self.at is None else max(0.0, (self.at - _now()) / 1e9)

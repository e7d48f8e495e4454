# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What ends or wakes intakes and executors when a context, or the interpreter, comes to its end.

A daemon thread that wants the interpreter back while that ends is ended by it.  Where it is in
native code then (in a wait of rcl, a sleep of a clock), C++ calls ``terminate``: the process
aborts after its work was done.  (rclpy's own executors do so when a daemon thread spins one.)
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
from functools import partial
import os
import time
from typing import Protocol
import weakref

from rclpy.context import Context

FIRST_LOOK_NS = 5_000_000
LAST_LOOK_NS = 500_000_000
EXIT_PATIENCE_S = 1.0
"""So long a program that ends waits for callbacks that still run in an executor's threads."""
_now = time.monotonic_ns


class _Intake(Protocol):

    def stop(self) -> None: ...


class _Executor(Protocol):

    def halt(self) -> None: ...

    def wait_halted(self, seconds: float) -> None: ...


_started: weakref.WeakSet[_Intake] = weakref.WeakSet()
_executors: weakref.WeakSet[_Executor] = weakref.WeakSet()
_Methods = set[weakref.WeakMethod[Callable[[], None]]]
_by_context: weakref.WeakKeyDictionary[Context, _Methods] = weakref.WeakKeyDictionary()


def stop_at_exit(intake: _Intake) -> None:
    """
    Have an intake stopped before the interpreter and the middleware end, if it still runs then.

    A thread that is in the middleware meanwhile can crash the process.
    """
    _started.add(intake)


def halt_at_exit(executor: _Executor) -> None:
    """Have an executor stopped before the interpreter ends, in whichever thread it spins."""
    _executors.add(executor)


@atexit.register
def _stop_all() -> None:
    executors = list(_executors)
    for executor in executors:
        executor.halt()
    end = _now() + int(EXIT_PATIENCE_S * 1e9)
    for executor in executors:
        executor.wait_halted(max(0.0, (end - _now()) / 1e9))
    for intake in list(_started):
        intake.stop()


def _forget() -> None:
    """Forget all in a forked child: it has none of the threads, and locks may be held for ever."""
    _executors.clear()
    _started.clear()


os.register_at_fork(after_in_child=_forget)


def call_at_shutdown(context: Context, method: Callable[[], None]) -> None:
    """
    Have a method called when a context is shut down, as long as its object is alive.

    A context never forgets a callback of somebody who is alive, and executors can make an intake
    for each spin; so it gets only one for all.

    :param method: must not wait for a lock: whoever ends the context may hold it.
    """
    methods = _by_context.get(context)
    if methods is None:
        methods = _by_context[context] = set()
        context.on_shutdown(partial(_call_all, methods))
    methods.add(weakref.WeakMethod(method, methods.discard))


def _call_all(methods: _Methods) -> None:
    for reference in list(methods):
        method = reference()
        if method is not None:
            method()


class SecondLooks:
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
        self._step = FIRST_LOOK_NS
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

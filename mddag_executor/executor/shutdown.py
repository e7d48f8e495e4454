# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Ends or wakes executors at the end of a context or of the interpreter.

A daemon thread that waits for the GIL while the interpreter ends is ended by it.  If the thread is
in native code then (in a wait of rcl, a sleep of a clock), C++ calls ``terminate``: the process
aborts after its work was done.  (rclpy's own executors cause this if a daemon thread spins one.)
"""

from __future__ import annotations

import atexit
from functools import partial
import os
import threading
import time
from typing import Any
import weakref

from mddag_executor.executor.bounds import END_S
from mddag_executor.executor.compat import on_end
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle

_Kept = dict[weakref.ref[Any], Any]
_started: _Kept = {}
_executors: _Kept = {}
_by_context: weakref.WeakKeyDictionary[Context, _Kept] = weakref.WeakKeyDictionary()
_kept: weakref.WeakKeyDictionary[Context, object] = weakref.WeakKeyDictionary()
_ended: weakref.WeakSet[Context] = weakref.WeakSet()
"""Contexts that are shut down, or are just being shut down."""


def _keep(kept: _Kept, owner: Any, value: Any = None) -> None:
    """
    Keep a value of an object as long as the object lives.

    It is removed without Python code: a KeyboardInterrupt in Python code there would be printed
    and lost, and executors are destroyed just when a program is interrupted.
    """
    kept[weakref.ref(owner, kept.pop)] = value


def _living(kept: _Kept) -> list[tuple[Any, Any]]:
    return [(owner, value) for reference, value in list(kept.items())
            if (owner := reference()) is not None]


def is_over(context: Context) -> bool:
    """Return whether a context has ended: was shut down, or destroyed."""
    try:
        # not its own `ok`: for what a host of programs runs, it ends with the run
        return context in _ended or not type(context).ok(context)
    except InvalidHandle:
        return True


def stop_at_exit(thing: Any) -> None:
    """
    Stop a running object with threads before the interpreter and the middleware end.

    A thread that is in the middleware meanwhile can crash the process.
    """
    _keep(_started, thing)


def join(thread: threading.Thread, seconds: float | None = None) -> None:
    """Wait for the end of a thread that was asked to end; returns at once in that thread."""
    if thread is threading.current_thread():
        return
    try:
        thread.join(seconds)
    except RuntimeError:
        pass  # it is just being started, or its start was interrupted; it will find out itself


def halt_at_exit(executor: Any) -> None:
    """Stop an executor before the interpreter ends, whichever thread spins it."""
    _keep(_executors, executor)


@atexit.register
def _stop_all() -> None:
    executors = [executor for executor, _ in _living(_executors)]
    for executor in executors:
        executor.halt()
    end = time.monotonic() + END_S
    for executor in executors:
        executor.wait_halted(max(0.0, end - time.monotonic()))
    for thing, _ in _living(_started):
        thing.stop()


def _forget() -> None:
    """Forget everything in a forked child: it has no other threads, and locks may stay locked."""
    _executors.clear()
    _started.clear()


os.register_at_fork(after_in_child=_forget)


def call_at_shutdown(context: Context, method: Any) -> None:
    """
    Call a method when a context is shut down, as long as its object is alive.

    A context never forgets a callback whose object is alive, and a program can make many
    executors.  So the context gets one callback for all.

    :param method: must not wait for a lock: the thread that ends the context may own it.  Only one
        method of each object is called.
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

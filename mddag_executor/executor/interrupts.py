# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the handler of a signal raises comes out of a spin where that has nothing in hand.

Theory of operation
-------------------
1.  Python calls the handler of a signal between any two bytecodes of the main thread.  An
    exception that the handler raises within the executor's own code would lose whatever that code
    has in hand: an event that the kernel reports once, a message that was just taken, or an
    execution that the core has just dispatched.  A program that catches KeyboardInterrupt and
    spins again would wait for it for ever.
2.  So the handler of this module replaces those of Python functions while the main thread spins.
    It calls the replaced handler at once if the thread waits for events (in a function marked with
    ``interruptible``) or runs a callback (called by a function marked with ``runs_callbacks``).
    Otherwise it *defers* the call until the spin waits, or ends.
3.  A second SIGINT is not deferred: the first may have come to a callback that never ends, while
    the callback called the executor.  For this case, other signals are repeated every ``REPEAT_S``
    as long as they are deferred, and called as soon as one of them comes to a callback.  A
    repetition that is on its way when the call is made counts as handled by that call
    (``_Deferred._undefer``), and none is on its way when a handler is restored.
4.  If rclpy itself handles a signal, nothing is replaced: its handler is written in C, and ends
    the context, so the program cannot spin again.
"""

from __future__ import annotations

import _thread
from collections.abc import Callable
from functools import wraps
from importlib import import_module
import os
import select
import signal
import sys
import threading
import time
from types import CodeType, FrameType
from typing import Any, cast, TypeVar

_Function = TypeVar('_Function', bound=Callable[..., Any])
_PACKAGE = __name__.partition('.')[0]
_MOST_FD_OF_SELECT = 1023
_FAULTS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)
# SIGINT, which usually raises, is the first to be replaced, and the last to be restored.
_NUMBERS = (signal.SIGINT, *(
    number for number in sorted(signal.valid_signals())
    if number < signal.SIGRTMIN and number not in (signal.SIGINT, *_FAULTS)))
# Without the conversion of ``signal`` to enumerations: this runs in each ``spin_once``.
_signal: Any = import_module('_signal')
REPEAT_S = 0.05
"""How often a signal is repeated whose handler is deferred."""

_interruptible: set[CodeType] = set()
_runs_callbacks: set[CodeType] = set()


def interruptible(function: _Function) -> _Function:
    """Mark a function that waits, and has nothing in hand."""
    _interruptible.add(function.__code__)
    return function


def runs_callbacks(function: _Function) -> _Function:
    """Mark a function that calls code of the program; before that, it has something in hand."""
    _runs_callbacks.add(function.__code__)
    return function


def waits(function: _Function) -> _Function:
    """Mark a function that waits in code of Python's library, and has nothing in hand."""
    interruptible(function)
    runs_callbacks(function)

    @wraps(function)
    def wait(*args: Any, **more: Any) -> Any:
        _call_pending()
        return function(*args, **more)
    return cast(_Function, wait)


class _Deferred:
    """
    The handler of signals in a spin of the main thread.

    :ivar originals: the handlers that it replaces, by signal.
    :ivar pending: the signals whose handlers are still to be called, in their order.
    :ivar may_repeat: whether pending signals may be sent to the main thread again.
    """

    def __init__(self) -> None:
        self.originals: dict[int, Any] = {}
        self.pending: dict[int, bool] = {}
        self.may_repeat = True
        # the threads that may be about to send a signal
        self._sending: set[object] = set()
        # the signals whose repetitions are being awaited
        self._awaited: set[int] = set()
        os.register_at_fork(after_in_child=self._sending.clear)

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Call the original handler, or defer that."""
        if number in self._awaited:
            return
        is_second = number in self.pending
        if is_second and number != signal.SIGINT:
            if self._is_due(number, frame):
                self.originals[number](number, frame)
        elif is_second or _may_interrupt(frame):
            if not is_second or self._undefer(number):
                self.originals[number](number, frame)
        else:
            self.pending[number] = True
            if number != signal.SIGINT:
                # not a ``Thread``: the signal may have interrupted one that starts, with its lock
                _thread.start_new_thread(self._repeat, (number,))

    def _is_due(self, number: int, frame: FrameType | None) -> bool:
        """End the deferral of a signal that was sent again, if its handler may be called now."""
        self._awaited.add(number)  # first: further ones would interrupt this again and again
        try:
            return (_may_interrupt(frame) or _is_in_callback(frame)) and self._undefer(number)
        finally:
            self._awaited.discard(number)

    def _repeat(self, number: int) -> None:
        """Send a signal to the main thread again and again, while its handler is deferred."""
        me = object()
        time.sleep(REPEAT_S)
        while number in self.pending:
            self._sending.add(me)  # before the last look: see ``await_repetitions``
            if self.may_repeat and number in self.pending and number not in self._awaited and (
                    _signal.getsignal(number) == self.handle):
                signal.pthread_kill(threading.main_thread().ident or 0, number)
            self._sending.discard(me)
            time.sleep(REPEAT_S)

    def await_repetitions(self) -> None:
        """Wait until Python has called ``handle`` for each signal that ``_repeat`` has sent."""
        while self._sending:
            time.sleep(0)
        # The kernel delivers a signal at the end of a system call at the latest, and Python calls
        # its handler where a loop begins again.
        for _ in range(3):
            time.sleep(0)

    def _undefer(self, number: int) -> bool:
        """End the deferral of a signal; return whether its original handler is to be called."""
        if number == signal.SIGINT:  # it is not repeated
            return self.pending.pop(number, False)
        self._awaited.add(number)
        try:
            self.await_repetitions()
            return self.pending.pop(number, False)  # a handler of another one may have called it
        finally:
            self._awaited.discard(number)

    def call_pending(self) -> None:
        """Call the original handlers now whose calls were deferred."""
        numbers = list(self.pending)
        if numbers:
            try:
                # unless a second one has come meanwhile, whose handler was called at once
                if self._undefer(numbers[0]):
                    self.originals[numbers[0]](numbers[0], sys._getframe())
            finally:
                self.call_pending()


def _may_interrupt(frame: FrameType | None) -> bool:
    """Return whether a thread waits, or runs code that is not of this package."""
    if frame is None or frame.f_code in _interruptible:
        return True
    while frame is not None and not _is_of_package(frame):
        frame = frame.f_back
        if frame is not None and frame.f_code in _runs_callbacks:
            return True
    return frame is None


def _is_of_package(frame: FrameType) -> bool:
    return str(frame.f_globals.get('__name__')).partition('.')[0] == _PACKAGE


def _is_in_callback(frame: FrameType | None) -> bool:
    """Return whether a thread runs a callback, perhaps in a call of this package."""
    while frame is not None and frame.f_code not in _runs_callbacks:
        frame = frame.f_back
    return frame is not None


_deferred = _Deferred()  # Python handles signals in one thread only


def handler_of(number: int) -> Any:
    """Return the handler of a signal; in a spin the one that has been replaced."""
    handler = signal.getsignal(number)
    return _deferred.originals[number] if handler == _deferred.handle else handler


class InterruptsDeferred:
    """Defer what interrupts the calling thread while entered, if it is the main thread."""

    __slots__ = ('_replaced',)

    def __enter__(self) -> None:
        """Replace the handlers of signals, unless a spin that calls this one has."""
        self._replaced: list[int] = []
        if threading.current_thread() is not threading.main_thread():
            return
        try:
            for number, handler in zip(_NUMBERS, map(_signal.getsignal, _NUMBERS)):
                if callable(handler) and _is_to_be_deferred(number, handler):
                    _deferred.originals[number] = handler
                    self._replaced.append(number)
                    _signal.signal(number, _deferred.handle)
        except BaseException:  # of a handler that is not yet replaced
            self.__exit__()
            raise

    def __exit__(self, *args: object) -> None:
        """Restore the handlers, and call those that were deferred."""
        if threading.current_thread() is not threading.main_thread():
            return
        try:
            _deferred.may_repeat = False
            if _deferred.pending:
                _deferred.await_repetitions()
            self._restore()
        except BaseException:  # a second SIGINT, which is not deferred
            self._restore()
            raise
        if _deferred.pending:
            _deferred.call_pending()

    def _restore(self) -> None:
        for number in reversed(self._replaced):
            if _signal.getsignal(number) == _deferred.handle:
                if number == signal.SIGINT:  # the last one; after that it may interrupt this
                    _deferred.may_repeat = True
                _signal.signal(number, _deferred.originals[number])
        _deferred.may_repeat = True


def _is_to_be_deferred(number: int, handler: Any) -> bool:
    return handler != _deferred.handle and not _is_of_rclpy(number) and (
        number == signal.SIGINT  # asyncio's does nothing but to wake its loop
        or getattr(handler, '__module__', None) != 'asyncio.unix_events')


def _is_of_rclpy(number: int) -> bool:
    if number not in (signal.SIGINT, signal.SIGTERM):
        return False
    # the command line imports this module, and often no rclpy
    from rclpy.signals import get_current_signal_handlers_options, SignalHandlerOptions
    one = SignalHandlerOptions.SIGINT if number == signal.SIGINT else SignalHandlerOptions.SIGTERM
    return get_current_signal_handlers_options() in (SignalHandlerOptions.ALL, one)


def _call_pending() -> None:
    if threading.current_thread() is threading.main_thread():
        _deferred.call_pending()


@interruptible
def wait_for_permit(lock: threading.Lock, seconds: float | None) -> bool:
    """Acquire a lock that another thread releases; return whether that was in time."""
    _call_pending()
    return lock.acquire(timeout=-1 if seconds is None else seconds)


@interruptible
def interruptible_sleep(seconds: float) -> None:
    """Sleep; an interrupt ends that."""
    _call_pending()
    time.sleep(seconds)


@interruptible
def wait_readable(fd: int, seconds: float | None) -> None:
    """
    Wait until a descriptor is readable, and read nothing: an interrupt loses no event.

    :param seconds: the timeout; None: for ever.
    """
    _call_pending()
    if fd <= _MOST_FD_OF_SELECT:  # its resolution is 1 us; that of ``poll`` is 1 ms
        select.select([fd], [], [], seconds)
    else:
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        poll.poll(None if seconds is None else 1e3 * seconds)

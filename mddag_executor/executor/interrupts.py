# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A SIGINT raises KeyboardInterrupt where a spin has nothing in hand.

Theory of operation
-------------------
1.  Python calls the handler of a signal between any two bytecodes of the main thread.  An
    exception that the handler raises within the executor's own code would lose whatever that code
    has in hand: an event that the kernel reports once, a message that was just taken, or an
    execution that the core has just dispatched.  A program that catches KeyboardInterrupt and
    spins again would wait for it for ever.
2.  So SIGINT has the handler of this module while the main thread spins.  It calls the handler
    that it has replaced at once if the thread waits for events or runs a callback (the functions
    marked with ``interruptible``).  Otherwise it *defers* the call until the spin waits, or ends.
3.  A second SIGINT is not deferred: the first may have come to a callback that never ends, while
    the callback called the executor.
4.  If rclpy itself handles SIGINT, nothing is replaced: its handler is written in C, and ends the
    context, so the program cannot spin again.
"""

from __future__ import annotations

from collections.abc import Callable
import select
import signal
import sys
import threading
from types import CodeType, FrameType
from typing import Any, TypeVar

from rclpy.signals import get_current_signal_handlers_options, SignalHandlerOptions

_Function = TypeVar('_Function', bound=Callable[..., Any])
_PACKAGE = __name__.partition('.')[0]
_MOST_FD_OF_SELECT = 1023
_OF_RCLPY = (SignalHandlerOptions.ALL, SignalHandlerOptions.SIGINT)

_interruptible: set[CodeType] = set()


def interruptible(function: _Function) -> _Function:
    """Mark a function that waits or runs code of the program, and has nothing in hand."""
    _interruptible.add(function.__code__)
    return function


class _Deferred:
    """
    The handler of SIGINT in a spin of the main thread.

    :ivar original: the handler that it replaces.
    :ivar is_pending: whether a call of that is deferred.
    """

    def __init__(self) -> None:
        self.original: Any = None
        self.is_pending = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Call the original handler, or defer that."""
        if self.is_pending or _may_interrupt(frame):
            self.is_pending = False
            self.original(number, frame)
        else:
            self.is_pending = True

    def call_pending(self) -> None:
        """Call the original handler now, if that was deferred."""
        if self.is_pending:
            self.is_pending = False
            self.original(signal.SIGINT, sys._getframe())


def _may_interrupt(frame: FrameType | None) -> bool:
    """Return whether the innermost function of this package is marked as interruptible."""
    while frame is not None:
        if frame.f_code in _interruptible:
            return True
        if str(frame.f_globals.get('__name__')).partition('.')[0] == _PACKAGE:
            return False
        frame = frame.f_back
    return True


_deferred = _Deferred()  # Python handles signals in one thread only


class InterruptsDeferred:
    """Defer interrupts of the calling thread while entered, if it is the main thread."""

    __slots__ = ('_replaces',)

    def __enter__(self) -> None:
        """Replace the handler of SIGINT, unless a spin that calls this one has."""
        self._replaces = False
        if threading.current_thread() is not threading.main_thread():
            return
        original = signal.getsignal(signal.SIGINT)
        if callable(original) and original != _deferred.handle and (
                get_current_signal_handlers_options() not in _OF_RCLPY):
            _deferred.original, _deferred.is_pending = original, False
            signal.signal(signal.SIGINT, _deferred.handle)
            self._replaces = True

    def __exit__(self, *args: object) -> None:
        """Restore the handler, and call it if that was deferred."""
        if threading.current_thread() is not threading.main_thread():
            return
        if self._replaces and signal.getsignal(signal.SIGINT) == _deferred.handle:
            signal.signal(signal.SIGINT, _deferred.original)
        _deferred.call_pending()


@interruptible
def wait_readable(fd: int, seconds: float | None) -> None:
    """
    Wait until a descriptor is readable, and read nothing: an interrupt loses no event.

    :param seconds: the timeout; None: for ever.
    """
    if threading.current_thread() is threading.main_thread():
        _deferred.call_pending()
    if fd <= _MOST_FD_OF_SELECT:  # its resolution is 1 us; that of ``poll`` is 1 ms
        select.select([fd], [], [], seconds)
    else:
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        poll.poll(None if seconds is None else 1e3 * seconds)

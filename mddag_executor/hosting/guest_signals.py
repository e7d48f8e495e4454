# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Signal handlers of hosted programs, none of which runs in the main thread.

Theory of operation
-------------------
Python runs handlers in the main thread, and only the main thread may set them.  So this module
sets a common handler for the signals that programs use, and stores the handlers of programs.  When
a signal arrives, first its earlier handler runs (SIGINT ends the run), then those of the programs.
SIGHUP ends the run only if no running program handles it, which usually means to read settings
again.
An exception of a program's handler is raised in the program's own thread, as soon as that runs
Python.
"""

from __future__ import annotations

from collections.abc import Callable
import ctypes
import os
import signal
import threading
from typing import Any, TYPE_CHECKING

from mddag_executor.replacements import Replacements

if TYPE_CHECKING:
    from mddag_executor.hosting.host import Guest, Host

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)


class GuestSignals:
    """The signal handlers of a host's programs."""

    def __init__(self, host: Host) -> None:
        self._host = host
        # of programs (None: of callbacks), by signal, and those of the main thread
        self._handlers: dict[int, dict[Guest | None, Any]] = {each: {} for each in _SIGNALS}
        self._before: dict[int, Any] = {}

    def install(self, replacements: Replacements) -> None:
        """Store handlers of programs, if the calling thread is the main thread."""
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                self._before[number] = signal.signal(number, self._handle)
            replacements.callback(self._restore)
            replacements.replace(signal, 'signal', self._signal)
            replacements.replace(signal, 'getsignal', self._getsignal)

    def _restore(self) -> None:
        for number, before in self._before.items():
            signal.signal(number, signal.SIG_DFL if before is None else before)

    def _signal(self, original: Callable[..., Any]) -> Callable[..., Any]:
        self._set = original

        def set_handler(number: int, handler: Any) -> Any:
            guest = self._host.current_guest()
            if number not in _SIGNALS or (
                    not callable(handler) and handler not in (signal.SIG_DFL, signal.SIG_IGN)):
                return original(number, handler)
            before = signal.getsignal(number)
            if guest is None and threading.current_thread() is threading.main_thread():
                self._before[number] = handler
            elif handler == signal.SIG_DFL:
                self._handlers[number].pop(guest, None)
            else:
                self._handlers[number][guest] = handler
            return before

        return set_handler

    def _getsignal(self, original: Callable[[int], Any]) -> Callable[[int], Any]:
        def getsignal(number: int) -> Any:
            handlers, guest = self._handlers.get(number, {}), self._host.current_guest()
            return handlers[guest] if guest in handlers else self._before.get(
                number, original(number))

        return getsignal

    def _handle(self, number: int, frame: Any) -> None:
        before, handlers = self._before[number], self._handlers[number]
        running = [(guest, handler) for guest, handler in handlers.items()
                   if guest is None or not guest.ended]
        if callable(before):
            if number != signal.SIGHUP or not running:
                before(number, frame)
        elif before == signal.SIG_DFL and not running:
            self._set(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        for guest, handler in running:
            if callable(handler):
                self._call(guest, handler, number, frame)

    def _call(self, guest: Guest | None, handler: Any, number: int, frame: Any) -> None:
        guest_of, main = self._host.guest_of, threading.current_thread()
        interrupted, guest_of[main] = guest_of.get(main), guest
        try:
            handler(number, frame)
        except BaseException as error:
            if guest is None:
                raise
            raise_in(guest.thread, error)
            self._host.wake()
        finally:
            guest_of[main] = interrupted


def raise_in(thread: threading.Thread, error: BaseException) -> None:
    """Raise an exception in another thread as soon as that runs Python."""
    kind = type(type(error).__name__, (type(error),), {'__new__': lambda *args: error})
    ctypes.pythonapi.PyThreadState_SetAsyncExc(
        ctypes.c_ulong(thread.ident or 0), ctypes.py_object(kind))

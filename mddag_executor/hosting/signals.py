# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Signals that end a run, and the main thread that belongs to a program.

Theory of operation
-------------------
1.  SIGINT, SIGTERM and SIGHUP end a run.  Their handler runs in the main thread.
2.  While the main thread runs a program, Python's handler of SIGINT is its own one again, which
    raises KeyboardInterrupt in the program, and the program may set handlers of its own and call
    ``loop.add_signal_handler``: all that is as without this package.  rclpy's handlers are in C,
    and run before those of Python.  In their place, Python's wake-up descriptor reports each
    signal to a thread, and the thread ends the run if rclpy would have shut the context down
    (``ends_run``).
3.  A process that a program forks has the handlers of before the run: it ends with SIGTERM.
4.  A program may take the wake-up descriptor (as asyncio's loops do).  Then its spin reports the
    KeyboardInterrupt that it gets (``interrupted``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import os
import select
import signal
import threading
import time
from types import FrameType
from typing import Any, Protocol

from mddag_executor.defaults import SAME_SIGNAL_S
from mddag_executor.executor.interrupts import handler_of

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Ended(Protocol):
    """What signals end."""

    @property
    def stopped(self) -> bool:
        """Return whether it is to end."""

    def stop(self) -> None:
        """End it."""

    def hurry(self) -> None:
        """Wait no longer for what still runs at the end."""


class Signals:
    """
    Let SIGINT, SIGTERM and SIGHUP end a run, and its report be written; a context manager.

    A SIGINT that comes while a run ends, but not together with the first, interrupts what still
    runs; the next one interrupts the end itself.

    :param ends_process: the process ends with the run, so signals that come after the first one do
        nothing at the end.
    :ivar ends_run: whether SIGINT, or a signal that a program handles, ends the run.
    :ivar wake: called after each signal, without a lock.
    :ivar ended_by: the signal that has ended the run; None: none has.
    """

    def __init__(self, ends_process: bool = False) -> None:
        self._ends_process = ends_process
        self.ends_run: Callable[[int], bool] = lambda number: True
        self.wake: Callable[[], None] = lambda: None
        self.ended_by: int | None = None
        self._session: Ended | None = None
        self._last: float | None = None  # when one came that counts
        self._hurried = False
        self._found: dict[int, Any] = {}
        self._before: dict[int, Any] = {}
        # reentrant: a handler may interrupt its owner
        self._lock = threading.RLock()
        self._pipe: tuple[int, int] | None = None
        # how many of the SIGINTs to come are our own
        self._n_own = 0

    def __enter__(self) -> Signals:
        """Note the handlers: those that a module sets while it is imported stay."""
        self._found = {number: signal.getsignal(number) for number in _NUMBERS}
        return self

    def end_of(self, session: Ended) -> None:
        """From now on they end this session."""
        self._session = session
        if threading.current_thread() is threading.main_thread():
            _active.append(self)
            for number in _NUMBERS:
                now = signal.getsignal(number)
                if now == self._found[number] and (
                        number != signal.SIGHUP or now != signal.SIG_IGN):  # nohup
                    self._before[number] = signal.signal(number, self._handle)

    def __exit__(self, *args: object) -> None:
        if self in _active:
            _active.remove(self)
        for number, before in self._before.items():
            signal.signal(number, before)
        for number in self._before if self._ends_process and self._last is not None else ():
            # The process is about to end by itself; it is not to look as if it was killed.
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._is_third(number):
            signal.default_int_handler(number, frame)
        self.received(number, number != signal.SIGINT)
        self.wake()

    def _is_third(self, number: int) -> bool:
        return (number == signal.SIGINT and self._hurried and self._last is not None
                and time.monotonic() - self._last > SAME_SIGNAL_S)

    def received(self, number: int, ends: bool = False) -> None:
        """
        Note a signal.

        :param ends: it ends the run, whatever programs do with it.
        """
        now, session = time.monotonic(), self._session
        with self._lock:
            if session is None:
                self._last = now
            elif not session.stopped:
                if ends or self.ends_run(number):
                    self._last, self.ended_by = now, number
                    session.stop()
            elif number == signal.SIGINT and (
                    self._last is None or now - self._last > SAME_SIGNAL_S):
                self._last, self._hurried = now, True
                session.hurry()

    def leave_child(self) -> None:
        """Restore the handlers in a child that a program has forked: it has no run."""
        for number, before in self._before.items():
            if handler_of(number) == self._handle:
                signal.signal(number, before)
        self._before = {}

    # --- a program in the main thread ------------------------------------------------------------

    @contextmanager
    def of_program(self) -> Iterator[None]:
        """Let the main thread belong to a program while entered."""
        self._pipe = pipe = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        _given.append(pipe)
        process = os.getpid()
        thread = threading.Thread(target=self._read, args=(pipe,), name='mddag-signals',
                                  daemon=True)
        thread.start()
        signal.set_wakeup_fd(pipe[1], warn_on_full_buffer=False)
        try:
            if signal.SIGINT in self._before:
                signal.signal(signal.SIGINT, signal.default_int_handler)
            yield
        finally:
            if os.getpid() == process:  # else the pipe is that of the parent
                self.take_back()
                _given.remove(pipe)
                os.write(pipe[1], b'\0')  # the thread ends, and closes the pipe

    def take_back(self) -> None:
        """Let SIGINT raise nothing in the main thread any more; may be called again."""
        if signal.SIGINT in self._before:
            signal.signal(signal.SIGINT, self._handle)
        self._pipe = None
        signal.set_wakeup_fd(-1)

    def _read(self, pipe: tuple[int, int]) -> None:
        """Handle signals that Python has received, until a zero comes."""
        poll = select.poll()  # a descriptor may be beyond those that ``select`` knows
        poll.register(pipe[0], select.POLLIN)
        while poll.poll():
            with self._lock:
                if self._drain(pipe):
                    break
            self.wake()  # Python may run the handler only now
        for fd in pipe:
            os.close(fd)

    def _drain(self, pipe: tuple[int, int]) -> bool:
        """Handle the signals in the pipe; return whether there is a zero, which ends it."""
        with suppress(BlockingIOError):
            while numbers := os.read(pipe[0], 64):
                for number in numbers:
                    if number == signal.SIGINT and self._n_own:
                        self._n_own -= 1
                        continue
                    # others have their handlers, which do it
                    if number == signal.SIGINT or number in self._before and (
                            handler_of(number) != self._handle):
                        self.received(number)
                if 0 in numbers:
                    return True
        return False

    def interrupted(self) -> None:
        """Note now that the program in the main thread, which calls this, has been interrupted."""
        pipe = self._pipe
        if pipe is None:
            return
        other = signal.set_wakeup_fd(pipe[1], warn_on_full_buffer=False)
        if other == pipe[1]:
            with self._lock:
                self._drain(pipe)
        else:
            if other >= 0:
                signal.set_wakeup_fd(other, warn_on_full_buffer=False)
            self.received(signal.SIGINT)

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt in the program in the main thread, if Python's handler does."""
        if self._pipe is not None and (
                handler_of(signal.SIGINT) is signal.default_int_handler):
            with self._lock:
                self._n_own += 1
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


_given: list[tuple[int, int]] = []
"""The pipes of programs that have the main thread."""
_active: list[Signals] = []
"""Those that have replaced the handlers of signals."""
_blocked = threading.local()
"""``before``: the signal mask of a thread that forks, before it does."""


def _block() -> None:
    """Block signals that would end a child before it has its own handlers: Python drops them."""
    if _active:
        _blocked.before = signal.pthread_sigmask(
            signal.SIG_BLOCK, (signal.SIGTERM, signal.SIGHUP))


def _unblock() -> None:
    before = getattr(_blocked, 'before', None)
    if before is not None:
        _blocked.before = None
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _forget_in_child() -> None:
    """Let a forked child handle its own signals, and not report them to its parent."""
    with suppress(ValueError):  # another thread than the main one has forked
        if _given:
            signal.set_wakeup_fd(-1)
        for signals in _active:
            signals.leave_child()
    _active.clear()
    _unblock()


os.register_at_fork(
    before=_block, after_in_parent=_unblock, after_in_child=_forget_in_child)

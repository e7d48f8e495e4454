# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Arrivals that are handled at once: they complete something that callbacks may wait for.

Responses complete futures, ``/clock`` sets simulated time, and the timer of a ``Rate`` ends a
sleep.  All of this is short code of rclpy.  The spinning thread runs it, from a separate epoll, so
that it runs even if all workers wait for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
import signal
import threading
from time import monotonic_ns

from mddag_executor.core import NEVER
from mddag_executor.executor import compat
from mddag_executor.executor.agenda import Agenda
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.loop import ChannelSource, EventLoop, Events
from mddag_executor.executor.timers import Fired, TimerQueue
from mddag_executor.executor.workers import WorkerPool


class AtOnce:
    """
    The sources handled at once.

    All methods belong to the spinning thread, except for ``ring`` and ``handled``: a thread that
    has sent a response takes it itself (``sent_requests``).

    :ivar has_run: whether the last ``handle`` has handled anything.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self.loop = EventLoop()
        self.agenda = Agenda()
        self._fired: list[Fired] = []
        self.timers = TimerQueue(
            self.agenda, self._fired.append, self.loop.wake, pool.fail)
        self.pool = pool
        self.has_run = False

    def ring(self) -> None:
        """End the current wait, or the next one; from any thread or signal handler."""
        self.loop.wake()

    def handle(self, events: Events) -> bool:
        """Handle arrivals; return whether there were any."""
        self.has_run = False
        for source in self.loop.sources(events):
            source.collect()
        if self.timers.has_jumped or self.loop.timer.at <= monotonic_ns():
            self.loop.timer.at = NEVER
            with self.pool.lock:
                if self.timers.has_jumped:
                    self.timers.ask_after_jump()
                self.agenda.handle(monotonic_ns)
            fired = self._fired[:]
            self._fired.clear()
            for work, *_ in fired:
                if compat.ends_sleep(work.function):
                    work.function(*work.args)
                    self.count(work.entity)
                else:  # it had no callback at first, and is not that of a Rate
                    self.pool.post([work])
        due = self.agenda.next
        if due != self.loop.timer.at:
            self.loop.timer.arm(due)
        return self.has_run

    def count(self, entity: Entity) -> None:
        """Count a callback that has run."""
        with self.pool.lock:
            self.pool.engine.ran_at_once(entity)
        self.handled(entity)

    def handled(self, entity: Entity) -> None:
        """Note that an arrival has been handled, whether or not its outer group is open."""
        self.has_run = True
        if self.pool.callback_ended is not None:
            self.pool.callback_ended(entity.rclpy_object, None, -1)


class SignalPipe(ChannelSource):
    """
    Ends the wait of the main thread when a signal comes.

    Python runs handlers between bytecodes only: without this, that of a signal which comes right
    before the wait would run after it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.fd, self._write_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Watch for signals while entered in the main thread, unless something else does."""
        watches = self.fd >= 0 and threading.current_thread() is threading.main_thread()
        if watches:
            other = signal.set_wakeup_fd(self._write_fd, warn_on_full_buffer=False)
            if other >= 0:  # asyncio's, or that of a spin which has called this one
                signal.set_wakeup_fd(other, warn_on_full_buffer=False)
                watches = False
        try:
            yield
        finally:
            if watches:
                signal.set_wakeup_fd(-1)

    def collect(self) -> None:
        """Empty the pipe; the handlers have run already."""
        with suppress(BlockingIOError):
            while os.read(self.fd, 4096):
                pass

    def close(self) -> None:
        """Close both ends, once; not while signals are watched."""
        if self.fd >= 0:
            os.close(self.fd)
            os.close(self._write_fd)
            self.fd = -1

    def __del__(self) -> None:
        """Close the descriptors of an executor that was never shut down."""
        self.close()

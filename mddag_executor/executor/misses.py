# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reports missed deadlines: in the log, and to the user's handler, in a separate thread.

Theory of operation
-------------------
1.  A worker that finds a miss only appends it to a queue.  The handler may log, sleep, publish or
    call a service, and a worker that waited for it would run no callbacks meanwhile.
2.  The queue is bounded. A miss that does not fit is counted and never reported: the counts are in
    ``statistics()`` and ``/diagnostics``, and a warning in the log names them.
3.  An exception of the handler, including ``SystemExit``, comes out of ``spin``; later misses are
    still reported.
4.  rclpy looks up the caller of each line of the log, and Python's first such lookup visits all
    modules: over 10 ms, in which no callback runs.  So it is done when the executor is made.
5.  At the end the queued misses are reported.  But the handler is not called after ``END_S``, and
    not waited for after twice that: it may call a service that is no longer answered.
"""

from __future__ import annotations

from collections.abc import Callable
import inspect
from queue import SimpleQueue
import sys
import threading
import time
from typing import TYPE_CHECKING

from mddag_executor.errors import from_user_code
from mddag_executor.executor.bounds import END_S, LOG_EVERY_S
from mddag_executor.executor.interrupts import InterruptsDeferred, waits
from mddag_executor.executor.shutdown import join, stop_at_exit
from mddag_executor.text import counted
from msg_graph.errors import printable
from rclpy.logging import get_logger

if TYPE_CHECKING:
    from mddag_executor.executor.verdicts import DeadlineMiss, Verdicts

MOST_WAITING = 256
"""The most misses queued for the handler: at 10 ms each, the last one is reported 2.5 s late."""


class MissNotifier:
    """Calls the user's handler with each miss, in order; ``fail`` receives its exceptions."""

    def __init__(
        self, handler: Callable[[DeadlineMiss], None], fail: Callable[[BaseException], None],
    ) -> None:
        self._handler = handler
        self._fail = fail
        self._queue: SimpleQueue[DeadlineMiss | None] = SimpleQueue()
        self._thread = threading.Thread(
            target=self._run, name='mddag-deadline-misses', daemon=True)
        self._starting = threading.Lock()
        self._ends_at: float | None = None
        self._did_not_fit = 0
        self._too_late = 0
        self._warned = 0
        self._warn_at = 0.0

    @property
    def unreported(self) -> int:
        """Return how many misses the handler was not called with."""
        return self._did_not_fit + self._too_late

    def post(self, miss: DeadlineMiss) -> None:
        """Queue a miss; never waits, and the caller may hold a lock."""
        if self._queue.qsize() < MOST_WAITING:
            self._queue.put(miss)
        else:
            self._did_not_fit += 1

    def start(self) -> None:
        """Begin to report; further calls do nothing."""
        with self._starting:
            if self._thread.ident is None and self._ends_at is None:
                stop_at_exit(self)
                self._thread.start()

    def is_calling(self) -> bool:
        """Return whether the calling thread is the handler's."""
        return threading.current_thread() is self._thread

    def stop(self, timeout: float | None = None) -> bool:
        """
        Report the queued misses, and end; further calls wait again.

        If the handler calls this, it returns at once, and the rest is reported after that.

        :param timeout: seconds to wait for the handler, if that is less than twice ``END_S``.
        :return: whether the handler has returned.
        """
        with InterruptsDeferred(), self._starting:  # else the lock might never be released
            if self._ends_at is None:
                self._ends_at = time.monotonic() + END_S
                self._queue.put(None)
            if self._thread.ident is None:
                return True
        self._wait(2 * END_S if timeout is None else min(timeout, 2 * END_S))
        return not self._thread.is_alive() or self.is_calling()

    @waits
    def _wait(self, seconds: float) -> None:
        join(self._thread, seconds)

    def _run(self) -> None:
        while True:
            miss = self._queue.get()
            if miss is None:
                break
            if self._ends_at is not None and time.monotonic() > self._ends_at:
                self._too_late += 1
                continue
            try:
                self._handler(miss)
            except BaseException as error:
                self._fail(from_user_code(error))
            if time.monotonic() >= self._warn_at:
                self._warn()
        self._warn()

    def _warn(self) -> None:
        """Log how many misses were not reported since the last warning."""
        new = self.unreported - self._warned
        if new:
            self._warned += new
            self._warn_at = time.monotonic() + LOG_EVERY_S
            get_logger('mddag_executor').warning(
                f'on_deadline_miss: {counted(new, "miss was", "misses were")} not reported, as '
                'it has not returned in time: have it return sooner')


class MissLog:
    """Writes missed deadlines to the log, at a limited rate."""

    def __init__(self, verdicts: Verdicts) -> None:
        inspect.getframeinfo(sys._getframe())  # rule 4; a variable would keep the caller alive
        self._verdicts = verdicts
        self._lock = threading.Lock()
        self._logged = 0
        self._at = 0.0

    def is_behind(self) -> bool:
        """Return whether there were misses since the last line, and a line may be logged."""
        return self.has_new() and (
            not self._logged or time.monotonic() - self._at >= LOG_EVERY_S)

    def has_new(self) -> bool:
        """Return whether there were misses since the last line."""
        return self._verdicts.missed != self._logged

    def next_at(self) -> int:
        """Return when the next line may be logged, monotonic ns."""
        return int((self._at + LOG_EVERY_S) * 1e9)

    def write(self) -> None:
        """Log the misses since the last line, if any; from any thread, without a lock."""
        if not self.is_behind() or not self._lock.acquire(blocking=False):
            return
        try:
            now, count = time.monotonic(), self._verdicts.missed - self._logged
            if count == 0:
                return  # another thread has just logged them
            dag, sink, job, deadline_ns = self._verdicts.last_missed()
            since = f' within {now - self._at:.0f} s' if self._logged else ''
            since += ', the last' if count > 1 else ''
            is_gone = sink.partition('@')[0] in self._verdicts.gone
            get_logger('mddag_executor').warning(printable(
                f'{counted(count, "deadline")} missed{since}: {sink}, {deadline_ns / 1e6:g} ms, '
                f'job {job} of {dag}' + (
                    ' (its program destroyed it, or has ended)' if is_gone else '')))
            self._logged += count
            self._at = now
        finally:
            self._lock.release()

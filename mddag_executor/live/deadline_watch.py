# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Notices that a deadline has passed when it passes, and writes misses to the log.

Theory of operation
-------------------
The core knows the next deadline of its open jobs (``core.deadlines``).  A thread waits for that on
a timerfd, which others set without waking the thread, and has the core judge then.  So a miss is
known though its result never comes, or its callback hangs.

The log gets the first miss at once, and after that a line every ``LOG_EVERY_S`` at most, with how
many there have been since.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from typing import TYPE_CHECKING

from mddag_executor.core import NEVER
from mddag_executor.live.alarm import Alarm
from mddag_executor.live.shutdown import join
from mddag_executor.text import counted
from msg_graph.errors import printable
from rclpy.logging import get_logger

if TYPE_CHECKING:
    from mddag_executor.live.verdicts import Verdicts

PERIOD_NS = 10_000_000
"""Without timerfds it looks this often."""
LOG_EVERY_S = 10.0


class DeadlineWatch:
    """
    Calls a function each time that the next deadline has passed.

    :param lock: held by the callers of ``wait_for``.
    :param passed: called then, without the lock; it calls ``wait_for`` with the next
        deadline.
    :param now: returns the time on the clock of the deadlines, ns.
    :param fail: gets what goes wrong.
    """

    def __init__(
        self, lock: threading.Lock, passed: Callable[[], None], now: Callable[[], int],
        fail: Callable[[BaseException], None],
    ) -> None:
        self._lock = lock
        self._passed = passed
        self._now = now
        self._fail = fail
        self._alarm: Alarm | None = None
        self._thread: threading.Thread | None = None
        self._closed = False
        #: The deadline that it waits for; no deadline is before it unless the thread has started.
        self.at = -NEVER

    def start(self) -> None:
        """Begin to watch; further calls do nothing."""
        with self._lock:
            if self._thread is None and not self._closed:
                self._alarm = Alarm(PERIOD_NS)
                self.at = NEVER
                self._thread = threading.Thread(
                    target=self._run, args=(self._alarm,), name='mddag-deadlines', daemon=True)
                self._thread.start()

    def wait_for(self, deadline: int) -> None:
        """Wait for this deadline, ``NEVER`` for none; the caller holds the lock."""
        if self._alarm is None or self._closed or deadline == self.at:
            return
        self.at = deadline
        self._alarm.start(0 if deadline >= NEVER else max(1, deadline - self._now() + 1))

    def close(self) -> None:
        """End the thread."""
        with self._lock:
            self._closed = True
        if self._alarm is not None and self._thread is not None:
            self._alarm.ring()
            join(self._thread)

    def _run(self, alarm: Alarm) -> None:
        while True:
            alarm.wait()
            if self._closed:
                break
            with self._lock:
                self.at = NEVER
            try:
                self._passed()
            except BaseException as error:
                self._fail(error)
        alarm.close()


class MissLog:
    """Writes missed deadlines to the log, a line now and then."""

    def __init__(self, verdicts: Verdicts) -> None:
        self._verdicts = verdicts
        self._lock = threading.Lock()
        self._logged = 0
        self._at = 0.0

    def write(self) -> None:
        """Log the misses since the last line, if any; from any thread, and not under a lock."""
        if self._verdicts.missed == self._logged or not self._lock.acquire(blocking=False):
            return
        try:
            now, count = time.monotonic(), self._verdicts.missed - self._logged
            if self._logged and now - self._at < LOG_EVERY_S:
                return
            dag, sink, job, deadline_ns = self._verdicts.last_missed()
            since = f' within {now - self._at:.0f} s, the last' if self._logged else ''
            get_logger('mddag_executor').warning(printable(
                f'{counted(count, "deadline")} missed{since}: {sink}, {deadline_ns / 1e6:g} ms, '
                f'job {job} of {dag}'))
            self._logged += count
            self._at = now
        finally:
            self._lock.release()

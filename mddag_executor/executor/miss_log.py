# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes missed deadlines to the log.

The first miss is logged at once.  After that there is at most one line every ``LOG_EVERY_S``, with
the number of misses since the last line.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

from mddag_executor.executor.bounds import LOG_EVERY_S
from mddag_executor.text import counted
from msg_graph.errors import printable
from rclpy.logging import get_logger

if TYPE_CHECKING:
    from mddag_executor.executor.verdicts import Verdicts


class MissLog:
    """Writes missed deadlines to the log, at a limited rate."""

    def __init__(self, verdicts: Verdicts) -> None:
        self._verdicts = verdicts
        self._lock = threading.Lock()
        self._logged = 0
        self._at = 0.0

    def write(self) -> None:
        """Log the misses since the last line, if any; from any thread, without a lock."""
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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What executors may believe of each other's announcements, which come from outside.

Announcements are handled before all callbacks, so they get a part of a core at most: an
``Allowance``.  The release of an announced job must be plausible.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
import time

from mddag_executor.executor.bounds import LOG_EVERY_S
from rclpy.logging import get_logger

SHARE, SAVED_NS = 20, 20_000_000
"""Announcements get this part of a core (1 of ``SHARE``), and may save this time of it."""
OLDEST_NS, LATEST_NS = 3_600_000_000_000, 1_000_000_000
"""How long before now, and after it, the release of an announced job may be."""


def is_plausible(release: int, now: int) -> bool:
    """Return whether an announced job may have been released at a time of the same clock."""
    return now - OLDEST_NS <= release <= now + LATEST_NS


class Allowance:
    """
    The CPU time that may be spent on announcements; the rest is ignored, with a warning.

    :param unlocked_calls: receives the warning.
    :param topic: on which they arrive.
    :ivar updated_at: when the allowance was last asked for, monotonic ns.
    """

    def __init__(self, unlocked_calls: deque[Callable[[], None]], topic: str) -> None:
        self._unlocked_calls = unlocked_calls
        self._topic = topic
        self._left = SAVED_NS
        self.updated_at = time.monotonic_ns()
        self._warn_at = 0

    def has_time(self) -> bool:
        """Return whether announcements have taken no more than their share of the time."""
        before, now = self.updated_at, time.monotonic_ns()
        self.updated_at = now
        self._left = min(SAVED_NS, self._left + (now - before) // SHARE)
        if self._left > 0:
            return True
        if now > self._warn_at:
            self._warn_at = now + int(LOG_EVERY_S * 1e9)
            self._unlocked_calls.append(partial(
                get_logger('mddag_executor').warning,
                'announcements of jobs are ignored: more arrive than the executors of the '
                f'declared processes can send; another program publishes on {self._topic} or '
                'its siblings'))
        return False

    def spend(self, taken: int) -> None:
        """Subtract the CPU time (ns) that announcements took."""
        self._left -= taken

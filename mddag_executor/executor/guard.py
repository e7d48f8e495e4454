# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What wakes a thread when a callback that was expected to end soon has not.

The guard has a timerfd of its own, which the spinning thread waits for.  To set and clear a time
for each callback would cost more than the callback (9 us on a virtual machine).  So the time is
set once, and neither changed nor cleared until it has come.
"""

from __future__ import annotations

from collections.abc import Callable
import os

from mddag_executor.executor.listeners import TimerFd


class Guard:
    """
    A time by which a thread is to be woken; all methods but ``collect`` under the engine's lock.

    :param expired: called when the time has come; it calls ``end``.
    """

    urgency = -1
    is_counted = asks_others = False

    def __init__(self, expired: Callable[[], None]) -> None:
        self._timer = TimerFd()
        self.fd = self._timer.fd
        self.collect = expired

    @property
    def is_set(self) -> bool:
        """Return whether a time is set."""
        return self._timer.at > 0

    def set(self, at: int) -> None:
        """Set the time (monotonic ns), unless one is set."""
        if not self._timer.at:
            self._timer.arm(at)

    def end(self) -> None:
        """Note that the time has come."""
        self._timer.at = 0

    def close(self) -> None:
        """Close the descriptor, once."""
        fd, self.fd, self._timer.fd = self.fd, -1, -1
        if fd >= 0:
            os.close(fd)

    def __del__(self) -> None:
        """Close what an executor that was never shut down has left open."""
        self.close()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Wakes a thread when a callback runs longer than expected.

The guard has a separate timerfd, which the spinning thread waits for.  Setting and clearing a time
for each callback would cost more than the callback (9 us on a virtual machine).  So the time is
set once, and neither changed nor cleared until it expires.
"""

from __future__ import annotations

from collections.abc import Callable
import os

from mddag_executor.executor.listeners import TimerFd


class Guard:
    """
    A time at which to wake a thread; all methods but ``collect`` need the engine's lock.

    :param expired: called when the time expires; it calls ``end``.
    :ivar is_set: whether a time is set.
    """

    urgency = -1
    is_counted = asks_others = False

    def __init__(self, expired: Callable[[], None]) -> None:
        self._timer = TimerFd()
        self.is_set = False
        self.fd = self._timer.fd
        self.collect = expired

    def set(self, at: int) -> None:
        """Set the time (monotonic ns), unless one is set."""
        if not self.is_set:
            self.is_set = True
            self._timer.arm(at)

    def end(self) -> None:
        """Note that the time has expired."""
        self.is_set = False

    def close(self) -> None:
        """Close the descriptor, once."""
        fd, self.fd, self._timer.fd = self.fd, -1, -1
        if fd >= 0:
            os.close(fd)

    def __del__(self) -> None:
        """Close the descriptor of an executor that was never shut down."""
        self.close()

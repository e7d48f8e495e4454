# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a thread waits for: a bell, and an alarm that others set without waking it."""

from __future__ import annotations

import ctypes
import os
import threading
import time

_CLOEXEC = os.O_CLOEXEC  # TFD_CLOEXEC of timerfd_create(2)
_ENDING_NS = 1
_TIMES = ctypes.c_long * 4


class Bell:
    """One thread waits until others ring; who rings while nobody waits ends the next wait."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def ring(self) -> None:
        """End the present wait, or the next one; from any thread."""
        try:
            self._lock.release()
        except RuntimeError:
            pass  # it rings already

    def wait(self, seconds: float = -1) -> bool:
        """Wait until it rings, for so long at most unless that is -1; return whether it rang."""
        return self._lock.acquire(True, seconds)


class Alarm:
    """
    One thread waits until it rings; others set it, anew or off, in a microsecond.

    It is a timerfd of Linux: nobody is woken before it rings.  Where there is none, it rings every
    ``period_ns`` whether it is set or not.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._file = -1
        try:
            library = ctypes.PyDLL(None, use_errno=True)
            self._set = library.timerfd_settime
            self._file = library.timerfd_create(time.CLOCK_MONOTONIC, _CLOEXEC)
        except (AttributeError, OSError):
            return
        self._set.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]

    def start(self, ns: int) -> None:
        """Have it ring so much later, and not when it was to ring before; 0: never."""
        if self._file < 0:
            return
        # period and time: seconds, nanoseconds
        self._set(self._file, 0, _TIMES(0, 0, *divmod(ns, 1_000_000_000)), None)

    def wait(self) -> None:
        """Wait until it rings."""
        if self._file < 0:
            time.sleep(self._period_ns / 1e9)
        else:
            os.read(self._file, 8)

    def ring(self) -> None:
        """Have it ring now."""
        self.start(_ENDING_NS)

    def close(self) -> None:
        """Give its file back; nobody waits any more."""
        if self._file >= 0:
            file, self._file = self._file, -1
            os.close(file)

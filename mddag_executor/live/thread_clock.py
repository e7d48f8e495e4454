# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How long a thread has computed, and has waited for a CPU."""

from __future__ import annotations

import os
from pathlib import Path
import threading
from time import clock_gettime_ns, pthread_getcpuclockid, thread_time_ns

Reading = tuple[int, int]
"""CPU time of a thread, and how long it waited for a CPU, ns."""


class ThreadClock:
    """
    How long the thread that makes it has computed, and has waited for a CPU.

    It is to be closed when that thread ends.
    """

    def __init__(self) -> None:
        self._clock = pthread_getcpuclockid(threading.get_ident())
        self._folder = Path(f'/proc/self/task/{threading.get_native_id()}')  # proc(5)
        self._file = -1
        self._at_end = 0
        try:  # not everywhere
            self._file = os.open(self._folder / 'schedstat', os.O_RDONLY)
        except OSError:
            pass

    def computed(self) -> int:
        """Return its CPU time, ns; from any thread, also when it has ended."""
        try:
            return clock_gettime_ns(self._clock)
        except OSError:
            return self._at_end

    def read(self, closely: bool) -> Reading:
        """Return what it reads now, in the thread itself; 0 for waiting, unless ``closely``."""
        waited = 0
        if closely and self._file >= 0:
            waited = int(os.pread(self._file, 64, 0).split()[1])
        return thread_time_ns(), waited

    def is_runnable(self) -> bool:
        """Return whether it runs or waits for a CPU, and for nothing else; from any thread."""
        return is_runnable(self._folder)

    def close(self) -> None:
        """Close what it reads, in the thread itself."""
        self._at_end = thread_time_ns()
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def is_runnable(folder: Path) -> bool:
    """Return whether a thread runs or waits for a CPU, by its folder in /proc (proc(5))."""
    try:
        return (folder / 'stat').read_bytes().rpartition(b')')[2].split()[0] == b'R'
    except (OSError, IndexError):
        return False

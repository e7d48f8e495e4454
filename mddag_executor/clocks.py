# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The clocks of a run: the trace's counts ns since the epoch, and is steady during the run."""

from __future__ import annotations

from pathlib import Path
import time


def boot() -> str:
    """Return which boot of which machine ``time.monotonic_ns()`` counts from; '' if unknown."""
    try:
        return Path('/proc/sys/kernel/random/boot_id').read_text('ascii').strip()
    except (OSError, UnicodeDecodeError):
        return ''


def epoch_offset_ns(enough_ns: int = 0) -> int:
    """
    Return what turns ``time.monotonic_ns()`` into ns since the epoch, now.

    The best of several readings, so that an interruption between the two clocks does no harm.

    :param enough_ns: a reading within this time is good enough.
    """
    readings = []
    for _ in range(20):
        before = time.monotonic_ns()
        now = time.time_ns()
        after = time.monotonic_ns()
        readings.append((after - before, now - (before + after) // 2))
        if after - before <= enough_ns:
            break
    return min(readings)[1]


class TraceClock:
    """The clock of a run's trace: ns since the epoch, and steady during the run."""

    __slots__ = ('offset_ns',)

    def __init__(self) -> None:
        self.offset_ns = epoch_offset_ns()

    def now(self) -> int:
        """Return the time."""
        return time.monotonic_ns() + self.offset_ns

    def of_system(self, at: int) -> int:
        """Convert a time of the system clock, which may have been set since the run began."""
        return at - epoch_offset_ns(2_000) + self.offset_ns

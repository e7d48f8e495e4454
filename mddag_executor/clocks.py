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


def epoch_offset_ns() -> int:
    """
    Return what turns ``time.monotonic_ns()`` into ns since the epoch, for a whole run.

    The best of several readings, so that an interruption between the two clocks does no harm.
    """
    readings = []
    for _ in range(20):
        before = time.monotonic_ns()
        now = time.time_ns()
        after = time.monotonic_ns()
        readings.append((after - before, now - (before + after) // 2))
    return min(readings)[1]


class TraceClock:
    """The clock of a run's trace: ns since the epoch, and steady during the run."""

    __slots__ = ('offset_ns',)

    def __init__(self) -> None:
        self.offset_ns = epoch_offset_ns()

    def now(self) -> int:
        """Return the time."""
        return time.monotonic_ns() + self.offset_ns

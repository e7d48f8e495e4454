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


LEAST_STEP_NS = 5_000_000
"""A smaller change of the system clock is not a step."""
SLEWED = 1_000
"""A clock that is slewed gains or loses less than this part of the time."""


class SystemClock:
    """Notices when the system clock is set: by a user, by NTP, or after a machine has slept."""

    def __init__(self) -> None:
        self._offset, self._at = epoch_offset_ns(), time.monotonic_ns()

    def step(self) -> int:
        """Return by how much it was set forward since the last call, ns; 0: it was not set."""
        now = time.monotonic_ns()
        if abs(time.time_ns() - now - self._offset) < LEAST_STEP_NS:
            return 0
        before, self._offset = self._offset, epoch_offset_ns(2_000)
        slewed, self._at = (now - self._at) // SLEWED, now
        step = self._offset - before
        return step if abs(step) >= LEAST_STEP_NS + slewed else 0


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

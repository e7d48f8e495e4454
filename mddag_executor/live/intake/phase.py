# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A timer with its phase grid, on which its nominal due times lie (see ``timers``)."""

from __future__ import annotations

import time
from typing import Any

from mddag_executor.live.compat import timer_functions, with_timer_info
from mddag_executor.live.work import Work
from rclpy.clock_type import ClockType
from rclpy.timer import Timer

TOLERANCE_NS = 20_000
"""How far a due time may be off the phase grid before the grid is anchored anew."""

# An interval wider than this comes from a preempted thread and is measured again.
WIDE_NS = 50_000

_now = time.monotonic_ns


class PhasedTimer:
    """A timer with its phase grid; ``entry`` is the number of its one valid heap entry, or 0."""

    __slots__ = (
        'timer', 'handle', 'until', 'get_period', 'may_be_overridden', '_call', '_info', '_clock',
        'period', 'anchor', 'due', 'entry', 'cancelled', 'simulated', 'missed')

    def __init__(self, timer: Timer) -> None:
        self.timer = timer
        self.handle: Any = timer.handle
        self.until, self._call, self.get_period = timer_functions(timer)
        self._info: dict[str, int] | None = None
        self._clock: Any = timer.clock
        self.may_be_overridden = timer.clock.clock_type == ClockType.ROS_TIME
        self.period = self.get_period()
        self.anchor = 0
        self.due = 0
        self.entry = 0
        self.cancelled = False
        self.simulated = False
        self.missed = 0

    def overridden(self) -> bool:
        """Return whether the time of its clock is simulated now."""
        return self.may_be_overridden and bool(self._clock.ros_time_is_active)

    def call(self) -> None:
        """Move its next call time on; rcl skips what it has missed."""
        self._info = self._call()

    def arrival(self, due: int) -> Work | None:
        """Return what it is handed over as, now that it was called; None without a callback."""
        timer = self.timer
        callback = timer.callback
        missed, self.missed = self.missed, 0
        if callback is None:
            return None
        return Work(
            timer, with_timer_info(timer, callback, self._info), due=due, missed=missed)

    def measure(self) -> tuple[int, int] | None:
        """Return an interval that holds the next call time, or None when cancelled."""
        best: tuple[int, int] | None = None
        for _ in range(4):
            before = _now()
            until = self.until()
            after = _now()
            if until is None:
                return None
            if best is None or after - before < best[1] - best[0]:
                best = before + until, after + until
            if after - before < WIDE_NS:
                break
        return best

    def take_anchor(self) -> bool:
        """Anchor the phase grid at the next call time; False when cancelled."""
        self.period = self.get_period()
        best: tuple[int, int] | None = None
        for _ in range(5):
            interval = self.measure()
            if interval is None:
                return False
            if best is None or interval[1] - interval[0] < best[1] - best[0]:
                best = interval
        assert best is not None
        self.anchor = self.due = (best[0] + best[1]) // 2
        return True

    def grid_point(self, low: int, high: int) -> int | None:
        """Return the point of the phase grid in an interval, or None if there is none."""
        period = self.period
        if period <= 0:
            return None
        middle = (low + high) // 2
        point: int = self.anchor + (middle - self.anchor + period // 2) // period * period
        if low - TOLERANCE_NS <= point <= high + TOLERANCE_NS:
            return point
        return None

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When a job was released by the header stamp of its message (``release_from: header_stamp``).

A stamp counts if it is of the system clock.  In simulated time, or when a bag is played, stamps
are of another clock, so they are far from now.  They still identify the job in all processes, but
its release is the arrival of the message.  A stamp that is only some seconds from now may be late,
or of a bag that is played right after it was recorded: it counts, and a warning says so.
"""

from __future__ import annotations

from collections.abc import Callable

from mddag_executor.clocks import TraceClock

OTHER_CLOCK_NS = 60_000_000_000
"""No message takes a minute: a stamp that is farther from now is of another clock."""
ODD_NS = 5_000_000_000
"""A stamp that is farther from now is odd: a job is hardly ever that late when it begins."""


class StampedReleases:
    """
    The releases of jobs by header stamps.

    :param warn: receives a line for each topic whose stamps are of another clock, or odd.
    :ivar clock: the clock of the trace.
    :ivar is_other: whether any stamp was of another clock.
    """

    def __init__(self, clock: TraceClock, warn: Callable[[str], None]) -> None:
        self.clock = clock
        self._warn = warn
        self._named: set[str] = set()
        self.is_other = False

    def release(self, stamp: int, topic: str, now: int) -> int:
        """Return the release of a job whose message on a topic has a stamp and arrives now."""
        release = self.clock.of_system(stamp)
        away = release - now
        if -ODD_NS <= away <= ODD_NS:
            return release
        counts = -OTHER_CLOCK_NS <= away <= OTHER_CLOCK_NS
        self.is_other |= not counts
        if topic not in self._named:
            self._named.add(topic)
            self._warn(
                f'{topic}: the header stamps are {abs(away) / 1e9:.0f} s '
                f'{"before" if away < 0 else "after"} the arrivals of their messages (simulated '
                'time, a played bag, or the clock of another machine): jobs are released at the '
                + ("stamps; if these are not of this run, declare 'release_from: arrival'"
                   if counts else 'arrivals'))
        return release if counts else now

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Notices that no thread of the process runs: the machine stands still, or has no time for it.

Theory of operation
-------------------
The spinning thread mostly waits, and it does that in slices of ``SLICE_NS``.  If a slice ends
late, either other threads of the process kept the interpreter's lock, or nothing of the process
ran.  The CPU time of the process shows which: in a stop it does not grow.

* A stop is as long as the lateness, less the CPU time that the process took since the slice
  before.  Its end is known, so its begin is taken that much before it.  CPU time before and after
  the stop counts, too, and that of threads beside each other, so it was longer, if anything.
* What the spinning thread does between two waits belongs to the slice after it: it may be stopped
  there as well.
* What is shorter than ``SHORT_NS`` is not reported.  A stop may begin up to a slice before what is
  given it, so what is reported as too short for a stop is recorded, too, for `mddag explain`.
* When it starts it reports a stop of no length: from then on stops are noticed.

Nothing is added to the way of a message or a timer.  If a callback waits while it keeps the
interpreter's lock, no thread runs either: that looks the same.
"""

from __future__ import annotations

from collections.abc import Callable
import time

from mddag_executor.live.alarm import Bell

SLICE_NS = 20_000_000
SHORT_NS = 5_000_000


class StopWatch:
    """
    Waits for a bell, and reports stops meanwhile.

    :param stopped: gets begin and end of each stop, as ``clock`` has them.
    :param clock: ns.
    :param cpu: CPU time of the process, ns.
    :param look: called after each slice.
    """

    def __init__(
        self, bell: Bell, stopped: Callable[[int, int], None],
        clock: Callable[[], int] = time.monotonic_ns,
        cpu: Callable[[], int] = time.process_time_ns,
        look: Callable[[], None] = lambda: None,
    ) -> None:
        self._wait = bell.wait
        self._stopped = stopped
        self._look = look
        self._clock = clock
        self._cpu = cpu
        self._look_at_clocks()

    def start(self) -> None:
        """Begin to watch now."""
        self._look_at_clocks()
        self._stopped(self._last, self._last)

    def _look_at_clocks(self) -> None:
        self._last, self._used = self._clock(), self._cpu()

    def wait(self, seconds: float) -> None:
        """Wait until it rings, or the time is over."""
        now = self._clock()
        end = now + int(seconds * 1e9)
        rang = False
        while not rang and now < end:
            slice_ns = min(end - now, SLICE_NS)
            rang = self._wait(slice_ns / 1e9)
            last, used = self._last, self._used
            self._look_at_clocks()
            now = self._last
            stop = now - last - slice_ns - (self._used - used)
            if stop >= SHORT_NS:
                self._stopped(now - stop, now)
            self._look()

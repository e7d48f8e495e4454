# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Notices that no thread of the process runs: the machine stands still, or has no time for it.

Theory of operation
-------------------
The spinning thread mostly waits, and it does that in slices of ``SLICE_NS``.  If a slice ends
late, either other threads of the process kept the interpreter's lock, or nothing of the process
ran.  The CPU time of the process tells which: in a stop it does not grow.

* A stop is a lateness of ``LEAST_NS`` or more, and the process took less CPU time than
  ``1 / CPU_SHARE`` of it.  CPU time before and after the stop counts, too, so in doubt there was
  none.
* It begins when the slice was due.  So a stop is noted as shorter than it was, by up to a slice,
  and a very short one is not noted.

Nothing is added to the way of a message or a timer.  If a callback waits while it keeps the
interpreter's lock, no thread runs either: that looks the same.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time

from mddag_executor.core.stops import LEAST_NS

SLICE_NS = 20_000_000
CPU_SHARE = 4


class StopWatch:
    """
    Waits for an event, and tells of the stops meanwhile.

    :param stopped: gets begin and end of each stop, as ``clock`` has them.
    :param clock: ns.
    :param cpu: CPU time of the process, ns.
    :param look: called after each slice.
    """

    def __init__(
        self, event: threading.Event, stopped: Callable[[int, int], None],
        clock: Callable[[], int] = time.monotonic_ns,
        cpu: Callable[[], int] = time.process_time_ns,
        look: Callable[[], None] = lambda: None,
    ) -> None:
        self._event = event
        self._stopped = stopped
        self._look = look
        self._clock = clock
        self._cpu = cpu

    def wait(self, seconds: float) -> None:
        """Wait until the event is set, or the time is over."""
        now, used = self._clock(), self._cpu()
        end = now + int(seconds * 1e9)
        is_set = False
        while not is_set and now < end:
            due = min(end, now + SLICE_NS)
            is_set = self._event.wait((due - now) / 1e9)
            now, before, used = self._clock(), used, self._cpu()
            if now - due >= LEAST_NS and (used - before) * CPU_SHARE < now - due:
                self._stopped(due, now)
            self._look()

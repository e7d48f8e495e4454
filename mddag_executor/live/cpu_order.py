# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One order on the CPUs for the workers of several processes: by the urgency of what they run.

Theory of operation
-------------------
Each process keeps the order of deadlines among its own callbacks.  Where more processes compute
than there are CPUs, the operating system shares these evenly, whatever is urgent.  So a worker
that starts a callback gets a nice level by the time that is left until its reference deadline;
deadlines of all processes are of one clock, so that is one order.  The level changes only when the
class of urgency does, as a change is a system call; it stays until the worker's next callback.

Levels are relative to that of the process, and no worker gets less than that.  To get more a
process needs CAP_SYS_NICE, or a limit (``ulimit -e``) that allows it; else there is no order.
"""

from __future__ import annotations

import os
import threading

from mddag_executor.live.engine import Engine
from mddag_executor.live.seat import Seat

CLASSES = ((10_000_000, 15), (30_000_000, 10), (100_000_000, 5))
"""By how much less nice a worker is that runs what is to be done within so many ns."""


def why_not() -> str | None:
    """Return why threads of this process cannot be less nice than it is; None: they can."""
    reasons: list[str | None] = []

    def attempt() -> None:
        try:
            nice = os.getpriority(os.PRIO_PROCESS, 0)
            os.setpriority(os.PRIO_PROCESS, 0, nice - CLASSES[0][1])
            reasons.append(None)
        except (OSError, AttributeError) as error:
            reasons.append(str(error))

    thread = threading.Thread(target=attempt)  # one that ends, so nothing has to be taken back
    thread.start()
    thread.join()
    return reasons[0]


class CpuOrder:
    """Gives the workers of one executor their nice levels."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._base = os.getpriority(os.PRIO_PROCESS, 0)
        self._less: dict[int, int] = {}

    def starts(self, seat: Seat, now: int) -> None:
        """Set the level of the calling worker's thread for what it is to run."""
        work = seat.work
        assert work is not None
        deadline = self._engine.reference_deadline(work)
        less = 0
        if deadline is not None:
            left = deadline - now
            less = next((by for within, by in CLASSES if left < within), 0)
        if self._less.get(seat.vtid, 0) != less:
            self._less[seat.vtid] = less
            os.setpriority(os.PRIO_PROCESS, seat.vtid, max(-20, self._base - less))

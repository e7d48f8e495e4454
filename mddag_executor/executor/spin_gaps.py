# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Records the times in which callbacks could not run, because nothing spun."""

from __future__ import annotations

from collections.abc import Callable
from threading import get_native_id

LEAST_NS = 1_000_000
"""
Shorter gaps are not recorded.

They explain no wait, and a loop of ``spin_once`` that does nothing else has thousands a second.
"""
EXECUTOR = -1


class SpinGaps:
    """
    The gaps between the spins of programs (by their outer groups), and of the ``EXECUTOR``.

    Times are ns on the trace's clock.

    :param record: writes an event; None: nothing is recorded.
    """

    def __init__(self, record: Callable[..., None] | None) -> None:
        self._record = record
        self._since: dict[int, int] = {}

    def begin(self, program: int, now: int) -> None:
        """Note that a program does not spin from now on, unless it has not done so already."""
        if self._record is not None:
            self._since.setdefault(program, now)

    def end(self, program: int, now: int) -> None:
        """Note that a program spins, and record how long it has not; not before its first spin."""
        since = self._since.pop(program, now)
        if self._record is not None and now - since >= LEAST_NS:
            self._record('spin_gap', now, get_native_id(), program, since, now)

    def finish(self, now: int) -> None:
        """Record the gaps that last until the end of the run, and nothing after that."""
        for program in list(self._since):
            self.end(program, now)
        self._record = None

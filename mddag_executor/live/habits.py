# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether a callback holds the interpreter while it runs: declared, or learnt from how it runs.

Theory of operation
-------------------
After an execution its CPU time is compared with its duration; after the first executions for a
sample of them only, because reading the clocks costs some microseconds.  Left out of the duration
is what other executions computed meanwhile, and what other processes took: if two callbacks fight
for the lock, each computes for half of the time, but for all of the time that the other one
leaves.  A callback that computed for over four fifths of that time, lately, holds the interpreter;
one that computed for less than half of it does not.  Executions of less than ``SHORT_NS`` of CPU
are not worth an order.

One that computes with the lock released (numpy, hashlib) does not hold the interpreter, either:
``interpreter`` finds that out while others wait for it.  One of ``TRY_EVERY`` measured executions
is looked at again.
"""

from __future__ import annotations

from collections.abc import Callable

from mddag_executor.live.thread_clock import Reading

COMPUTES = 0.8
WAITS = 0.5
SHORT_NS = 20_000
LATELY = 8
"""The last execution counts for one in so many."""
FIRST = 16
SAMPLE = 8
"""After the first executions one in so many is measured, and more where it behaves otherwise."""
RELEASED = 0.6
TRY_EVERY = 8


class Habit:
    """
    Whether one callback holds the interpreter while it runs.

    :param declared: what the declaration says, or None: it is learnt.
    :ivar holds: 1 or 0, for its next execution.
    """

    __slots__ = (
        'holds', '_declared', '_computed_ns', '_own_ns', '_released', '_passed', '_runs', '_close')

    def __init__(self, declared: bool | None = None) -> None:
        self.holds = int(declared or False)
        self._declared = declared is not None
        self._computed_ns = 0.0
        self._own_ns = 0.0
        self._released = 0.0
        self._passed = 0
        self._runs = 0
        self._close = FIRST

    def is_to_be_measured(self) -> bool:
        """Return whether to measure the execution that begins now."""
        if self._declared:
            return False
        if self._close > 0:
            self._close -= 1
            return True
        self._runs += 1
        return self._runs % SAMPLE == 0

    @property
    def computes_at_all(self) -> bool:
        """Return whether it may be one that holds the interpreter."""
        return self._computed_ns >= max(SHORT_NS / 2, self._own_ns / 8)

    def ran(
        self, duration: int, before: Reading, after: Reading, beside: Callable[[], int],
    ) -> None:
        """
        Learn from an execution.

        :param duration: how long it took, ns.
        :param before: what its thread's clock read when it began; ``after``: when it ended.
        :param beside: returns how long other executions computed meanwhile, ns.
        """
        computed = after[0] - before[0]
        own = duration - (after[1] - before[1])
        if SHORT_NS <= computed < COMPUTES * own:
            own -= beside()
        own = max(computed, own)
        if self._own_ns == 0.0:
            self._computed_ns, self._own_ns = computed, own
        else:
            self._computed_ns += (computed - self._computed_ns) / LATELY
            self._own_ns += (own - self._own_ns) / LATELY
        share, least_ns = (WAITS, SHORT_NS / 2) if self.holds else (COMPUTES, SHORT_NS)
        if (computed >= max(share * own, least_ns)) != self.holds and self._released < RELEASED:
            self._close = LATELY  # it may have changed
        self.holds = int(self._computed_ns >= max(share * self._own_ns, least_ns))
        if self._released >= RELEASED:
            self._passed += 1
            self.holds &= self._passed % TRY_EVERY == 0

    def was_free(self, free: bool) -> bool:
        """Learn whether the lock was free while it computed; False where a declaration knows."""
        if self._declared:
            return False
        self._released += (free - self._released) / LATELY
        if self._released >= RELEASED:
            self.holds = 0
        return free

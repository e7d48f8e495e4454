# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether a callback holds the interpreter while it runs: declared, or learnt from how it runs.

Theory of operation
-------------------
After an execution its CPU time is compared with its duration; after the first executions for a
sample of them only, because reading the clocks costs some microseconds.  Left out of the duration
is what other processes took.  What other executions computed meanwhile may have kept the lock from
it, or may have run beside it: so there is a least and a most that it had for itself.  A callback
that computed for over four fifths of the most, lately, holds the interpreter, also one that waited
for ``GAP_NS`` at most.  One that computed for less than half of the least does not.  An execution
between the two says nothing; but as long as nothing is known, and now and then, the next execution
is taken as one that holds it, because that one runs by itself and shows what is true.  (If it does
not, what was known before holds on.)  One that computed for less than ``BRIEF_NS`` is seldom kept
from the lock, because Python takes it away after a whole turn only: so all that it did not compute
it has waited.

One that computes with the lock released (numpy, hashlib) does not hold the interpreter, either, if
it does so for a good part of its time: ``interpreter`` finds that out while others wait for it.
One of ``TRY_EVERY`` measured executions is looked at again.
"""

from __future__ import annotations

from mddag_executor.core.queues import TURN_NS
from mddag_executor.live.thread_clock import Reading

LOOK_NS = 2_000_000
"""How often it is looked at who keeps others from the interpreter (see ``interpreter``)."""
PROVEN = 16
"""Who has waited is trusted again after so many executions; who has not, after ``LATELY``."""

COMPUTES = 0.8
WAITS = 0.5
SHORT_NS = 2_000
"""Executions of less CPU time are not worth an order."""
BRIEF_NS = TURN_NS // 2
"""Who computes for less than this is seldom kept from the lock, and not worth a trial."""
GAP_NS = 100_000
"""Who waits for less than this may as well keep the interpreter meanwhile."""
LATELY = 8
"""The last execution counts for one in so many."""
FIRST = 16
SAMPLE = 32
"""After the first executions one in so many is measured, and more where it behaves otherwise."""
TRY_SAMPLE = 8
"""
One in so many is looked at whether it computes with the lock released; and is measured where it
does.
"""
MIXED, RELEASED, STILL_RELEASED = 0.1, 0.4, 0.25
"""
Parts of its time in which a callback computes with the lock released: more than the first, and it
is looked at often; more than the second, and it does not hold the interpreter, until less than the
third.
"""
TRY_EVERY = 8


class Habit:
    """
    Whether one callback holds the interpreter while it runs.

    :param declared: what the declaration says, or None: it is learnt.
    :ivar holds: 1 or 0, for its next execution.
    :ivar computed_ns: how long it computes, lately; 0 where that is not learnt.
    :ivar is_to_be_learnt: whether it is not known yet if it computes with the lock released.
    :ivar runs: how many executions have begun; whoever begins one counts it.
    :ivar due: from which run on ``is_to_be_measured`` is to be asked.
    """

    __slots__ = (
        'holds', '_declared', 'computed_ns', 'is_to_be_learnt', '_part', '_known', '_released',
        '_passed', 'runs', 'due', '_close', '_unclear', '_looks', '_tries', '_trusted_from',
        '_sampled', '_overlaps')

    def __init__(self, declared: bool | None = None) -> None:
        self.holds = int(declared or False)
        self._declared = declared is not None
        self.computed_ns = 0.0
        self.is_to_be_learnt = False
        self._part: float | None = None
        self._known = 0
        self._released = 0.0
        self._passed = 0
        self.runs = 0
        self.due = 0
        self._close = FIRST
        self._unclear = 0
        self._looks = 0
        self._tries = 0
        self._trusted_from = LATELY
        self._sampled = -1
        self._overlaps = False

    def is_to_be_measured(self) -> bool:
        """Return whether to measure the execution that begins now."""
        if self._close > 0 and not self._declared:
            self._close -= 1
            return True
        self.due = self.runs - self.runs % TRY_SAMPLE + TRY_SAMPLE
        if self.due != self.runs + TRY_SAMPLE:
            return False
        if self.computed_ns >= LOOK_NS and (
                self._tries < FIRST or self.runs % (TRY_SAMPLE * FIRST) == 0):
            self._sampled = self.runs
        return not self._declared and (self._overlaps or self.runs % SAMPLE == 0)

    @property
    def is_trusted(self) -> bool:
        """Return whether it is expected to compute all the time, as it has always done lately."""
        return (self.runs >= self._trusted_from and self.runs != self._sampled
                and self._released <= MIXED)

    def has_waited(self) -> None:
        """Learn that it waited though it was thought to compute."""
        self._trusted_from = self.runs + PROVEN

    @property
    def share(self) -> float | None:
        """Return for which part of its time it needs the interpreter; None: not known yet."""
        if self._part is None:
            return float(self.holds) if self._declared else None
        return self._part * (1 - self._released)

    @property
    def computes_at_all(self) -> bool:
        """Return whether it may be one that holds the interpreter, for all that is known."""
        return self._part is None or (
            self._part >= 1 / 32 and self.computed_ns >= SHORT_NS / 2)

    def ran(self, duration: int, before: Reading, after: Reading, beside: int) -> None:
        """
        Learn from an execution.

        :param duration: how long it took, ns.
        :param before: what its thread's clock read when it began; ``after``: when it ended.
        :param beside: how long other executions computed meanwhile, ns.
        """
        computed = after[0] - before[0]
        most = max(computed, duration - (after[1] - before[1]))
        least = most if computed < BRIEF_NS else max(computed, most - beside)
        if most - computed <= GAP_NS:
            most = least = computed
        if WAITS * least <= computed < COMPUTES * most:
            self._unclear += 1
            self.holds = self._known
            if self._part is None or self._unclear >= LATELY:
                self._unclear = 0
                self.holds = 1
                self._measure_next(1)
        else:
            self._learn(computed, most if computed >= COMPUTES * most else least)
        if self._overlaps:
            self._passed += 1
            self.holds &= self._passed % TRY_EVERY == 0

    def _measure_next(self, executions: int) -> None:
        self._close, self.due = max(self._close, executions), 0

    def _learn(self, computed: int, own: int) -> None:
        # The part counts, not the time: where the machine stood still for long, once, that is not
        # to count for more.
        part = computed / max(1, own)
        if self._part is None:
            self._part, self.computed_ns = part, computed
        else:
            self._part += (part - self._part) / LATELY
            self.computed_ns += (computed - self.computed_ns) / LATELY
        self.is_to_be_learnt = self._tries < FIRST and self.computed_ns >= BRIEF_NS
        least, shortest = (WAITS, SHORT_NS / 2) if self._known else (COMPUTES, SHORT_NS)
        if (part >= least and computed >= shortest) != self._known and not self._overlaps:
            self._measure_next(LATELY)  # it may have changed
        self.holds = self._known = int(self._part >= least and self.computed_ns >= shortest)

    def is_to_be_tried(self) -> bool:
        """Return whether to find out, at a look, whether it computes with the lock released."""
        self._looks += 1
        return not self._declared and self.computed_ns >= BRIEF_NS and (
            self._looks <= FIRST or self._released > MIXED or self._looks % TRY_SAMPLE == 0)

    def was_released(self, released: bool) -> bool:
        """Learn whether it computed with the lock released, and return that."""
        self._tries += 1
        self.is_to_be_learnt &= self._tries < FIRST
        self._released += (released - self._released) / min(LATELY, self._tries)
        overlapped = self._overlaps
        self._overlaps = self._released >= (STILL_RELEASED if overlapped else RELEASED)
        if self._overlaps:
            self.holds = 0
        elif overlapped:
            self._measure_next(LATELY)  # it may hold it now
        return released

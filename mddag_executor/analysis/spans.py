# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Sums of overlaps of time spans."""

from __future__ import annotations

from mddag_executor.recording.columns import Ints
import numpy as np


class Spans:
    """
    Spans from starts to ends, ns.

    Sums of times would exceed 64 bits.  So times count from the first one, and their sums are
    modulo 2**64.  Results are differences, which fit.
    """

    def __init__(self, starts: Ints, ends: Ints) -> None:
        # most are in order of time
        self._starts, self._ends = (np.sort(each, kind='stable') for each in (starts, ends))
        self._origin = int(self._starts[0]) if len(starts) else 0
        self._sums = [np.r_[0, np.cumsum(each - self._origin)]
                      for each in (self._starts, self._ends)]

    def within(self, begins: Ints, ends: Ints) -> Ints:
        """Return their total time within each of other spans, ns."""
        found: Ints = np.maximum(0, self._before(ends) - self._before(begins))
        return found

    def _before(self, times: Ints) -> Ints:
        total = np.zeros(len(times), dtype=np.int64)
        near = times - self._origin
        for sign, each, sums in zip((1, -1), (self._starts, self._ends), self._sums):
            number = np.searchsorted(each, times, 'right')
            total += sign * (near * number - sums[number])
        return total


def crowded(starts: Ints, ends: Ints, least: int) -> tuple[Ints, Ints]:
    """Return the starts and ends of the times at which at least ``least`` spans overlap."""
    times = np.concatenate([np.sort(each, kind='stable') for each in (ends, starts)])
    order = np.argsort(times, kind='stable')    # at the same instant, ends come first
    times, count = times[order], np.cumsum(np.where(order < len(ends), -1, 1))
    full = count >= least
    before = np.r_[False, full[:-1]]
    return times[full & ~before], times[~full & before]

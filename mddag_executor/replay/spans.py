# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Spans of time, which may overlap: how long they lasted altogether within another one."""

from __future__ import annotations

from mddag_executor.replay.happenings import Ints
import numpy as np

_FAR_NS = 1 << 40


class Spans:
    """
    Spans from starts to ends, ns.

    :param origin: a time near all of them; what is further away than 18 minutes is cut there.
    """

    def __init__(self, starts: Ints, ends: Ints, origin: int) -> None:
        self._origin = origin
        self._starts, self._ends = (np.sort(self._near(each)) for each in (starts, ends))
        self._sums = [np.r_[0, np.cumsum(each)] for each in (self._starts, self._ends)]

    def _near(self, times: Ints) -> Ints:
        near: Ints = np.clip(times - self._origin, -_FAR_NS, _FAR_NS)
        return near

    def within(self, begins: Ints, ends: Ints) -> Ints:
        """Return how long they lasted within each span of time, added up, ns."""
        found: Ints = np.maximum(0, self._before(ends) - self._before(begins))
        return found

    def _before(self, times: Ints) -> Ints:
        near = self._near(times)
        total = np.zeros(len(near), dtype=np.int64)
        for sign, each, sums in zip((1, -1), (self._starts, self._ends), self._sums):
            number = np.searchsorted(each, near, 'right')
            total += sign * (near * number - sums[number])
        return total


def crowded(starts: Ints, ends: Ints, least: int) -> tuple[Ints, Ints]:
    """Return the starts and ends of the times at which at least so many spans last."""
    times = np.concatenate([starts, ends])
    step = np.repeat([1, -1], len(starts))
    order = np.lexsort((step, times))       # at one instant what ends goes first
    times, count = times[order], np.cumsum(step[order])
    full = count >= least
    before = np.r_[False, full[:-1]]
    return times[full & ~before], times[~full & before]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Distributions of times that need the same memory however many times there are."""

from __future__ import annotations

from typing import Any

from mddag_executor.core import quantile
import numpy as np
import numpy.typing as npt

Column = npt.NDArray[np.int64]

KEEP_EXACT = 32_768
"""Up to so many times quantiles are exact."""
_BITS = 11
QUANTILE_ERROR = 2.0 ** -(_BITS + 1)
"""Beyond them they are right to this share (0.03 %)."""

_MOST = 2 ** 62


class Spread:
    """
    The distribution of times, ns.

    Count, least, greatest and mean are exact, quantiles up to ``KEEP_EXACT`` times; then there is
    a histogram, whose bins are as wide as a 2048th of the power of two that they are in.
    """

    def __init__(self, keep: int = KEEP_EXACT) -> None:
        self.count = 0
        self.total = 0
        self.least = 2 ** 63
        self.greatest = -2 ** 63
        self._keep = keep
        self._exact: list[Column] | None = []
        self._bins: dict[int, int] = {}

    def add(self, times: Column) -> None:
        """Add times."""
        if not len(times):
            return
        least, greatest = int(times.min()), int(times.max())
        self.count += len(times)
        self.total += int(times.sum()) if max(-least, greatest) < _MOST // len(times) \
            else sum(times.tolist())
        self.least = min(self.least, least)
        self.greatest = max(self.greatest, greatest)
        if self._exact is not None:
            self._exact.append(times)
            if self.count <= self._keep:
                if len(self._exact) > 64:
                    self._exact = [np.concatenate(self._exact)]
                return
            times = np.concatenate(self._exact)
            self._exact = None
        for place, n in zip(*(each.tolist() for each in np.unique(
                _bins(times), return_counts=True))):
            self._bins[place] = self._bins.get(place, 0) + n

    def result(self) -> dict[str, Any] | None:
        """
        Return count, min, mean, median, p99 and max; None: there is none.

        Where the quantiles are not exact ``quantiles_within`` says how exact, as a share.
        """
        if not self.count:
            return None
        found = {'count': self.count, 'min': self.least, 'mean': round(self.total / self.count)}
        if self._exact is not None:
            ordered = memoryview(np.sort(np.concatenate(self._exact)))
            return {**found, 'median': quantile(ordered, 0.5), 'p99': quantile(ordered, 0.99),
                    'max': self.greatest}
        places = sorted(self._bins)
        until = np.cumsum([self._bins[place] for place in places])
        values = []
        for share in (0.5, 0.99):
            rank = quantile(range(self.count), share)
            place = places[int(np.searchsorted(until, rank, side='right'))]
            values.append(min(max(_middle(place), self.least), self.greatest))
        return {**found, 'median': values[0], 'p99': values[1], 'max': self.greatest,
                'quantiles_within': QUANTILE_ERROR}


def _bins(times: Column) -> Column:
    """Return the bin of each time: the power of two and the bits after its first one."""
    size = np.abs(times)
    shift = np.maximum(0, np.frexp(size.astype(np.float64))[1].astype(np.int64) - 1 - _BITS)
    # a float may round a number up to the next power of two
    shift = np.where(size >> shift < 1 << _BITS, np.maximum(0, shift - 1), shift)
    places = (shift << (_BITS + 1)) + (size >> shift)
    found: Column = np.where(times < 0, -1 - places, places)
    return found


def _middle(place: int) -> int:
    """Return the time in the middle of a bin."""
    if place < 0:
        return -_middle(-1 - place)
    shift, bits = place >> (_BITS + 1), place & ((1 << (_BITS + 1)) - 1)
    return (bits << shift) + ((1 << shift) >> 1)

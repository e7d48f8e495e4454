# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Acceptance ratios: how many runs met every deadline, by normalised utilisation.

The bins of one task set are the paper's: the nearest multiple of 0.05, everything below 0.525 in
0.5 and everything from 0.975 up in 1.0. Those of many task sets begin at 0.05.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any

import numpy as np
import numpy.typing as npt

BINS = tuple(round(0.5 + 0.05 * i, 2) for i in range(11))
WIDE_BINS = tuple(round(0.05 + 0.05 * i, 2) for i in range(20))

Z_95 = 1.959963984540054
"""Half the width of the central 95 % of the normal distribution, in standard deviations."""

Bools = npt.NDArray[np.bool_]


def bins_of(
    utilisation: npt.NDArray[np.float64], bins: Sequence[float] = BINS
) -> npt.NDArray[np.int64]:
    """
    Return for each utilisation the number of its bin.

    :param bins: their centres.
    """
    edges = np.array([round(centre + 0.025, 3) for centre in bins[:-1]])
    return np.searchsorted(edges, utilisation, side='right').astype(np.int64)


def wilson(accepted: int, runs: int) -> tuple[float, float]:
    """
    Return the 95 % confidence interval of a ratio by Wilson's score method.

    Unlike the normal approximation it stays within 0 and 1 and is right near them.
    """
    z2 = Z_95 * Z_95
    ratio = accepted / runs
    centre = (ratio + z2 / (2 * runs)) / (1 + z2 / runs)
    half = Z_95 / (1 + z2 / runs) * math.sqrt(
        ratio * (1 - ratio) / runs + z2 / (4 * runs * runs))
    # At the ends rounding must not leave the ratio outside of its own interval.
    return min(ratio, max(0.0, centre - half)), max(ratio, min(1.0, centre + half))


class Acceptance:
    """
    Acceptance of one set of runs: ratio and confidence interval of each bin and of all runs.

    ``ratio`` and ``interval`` hold None where a bin is empty.

    :param bins: number of the bin of each run.
    :param n_bins: how many bins there are.
    """

    def __init__(
        self, bins: npt.NDArray[np.int64], accepted: Bools, n_bins: int = len(BINS)
    ) -> None:
        counts = np.bincount(bins, minlength=n_bins).tolist()
        self.accepted: list[int] = np.bincount(bins[accepted], minlength=n_bins).tolist()
        self.ratio: list[float | None] = []
        self.interval: list[tuple[float, float] | None] = []
        for good, runs in zip(self.accepted, counts):
            self.ratio.append(good / runs if runs else None)
            self.interval.append(wilson(good, runs) if runs else None)
        self.total = float(np.mean(accepted)) if len(accepted) else None

    def result(self) -> dict[str, Any]:
        """Return the parts for machines, apart from the ratios by bin."""
        return {'total': self.total, 'interval_95': self.interval}

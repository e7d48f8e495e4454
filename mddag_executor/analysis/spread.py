# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Statistics of times."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.core import quantile
from mddag_executor.recording.columns import Ints
import numpy as np

if TYPE_CHECKING:
    from mddag_executor.results.replays import Spread


def spread(times: Ints) -> Spread | None:
    """Return count, min, mean, median, p99 and max of times, ns; None without times."""
    return spread_of(times) if len(times) else None


def spread_of(times: Ints) -> Spread:
    """Return count, min, mean, median, p99 and max of times, ns; there is at least one."""
    ordered = memoryview(np.sort(times))
    return {
        'count': len(ordered), 'min': ordered[0], 'mean': round(sum_of(times) / len(ordered)),
        'median': quantile(ordered, 0.5), 'p99': quantile(ordered, 0.99), 'max': ordered[-1]}


def sum_of(times: Ints) -> int:
    """Return the sum of times, without overflow."""
    low, high = times & 0x7FFFFFFF, times >> 31
    return int(high.sum()) * (1 << 31) + int(low.sum())

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Rules for times of recordings: what is possible, what is credible, and what is a pause.

A time before 1970 or at or after `NEVER` (2116) is impossible: its message is left out.  Other
times are used as they are.
"""

from __future__ import annotations

from typing import Any

import numpy as np

NEVER = 2 ** 62
GAP_NS = 60 * 1_000_000_000
FAR_NS = 366 * 24 * 3600 * 1_000_000_000


def credible(stamp: Any, arrival: Any) -> Any:
    """Return whether stamps fit times of arrival: not years before them."""
    return (stamp > 0) & (arrival - stamp < FAR_NS)


def stretches(times: Any) -> list[tuple[int, int]]:
    """Return the ranges of times without a gap of more than `GAP_NS`, in the order of time."""
    array = np.sort(np.asarray(times, dtype=np.int64))
    if not len(array):
        return []
    return [(int(group[0]), int(group[-1]))
            for group in np.split(array, np.flatnonzero(np.diff(array) > GAP_NS) + 1)]

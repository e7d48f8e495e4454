# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Stops: stretches of time in which no thread of the process ran, and the misses that fell into them.

A miss falls into a stop that overlaps the time from its job's release to its deadline.  A stop is
known a little later than what it delayed, and a late completion may come long after it.  So both
sides wait for each other: the last stops, and the last misses that fell into none so far.
"""

from __future__ import annotations

from collections import deque
from typing import Any

LEAST_NS = 20_000_000
"""What is shorter is no stop."""
KEEP_STOPS = 100
KEEP_MISSES = 2_000


class Stops:
    """Counts the stops of a run and the misses in them; times in ns, of one clock."""

    def __init__(self) -> None:
        self._count = 0
        self._total_ns = 0
        self._misses = 0
        self._latest: deque[tuple[int, int]] = deque(maxlen=KEEP_STOPS)
        self._elsewhere: deque[tuple[int, int, Any]] = deque(maxlen=KEEP_MISSES)

    def stopped(self, begin: int, end: int) -> list[Any]:
        """
        Note a stop; each begins after the one before has ended.

        Return what `missed` got of the misses that turn out to fall into it.
        """
        self._count += 1
        self._total_ns += end - begin
        self._latest.append((begin, end))
        others = [miss for miss in self._elsewhere if miss[1] < begin or miss[0] > end]
        found = [what for release, deadline, what in self._elsewhere
                 if deadline >= begin and release <= end]
        self._misses += len(found)
        self._elsewhere = deque(others, KEEP_MISSES)
        return found

    def missed(self, release: int, deadline: int, what: Any = None) -> bool:
        """
        Note a miss of a job that was to run between these times.

        Return whether it falls into a stop that is known.
        """
        if any(begin <= deadline and release <= end for begin, end in self._latest):
            self._misses += 1
            return True
        self._elsewhere.append((release, deadline, what))
        return False

    def result(self) -> dict[str, Any]:
        """Return how many stops there were, how long, the misses in them, and the last stops."""
        return {
            'count': self._count, 'total_ns': self._total_ns, 'misses': self._misses,
            'latest': [{'begin_ns': begin, 'end_ns': end} for begin, end in self._latest]}

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Stops: times in which no thread of the process ran, and the misses that they explain.

1.  A stop explains a late completion if it lasted, between the job's release and its completion,
    at least as long as the completion was late: without the stop the job would have been in time.
2.  It explains a job that never completed if the job was released during the stop: the period was
    skipped.
3.  A stop is reported after the executions that it delayed, and a late completion may come long
    after the stop.  So both are kept for comparison: the last stops, and the last unexplained
    misses.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple, TYPE_CHECKING

if TYPE_CHECKING:
    from mddag_executor.results.runs import Stops as StopsResult


LEAST_NS = 20_000_000
"""A shorter time does not count as a stop, ns."""
KEEP_STOPS = 100
KEEP_MISSES = 2_000


class _Miss(NamedTuple):
    """Release, deadline, completion (-1: never), and the driver's object for it."""

    release: int
    deadline: int
    completed: int
    what: Any

    def is_explained_by(self, begin: int, end: int) -> bool:
        if self.completed < 0:
            return begin <= self.release <= end
        stood_still = min(end, self.completed) - max(begin, self.release)
        return stood_still >= self.completed - self.deadline


class Stops:
    """Counts the stops of a run and the misses they explain; times in ns, of one clock."""

    def __init__(self) -> None:
        self._count = 0
        self._total_ns = 0
        self._misses = 0
        self._latest: deque[tuple[int, int]] = deque(maxlen=KEEP_STOPS)
        self._unexplained: deque[_Miss] = deque(maxlen=KEEP_MISSES)

    def stopped(self, begin: int, end: int) -> list[Any]:
        """
        Note a stop; each begins after the previous one has ended.

        Return the ``what`` of each earlier miss that it explains.
        """
        self._count += 1
        self._total_ns += end - begin
        self._latest.append((begin, end))
        found: list[Any] = []
        left: deque[_Miss] = deque(maxlen=KEEP_MISSES)
        for miss in self._unexplained:
            if miss.is_explained_by(begin, end):
                found.append(miss.what)
            elif max(miss.release, miss.completed) >= end:
                left.append(miss)  # else no later stop explains it
        self._unexplained = left
        self._misses += len(found)
        return found

    def missed(self, release: int, deadline: int, completed: int, what: Any = None) -> bool:
        """
        Note a miss; return whether a known stop explains it.

        :param completed: -1: never.
        """
        miss = _Miss(release, deadline, completed, what)
        for begin, end in reversed(self._latest):
            if end < release:
                break  # so did all stops before it: they explain nothing
            if miss.is_explained_by(begin, end):
                self._misses += 1
                return True
        self._unexplained.append(miss)
        return False

    def result(self) -> StopsResult:
        """Return the stops' number, duration, explained misses, and the last stops."""
        return {
            'count': self._count, 'total_ns': self._total_ns, 'misses': self._misses,
            'latest': [{'begin_ns': begin, 'end_ns': end} for begin, end in self._latest]}

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Weakly hard deadlines: whether a sink keeps `tolerate: m of k`.

The rule: of any k jobs in a row, at most m miss the deadline. Jobs are in a row by their numbers;
a job without a verdict counts as in time. A run of fewer than k jobs is one window.

Source: G. Bernat, A. Burns and A. Llamosi, "Weakly hard real-time systems", IEEE Transactions on
Computers 50(4), 2001.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable


class MissWindow:
    """
    The most misses in any window of jobs in a row, updated with each miss.

    Misses may be added in any order, as long as a job is less than ``ORDER`` jobs or one window
    behind the newest that missed: older ones are forgotten.

    :param of: the length of the window, in jobs
    :ivar worst: the most misses in one window
    """

    ORDER = 1000

    def __init__(self, of: int) -> None:
        self.of = of
        self.worst = 0
        self._jobs: list[int] = []  # the latest misses, ascending

    def add(self, job: int) -> None:
        """Count a job that missed; a job may be given more than once."""
        jobs = self._jobs
        at = bisect_left(jobs, job)
        if at < len(jobs) and jobs[at] == job:
            return
        jobs.insert(at, job)
        # The windows that contain the job, each by the miss that it ends with.
        for last in range(at, bisect_left(jobs, job + self.of)):
            self.worst = max(self.worst, last + 1 - bisect_right(jobs, jobs[last] - self.of))
        if len(jobs) > 2 * (self.of + self.ORDER):
            del jobs[:bisect_left(jobs, jobs[-1] - 2 * self.of - self.ORDER)]

    def worst_with(self, jobs: Iterable[int]) -> int:
        """Return ``worst`` as if these jobs had missed as well."""
        other = MissWindow(self.of)
        other.worst, other._jobs = self.worst, list(self._jobs)
        for job in jobs:
            other.add(job)
        return other.worst

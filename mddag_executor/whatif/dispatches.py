# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Dispatch times: how late the executor started executions.

Theory of operation
-------------------
An execution could start as soon as it was ready, its callback group was free and a worker was
idle. Its dispatch time is the time from then to its start.

Idle workers are counted.  An execution is *free* from when it is ready and its group is free.
Free executions that have not ended are on workers, or wait for one.  If there are no more of them
than workers when an execution becomes free, it could start at once.  (It may still have waited: a
worker that is about to end keeps the callback that it started.)  Otherwise it waited until its
worker had ended the previous execution.

An execution that holds the GIL also waited until the previous one had released it.
"""

from __future__ import annotations

from collections.abc import Iterable

from mddag_executor.recording.columns import Ints, Mask
from mddag_executor.recording.joins import as_of
import numpy as np


def dispatch_times(
    worker: Ints, group: Ints, ready: Ints, start: Ints, end: Ints,
    processes: Iterable[tuple[int, Ints | slice]], holding: Mask,
) -> Ints:
    """
    Return the dispatch times of executions, ns.

    All are given by columns, in the order of their ends; times in ns.

    :param worker: the worker of each execution, -1: unknown.
    :param group: number of its mutually exclusive callback group, or -1.
    :param processes: of each process its number of workers, and its executions.
    :param holding: whether it holds the GIL.
    """
    free = np.maximum(ready, _end_before(group, end))
    could = np.maximum(free, _end_before(worker, end))
    for n_workers, mine in processes:
        free_at, could_at, begin, until, holds = (
            column[mine] for column in (free, could, start, end, holding))
        waiting = np.flatnonzero(free_at < could_at)
        at = free_at[waiting]
        n_free = np.searchsorted(np.sort(free_at, kind='stable'), at, 'right')  # almost sorted
        at_once = waiting[n_free - np.searchsorted(until, at, 'right') <= n_workers]
        could_at[at_once] = free_at[at_once]
        until = until[holds]
        place = as_of(until, begin[holds])
        could_at[holds] = np.maximum(could_at[holds], np.where(place >= 0, until[place], 0))
        could[mine] = could_at
    late: Ints = np.maximum(0, start - could)
    return late


def _end_before(of: Ints, end: Ints) -> Ints:
    """Return the previous end of the same number; 0 for the first, and for -1."""
    found = np.zeros(len(of), dtype=np.int64)
    order = np.argsort(of, kind='stable')
    number = of[order]
    again = np.flatnonzero((number[1:] == number[:-1]) & (number[1:] >= 0)) + 1
    found[order[again]] = end[order[again - 1]]
    return found

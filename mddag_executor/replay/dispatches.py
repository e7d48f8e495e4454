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

from typing import Any

from mddag_executor.recording.tables import Ints
import numpy as np


class Dispatches:
    """
    Computes the dispatch times of executions.

    All are given by columns, in the order of their ends; times in ns.

    :param n_workers: number of workers of each process.
    :param worker: the worker of each execution, -1: unknown.
    :param group: number of its mutually exclusive callback group, or -1.
    """

    def __init__(
        self, n_workers: int, worker: Ints, group: Ints, ready: Ints, start: Ints, end: Ints,
        process: Ints,
    ) -> None:
        self._n_workers = n_workers
        self._start, self._end, self._process = start, end, process
        # when it was free, and when its worker was free, too
        self._free = np.maximum(ready, _end_before(group, end))
        self._worker = np.maximum(self._free, _end_before(worker, end))

    def late(self, holding: Any = ()) -> Any:
        """
        Return by number the dispatch time, ns, as an array.

        :param holding: the numbers of executions that hold the GIL.
        """
        free, start, end, worker = self._free, self._start, self._end, self._worker
        process = self._process
        could = worker.copy()
        for number in np.unique(process).tolist():
            here = process == number
            n_free, n_ended = (
                np.searchsorted(np.sort(times[here]), free, 'right') for times in (free, end))
            could = np.where(here & (n_free - n_ended <= self._n_workers), free, could)
        holding = np.array(holding, dtype=np.int64)
        for number in np.unique(process[holding]).tolist():
            mine = holding[process[holding] == number]
            ended = np.sort(end[mine])
            place = np.searchsorted(ended, start[mine], 'right') - 1
            could[mine] = np.maximum(could[mine], np.where(place >= 0, ended[place], 0))
        return np.maximum(0, start - could)


def _end_before(of: Ints, end: Ints) -> Ints:
    """Return the previous end of the same number; 0 for the first, and for -1."""
    found = np.zeros(len(of), dtype=np.int64)
    order = np.argsort(of, kind='stable')
    number = of[order]
    again = np.flatnonzero((number[1:] == number[:-1]) & (number[1:] >= 0)) + 1
    found[order[again]] = end[order[again - 1]]
    return found

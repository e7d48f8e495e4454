# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How late executions were dispatched: what the executor itself took.

Theory of operation
-------------------
An execution could have started as soon as it was ready, its callback group had nothing else and a
worker was idle; it is late by what passed from then until it did.

Whether a worker was idle is counted.  An execution is *free* from when it is ready and its group
has nothing else; those that are free and have not ended are on workers, or about to be, or wait
for one.  Where they are no more than the workers at the instant from which an execution is free,
it could have started at once.  (It may still have waited: a worker that is about to end is left
to take what it has started itself.)  Else it had to wait for the worker that took it, until that
had ended what it did before.

One that holds the interpreter had to wait for its turn: for the end of the last one that held it.
"""

from __future__ import annotations

from array import array
from typing import Any

from mddag_executor.simulate.machine import WARM_NS


class Dispatches:
    """
    Collects executions, in the order of their ends on each worker, and says how late they were.

    :param n_workers: how many there were in each process.
    """

    def __init__(self, n_workers: int) -> None:
        self._n_workers = n_workers
        self._worker_free: dict[int, int] = {}
        self._group_free: dict[int, int] = {}
        # from when it was free, and from when its worker was, too
        self._free, self._worker = array('q'), array('q')
        self._start, self._end = array('q'), array('q')
        self._process, self._warm = array('q'), array('b')

    def add(
        self, worker: int, group: int | None, ready: int, start: int, end: int,
        process: int = 1,
    ) -> int:
        """
        Add an execution; times in ns.

        :param worker: which one ran it, -1 where that is not known.
        :param group: what identifies its mutually exclusive callback group, or None.
        :return: its number.
        """
        could, ended = ready, 0
        if group is not None:
            could = max(could, self._group_free.get(group, 0))
            self._group_free[group] = end
        self._free.append(could)
        if worker >= 0:
            ended = self._worker_free.get(worker, 0)
            could = max(could, ended)
            self._worker_free[worker] = end
        self._worker.append(could)
        self._start.append(start)
        self._end.append(end)
        self._process.append(process)
        self._warm.append(start - ended <= WARM_NS)
        return len(self._start) - 1

    def warm(self) -> Any:
        """Return by number whether its worker had only just ended another, as an array."""
        import numpy as np
        return np.array(self._warm, dtype=np.bool_)

    def late(self, holding: Any = ()) -> Any:
        """
        Return by number how late it was dispatched, ns, as an array.

        :param holding: the numbers of those that hold their interpreter.
        """
        import numpy as np
        free, start, end, worker = (
            np.array(column, dtype=np.int64) for column in (
                self._free, self._start, self._end, self._worker))
        process = np.array(self._process, dtype=np.int64)
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

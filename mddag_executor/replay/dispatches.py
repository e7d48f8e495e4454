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

from typing import Any

from mddag_executor.recording.tables import Ints
from mddag_executor.simulate.machine import WARM_NS
import numpy as np


class Dispatches:
    """
    Says how late executions were dispatched.

    All are given by columns, in the order of their ends; times in ns.

    :param n_workers: how many there were in each process.
    :param worker: which one ran it, -1 where that is not known.
    :param group: what identifies its mutually exclusive callback group, or -1.
    """

    def __init__(
        self, n_workers: int, worker: Ints, group: Ints, ready: Ints, start: Ints, end: Ints,
        process: Ints,
    ) -> None:
        self._n_workers = n_workers
        self._start, self._end, self._process = start, end, process
        # from when it was free, and from when its worker was, too
        self._free = np.maximum(ready, _end_before(group, end))
        ended = _end_before(worker, end)
        self._worker = np.maximum(self._free, ended)
        self._warm = start - ended <= WARM_NS

    def warm(self) -> Any:
        """Return by number whether its worker had only just ended another, as an array."""
        return self._warm

    def late(self, holding: Any = ()) -> Any:
        """
        Return by number how late it was dispatched, ns, as an array.

        :param holding: the numbers of those that hold their interpreter.
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
    """Return when what has the same number had ended before, 0 for the first and of -1."""
    found = np.zeros(len(of), dtype=np.int64)
    order = np.argsort(of, kind='stable')
    number = of[order]
    again = np.flatnonzero((number[1:] == number[:-1]) & (number[1:] >= 0)) + 1
    found[order[again]] = end[order[again - 1]]
    return found

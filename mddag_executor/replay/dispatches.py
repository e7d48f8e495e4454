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

One that holds the interpreter also had to wait until the last one before it that did so had ended.
One that starts while another holds it waits for a switch interval at most, with whatever a thread
does before it runs a callback: that is the interpreter's time, not the executor's.
"""

from __future__ import annotations

from array import array
from typing import Any


class Dispatches:
    """
    Collects executions, in the order of their ends on each worker, and tells how late they were.

    :param n_workers: how many there were.
    """

    def __init__(self, n_workers: int) -> None:
        self._n_workers = n_workers
        self._worker_free: dict[int, int] = {}
        self._group_free: dict[int, int] = {}
        # from when it was free, and from when its worker was, too
        self._free, self._worker = array('q'), array('q')
        self._start, self._end = array('q'), array('q')
        self._holding: list[int] = []

    def add(self, worker: int, group: int | None, ready: int, start: int, end: int) -> int:
        """
        Take in an execution; times in ns.

        :param worker: which one ran it, -1 where that is not known.
        :param group: what identifies its mutually exclusive callback group, or None.
        :return: its number.
        """
        could = ready
        if group is not None:
            could = max(could, self._group_free.get(group, 0))
            self._group_free[group] = end
        self._free.append(could)
        if worker >= 0:
            could = max(could, self._worker_free.get(worker, 0))
            self._worker_free[worker] = end
        self._worker.append(could)
        self._start.append(start)
        self._end.append(end)
        return len(self._start) - 1

    def holds(self, number: int) -> None:
        """Take in that an execution holds the interpreter."""
        self._holding.append(number)

    def late(self) -> Any:
        """Return by number how late it was dispatched, ns, as an array."""
        import numpy as np
        free, start, end, worker = (
            np.array(column, dtype=np.int64) for column in (
                self._free, self._start, self._end, self._worker))
        n_free, n_ended = (
            np.searchsorted(np.sort(times), free, 'right') for times in (free, end))
        could = np.where(n_free - n_ended <= self._n_workers, free, worker)
        if self._holding:
            from mddag_executor.replay.alone import held_for
            from mddag_executor.simulate.machine import SWITCH_NS
            begins, ends = start[self._holding], end[self._holding]
            before = np.sort(ends)
            place = np.searchsorted(before, begins, 'right') - 1
            last = np.where(place >= 0, before[place], could[self._holding])
            could[self._holding] = np.maximum(could[self._holding], last)
            could = could + np.minimum(held_for(start, begins, ends), SWITCH_NS)
        return np.maximum(0, start - could)

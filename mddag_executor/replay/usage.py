# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How much the callbacks ran and waited, and how busy the workers were."""

from __future__ import annotations

from collections import Counter, deque
from itertools import islice
from typing import Any

from mddag_executor.replay.entities import Entities
from mddag_executor.replay.happenings import Batch, COMPLETED, Ints, Observer, RAN, sums
from msg_graph import TaskSet
import numpy as np

_KEEP = 256
# Columns of what a callback used, ns: sums over all executions; of how many the CPU time is known,
# what these took, and what they computed.
(_EXECUTIONS, _BUSY, _LONGEST, _WAITING, _LONGEST_WAIT, _GROUP, _MEASURED, _MEASURED_BUSY, _CPU,
 _HELD) = range(10)
_NAMES = ('executions', 'busy_ns', 'longest_ns', 'waiting_ns', 'longest_wait_ns',
          'waiting_group_ns', 'measured', 'measured_busy_ns', 'cpu_ns', 'held_interpreter')


class GroupWaits(Observer):
    """
    Finds out how much of each wait was for the callback group: while another of it ran.

    It observes before those that ask it.

    :ivar found: of the last batch: by piece, how long its group was busy, ns.
    """

    def __init__(self, who: Entities) -> None:
        self._who = who
        # by group what ran in it last: start and end
        self._busy: dict[int, deque[tuple[int, int]]] = {}
        self.found: Ints = np.empty(0, dtype=np.int64)

    def take(self, batch: Batch) -> None:
        """Look how long pieces of executions waited."""
        pieces = batch.columns(RAN)
        self.found = np.zeros(len(pieces), dtype=np.int64)
        number = self._who.groups
        if not len(pieces) or not number:
            return
        callbacks, which = np.unique(pieces[:, 0], return_inverse=True)
        group = np.array([number.get(callback, -1) for callback in callbacks.tolist()])[which]
        rows = np.flatnonzero(group >= 0)
        rows = rows[np.argsort(group[rows], kind='stable')]
        begins = np.flatnonzero(np.r_[True, group[rows][1:] != group[rows][:-1]])
        for mine in np.split(rows, begins[1:]) if len(rows) else ():
            self._take_group(int(group[mine[0]]), mine, pieces[mine])

    def _take_group(self, group: int, rows: Ints, pieces: Ints) -> None:
        """Look at the pieces of a group, in order."""
        before = self._busy.setdefault(group, deque(maxlen=_KEEP))
        n = len(before)
        busy = [*before, *zip(pieces[:, 6].tolist(), pieces[:, 7].tolist())]
        ready = pieces[:, 5]
        ended = np.r_[before[-1][1] if before else -1, pieces[:-1, 7]]
        # only where the one before ended after this one was ready
        for i in np.flatnonzero((ended > ready) & (pieces[:, 8] != 0)).tolist():
            since, start, waited = int(ready[i]), busy[n + i][0], 0
            for begun, end in islice(reversed(busy[max(0, n + i - _KEEP):n + i]), _KEEP):
                if end <= since:
                    break
                waited += max(0, min(end, start) - max(begun, since))
            self.found[rows[i]] = waited
        before.extend(busy[max(n, len(busy) - _KEEP):])


class PoolUse:
    """
    How busy the pool was over time: in each step, how long all workers together ran callbacks.

    Steps begin at multiples of their length; where there would be more than `MOST_STEPS`, it is
    doubled.

    :param step: their length at first, ns.
    """

    FIRST_STEP_NS = 100_000_000
    MOST_STEPS = 600

    def __init__(self, step: int = FIRST_STEP_NS) -> None:
        self.step = step
        self._busy: dict[int, int] = {}

    def add(self, starts: Ints, ends: Ints) -> None:
        """Add executions, in the order of their ends."""
        while len(starts) and int((ends // self.step - starts // self.step).max()
                                  ) > self.MOST_STEPS:
            self._double()
        starts, ends = starts[starts < ends], ends[starts < ends]
        while len(starts):
            until = np.minimum(ends, (starts // self.step + 1) * self.step)
            numbers, place = np.unique(starts // self.step, return_inverse=True)
            busy = np.zeros(len(numbers), dtype=np.int64)
            np.add.at(busy, place, until - starts)
            for number, more in zip(numbers.tolist(), busy.tolist()):
                self._busy[number] = self._busy.get(number, 0) + more
            goes_on = until < ends
            starts, ends = until[goes_on], ends[goes_on]
        while len(self._busy) > self.MOST_STEPS:
            self._double()

    def _double(self) -> None:
        self.step *= 2
        merged: dict[int, int] = {}
        for number, busy in self._busy.items():
            merged[number // 2] = merged.get(number // 2, 0) + busy
        self._busy = merged

    def result(self) -> dict[str, Any]:
        """Return the length of a step, the first's begin, and what each step was busy, ns."""
        if not self._busy:
            return {'step_ns': self.step, 'start_ns': None, 'busy_ns': []}
        while max(self._busy) - min(self._busy) >= self.MOST_STEPS:
            self._double()      # there are gaps
        first = min(self._busy)
        return {
            'step_ns': self.step, 'start_ns': first * self.step,
            'busy_ns': [self._busy.get(n, 0) for n in range(first, max(self._busy) + 1)]}


class Usage(Observer):
    """
    Adds up what ran.

    ``waits``, which comes before, knows what was waited for.
    An execution of a declared callback counts when it has completed; what it took so far counts
    at once, also where it never completed.
    """

    def __init__(self, task_set: TaskSet, waits: GroupWaits | None = None) -> None:
        self._waits = waits
        self._places = task_set.places()
        # by global vertex the place of its callback, at last that of all undeclared ones
        self._place = np.array([*task_set.places_of_vertices(), len(self._places)])
        # by place; Python's numbers, as sums of a damaged trace may be of any size
        self._table = np.zeros((len(self._places) + 1, len(_NAMES)), dtype=object)
        self.by_worker: Counter[int] = Counter()
        self.pool = PoolUse()
        self._counted = -1

    def take(self, batch: Batch) -> None:
        """Add what ran and what completed."""
        pieces = batch.columns(RAN)
        if len(pieces):
            self._ran(pieces)
        done = batch.columns(COMPLETED)
        done = done[done[:, 10] >= 0]
        if len(done):
            numbers = done[:, 10]
            done = done[np.r_[self._counted, numbers[:-1]] != numbers]   # not one leg more
            self._counted = int(numbers[-1])
            place = self._place[done[:, 1]]
            self._add(_EXECUTIONS, place)
            self._most(_LONGEST, place, done[:, 9])
            known = done[:, 11] >= 0
            place, done = place[known], done[known]
            self._add(_MEASURED, place)
            for column, field in ((_MEASURED_BUSY, 9), (_CPU, 11), (_HELD, 12)):
                self._add(column, place, done[:, field])

    def _ran(self, pieces: Ints) -> None:
        took, place = pieces[:, 7] - pieces[:, 6], self._place[pieces[:, 2]]
        workers, which = np.unique(pieces[:, 4], return_inverse=True)
        for worker, total in zip(workers.tolist(), sums(which, took, len(workers))):
            self.by_worker[worker] += total
        self.pool.add(pieces[:, 6], pieces[:, 7])
        self._add(_BUSY, place, took)
        first = pieces[:, 8] != 0
        undeclared = pieces[:, 2] < 0
        self._add(_EXECUTIONS, place[undeclared & first])
        self._most(_LONGEST, place[undeclared], took[undeclared])
        place, waited = place[first], (pieces[:, 6] - pieces[:, 5])[first]
        self._add(_WAITING, place, waited)
        self._most(_LONGEST_WAIT, place, waited)
        if self._waits is not None and self._waits.found.any():
            self._add(_GROUP, place, self._waits.found[first])

    def _add(self, column: int, places: Ints, values: Ints | None = None) -> None:
        """Add values of callbacks at these places; without values count them."""
        self._table[:, column] += np.array(sums(
            places, np.ones_like(places) if values is None else values, len(self._table)),
            dtype=object)

    def _most(self, column: int, places: Ints, times: Ints) -> None:
        """Keep the longest times of callbacks at these places."""
        longest = np.full(len(self._table), -1, dtype=np.int64)
        np.maximum.at(longest, places, times)
        self._table[:, column] = np.maximum(self._table[:, column], longest.astype(object))

    @property
    def busy(self) -> int:
        """Return how long declared callbacks ran altogether, ns."""
        return int(self._table[:-1, _BUSY].sum())

    def callbacks(self) -> dict[str, dict[str, int]]:
        """Return what each declared callback used, in file order."""
        return {key: self._result(place) for key, place in self._places.items()}

    def undeclared(self) -> dict[str, int]:
        """Return what all callbacks that are not declared used together."""
        return self._result(-1)

    def _result(self, place: int) -> dict[str, int]:
        row = self._table[place].tolist()
        return dict(zip(_NAMES, row if row[_MEASURED] else row[:_MEASURED]))

    def workers(self, count: int, duration: int) -> dict[str, Any]:
        """Return how busy the workers were; ``lent`` is what ran beside them (blocking calls)."""
        busy = {str(w): self.by_worker[w] for w in sorted(self.by_worker) if w >= 0}
        total = sum(self.by_worker.values())
        return {
            'busy_ns': busy,
            'lent_ns': sum(took for w, took in self.by_worker.items() if w < 0),
            'use': share(total, count, duration),
            'over_time': self.pool.result()}


def share(busy: int, workers: int, duration: int) -> float | None:
    """Return the share of the workers' time that was busy, None where there is no time."""
    if workers < 1 or duration <= 0:
        return None
    return busy / (workers * duration)

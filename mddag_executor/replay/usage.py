# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How much the callbacks ran and waited, and how busy the workers were."""

from __future__ import annotations

from collections import Counter
from typing import Any

from mddag_executor.replay.follower import Execution, Observer, Piece
from mddag_executor.replay.waits import GroupWaits
from msg_graph import TaskSet
import numpy as np
import numpy.typing as npt


class CallbackUse:
    """Counts and sums of one callback's executions, ns."""

    __slots__ = ('executions', 'busy', 'longest', 'waiting', 'longest_wait', 'group')

    def __init__(self) -> None:
        self.executions = 0
        self.busy = 0
        self.longest = 0
        self.waiting = 0
        self.longest_wait = 0
        self.group = 0

    def result(self) -> dict[str, int]:
        """Return the callback's part of the result; the sums are over all executions."""
        return {
            'executions': self.executions, 'busy_ns': self.busy, 'longest_ns': self.longest,
            'waiting_ns': self.waiting, 'longest_wait_ns': self.longest_wait,
            'waiting_group_ns': self.group}


class PoolUse:
    """
    How busy the pool was over time: in each step, how long all workers together ran callbacks.

    Steps begin at multiples of their length, `FIRST_STEP_NS` at first; where there would be more
    than `MOST_STEPS`, it is doubled.
    """

    FIRST_STEP_NS = 100_000_000
    MOST_STEPS = 600

    def __init__(self) -> None:
        self.step = self.FIRST_STEP_NS
        self._busy: dict[int, int] = {}

    def add(self, start: int, end: int) -> None:
        """Add an execution."""
        while end // self.step - start // self.step > self.MOST_STEPS:
            self._double()
        while start < end:
            number = start // self.step
            until = min(end, (number + 1) * self.step)
            self._busy[number] = self._busy.get(number, 0) + until - start
            start = until
        while len(self._busy) > self.MOST_STEPS:
            self._double()

    def add_many(self, starts: npt.NDArray[np.int64], ends: npt.NDArray[np.int64]) -> None:
        """Add executions: as ``add`` does, one after the other."""
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

    What was waited for ``waits`` knows, which is told before.
    An execution of a declared callback counts when it has completed; what it took so far counts
    at once, also where it never completed.
    """

    def __init__(self, task_set: TaskSet, waits: GroupWaits | None = None) -> None:
        self._waits = waits
        self._by_key = {c.key: CallbackUse() for c in task_set.callbacks}
        self._by_vertex = [self._by_key[v.callback.key] for v in task_set.vertices]
        self.undeclared = CallbackUse()
        self.by_worker: Counter[int] = Counter()
        self.pool = PoolUse()
        self._counted: Execution | None = None

    def ran(self, piece: Piece) -> None:
        """Add a piece of an execution."""
        took = piece.end - piece.start
        self.by_worker[piece.worker] += took
        self.pool.add(piece.start, piece.end)
        if piece.vertex >= 0:
            use = self._by_vertex[piece.vertex]
        else:
            use = self.undeclared
            use.executions += piece.first
            use.longest = max(use.longest, took)
        use.busy += took
        if piece.first:
            waited = piece.start - piece.ready
            use.waiting += waited
            if self._waits is not None:
                use.group += self._waits.last
            if waited > use.longest_wait:
                use.longest_wait = waited

    def completed(
        self, dag: int, vertex: int, job: int, leg: int, whole: bool, end: int,
        execution: Execution | None,
    ) -> None:
        """Count an execution, if it is in the trace and not one leg more of the last one."""
        if execution is None or execution is self._counted:
            return
        self._counted = execution
        use = self._by_vertex[vertex]
        use.executions += 1
        if execution.busy > use.longest:
            use.longest = execution.busy

    @property
    def busy(self) -> int:
        """Return how long declared callbacks ran altogether, ns."""
        return sum(use.busy for use in self._by_key.values())

    def every(self) -> list[CallbackUse]:
        """Return the use of each declared callback, in file order, then of the undeclared."""
        return [*self._by_key.values(), self.undeclared]

    def number_by_vertex(self) -> list[int]:
        """Return for each global vertex the place of its callback in ``every``."""
        numbers = {id(use): number for number, use in enumerate(self._by_key.values())}
        return [numbers[id(use)] for use in self._by_vertex]

    def callbacks(self) -> dict[str, dict[str, int]]:
        """Return what each declared callback used, in file order."""
        return {key: use.result() for key, use in self._by_key.items()}

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

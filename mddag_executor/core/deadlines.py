# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The deadlines of open jobs, for drivers with a clock: a miss is known when it happens (rule 6).

A driver asks for the next deadline before it waits (``first``), and calls ``judge`` after it.
Most jobs end before that, so a new job is only noted until then.  After that, its slot has one
entry in a heap, for the next deadline of its job.  A job that ends leaves its entry behind.  It is
removed when it comes first while the slot is free; else it may be too early for the slot's next
job, and is replaced when its time has come.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from heapq import heappop, heappush
from itertools import pairwise

from mddag_executor.core.jobs import judge_incomplete, next_deadline
from mddag_executor.core.state import OPEN, SINK_OVERDUE, State
from mddag_executor.core.tables import NEVER, Tables


class Deadlines:
    """
    Finds the sinks that have not completed by their deadlines, each of them once.

    :ivar watch: ``watch(slot)`` watches the job that was just released in a slot.
    """

    def __init__(self, t: Tables, s: State) -> None:
        self._rule = t, s
        self._state = s
        # slots of jobs that were released since the heap was last used
        self._new: set[int] = set()
        self.watch: Callable[[int], None] = self._new.add  # a method would be one more call
        self._heap: list[tuple[int, int]] = []
        # by slot: the time of its entry, and until when its job was judged
        self._entry: dict[int, int] = {}
        self._judged: dict[int, int] = {}
        # by DAG: the least relative deadline of its sinks
        self._least = [
            min((t.sink_deadline[each] for each in t.sinks[first:last]), default=NEVER)
            for first, last in pairwise(t.first_sink)]

    def judge(self, now: int, later: Container[int] = ()) -> None:
        """
        Decide ``SINK_OVERDUE`` for each sink whose deadline was before now.

        :param later: the slots of jobs that are not judged yet.
        """
        self._add_new()
        heap = self._heap
        kept = []
        while heap and heap[0][0] < now:
            time, slot = heappop(heap)
            if self._entry.get(slot) != time:
                continue  # an earlier one was added
            if slot in later:
                kept.append((time, slot))
                continue
            del self._entry[slot]
            if self._state.job_state[slot] == OPEN:
                judge_incomplete(
                    *self._rule, slot, SINK_OVERDUE, self._judged[slot], now - 1)
                self._judged[slot] = now - 1
                self._add(slot, next_deadline(*self._rule, slot, now - 1))
        for entry in kept:
            heappush(heap, entry)

    def first(self) -> int:
        """
        Return a time at or before the next deadline; ``NEVER`` if there is none.

        What comes first is of an open job.
        """
        self._add_new()
        heap, states = self._heap, self._state.job_state
        while heap and states[heap[0][1]] != OPEN:
            time, slot = heappop(heap)
            if self._entry.get(slot) == time:
                del self._entry[slot]
        return heap[0][0] if heap else NEVER

    def _add_new(self) -> None:
        """Add entries for the new jobs that have not ended meanwhile."""
        state = self._state
        for slot in self._new:
            if state.job_state[slot] == OPEN:
                self._judged[slot] = -NEVER
                # it is too early, and replaced then, if that sink is in another process
                self._add(slot, state.job_release[slot] + self._least[state.job_dag[slot]])
        self._new.clear()

    def _add(self, slot: int, time: int) -> None:
        if time < self._entry.get(slot, NEVER):
            self._entry[slot] = time
            heappush(self._heap, (time, slot))

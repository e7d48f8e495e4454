# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The outer groups of the core (``core.rules``, rule 4), as the executor opens and fills them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from mddag_executor.core import Scheduler
from mddag_executor.core.queues import first_of, has_place
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.spin_gaps import SpinGaps

if TYPE_CHECKING:
    from mddag_executor.executor.work import Work


class OuterPlaces:
    """
    The outer groups, by number; all methods need the engine's lock.

    :param end_bypass: lets the core know of all executions.
    :param works: the executions that wait, by their numbers in the core.
    :ivar once: those that close when the next of their executions starts.
    :ivar new: adds an outer group, which is closed, and returns its number.
    """

    def __init__(
        self, scheduler: Scheduler, end_bypass: Callable[[], object], works: Mapping[int, Work],
        gaps: SpinGaps,
    ) -> None:
        self._scheduler = scheduler
        self._state = scheduler.state
        self._end_bypass = end_bypass
        self._works = works
        self._gaps = gaps
        self.once: set[int] = set()
        self.new = scheduler.new_outer_group

    def free(self, outer: int) -> None:
        """Let the number of an outer group without callbacks be used again."""
        self._gaps.end(outer, 0)
        self.once.discard(outer)
        self._scheduler.free_outer_group(outer)

    def open(self, outer: int, limit: int, now: int, once: bool = False) -> bool:
        """
        Set how many executions of an outer group may run at a time.

        :param once: it closes when the next one starts.
        :return: whether one may start now.
        """
        self._end_bypass()
        self._scheduler.open_outer(outer, limit, once)
        (self.once.add if once and limit else self.once.discard)(outer)
        (self._gaps.end if limit else self._gaps.begin)(outer, now)
        state = self._state
        return any(
            state.x_outer[first_of(state, entry)] == outer and has_place(
                state, first_of(state, entry))
            for heap in (state.ready, state.deferred) for entry in heap)

    def started(self, outer: int, now: int) -> None:
        """Note that an execution has started of an outer group that this closes."""
        self.once.discard(outer)
        self._gaps.begin(outer, now)

    def is_open(self, outer: int) -> bool:
        """Return whether executions of it may start, and will still when one has started."""
        return self._state.outer_limit[outer] > 0 and not self._state.outer_once[outer]

    def read_wait(self, outer: int) -> int:
        """Return how long (ns) executions have waited for others of it since the last call."""
        waited = self._state.outer_wait[outer]
        self._state.outer_wait[outer] = 0
        return waited

    def move(self, entity: Entity, outer: int) -> None:
        """Move an entity to another outer group, or to none (-1)."""
        self._end_bypass()
        entity.outer = outer
        for work in self._works.values():
            if work.entity is entity:
                self._scheduler.set_outer(work.x, outer)

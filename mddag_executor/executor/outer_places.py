# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The outer groups of the core (``core.rules``, rule 4), as the executor opens and fills them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from mddag_executor.core import Scheduler
from mddag_executor.core.queues import first_of, has_place
from mddag_executor.executor.entity import Entity

if TYPE_CHECKING:
    from mddag_executor.executor.work import Work


class OuterPlaces:
    """
    The outer groups, by number; all methods need the engine's lock.

    :param end_bypass: lets the core know of all executions.
    :param works: the executions that wait, by their numbers in the core.
    :ivar new: adds an outer group, which is closed, and returns its number.
    :ivar free: lets the number of an outer group without callbacks be used again.
    """

    def __init__(
        self, scheduler: Scheduler, end_bypass: Callable[[], object], works: Mapping[int, Work]
    ) -> None:
        self._scheduler = scheduler
        self._state = scheduler.state
        self._end_bypass = end_bypass
        self._works = works
        self.new = scheduler.new_outer_group
        self.free = scheduler.free_outer_group

    def open(self, outer: int, limit: int, once: bool = False) -> bool:
        """
        Set how many executions of an outer group may run at a time.

        :param once: it closes when the next one starts.
        :return: whether one may start now.
        """
        self._end_bypass()
        self._scheduler.open_outer(outer, limit, once)
        state = self._state
        return any(
            state.x_outer[first_of(state, entry)] == outer and has_place(
                state, first_of(state, entry))
            for heap in (state.ready, state.deferred) for entry in heap)

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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The callback groups of entities: their numbers in the core."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any
import weakref

from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.work import decides_itself, run_in_group, Work
from rclpy.callback_groups import ReentrantCallbackGroup


class CallbackGroups:
    """
    The callback groups that have a number in the core.

    :param passed: called with each execution that a callback group has let run (see ``work``).
    """

    def __init__(self, engine: Engine, passed: Callable[[Work], None]) -> None:
        self._engine = engine
        self._passed = passed
        # the core's numbers of callback groups (of user-defined groups: of their entities), and
        # all that are not freed yet
        self._groups: weakref.WeakKeyDictionary[Any, int] = weakref.WeakKeyDictionary()
        self._numbers: set[int] = set()

    def enter(self, entity: Entity) -> None:
        """Set the callback group of a new entity."""
        rclpy_object = entity.rclpy_object
        group = getattr(rclpy_object, 'callback_group', None)
        decides = group is not None and decides_itself(group)
        entity.group = self._number(rclpy_object if decides else group)
        if decides:
            entity.gate = partial(run_in_group, group, rclpy_object, self._passed)
        elif group is not None and entity.group >= 0 and group.has_entity(rclpy_object):
            entity.exclusive = group

    def _number(self, group: Any) -> int:
        """Return the core's number of a callback group, -1 for a reentrant one and for none."""
        if group is None or isinstance(group, ReentrantCallbackGroup):
            return -1
        number = self._groups.get(group)
        if number is None:
            number = self._groups[group] = self._engine.scheduler.new_group()
            self._numbers.add(number)
        return number

    def free(self) -> None:
        """Free the numbers of destroyed groups: memory is bounded."""
        if len(self._groups) < len(self._numbers):
            for number in self._numbers.difference(list(self._groups.values())):
                self._numbers.remove(number)
                self._engine.scheduler.free_group(number)

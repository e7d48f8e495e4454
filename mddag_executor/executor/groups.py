# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Callback groups of a user-defined class.

Theory of operation
-------------------
The core implements rclpy's two kinds of callback groups.  Any other group is asked, as by rclpy's
executors: ``can_execute`` and ``beginning_execution`` before a callback, and ``ending_execution``
after it.  This is user code, which may wait for a lock.  So the worker that is to run the callback
asks, without the engine's lock.

Each entity of such a group is a group of one in the core (rule 4).  Its execution leaves that
group as soon as it may run.  So the group is asked about an entity's messages one at a time, in
their order.  A refused execution waits; the group is asked again after each callback that ends,
and every few milliseconds during a spin.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

if TYPE_CHECKING:
    from mddag_executor.executor.work import Work

_METHODS = ('can_execute', 'beginning_execution', 'ending_execution')


class Refused(Exception):
    """The callback group does not let a callback run now."""


def decides_itself(group: Any) -> bool:
    """Return whether a callback group is of neither of rclpy's kinds, or overrides one of them."""
    return not any(
        all(getattr(getattr(group, name), '__func__', None) is getattr(kind, name)
            for name in _METHODS)
        for kind in (MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup))


class Gate:
    """
    The user-defined callback group of an entity.

    :param passed: called with an execution that may run, before it does.
    """

    def __init__(self, group: Any, entity: Any, passed: Callable[[Work], None]) -> None:
        self._group = group
        self._entity = entity
        self._passed = passed

    def step(self, work: Work, must_check: bool = True) -> Any:
        """
        Run a step of an execution as ``Work.step`` does, if the group lets it.

        :raises Refused: if the group does not.
        """
        group, entity = self._group, self._entity
        if work.coroutine is None:
            if not (group.can_execute(entity) and group.beginning_execution(entity)):
                raise Refused
            self._passed(work)
        waits_for = None
        try:
            waits_for = work.step(must_check)
        finally:
            if waits_for is None:
                group.ending_execution(entity)
        return waits_for

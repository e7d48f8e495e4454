# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The callback groups of a recording, for the core.

Declared callbacks keep the callback groups that they had in the recording.  A `group:` of another
declaration than the recorded one goes before.
"""

from __future__ import annotations

from collections.abc import Iterable

from mddag_executor.core import Tables
from mddag_executor.replay.happenings import Event, Handlers


class RecordedGroups:
    """The callback groups of a recording: collects what the executor said at the beginning."""

    def __init__(self) -> None:
        self._exclusive: dict[int, bool] = {}
        self._group_of_entity: dict[int, int] = {}
        self._callbacks_of: dict[int, list[int]] = {}
        self._by_callback: dict[int, int] | None = None     # None: something new has come

    def handlers(self) -> Handlers:
        """Return what takes in the events, by full name."""
        return {
            'ros2_caret:add_callback_group': self._group,
            'ros2_caret:callback_group_add_timer': self._entity,
            'ros2_caret:callback_group_add_subscription': self._entity,
            'ros2_caret:callback_group_add_service': self._entity,
            'ros2:rclcpp_timer_callback_added': self._callback,
            'ros2:rclcpp_subscription_init': self._callback,
            'ros2:rclcpp_subscription_callback_added': self._callback,
            'ros2:rclcpp_service_callback_added': self._callback,
        }

    def _group(self, event: Event) -> None:
        self._exclusive[event[5]] = event[6] == 'mutually_exclusive'
        self._by_callback = None

    def _entity(self, event: Event) -> None:
        self._group_of_entity[event[5]] = event[4]
        self._by_callback = None

    def _callback(self, event: Event) -> None:
        # also from a subscription's handle to the subscription, which the callback belongs to
        self._callbacks_of.setdefault(event[4], []).append(event[5])
        self._by_callback = None

    def by_callback(self) -> dict[int, int]:
        """Return by callback its mutually exclusive group, or -1 for a reentrant one."""
        if self._by_callback is None:
            found: dict[int, int] = {}
            for entity, group in self._group_of_entity.items():
                number = group if self._exclusive.get(group) else -1
                for callback in self._reachable(entity):
                    found[callback] = number
            self._by_callback = found
        return self._by_callback

    def numbers(self) -> dict[int, int]:
        """Return the same by the callback's number with a sign, as columns have it."""
        return {callback - 2 ** 64 if callback >= 2 ** 63 else callback: number
                for callback, number in self.by_callback().items()}

    def _reachable(self, entity: int) -> Iterable[int]:
        seen = {entity: None}
        todo = [entity]
        for handle in todo:
            for after in self._callbacks_of.get(handle, ()):
                if after not in seen:
                    seen[after] = None
                    todo.append(after)
        return seen


def with_groups(
    tables: Tables, callback_of: dict[int, int], groups: dict[int, int], declared_first: bool
) -> Tables:
    """
    Return tables with the callback groups of a recording.

    :param callback_of: by global vertex the callback that ran as it.
    :param groups: by callback its group in the recording, -1 for a reentrant one.
    :param declared_first: whether declared groups go before recorded ones.
    """
    numbers: dict[tuple[bool, int], int] = {}
    column = []
    for vertex, declared in enumerate(tables.group):
        recorded = groups.get(callback_of.get(vertex, 0))
        if recorded is None or (declared_first and declared >= 0):
            choice = (False, declared)
        else:
            choice = (True, recorded)
        column.append(-1 if choice[1] == -1 else numbers.setdefault(choice, len(numbers)))
    return tables._replace(group=column, n_groups=len(numbers))

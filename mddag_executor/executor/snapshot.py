# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The entities of an executor's nodes.

Nodes notify an executor that their entities have changed (``Executor.wake``), but not how.  So the
snapshot is made again and compared.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.waitable import Waitable

LISTS = ('timers', 'subscriptions', 'services', 'clients', 'guards', 'waitables')
"""The entities of a node, by the names of its properties."""


EntitySet = dict[Node, tuple[list[Any], ...]]
"""The entities of each node, for each of ``LISTS``, in the order of creation."""


def snapshot(nodes: Iterable[Node]) -> EntitySet:
    """
    Return the entities that these nodes have now.

    :param nodes: may be changed by other threads meanwhile, which must cause another snapshot, as
        rclpy's nodes do by waking their executor.
    """
    return {node: tuple(_listed(node, name) for name in LISTS) for node in nodes}


def _listed(node: Node, name: str) -> list[Any]:
    """List entities until the list is unchanged: a concurrent removal may hide the next entity."""
    before: list[Any] | None = None
    found = list(getattr(node, name))
    while found != before:
        before, found = found, list(getattr(node, name))
    return found


def alive(entity: Any) -> bool:
    """Return whether a node or an entity has not been destroyed."""
    try:
        with entity.handle:
            return True
    except InvalidHandle:
        return False


def is_qos_event(waitable: Waitable) -> bool:
    """Return whether a waitable is an ``EventHandler`` that waits and takes as rclpy's does."""
    kind = type(waitable)
    return isinstance(waitable, EventHandler) and all(
        getattr(kind, name) is getattr(EventHandler, name)
        for name in ('add_to_wait_set', 'is_ready', 'take_data', 'get_num_entities'))

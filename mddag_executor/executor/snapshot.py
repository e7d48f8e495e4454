# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What an executor's nodes have to wait for.

Nodes notify an executor that *something* has changed (``Executor.wake``) but not what, so the set
is taken again and compared.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.waitable import Waitable

LISTS = ('timers', 'subscriptions', 'services', 'clients', 'guards', 'waitables')
"""What a node has, by the names of its properties."""


EntitySet = dict[Node, tuple[list[Any], ...]]
"""What each node has, for each of ``LISTS``, in the order of creation."""


def snapshot(nodes: Iterable[Node]) -> EntitySet:
    """
    Return what these nodes have to wait for now.

    :param nodes: the nodes; may be changed by other threads meanwhile (who must see to it that a
        further snapshot is taken, as rclpy's nodes do by waking their executor).
    """
    return {node: tuple(_listed(node, name) for name in LISTS) for node in nodes}


def _listed(node: Node, name: str) -> list[Any]:
    """List what a node has, until nothing changes meanwhile: else a removal hides the next one."""
    before: list[Any] | None = None
    found = list(getattr(node, name))
    while found != before:
        before, found = found, list(getattr(node, name))
    return found


def alive(entity: Any) -> bool:
    """Return whether a node, or what belongs to one, has not been destroyed."""
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

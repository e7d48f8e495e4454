# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What an executor's nodes have to wait for.

An ``EntitySet`` is what all nodes had at one moment. Nodes notify an executor that *something* has
changed (``Executor.wake``) but not what, so the set is taken again and compared: lists are
compared node by node, which for equal lists is one identity test for each entity.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from mddag_executor.live.compat import is_of_wait_for_message, only_logs
from rclpy.client import Client
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.waitable import Waitable

LISTS = ('timers', 'subscriptions', 'services', 'clients', 'guards', 'waitables')
"""What a node has, by the names of its properties."""


@dataclass(frozen=True, eq=False)
class EntitySet:
    """
    What some nodes have to wait for, at one moment, in the order of their creation by node.

    QoS events (rclpy's ``EventHandler``, as it is) are apart from all other ``waitables``: a node
    has a few of them for every publisher and subscription, and they hardly ever become ready.
    ``logged_events`` are those that rclpy makes by itself, which only write to the log.
    ``by_node`` has all of them, for each of ``LISTS``.
    """

    subscriptions: list[Subscription]
    timers: list[Timer]
    clients: list[Client]
    services: list[Service]
    guards: list[GuardCondition]
    waitables: list[Waitable]
    events: list[EventHandler]
    logged_events: list[EventHandler]
    by_node: dict[Node, tuple[list[Any], ...]]

    @property
    def nodes(self) -> list[Node]:
        """Return the nodes that the set was taken from."""
        return list(self.by_node)


EMPTY = EntitySet([], [], [], [], [], [], [], [], {})


def snapshot(nodes: Iterable[Node], previous: EntitySet | None = None) -> EntitySet:
    """
    Return what these nodes have to wait for now.

    What ``rclpy.wait_for_message`` takes from itself is left out.

    :param nodes: the nodes; may be changed by other threads meanwhile (who must see to it that a
        further snapshot is taken, as rclpy's nodes do by waking their executor).
    :param previous: an earlier set; returned itself if nothing changed.
    """
    found = {node: tuple(_listed(node, name) for name in LISTS) for node in nodes}
    if previous is not None and found == previous.by_node:
        return previous
    timers, subscriptions, services, clients, guards, waitables = (
        [entity for lists in found.values() for entity in lists[index]]
        for index in range(len(LISTS)))
    events = [w for w in waitables if is_qos_event(w)]
    return EntitySet(
        [s for s in subscriptions if not is_of_wait_for_message(s)],
        timers, clients, services, guards,
        [w for w in waitables if not is_qos_event(w)],
        [e for e in events if not only_logs(e)], [e for e in events if only_logs(e)], found)


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

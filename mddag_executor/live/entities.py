# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What an executor's nodes have to wait for, and whom the intake tells that it is there.

An ``EntitySet`` is what all nodes had at one moment. Nodes tell an executor that *something* has
changed (``Executor.wake``) but not what, so the set is taken again and compared: lists are
compared node by node, which for equal lists is one identity test for each entity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

from rclpy.client import Client
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.time_source import TimeSource
from rclpy.timer import Timer
from rclpy.waitable import Waitable

_Lists = tuple[
    list[Subscription], list[Timer], list[Client], list[Service], list[GuardCondition],
    list[Waitable]]


class Receiver(Protocol):
    """
    Whom the intake hands over to, from its threads (several at once) or from ``poll``.

    Handing over is taking: the message, request, … is no longer in the middleware. A method that
    raises does no harm to the intake: its exception is passed on to ``on_intake_error``.
    """

    def hold(self) -> None:
        """Take note that several timers are handed over that were due at one wake-up."""

    def let_go(self) -> None:
        """Take note that all of them have been; one call for each ``hold``."""

    def on_timer(self, timer: Timer, due_ns: int) -> None:
        """
        Take in a timer that became due (``call_timer`` has been done).

        :param due_ns: nominal due time, ns on the scale of ``time.monotonic_ns``: a point of the
            timer's exact phase grid; with simulated time active, when it was noticed. After an
            overrun it is when the first of the missed periods was due; the others are skipped,
            as rcl does it, and told by ``on_missed``.
        """

    def on_missed(self, timer: Timer, due_ns: int, count: int) -> None:
        """Take in that so many periods after that of ``due_ns`` are skipped, after an overrun."""

    def on_message(
        self, subscription: Subscription, message: Any, info: dict[str, Any]
    ) -> None:
        """Take in a message (bytes of a raw subscription) with its info."""

    def on_request(self, service: Service, request: Any, header: Any) -> None:
        """Take in a request; ``header`` is what ``Service.send_response`` wants."""

    def on_response(self, client: Client, sequence: int, header: Any, response: Any) -> None:
        """Take in a response; ``header`` is None where the intake does not get to see it."""

    def on_guard(self, guard_condition: GuardCondition) -> None:
        """Take in a node's guard condition that was triggered (once or more often)."""

    def on_waitable(self, waitable: Waitable, data: Any) -> None:
        """Take in what ``take_data`` of a waitable gave; ``execute(data)`` is still to run."""

    def on_intake_error(self, error: BaseException) -> None:
        """Take in an exception of a take or of one of the methods above."""


@dataclass(frozen=True, eq=False)
class EntitySet:
    """
    What some nodes have to wait for, at one moment, in the order of their creation by node.

    ``events`` holds the QoS events (rclpy's ``EventHandler``, as it is), ``waitables`` all other
    waitables: a node has a few of the former for every publisher and subscription, and they
    hardly ever become ready.
    """

    subscriptions: list[Subscription]
    timers: list[Timer]
    clients: list[Client]
    services: list[Service]
    guards: list[GuardCondition]
    waitables: list[Waitable]
    events: list[EventHandler]
    _nodes: dict[Node, _Lists]

    @cached_property
    def _owner(self) -> dict[int, Node]:
        return {
            id(entity): node
            for node, lists in self._nodes.items() for part in lists for entity in part}

    def node_of(self, entity: Any) -> Node:
        """
        Return the node that an entity of this set belongs to.

        :raises KeyError: when the entity is not in this set.
        """
        return self._owner[id(entity)]

    @property
    def nodes(self) -> list[Node]:
        """Return the nodes that the set was taken from."""
        return list(self._nodes)

    def __len__(self) -> int:
        """Return how many entities there are."""
        return sum(len(part) for lists in self._nodes.values() for part in lists)


EMPTY = EntitySet([], [], [], [], [], [], [], {})


def snapshot(
    nodes: Iterable[Node],
    previous: EntitySet | None = None,
    accept: Callable[[Any], bool] | None = None,
) -> EntitySet:
    """
    Return what these nodes have to wait for now.

    :param nodes: the nodes; may be changed by other threads meanwhile (who must see to it that a
        further snapshot is taken, as rclpy's nodes do by waking their executor).
    :param previous: an earlier set of the same ``accept``; returned itself if nothing changed.
    :param accept: which entities to take (by default all), for instance those of some callback
        groups. Asked only when a set is made anew.
    """
    known = previous._nodes if previous is not None else {}
    found: dict[Node, _Lists] = {}
    changed = previous is None
    for node in nodes:
        lists: _Lists = (
            list(node.subscriptions), list(node.timers), list(node.clients),
            list(node.services), list(node.guards), list(node.waitables))
        if not changed and known.get(node) != lists:
            changed = True
        found[node] = lists
    if previous is not None and not changed and len(found) == len(known):
        return previous
    return _flatten(found, accept)


def _flatten(nodes: dict[Node, _Lists], accept: Callable[[Any], bool] | None) -> EntitySet:
    def flat(index: int) -> list[Any]:
        found = [entity for lists in nodes.values() for entity in lists[index]]
        return found if accept is None else [entity for entity in found if accept(entity)]

    waitables = flat(5)
    return EntitySet(
        flat(0), flat(1), flat(2), flat(3), flat(4),
        [w for w in waitables if not is_qos_event(w)],
        [w for w in waitables if is_qos_event(w)],
        nodes)


def alive(entity: Any) -> bool:
    """Return whether a node, or what belongs to one, has not been destroyed."""
    try:
        with entity.handle:
            return True
    except InvalidHandle:
        return False


def keeps_time(subscription: Subscription) -> bool:
    """Return whether it is the one through which rclpy gets a node's simulated time."""
    callback = subscription.callback
    return getattr(callback, '__func__', None) is TimeSource.clock_callback


def is_qos_event(waitable: Waitable) -> bool:
    """Return whether a waitable is an ``EventHandler`` that waits and takes as rclpy's does."""
    kind = type(waitable)
    return isinstance(waitable, EventHandler) and all(
        getattr(kind, name) is getattr(EventHandler, name)
        for name in ('add_to_wait_set', 'is_ready', 'take_data', 'get_num_entities'))

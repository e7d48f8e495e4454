# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A draft of the running system, from the ROS graph and the rates of its topics.

Theory of operation
-------------------
The ROS graph shows the topics and services of each node. It shows neither timers, nor callback
groups, nor which callback publishes a topic. So:

1. A node has a callback for each topic it subscribes, and for each service. Each of a node's
   callbacks may publish the node's topics.
2. A node without subscriptions and services is assumed to have one timer, which publishes all of
   the node's topics, at the rate of the most frequent one. So the probe listens to these topics
   for a while, without deserialising messages.

The rate of a topic is that of its messages' source timestamps, divided by the number of its
publishers. Lost messages are counted by their sequence numbers: images are often published as best
effort. So no executor needs to spin: messages are polled, from all topics alike. Topics and
services that every node has are left out, and so are hidden nodes (``_…``). Discovery continues
until the end, as nodes are found one by one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib import import_module
import time
from typing import Any

from mddag_executor.executor.compat import message_taker
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.hosting.initialised import initialised
from msg_graph.binding import is_background
from msg_graph.draft import Draft, DraftCallback, DraftNode
from msg_graph.drift import Releases
from msg_graph.language import NODE, SERVICE, TOPIC
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

_LEAST_MESSAGES = 3
_STEP_S = 0.2
_POLL_S = 0.02
_DEPTH = 200  # for up to 10,000 messages a second on one topic


@dataclass
class Endpoints:
    """A node's published topics, subscribed topics and services, with their types."""

    publishes: dict[str, str] = field(default_factory=dict)
    subscribes: dict[str, str] = field(default_factory=dict)
    serves: dict[str, str] = field(default_factory=dict)


@dataclass
class Seen(Releases):
    """
    The messages of a topic by their source timestamps.

    :ivar published: how many the sender of the last message has published since the first one.
    """

    published: int = 0
    _first_number: int = 0

    def message(self, stamp: int, number: int | None) -> None:
        """Count a message; its number is its publisher's."""
        if not self.count:
            self._first_number = number or 0
        self.add(stamp)
        self.published = (number or 0) - self._first_number + 1


@dataclass
class Probe:
    """
    The findings.

    :ivar nodes: endpoints by node.
    :ivar seen: messages by topic.
    :ivar warnings: what could not be found out, one line each.
    """

    nodes: dict[str, Endpoints] = field(default_factory=dict)
    seen: dict[str, Seen] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def warn(self, text: str) -> None:
        """Add a warning, unless it exists."""
        if text not in self.warnings:
            self.warnings.append(text)

    def interval_ns(self, topic: str) -> int | None:
        """Return the mean time between two messages of a publisher; None if there are too few."""
        seen = self.seen.get(topic, Seen())
        n_publishers = sum(topic in node.publishes for node in self.nodes.values())
        count = max(seen.count, seen.published) if n_publishers == 1 else seen.count
        if count < _LEAST_MESSAGES or seen.last <= seen.first:
            return None
        return n_publishers * (seen.last - seen.first) // (count - 1)


def probe(seconds: float, tick: Callable[[float], None] = lambda _: None) -> Probe:
    """
    Inspect the ROS graph of this domain.

    :param seconds: duration; most of it is spent on measuring rates.
    :param tick: called repeatedly with the elapsed seconds.
    """
    found = Probe()
    subscriptions: list[tuple[Any, Seen]] = []
    with ExitStack() as stack:
        node = quiet_node('_mddag_graph_probe', stack.enter_context(initialised(None, Context())))
        stack.callback(node.destroy_node)
        begin = next_look = time.monotonic()
        while (now := time.monotonic()) < begin + seconds:
            if now >= next_look:
                next_look = now + _STEP_S
                _find_nodes(node, found)
                subscriptions += _listen(node, found)
            for subscription, seen in subscriptions:
                _take(subscription, seen)
            tick(now - begin)
            time.sleep(min(_POLL_S, max(0.0, begin + seconds - time.monotonic())))
    return found


def _take(subscription: Any, seen: Seen) -> None:
    """Count arrived messages; they are not deserialised."""
    take = message_taker(subscription)
    with subscription.handle:
        for _ in range(_DEPTH):
            taken = take()
            if taken is None:
                return
            about = taken[1]
            seen.message(about['source_timestamp'] or about['received_timestamp'],
                         about['publication_sequence_number'])


def _find_nodes(node: Node, found: Probe) -> None:
    """Add the nodes, with their topics and services."""
    names = [f'{namespace.rstrip("/")}/{name}'
             for name, namespace in node.get_node_names_and_namespaces()
             if not name.startswith('_')]
    for full, count in sorted(Counter(names).items()):
        if not NODE.fits(full):
            found.warn(f'{full}: left out, this is no valid node name')
            continue
        if count > 1:
            found.warn(
                f'{full}: {count} nodes have this name; they are treated as one: rename them')
        namespace, _, name = full.rpartition('/')
        endpoints = found.nodes.setdefault(full, Endpoints())
        for get, target, kind in (
            (node.get_publisher_names_and_types_by_node, endpoints.publishes, TOPIC),
            (node.get_subscriber_names_and_types_by_node, endpoints.subscribes, TOPIC),
            (node.get_service_names_and_types_by_node, endpoints.serves, SERVICE),
        ):
            try:
                listed = get(name, namespace or '/')
            except Exception as error:  # rclpy raises several kinds if the node has just ended
                found.warn(f'{full}: {error}')
                continue
            target.update((each, types[0]) for each, types in listed
                          if types and not is_background(each, full) and kind.fits(each))


def _listen(node: Node, found: Probe) -> list[tuple[Any, Seen]]:
    """Subscribe every new topic whose rate is needed, as best effort."""
    qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT,
                     durability=DurabilityPolicy.VOLATILE)
    types = {topic: kind for endpoints in found.nodes.values()
             if not (endpoints.subscribes or endpoints.serves)
             for topic, kind in endpoints.publishes.items()}
    subscriptions = []
    for topic in sorted(types.keys() - found.seen.keys()):
        seen = found.seen[topic] = Seen()
        try:
            subscription = node.create_subscription(
                _message_type(types[topic]), topic, lambda _: None, qos, raw=True,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
        except Exception as error:  # any error of the import of the type's package
            found.warn(f'{topic}: its rate is not known: its type {types[topic]} cannot be used '
                       f'here ({error})')
        else:
            subscriptions.append((subscription, seen))
    return subscriptions


def _message_type(kind: str) -> Any:
    """Return the class of a type name such as `std_msgs/msg/String`, which is not trusted."""
    match kind.split('/'):
        case [package, 'msg', name] if package.isidentifier() and name.isidentifier():
            return getattr(import_module(f'{package}.msg'), name)
    raise ValueError('this is no name of a message type')


def draft_of(found: Probe) -> Draft:
    """Return the known and assumed parts of the system (rules 1 and 2)."""
    nodes = []
    for name, endpoints in sorted(found.nodes.items()):
        starts = [*(('subscription', topic) for topic in sorted(endpoints.subscribes)),
                  *(('service', service) for service in sorted(endpoints.serves))]
        published = sorted(endpoints.publishes)
        callbacks = [DraftCallback(name, f'callback_{i}', kind, [start], maybe=[*published])
                     for i, (kind, start) in enumerate(starts)]
        if not callbacks:
            intervals = filter(None, map(found.interval_ns, published))
            callbacks = [DraftCallback(name, 'callback_0', 'timer', publishes=published,
                                       interval_ns=min(intervals, default=None))]
        nodes.append(DraftNode(name, {callback.name: callback for callback in callbacks}))
    return Draft('the nodes that ran', nodes)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Answers to questions about the ROS graph: the nodes of the run, and what is recorded.

The middleware discovers nodes after some time. Here all are known at once. Other questions go to
the middleware, and a warning says that the answer is not the same in each run.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.executor import NodeHolder
from mddag_executor.rerun.loop import Loop
from mddag_executor.rerun.message_types import type_name
from mddag_executor.rerun.messages import Messages
from rclpy.node import Node

_OTHERS = (
    'get_publisher_names_and_types_by_node', 'get_subscriber_names_and_types_by_node',
    'get_service_names_and_types_by_node', 'get_client_names_and_types_by_node',
    'get_service_names_and_types', 'get_publishers_info_by_topic',
    'get_subscriptions_info_by_topic', 'count_clients', 'count_services')


class Discovery:
    """
    Answers questions about the ROS graph.

    :param kinds: returns the type of each recorded topic, as far as it is known.
    """

    def __init__(
        self, loop: Loop, holder: NodeHolder, messages: Messages, recorded: Collection[str],
        kinds: Callable[[], dict[str, str]], warn: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._holder = holder
        self._messages = messages
        self._recorded = recorded
        self._kinds = kinds
        self._warn = warn

    def install(self, replacements: Replacements) -> None:
        """Replace the methods with which nodes ask."""
        replace = replacements.replace
        replace(Node, 'get_topic_names_and_types', instead(self._topics))
        replace(Node, 'count_publishers', instead(self._publishers))
        replace(Node, 'count_subscribers', instead(self._subscribers))
        replace(Node, 'get_node_names', instead(self._node_names))
        replace(Node, 'get_node_names_and_namespaces', instead(self._node_names_and_namespaces))
        for name in _OTHERS:
            if name in vars(Node):
                replace(Node, name, self._asking)

    def _asking(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def ask(node: Node, *args: Any, **more: Any) -> Any:
            self._warn(
                f'{node.get_fully_qualified_name()}: {original.__name__} asks the middleware, '
                'which does not find the same in each run')
            return original(node, *args, **more)

        return ask

    def _topics(self, node: Node, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        self._loop.refresh_now()
        kinds = {topic: {kind} for topic, kind in self._kinds().items()}
        for found in (self._messages.topics(), self._messages.offered):
            for topic, kind in found.items():
                kinds.setdefault(topic, set()).add(type_name(kind))
        return [(topic, sorted(names)) for topic, names in sorted(kinds.items())]

    def _publishers(self, node: Node, topic_name: str) -> int:
        self._loop.refresh_now()
        topic = node.resolve_topic_name(topic_name)
        return self._messages.publishers(topic) or int(topic in self._recorded)

    def _subscribers(self, node: Node, topic_name: str) -> int:
        self._loop.refresh_now()
        return len(self._messages.inlets(node.resolve_topic_name(topic_name)))

    def _node_names(self, node: Node) -> list[str]:
        return [each.get_name() for each in self._holder.ordered_nodes()]

    def _node_names_and_namespaces(self, node: Node) -> list[tuple[str, str]]:
        return [(each.get_name(), each.get_namespace()) for each in self._holder.ordered_nodes()]

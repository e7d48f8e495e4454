# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Answers to questions about the ROS graph: the nodes of the run, and what is recorded.

The middleware discovers nodes after some time. Here all are known at once. Other questions go to
the middleware, and a warning says that the answer is not the same in each run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.inputs import MessageBag
from mddag_executor.rerun.message_types import type_name
from mddag_executor.rerun.messages import Messages
from rclpy.node import Node

_OTHERS = (
    'get_publisher_names_and_types_by_node', 'get_subscriber_names_and_types_by_node',
    'get_service_names_and_types_by_node', 'get_client_names_and_types_by_node',
    'get_service_names_and_types', 'get_publishers_info_by_topic',
    'get_subscriptions_info_by_topic', 'count_clients', 'count_services')


class Discovery:
    """Answers questions about the ROS graph."""

    def __init__(self, messages: Messages, recording: MessageBag) -> None:
        self._messages = messages
        self._recording = recording

    def install(self, replacements: Replacements) -> None:
        """Replace the methods with which nodes ask."""
        for name, function in (
            ('get_topic_names_and_types', self._topics),
            ('count_publishers', self._publishers),
            ('count_subscribers', self._subscribers),
            ('get_node_names', self._node_names),
            ('get_node_names_and_namespaces', self._node_names_and_namespaces),
        ):
            replacements.replace(Node, name, instead(function))
        for name in _OTHERS:
            if name in vars(Node):
                replacements.replace(Node, name, self._asking)

    def _asking(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def ask(node: Node, *args: Any, **more: Any) -> Any:
            self._messages.loop.warn(
                f'{node.get_fully_qualified_name()}: {original.__name__} asks the middleware, '
                'which does not find the same in each run')
            return original(node, *args, **more)

        return ask

    def _known(self) -> Messages:
        self._messages.loop.refresh_now()
        return self._messages

    def _topics(self, node: Node, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        messages = self._known()
        kinds = {topic: {kind} for topic, kind in self._recording.kinds.items()}
        for found in (messages.inlets, messages.offered):
            for topic, (first, *_) in found.items():
                kinds.setdefault(topic, set()).add(type_name(first.kind))
        return [(topic, sorted(names)) for topic, names in sorted(kinds.items())]

    def _publishers(self, node: Node, topic_name: str) -> int:
        topic = node.resolve_topic_name(topic_name)
        return len(self._known().offered.get(topic, ())) or int(topic in self._recording.topics)

    def _subscribers(self, node: Node, topic_name: str) -> int:
        return len(self._known().inlets.get(node.resolve_topic_name(topic_name), ()))

    def _node_names(self, node: Node) -> list[str]:
        return [each.get_name() for each in self._known().nodes]

    def _node_names_and_namespaces(self, node: Node) -> list[tuple[str, str]]:
        return [(each.get_name(), each.get_namespace()) for each in self._known().nodes]

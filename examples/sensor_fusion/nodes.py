# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Camera and lidar, fused by stamp, with three results that have deadlines of their own.

The fusion is a callback of two topics.  With an installed ROS a node would use
`message_filters.TimeSynchronizer([image, points], 10)`; that package is not on the package index,
so `Pairs` does here what it does: it calls back within the callback of the message that makes a
pair whole.  The executor needs no more than that.
"""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

from rclpy.node import Node
from std_msgs.msg import Header


class Pairs:
    """Call back with the messages of two topics that have the same stamp."""

    def __init__(self, node: Node, topics: tuple[str, str], callback: Callable[..., Any]) -> None:
        self._waiting: dict[tuple[int, int], dict[str, Header]] = {}
        self._topics = topics
        self._callback = callback
        for topic in topics:
            node.create_subscription(
                Header, topic, lambda message, t=topic: self._take(t, message), 10)

    def _take(self, topic: str, message: Header) -> None:
        stamp = (message.stamp.sec, message.stamp.nanosec)
        pair = self._waiting.setdefault(stamp, {})
        pair[topic] = message
        if len(pair) == len(self._topics):
            del self._waiting[stamp]
            self._callback(*(pair[t] for t in self._topics))
        elif len(self._waiting) > 10:  # the oldest lost its partner
            del self._waiting[min(self._waiting)]


class Stage(Node):
    """A node that passes the stamp on, some milliseconds later."""

    def __init__(self, name: str, takes_ms: float, to: str | None = None) -> None:
        super().__init__(name)
        self._takes_s = takes_ms / 1000
        self._to = self.create_publisher(Header, to, 10) if to else None

    def work(self, first: Header, *others: Header) -> None:
        """Wait, as for a camera, a GPU or a library outside of Python."""
        time.sleep(self._takes_s)
        if self._to is not None:
            self._to.publish(Header(stamp=first.stamp, frame_id=self.get_name()))


def pulse() -> Node:
    node = Node('pulse')
    publisher = node.create_publisher(Header, '/pulse', 10)
    node.create_timer(
        0.1, lambda: publisher.publish(Header(stamp=node.get_clock().now().to_msg())))
    return node


def stages() -> list[Node]:
    chain = []
    for name, takes_ms, topic, to in (
        ('camera', 20, '/pulse', '/image'),
        ('lidar', 30, '/pulse', '/points'),
        ('brake', 5, '/objects', None),
        ('map', 40, '/objects', None),
        ('viewer', 5, '/image', None),
    ):
        stage = Stage(name, takes_ms, to)
        stage.create_subscription(Header, topic, stage.work, 10)
        chain.append(stage)
    fusion = Stage('fusion', 10, '/objects')
    Pairs(fusion, ('/image', '/points'), fusion.work)
    return [*chain, fusion]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes of a chain that pass the stamp of the first message on, for programs of one node each."""

from __future__ import annotations

import os
from pathlib import Path

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header

ENOUGH = 60


def _relay(name: str, topic: str, *publishes: str) -> Node:
    node = Node(name, start_parameter_services=False, enable_rosout=False)
    publishers = [node.create_publisher(Header, t, 50) for t in publishes]

    def on_message(message):
        for publisher in publishers:
            publisher.publish(Header(stamp=message.stamp, frame_id=name))

    node.create_subscription(
        Header, topic, on_message, 50, callback_group=ReentrantCallbackGroup())
    return node


def sensor() -> Node:
    """Publish with the time of the callback, once those who are to get it are there."""
    node = Node('sensor', start_parameter_services=False, enable_rosout=False)
    publisher = node.create_publisher(Header, '/raw', 50)

    def tick():
        if publisher.get_subscription_count():
            publisher.publish(Header(stamp=node.get_clock().now().to_msg()))

    node.create_timer(0.02, tick)
    return node


def first() -> Node:
    """Relay /raw to /half."""
    return _relay('first', '/raw', '/half')


def second() -> Node:
    """Relay /half to /whole."""
    return _relay('second', '/half', '/whole')


def last() -> list[Node]:
    """Take /whole; make a mark when there have been enough."""
    node = _relay('last', '/whole')
    counts = [0]

    def on_message(message):
        counts[0] += 1
        if counts[0] == ENOUGH:
            Path(os.environ['RELAY_MARK']).touch()

    # also on a topic of the graph, but of a node that the graph does not have
    watch = Node('watch', start_parameter_services=False, enable_rosout=False)
    watch.create_subscription(Header, '/whole', on_message, 50)
    return [node, watch]

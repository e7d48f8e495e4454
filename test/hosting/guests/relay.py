# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes of a chain that pass the stamp of the first message on, for programs of one node each."""

import os
from pathlib import Path

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header

ENOUGH = 60


def make(name):
    return Node(name, start_parameter_services=False, enable_rosout=False)


def sensor():
    """Publish with the time of the callback, once those who are to get it are there."""
    node = make('sensor')
    publisher = node.create_publisher(Header, '/raw', 50)

    def tick():
        if publisher.get_subscription_count():
            publisher.publish(Header(stamp=node.get_clock().now().to_msg()))

    node.create_timer(0.02, tick)
    return node


def relay(name, topic, to):
    node = make(name)
    publisher = node.create_publisher(Header, to, 50)
    node.create_subscription(
        Header, topic, publisher.publish, 50, callback_group=ReentrantCallbackGroup())
    return node


def first():
    return relay('first', '/raw', '/half')


def second():
    return relay('second', '/half', '/whole')


def last():
    """Take /whole; make a mark when there have been enough."""
    node = make('last')
    numbers = iter(range(1, 10 ** 6))

    def on_message(message):
        if next(numbers) == ENOUGH:
            Path(os.environ['RELAY_MARK']).touch()

    node.create_subscription(Header, '/whole', on_message, 50)
    # also on a topic of the graph, but of a node that the graph does not have
    watch = make('watch')
    watch.create_subscription(Header, '/whole', lambda message: None, 50)
    return [node, watch]

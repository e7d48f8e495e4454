# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A bag, a graph for it, and a node that notes what it sees."""

from mcap.writer import Writer
from mddag_executor.rerun import rerun
from mddag_executor.rerun.message_types import definition, type_name
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

START = 1_700_000_000_000_000_000
MS = 1_000_000

GRAPH = """\
mddag: 1
workers: 2
nodes:
  - node: /driver
    callbacks:
      - {name: drive, timer: 100ms, publishes: [/points], dag: main}
  - node: /filter
    callbacks:
      - {name: take, subscription: /points, publishes: [/filtered], execution_time: 10ms}
  - node: /sink
    callbacks:
      - {name: take, subscription: /filtered, publishes: [/out], execution_time: 5ms,
         deadline: 50ms}
"""


def write_bag(path, messages):
    """Write messages (ms after `START`, topic, message), in order of time, as rosbag2 does."""
    with open(path, 'wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2')
        channels = {}
        for ms, topic, message in sorted(messages, key=lambda each: each[0]):
            if topic not in channels:
                kind = type(message)
                schema = writer.register_schema(
                    type_name(kind), 'ros2msg', definition(kind).encode())
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            at = START + ms * MS
            writer.add_message(channels[topic], at, serialize_message(message), at)
        writer.finish()
    return str(path)


class Filter(Node):
    """The declared node; what it does with each message is given."""

    def __init__(self, take, **more):
        super().__init__('filter', **more)
        self.group = ReentrantCallbackGroup()
        self.seen = []
        self.create_subscription(
            Header, '/points', lambda message: take(self, int(message.frame_id)), 10,
            callback_group=self.group)

    def note(self, what):
        """Note something with the virtual time, ms after the start."""
        self.seen.append(((self.get_clock().now().nanoseconds - START) / MS, what))


def run_filter(
        bag, graph, take=lambda node, number: None, *others, fill=lambda node: None, **more):
    """Rerun the node; return what it noted."""
    nodes = []

    def make():
        node = Filter(take)
        fill(node)
        nodes.append(node)
        return node

    result = rerun(bag, graph, [make, *others], **more)
    return nodes[0].seen, result

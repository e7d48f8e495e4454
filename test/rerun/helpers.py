# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A bag, and a graph for it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mcap.writer import Writer
from mddag_executor.rerun.message_types import definition, type_name
from rclpy.serialization import serialize_message

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


def write_bag(path: Path, messages: Iterable[tuple[int, str, Any]]) -> str:
    """Write messages (ns after `START`, topic, message or its bytes) as rosbag2 does."""
    with open(path, 'wb') as file:
        writer: Any = Writer(file)
        writer.start(profile='ros2')
        channels: dict[str, int] = {}
        for time, topic, message in messages:
            kind, data = message if isinstance(message, tuple) else (
                type(message), serialize_message(message))
            if topic not in channels:
                schema = writer.register_schema(
                    type_name(kind), 'ros2msg', definition(kind).encode())
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], START + time, data, START + time)
        writer.finish()
    return str(path)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Ordinary bags that tests write, and the declaration of their robot."""

import numpy as np
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

MS = 1_000_000
BEGIN = 1_732_166_766_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
HEADER, STRING = 'std_msgs/msg/Header', 'std_msgs/msg/String'
GRAPH = """\
mddag: 1
workers: 2
nodes:
  - node: /lidar
    callbacks:
      - {name: in, subscription: /points, period: 100ms, publishes: [/cloud], execution_time: 1ms}
  - node: /detector
    callbacks:
      - {name: detect, subscription: /cloud, deadline: 20ms, execution_time: 8ms}
  - {node: /control, callbacks: [{name: tick, timer: 30ms, deadline: 10ms, execution_time: 3ms}]}
"""
BY_HEADER = GRAPH.replace('period: 100ms', 'period: 100ms, release_from: header_stamp')


def made(kind, *fields):
    return STORE.types[kind](*fields)


def time_of(stamp):
    return made('builtin_interfaces/msg/Time', *divmod(stamp, 1_000_000_000))


def header(stamp):
    return made(HEADER, time_of(stamp), 'lidar')


def write(path, types, messages, storage=MCAP, compression=None, version=9):
    """Write a bag; `types` by topic, `messages`: topic, arrival and message, or its bytes."""
    writer = Writer(path, version=version, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=STORE)
                       for topic, kind in types.items()}
        for topic, arrival, message in messages:
            writer.write(connections[topic], arrival, message if isinstance(
                message, bytes) else STORE.serialize_cdr(message, types[topic]))
    return path


def write_bag(path, storage=MCAP, compression=None, stamps=None):
    """Write a bag of ten scans, each 5 ms after its stamp, and a message of another topic."""
    scans = [('/points', BEGIN + (i * 100 + 5) * MS, header(stamp)) for i, stamp in enumerate(
        stamps or range(BEGIN, BEGIN + 1000 * MS, 100 * MS))]
    return write(path, {'/points': HEADER, '/chatter': STRING},
                 [('/chatter', BEGIN, made(STRING, 'hello')), *scans], storage, compression)


# By topic: the type, and a message with a stamp.
TOPICS = {
    '/parameter_events': ('rcl_interfaces/msg/ParameterEvent', lambda ns: (
        time_of(ns), '/camera', [], [], [])),
    '/rosout': ('rcl_interfaces/msg/Log', lambda ns: (
        time_of(ns), 20, 'camera', 'hello', 'camera.py', 'main', 7)),
    '/camera/image/compressed': ('sensor_msgs/msg/CompressedImage', lambda ns: (
        header(ns), 'jpeg', np.arange(200, dtype=np.uint8))),
    '/joint_states': ('sensor_msgs/msg/JointState', lambda ns: (
        header(ns), [], np.zeros(0), np.zeros(0), np.zeros(0))),
    'chatter': (STRING, lambda ns: ('no stamp',)),     # it is that below the root
}


def messages(part):
    """Make ten of each topic, 100 ms apart, each recorded 5 ms after its stamp."""
    return [(topic, stamp + 5 * MS, made(kind, *fields(stamp)))
            for stamp in (BEGIN + i * 100 * MS for i in range(10 * part, 10 * part + 10))
            for topic, (kind, fields) in TOPICS.items()]

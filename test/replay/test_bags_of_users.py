# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Bags as users record them: the topics of every robot, in all that `ros2 bag record` can write.

In those that rosbags cannot write, the definitions of the messages are the files that ROS
installs, as the recorder stores them.
"""

from contextlib import closing
import json
import os
from pathlib import Path
import shutil
import sqlite3
import sys

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mddag_executor.replay.bags import Bag, UNKNOWN
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

MS = 1_000_000
BEGIN = 1_732_166_766_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)


def time_of(ns):
    return STORE.types['builtin_interfaces/msg/Time'](*divmod(ns, 1_000_000_000))


def header(ns):
    return STORE.types['std_msgs/msg/Header'](time_of(ns), 'camera')


def bytes_of(values):
    import numpy as np
    return np.arange(values, dtype=np.uint8)


# By topic: the type, and how a message is made from its stamp.
TOPICS = {
    '/parameter_events': ('rcl_interfaces/msg/ParameterEvent', lambda new, ns: new(
        time_of(ns), '/camera', [], [], [])),
    '/rosout': ('rcl_interfaces/msg/Log', lambda new, ns: new(
        time_of(ns), 20, 'camera', 'hello', 'camera.py', 'main', 7)),
    '/camera/image/compressed': ('sensor_msgs/msg/CompressedImage', lambda new, ns: new(
        header(ns), 'jpeg', bytes_of(200))),
    '/joint_states': ('sensor_msgs/msg/JointState', lambda new, ns: new(
        header(ns), [], bytes_of(0).astype('f8'), bytes_of(0).astype('f8'),
        bytes_of(0).astype('f8'))),
    '/chatter': ('std_msgs/msg/String', lambda new, ns: new('no stamp')),
}
STAMPED = set(TOPICS) - {'/chatter'}


def messages(begin, count):
    """Make so many of each topic, 100 ms apart, each recorded 5 ms after its stamp."""
    found = []
    for i in range(begin, begin + count):
        for name, (kind, make) in TOPICS.items():
            stamp = BEGIN + i * 100 * MS
            found.append((name, kind, stamp + 5 * MS, bytes(STORE.serialize_cdr(
                make(STORE.types[kind], stamp), kind))))
    return found


def definition(kind):
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    package, folder, name = kind.split('/')
    for prefix in filter(None, prefixes):
        path = Path(prefix, 'share', package, folder, f'{name}.msg')
        if path.is_file():
            return path.read_text()
    pytest.skip(f'ROS is not installed: no {package}/{folder}/{name}.msg')


def with_rosbags(storage, compression=CompressionMode.NONE, version=9):
    def write(path, given):
        writer = Writer(path, version=version, storage_plugin=storage)
        writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            connections = {name: writer.add_connection(name, kind, typestore=STORE)
                           for name, (kind, _) in TOPICS.items()}
            for topic, _, time, data in given:
                writer.write(connections[topic], time, data)
    return write


def without_definitions(path, given):
    with_rosbags(StoragePlugin.SQLITE3)(path, given)
    with closing(sqlite3.connect(path / f'{path.name}.db3')) as storage:
        storage.execute('DROP TABLE message_definitions')


def with_mcap(**options):
    """Write as rosbag2_storage_mcap does with one of its presets, without metadata.yaml."""
    def write(path, given):
        path.mkdir()
        with open(path / f'{path.name}_0.mcap', 'wb') as file:
            writer = McapWriter(file, **options)
            writer.start(profile='ros2', library='libmcap 0.8.0')
            channels = {}
            for topic, (kind, _) in TOPICS.items():
                schema = writer.register_schema(kind, 'ros2msg', definition(kind).encode())
                channels[topic] = writer.register_channel(
                    topic, 'cdr', schema, {'offered_qos_profiles': '', 'topic_type_hash': ''})
            for number, (topic, _, time, data) in enumerate(given):
                writer.add_message(channels[topic], time, data, time, number)
            writer.add_metadata('rosbag2', {'serialized_metadata': 'version: 9'})
            writer.finish()
    return write


BAGS = {
    '-s mcap': with_rosbags(StoragePlugin.MCAP),
    '-s mcap of Iron': with_rosbags(StoragePlugin.MCAP, version=8),
    '-s mcap --compression-mode message': with_rosbags(
        StoragePlugin.MCAP, CompressionMode.MESSAGE),
    '-s mcap --compression-mode file': with_rosbags(StoragePlugin.MCAP, CompressionMode.FILE),
    '-s sqlite3': with_rosbags(StoragePlugin.SQLITE3),
    '-s sqlite3 of Humble': without_definitions,
    '-s sqlite3 --compression-mode message': with_rosbags(
        StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    '-s sqlite3 --compression-mode file': with_rosbags(
        StoragePlugin.SQLITE3, CompressionMode.FILE),
    '--storage-preset-profile none': with_mcap(compression=CompressionType.NONE),
    '--storage-preset-profile fastwrite': with_mcap(use_chunking=False, use_statistics=False),
    '--storage-preset-profile zstd_fast': with_mcap(
        compression=CompressionType.ZSTD, enable_crcs=False),
    '--storage-preset-profile zstd_small': with_mcap(compression=CompressionType.ZSTD),
    '--storage-config-file with lz4': with_mcap(
        compression=CompressionType.LZ4, chunk_size=1000),
}
GRAPH = 'mddag: 1\nnodes:\n  - node: /all\n    callbacks:\n' + ''.join(
    f'      - {{name: c{i}, subscription: {topic}, period: 100ms, release_from: '
    f'{"header_stamp" if topic in STAMPED else "arrival"}, deadline: 50ms, '
    f'execution_time: 1ms, dag: d{i}}}\n' for i, topic in enumerate(TOPICS))


@pytest.mark.parametrize('split', [False, True], ids=['one file', '-b'])
@pytest.mark.parametrize('kind', BAGS)
def test_each_kind_of_bag(tmp_path, graph, kind, split, call):
    bag, write = tmp_path / 'drive', BAGS[kind]
    if split:
        join(bag, [parted(tmp_path / f'part{i}', write, i) for i in range(2)])
    else:
        write(bag, messages(0, 20))
    read = Bag(bag, set(TOPICS))
    for topic in TOPICS:
        stamps = read.stamps[topic]
        assert list(stamps.arrival) == [BEGIN + (i * 100 + 5) * MS for i in range(20)]
        assert list(stamps.header) == [
            BEGIN + i * 100 * MS if topic in STAMPED else UNKNOWN for i in range(20)], topic
    done = call('replay', bag, graph, '--reschedule', '--json', '-')
    assert done.stderr.count('\n') == (not (bag / 'metadata.yaml').exists())
    result = json.loads(done.stdout)
    assert {name: dag['jobs'] for name, dag in result['dags'].items()} == {
        f'd{i}': 20 for i in range(len(TOPICS))}


def parted(path, write, part):
    write(path, messages(10 * part, 10))
    return path


def join(bag, parts):
    """Make one bag of several, as the recorder splits it: drive_0, drive_1, …."""
    bag.mkdir()
    names = []
    for i, part in enumerate(parts):
        file, = (path for path in part.iterdir() if path.name != 'metadata.yaml')
        names.append(f'drive_{i}{"".join(file.suffixes)}')
        shutil.move(file, bag / names[-1])
    metadata = parts[0] / 'metadata.yaml'
    if metadata.exists():
        old = next(line for line in metadata.read_text().splitlines() if '- part0' in line)
        indent = old[:old.index('-')]
        text = metadata.read_text().replace(
            old, '\n'.join(f'{indent}- {name}' for name in names), 1)
        total = 10 * len(TOPICS)
        (bag / 'metadata.yaml').write_text(
            text.replace(f'message_count: {total}\n', f'message_count: {2 * total}\n'))

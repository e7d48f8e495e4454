# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Ordinary bags, written by rosbags, as releases: every storage and compression, and damage."""

import os
import shutil
import sqlite3

from mddag_executor import open_recording
from mddag_executor.errors import InputError
from mddag_executor.replay.bags import Bag, BagError, is_ordinary
from mddag_executor.replay.bags_reschedule import read_bag, reschedule_bag
from mddag_executor.simulate import START
from mddag_executor.trace import TraceError, TraceFile, TraceReader
from msg_graph import loads
import pytest
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

MS = 1_000_000
BEGIN = 1_732_166_766_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)
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
  - node: /control
    callbacks:
      - {name: tick, timer: 30ms, deadline: 10ms, execution_time: 3ms}
"""
BY_HEADER = GRAPH.replace('period: 100ms', 'period: 100ms, release_from: header_stamp')


def header(stamp):
    """Return a std_msgs/Header as CDR."""
    time = STORE.types['builtin_interfaces/msg/Time'](*divmod(stamp, 1_000_000_000))
    message = STORE.types['std_msgs/msg/Header'](time, 'lidar')
    return bytes(STORE.serialize_cdr(message, 'std_msgs/msg/Header'))


def write_bag(path, storage=StoragePlugin.MCAP, compression=None, stamps=None, topic='/points'):
    """Write a bag of ten scans, each 5 ms after its stamp, and a message of another topic."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        points = writer.add_connection(topic, 'std_msgs/msg/Header', typestore=STORE)
        chatter = writer.add_connection('/chatter', 'std_msgs/msg/String', typestore=STORE)
        text = STORE.types['std_msgs/msg/String']('hello')
        writer.write(
            chatter, BEGIN, STORE.serialize_cdr(text, 'std_msgs/msg/String'))
        for i in range(10):
            stamp = BEGIN + i * 100 * MS
            given = stamp if stamps is None else stamps[i]
            writer.write(points, stamp + 5 * MS, header(given))
    return path


def responses(outcome, dag, sink):
    return outcome.result()['dags'][dag]['sinks'][sink]['response_ns']


def test_the_schedule_is_that_of_the_core(tmp_path):
    """On one worker scans and timer get into each other's way."""
    outcome = reschedule_bag(write_bag(tmp_path / 'bag'), loads(GRAPH, 'g.yaml'), workers=1)
    first = [(time - BEGIN, vertex) for time, kind, _, _, vertex, _ in outcome.log
             if kind == START][:4]
    assert first == [(0, 2), (5 * MS, 0), (6 * MS, 1), (30 * MS, 2)]
    slow = reschedule_bag(
        tmp_path / 'bag', loads(GRAPH, 'g.yaml'), workers=1, dispatch_overhead=MS)
    begun = [time - BEGIN for time, kind, *_ in slow.log if kind == START]
    assert begun[:3] == [0, 5 * MS, 7 * MS]
    table = [[2 * MS, 4 * MS], [MS]]
    given = reschedule_bag(tmp_path / 'bag', loads(GRAPH, 'g.yaml'), times=table)
    assert set(responses(given, '/lidar', '/detector:detect').values()) == {6 * MS}
    drawn = GRAPH.replace('execution_time: 8ms', 'execution_time: {quantiles_us: [1000, 9000]}')
    seeds = [reschedule_bag(tmp_path / 'bag', loads(drawn, 'g.yaml'), seed=seed).log
             for seed in (1, 1, 2)]
    assert seeds[0] == seeds[1] != seeds[2]


def test_stamps_that_can_not_be_are_said(tmp_path):
    stamps = [BEGIN + i * 100 * MS for i in range(10)]
    stamps[3] = 0
    stamps[4] += 50 * MS
    path = write_bag(tmp_path / 'bag', stamps=stamps)
    outcome = reschedule_bag(path, loads(BY_HEADER, 'g.yaml'))
    assert outcome.warnings == [
        f'{path}: 2 of 10 messages of /points (std_msgs/msg/Header) without a header stamp, or '
        'with one after the arrival or years before: released at the arrival']
    assert responses(outcome, '/lidar', '/detector:detect')['min'] == 9 * MS
    chatter = BY_HEADER.replace('/points', '/chatter')
    outcome = reschedule_bag(path, loads(chatter, 'g.yaml'))
    assert 'without a header stamp' in outcome.warnings[0]
    published = BY_HEADER.replace('header_stamp', 'source_timestamp')
    outcome = reschedule_bag(path, loads(published, 'g.yaml'))
    assert '10 of 10 messages' in outcome.warnings[0]
    assert 'without a publication time' in outcome.warnings[0]


def test_what_is_not_in_the_bag_is_said(tmp_path):
    path = write_bag(tmp_path / 'bag')
    text = GRAPH + """\
  - node: /camera
    callbacks:
      - {name: in, subscription: /image, period: 10ms, deadline: 5ms, execution_time: 1ms}
      - {name: ask, service: /s, period: 10ms, deadline: 5ms, execution_time: 1ms, dag: ask}
"""
    outcome = reschedule_bag(path, loads(text, 'g.yaml'))
    assert [text.split(': ', 1)[1] for text in outcome.warnings] == [
        'topic /image is not in it, so there are no jobs of /camera',
        'ask starts with a service call, which a bag does not have: there are no jobs of it']
    nothing = """\
mddag: 1
nodes:
  - node: /camera
    callbacks: [{name: in, subscription: /i, period: 9ms, deadline: 5ms, execution_time: 1ms}]
"""
    with pytest.raises(BagError, match='none of the sources of g.yaml is in it: it has /chatter'):
        reschedule_bag(path, loads(nothing, 'g.yaml'))
    with pytest.raises(InputError, match='g.yaml:4: /camera:in declares no execution_time'):
        reschedule_bag(path, loads(nothing.replace(', execution_time: 1ms', ''), 'g.yaml'))


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_several_files(tmp_path, storage):
    """As `ros2 bag record --max-bag-size` splits; one may be missing, or metadata.yaml."""
    suffix = 'db3' if storage == StoragePlugin.SQLITE3 else 'mcap'
    path = tmp_path / 'drive'
    path.mkdir()
    for i, part in enumerate('ab'):
        stamps = [BEGIN + (10 * i + j) * 100 * MS for j in range(10)]
        write_bag(tmp_path / part, storage, stamps=stamps)
        shutil.copy(tmp_path / part / f'{part}.{suffix}', path / f'drive_{i}.{suffix}')
    metadata = (tmp_path / 'a' / 'metadata.yaml').read_text().replace(
        f'- a.{suffix}', f'- drive_0.{suffix}\n  - drive_1.{suffix}')
    metadata = metadata.replace('message_count: 11', 'message_count: 22')
    (path / 'metadata.yaml').write_text(metadata)
    bag = Bag(path, {'/points'})
    assert bag.warnings == []
    assert list(bag.stamps['/points'].header) == [BEGIN + i * 100 * MS for i in range(20)]
    (path / 'metadata.yaml').unlink()
    again = Bag(path, {'/points'})
    assert list(again.stamps['/points'].header) == list(bag.stamps['/points'].header)
    assert 'metadata.yaml is missing' in again.warnings[0]
    (path / 'metadata.yaml').write_text(metadata)
    (path / f'drive_1.{suffix}').unlink()
    half = Bag(path, {'/points'})
    assert len(half.stamps['/points'].header) == 10
    assert half.warnings == [f'{path}/drive_1.{suffix}: is no file: it is left out']
    (path / f'drive_0.{suffix}').unlink()
    assert is_ordinary(str(path))       # not a folder without a trace
    with pytest.raises(BagError, match='is no file: it is left out'):
        read_bag(path, loads(GRAPH, 'g.yaml'))


def test_messages_in_a_write_ahead_log_are_not_passed_over(tmp_path):
    """As a killed recorder leaves them: the bag needs repair."""
    path = write_bag(tmp_path / 'bag', StoragePlugin.SQLITE3)
    (path / 'bag.db3-wal').write_bytes(b'x')
    with pytest.raises(BagError, match=r'its last messages are in bag\.db3-wal .*: let ros2 bag '):
        Bag(path, {'/points'})


@pytest.mark.parametrize('text', [
    '', '[', '- 1', 'rosbag2_bagfile_information: 1', 'rosbag2_bagfile_information: {}',
    'rosbag2_bagfile_information: {relative_file_paths: []}',
    'rosbag2_bagfile_information: {relative_file_paths: [1]}', '\x00', '[' * 5000,
    '!!python/object:os.system x'])
def test_wrong_metadata(tmp_path, text):
    path = write_bag(tmp_path / 'bag')
    (path / 'metadata.yaml').write_text(text)
    with pytest.raises(BagError) as caught:
        Bag(path, {'/points'})
    assert str(caught.value).startswith(f'{path}/metadata.yaml: this is no metadata of a bag (')
    assert '\n' not in str(caught.value)


def test_hostile_files(tmp_path):
    empty = tmp_path / 'empty.db3'
    sqlite3.connect(empty).execute('CREATE TABLE a(b)').connection.close()
    for content in (b'SQLite format 3\0' * 100, None):
        if content is not None:
            empty.write_bytes(content)
        with pytest.raises(BagError, match='its SQLite storage cannot be read'):
            Bag(empty, {'/points'})
    with pytest.raises(BagError, match='is no file'):
        Bag(tmp_path / 'gone', {'/points'})
    (tmp_path / 'folder').mkdir()
    with pytest.raises(BagError, match='there is neither metadata.yaml nor a bag file'):
        Bag(tmp_path / 'folder', {'/points'})


def test_on_the_command_line(tmp_path, call):
    path = write_bag(tmp_path / 'bag')
    graph = tmp_path / 'g.yaml'
    graph.write_text(BY_HEADER)
    times = tmp_path / 'times.json'
    times.write_text('{"/lidar": {"/lidar:in": 2000, "/detector:detect": 16000}, '
                     '"/control": {"/control:tick": 100}}')
    status, out, err = call('replay', path, graph, '--reschedule', '--fail-on-miss')
    assert (status, err) == (0, '')
    assert '/lidar: 10 jobs from the header stamp of /points' in out.splitlines()
    assert 'policy rad, 2 workers' in out
    status, out, _ = call('replay', path, graph, '--reschedule', '--execution-times', times,
                          '--fail-on-miss')
    assert status == 1
    assert '9 late' in out     # the last one is open at the end


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_relative_topic_is_that_below_the_root(tmp_path, storage):
    relative = write_bag(tmp_path / 'relative', storage, topic='points')
    absolute = write_bag(tmp_path / 'absolute', storage)
    outcomes = [reschedule_bag(bag, loads(GRAPH)) for bag in (relative, absolute)]
    assert [outcome.warnings for outcome in outcomes] == [[], []]
    assert outcomes[0].result()['dags'] == outcomes[1].result()['dags']
    assert Bag(relative, ['/points']).topics == {'/points', '/chatter'}


def test_a_folder_says_what_is_in_it(tmp_path):
    """A folder with a trace of this executor is no bag, and an empty one is nothing."""
    (tmp_path / 'run').mkdir()
    with TraceFile(tmp_path / 'run' / 'a.mcap') as file:
        file.add('caret_init', BEGIN, 1, 1, 5, 'jazzy')
    assert not is_ordinary(str(tmp_path / 'run'))
    assert is_ordinary(str(write_bag(tmp_path / 'bag')))
    # also where the recorder of a bag left its metadata next to it
    (tmp_path / 'run' / 'metadata.yaml').write_text('{}')
    assert not is_ordinary(str(tmp_path / 'run'))
    # nor is what is left of one a bag, however little it is
    data = (tmp_path / 'run' / 'a.mcap').read_bytes()
    for size in (len(data) // 2, 60, 45):
        (tmp_path / 'run' / 'a.mcap').write_bytes(data[:size])
        assert not is_ordinary(str(tmp_path / 'run' / 'a.mcap'))


def test_a_folder_is_looked_through_once(tmp_path, monkeypatch):
    path = write_bag(tmp_path / 'bag', StoragePlugin.MCAP)
    (path / 'metadata.yaml').unlink()
    opened = []

    class Counted(TraceReader):

        def __init__(self, path):
            opened.append(path)
            super().__init__(path)

    monkeypatch.setattr('mddag_executor.replay.bags.TraceReader', Counted)
    assert is_ordinary(str(path)) and opened == [str(path / 'bag.mcap')]


@pytest.mark.parametrize('mode', [0, 0o444])
def test_a_folder_that_may_not_be_read(tmp_path, monkeypatch, mode):
    path = write_bag(tmp_path / 'bag')
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o755)
    path.chmod(mode)
    user = os.geteuid()
    os.seteuid(user or 65534)       # root may read everything
    try:
        with pytest.raises((TraceError, BagError), match='bag.*Permission denied'):
            open_recording('bag', loads(GRAPH))
    finally:
        os.seteuid(user)
        path.chmod(0o755)

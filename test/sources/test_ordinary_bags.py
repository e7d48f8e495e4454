# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Ordinary bags as releases: all that `ros2 bag record` can write, and damage."""

from contextlib import closing
import errno
import gc
import os
import random
import re
import shutil
import sqlite3
import struct
import tracemalloc

from mcap.writer import Writer as McapWriter
from mddag_executor import open_recording, replay, ReplayError, reschedule
from mddag_executor.errors import InputError
from mddag_executor.recording.recording import Recording
from mddag_executor.simulate import START
from mddag_executor.sources.bag_run import read_bag
from mddag_executor.sources.bags import Bag, UNKNOWN
from mddag_executor.sources.kinds import BagError, is_ordinary
from mddag_executor.trace import blocks, times, TraceError, TraceFile
from mddag_executor.whatif.bags_reschedule import _drawn, reschedule_bag
from msg_graph import loads
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode
import zstandard

from .bags import (
    BEGIN,
    BY_HEADER,
    GRAPH,
    HEADER,
    header,
    MCAP,
    messages,
    MS,
    SQLITE,
    STRING,
    TOPICS,
    write,
    write_bag,
)

S = 1_000 * MS
TASK_SET = loads(GRAPH, 'g.yaml')


def responses(outcome):
    return outcome.result()['dags']['/lidar']['sinks']['/detector:detect']['response_ns']


def test_the_schedule_is_that_of_the_core(tmp_path):
    """On one worker scans and timer get into each other's way."""
    bag = write_bag(tmp_path / 'bag')
    run = open_recording(bag, TASK_SET)
    assert np.bincount(run.releases['dag']).tolist() == [10, 31]
    outcome = reschedule_bag(bag, TASK_SET, workers=1)
    assert reschedule(run, workers=1).decisions == outcome.decisions
    first = [(time - BEGIN, vertex) for time, kind, _, _, vertex, _ in outcome.log
             if kind == START][:4]
    assert first == [(0, 2), (5 * MS, 0), (6 * MS, 1), (30 * MS, 2)]
    slow = reschedule_bag(bag, TASK_SET, workers=1, dispatch_overhead=MS)
    begun = [time - BEGIN for time, kind, *_ in slow.log if kind == START]
    assert begun[:3] == [0, 5 * MS, 7 * MS]
    given = reschedule_bag(bag, TASK_SET, times=[[2 * MS, 4 * MS], [MS]])
    assert set(responses(given).values()) == {6 * MS}
    drawn = GRAPH.replace('execution_time: 8ms', 'execution_time: {quantiles_us: [1000, 9000]}')
    seeds = [reschedule_bag(bag, loads(drawn, 'g.yaml'), seed=seed).log for seed in (1, 1, 2)]
    assert seeds[0] == seeds[1] != seeds[2]
    for wrong, says in ((lambda: open_recording(bag), 'give the GRAPH'),
                        (lambda: replay(bag, TASK_SET), 'no callback ran: reschedule it')):
        with pytest.raises(ReplayError, match=says):
            wrong()


def test_only_the_load_of_a_bag_is_kept(tmp_path):
    """A long bag's releases took half of the memory of its schedule before."""
    bag = write_bag(tmp_path / 'bag')
    outcome = reschedule_bag(bag, TASK_SET)
    kept = [each for each in gc.get_objects()
            if isinstance(each, Recording) and each.name == str(bag) and len(each.releases)]
    assert not kept
    assert outcome.result()['dags']['/lidar']['jobs'] == 10


def test_stamps_that_can_not_be_are_said(tmp_path):
    stamps = [BEGIN + i * 100 * MS for i in range(10)]
    stamps[3] = 0
    stamps[4] += 50 * MS
    path = write_bag(tmp_path / 'bag', stamps=stamps)
    outcome = reschedule_bag(path, loads(BY_HEADER, 'g.yaml'))
    assert outcome.warnings == [
        f'{path}: 2 of 10 messages of /points (std_msgs/msg/Header) without a header stamp, or '
        'with one after the arrival or years before: released at the arrival']
    assert responses(outcome)['min'] == 9 * MS
    for old, new, says in (('/points', '/chatter', 'without a header stamp'),
                           ('header_stamp', 'source_timestamp',
                            '10 of 10 messages .*without a publication time')):
        warning, = reschedule_bag(path, loads(BY_HEADER.replace(old, new), 'g.yaml')).warnings
        assert re.search(says, warning)


def test_header_stamps_of_a_bag_that_was_played_are_named(tmp_path):
    path = write_bag(tmp_path / 'bag', stamps=[BEGIN - 20 * S + i * 100 * MS for i in range(10)])
    result = reschedule_bag(path, loads(BY_HEADER, 'g.yaml')).result()
    assert result['notes'][0] == (
        '/lidar: 10 jobs from the header stamp of /points, 20 s before the arrival: was another '
        'bag played when it was recorded?')


def test_what_is_not_in_the_bag_is_said(tmp_path):
    path = write_bag(tmp_path / 'bag')
    camera = """\
  - node: /camera
    callbacks:
      - {name: in, subscription: /image, period: 9ms, deadline: 5ms, execution_time: 1ms}
"""
    outcome = reschedule_bag(path, loads(GRAPH + camera + (
        '      - {name: ask, service: /s, period: 9ms, deadline: 5ms, execution_time: 1ms, '
        'dag: ask}'), 'g.yaml'))
    assert [text.split(': ', 1)[1] for text in outcome.warnings] == [
        'topic /image is not in it, so there are no jobs of /camera',
        'ask starts with a service call, which a bag does not have: there are no jobs of it']
    nothing = 'mddag: 1\nnodes:\n' + camera
    with pytest.raises(BagError, match='none of the sources of g.yaml is in it: it has /chatter'):
        reschedule_bag(path, loads(nothing, 'g.yaml'))
    with pytest.raises(InputError, match='g.yaml:5: /camera:in declares no execution_time'):
        reschedule_bag(path, loads(nothing.replace(', execution_time: 1ms', ''), 'g.yaml'))


# --- what users record ---------------------------------------------------------------------------

TYPES = {topic: kind for topic, (kind, _) in TOPICS.items()}


BAGS = {
    '-s mcap': (MCAP,),
    '-s mcap of Iron': (MCAP, None, 8),
    '-s mcap --compression-mode message': (MCAP, CompressionMode.MESSAGE),
    '-s mcap --compression-mode file': (MCAP, CompressionMode.FILE),
    '-s sqlite3': (SQLITE,),
    '-s sqlite3 of Humble': (SQLITE,),
    '-s sqlite3 --compression-mode message': (SQLITE, CompressionMode.MESSAGE),
    '-s sqlite3 --compression-mode file': (SQLITE, CompressionMode.FILE),
}
OF_USERS = 'mddag: 1\nnodes:\n  - node: /all\n    callbacks:\n' + ''.join(
    f'      - {{name: c{i}, subscription: /{topic.lstrip("/")}, period: 100ms, '
    f'release_from: {"header_stamp" if topic[0] == "/" else "arrival"}, deadline: 50ms, '
    f'execution_time: 1ms, dag: d{i}}}\n' for i, topic in enumerate(TOPICS))


def split_bag(folder, kind):
    """Make a bag of two files, as `ros2 bag record --max-bag-size` splits; return both."""
    bag, names = folder / 'drive', []
    bag.mkdir()
    for part in range(2):
        write(folder / f'part{part}', TYPES, messages(part), *BAGS[kind])
        file, = (path for path in (folder / f'part{part}').iterdir() if path.suffix != '.yaml')
        names.append(f'drive_{part}{"".join(file.suffixes)}')
        shutil.move(file, bag / names[-1])
        if kind.endswith('Humble'):
            with closing(sqlite3.connect(bag / names[-1])) as storage:
                storage.execute('DROP TABLE message_definitions')
    text = (folder / 'part0' / 'metadata.yaml').read_text()
    line = next(line for line in text.splitlines() if '- part0' in line)
    both = '\n'.join(line[:line.index('-')] + f'- {name}' for name in names)
    (bag / 'metadata.yaml').write_text(text.replace(line, both, 1).replace(
        'message_count: 50\n', 'message_count: 100\n'))
    return bag, [bag / name for name in names]


@pytest.mark.parametrize('kind', BAGS)
def test_each_kind_of_bag(tmp_path, kind):
    bag, _ = split_bag(tmp_path, kind)
    outcome = reschedule_bag(bag, loads(OF_USERS, 'g.yaml'))
    assert outcome.warnings == []
    assert [dag['jobs'] for dag in outcome.result()['dags'].values()] == [20] * len(TOPICS)
    read = Bag(bag, {f'/{topic.lstrip("/")}' for topic in TOPICS})
    assert read.topics == read.stamps.keys()
    for topic, stamps in read.stamps.items():
        assert list(stamps.arrival) == [BEGIN + (i * 100 + 5) * MS for i in range(20)]
        assert list(stamps.header) == [
            UNKNOWN if topic == '/chatter' else BEGIN + i * 100 * MS for i in range(20)], topic


@pytest.mark.parametrize('kind', ['-s mcap', '-s sqlite3'])
def test_files_that_are_missing_are_said(tmp_path, kind):
    bag, files = split_bag(tmp_path, kind)
    metadata = (bag / 'metadata.yaml').read_text()
    (bag / 'metadata.yaml').unlink()
    again = Bag(bag, {'/rosout'})
    assert len(again.stamps['/rosout'].header) == 20
    assert 'metadata.yaml is missing' in again.warnings[0]
    (bag / 'metadata.yaml').write_text(metadata)
    files[1].unlink()
    half = Bag(bag, {'/rosout'})
    assert len(half.stamps['/rosout'].header) == 10
    assert half.warnings == [f'{files[1]}: is not a file: it is left out']
    files[0].unlink()
    assert is_ordinary(str(bag))       # not a folder without a trace
    with pytest.raises(BagError, match='is not a file: it is left out'):
        read_bag(bag, loads(OF_USERS, 'g.yaml'))


def test_on_the_command_line(tmp_path, graph, call):
    path, times = write_bag(tmp_path / 'bag'), tmp_path / 'times.json'
    graph.write_text(BY_HEADER)
    times.write_text('{"/lidar": {"/lidar:in": 2000, "/detector:detect": 16000}, '
                     '"/control": {"/control:tick": 100}}')
    arguments = 'replay', path, graph, '--reschedule', '--fail-on-miss'
    status, out, err = call(*arguments)
    assert (status, err) == (0, '')
    assert '/lidar: 10 jobs from the header stamp of /points' in out.splitlines()
    assert 'policy rad, 2 workers' in out
    status, out, _ = call(*arguments, '--execution-times', times)
    assert status == 1 and '9 late' in out     # the last one is open at the end


# --- damage --------------------------------------------------------------------------------------

def test_hostile_files(tmp_path):
    other, text, folder = (tmp_path / name for name in ('other.db3', 'text.db3', 'folder'))
    sqlite3.connect(other).execute('CREATE TABLE a(b)').connection.close()
    text.write_bytes(b'SQLite format 3\0' * 100)
    folder.mkdir()
    killed = write_bag(tmp_path / 'killed', SQLITE)
    (killed / 'killed.db3-wal').write_bytes(b'x')

    def refuse(path, says):
        with pytest.raises(BagError, match=says) as caught:
            Bag(path, {'/points'})
        assert '\n' not in str(caught.value)

    for path, says in ((other, 'its SQLite storage cannot be read'),
                       (text, 'its SQLite storage cannot be read'),
                       (tmp_path / 'gone', 'is not a file'),
                       (killed, r'its last messages are in killed\.db3-wal .*: let ros2 bag '),
                       (folder, 'there is neither metadata.yaml nor a bag file')):
        refuse(path, says)
    files = 'rosbag2_bagfile_information: {relative_file_paths: %s}'
    for metadata in ('', '[', '- 1', files % '[]', files % '[[]]', '\x00', '[' * 900,
                     '!!python/object:os.system x'):
        (folder / 'metadata.yaml').write_text(metadata)
        refuse(folder, r'/metadata.yaml: this is not the metadata of a bag \(')


def test_a_folder_says_what_is_in_it(tmp_path):
    """A folder with a trace of this executor is not a bag, and an empty one is nothing."""
    folder = tmp_path / 'run'
    folder.mkdir()
    with TraceFile(folder / 'a.mcap') as file:
        file.add('caret_init', BEGIN, 1, 1, 5, 'jazzy')
    assert not is_ordinary(str(folder))
    for storage in (MCAP, SQLITE):
        assert is_ordinary(str(write_bag(tmp_path / storage.name, storage)))
    # also where the recorder of a bag left its metadata next to it
    (folder / 'metadata.yaml').write_text('{}')
    assert not is_ordinary(str(folder))
    # nor is what is left of one a bag, however little it is
    data = (folder / 'a.mcap').read_bytes()
    for size in (len(data) // 2, 60, 45):
        (folder / 'a.mcap').write_bytes(data[:size])
        assert not is_ordinary(str(folder / 'a.mcap'))


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
            open_recording('bag', TASK_SET)
    finally:
        os.seteuid(user)
        path.chmod(0o755)


N = 40                  # messages, 25 ms apart: 1 s
ARRIVALS = [BEGIN + k * 25 * MS for k in range(N)]
TIMER = 30 * MS


def rescheduled(path, arrivals, storage=MCAP):
    """Reschedule a bag of scans; there may not be more than each message warrants."""
    outcome = reschedule_bag(write(path, {'/points': HEADER}, [
        ('/points', arrival, header(BEGIN)) for arrival in arrivals], storage), TASK_SET)
    jobs = [dag['jobs'] for dag in outcome.result()['dags'].values()]
    assert jobs[0] <= N
    # a message further away is there alone: one more stretch of time, with one job at most
    assert jobs[1] <= (1 * S + times.GAP_NS) // TIMER + 2
    assert len(outcome.decisions) <= 2 * sum(jobs)
    assert sum(kind == START for _, kind, *_ in outcome.log) <= 2 * jobs[0] + jobs[1]
    return outcome


@pytest.mark.parametrize(('storage', 'odd'), [(MCAP, 2**62), (SQLITE, 2**63 - 1)])
def test_a_message_at_a_time_that_cannot_be(tmp_path, storage, odd):
    sound = rescheduled(tmp_path / 'sound', ARRIVALS[:20] + ARRIVALS[21:], storage)
    outcome = rescheduled(tmp_path / 'odd', ARRIVALS[:20] + [odd] + ARRIVALS[21:], storage)
    assert [line.split(': ', 1)[1] for line in outcome.warnings] == [
        'left out: 1 message at an impossible time']
    assert outcome.result()['dags'] == sound.result()['dags']


@pytest.mark.parametrize('storage', [MCAP, SQLITE])
def test_stamps_of_each_byte_order_and_of_short_messages(tmp_path, storage):
    """A stamp that cannot be read is unknown; one such message is at the end of the file."""
    plain = b'\0\1\0\0' + struct.pack('<iI', 5, 6) + bytes(8)
    contents = [plain, b'\0\0\0\0' + struct.pack('>iI', 7, 8) + bytes(8), b'\0\0', b'', plain[:11],
                b'\0\2' + plain[2:], b'\1' + plain[1:], plain[:4] + struct.pack('<iI', -1, 0),
                plain[:4] + struct.pack('<iI', 1, 10 ** 9), plain[:12], plain[:6]]
    path = write(tmp_path / 'bag', {'/points': HEADER}, [
        ('/points', BEGIN + k, content) for k, content in enumerate(contents)], storage)
    bag = Bag(path, {'/points'})
    assert bag.warnings == [] and list(bag.stamps['/points'].arrival) == [
        BEGIN + k for k in range(len(contents))]
    assert list(bag.stamps['/points'].header) == [
        5_000_000_006, 7_000_000_008, -1, -1, -1, -1, -1, -1, -1, 5_000_000_006, -1]


@pytest.mark.parametrize('storage', [MCAP, SQLITE])
def test_messages_are_kept_in_the_order_of_the_file(tmp_path, storage):
    """A rerun delivers messages of several topics in that order, even those of one time."""
    wanted = [(('/b', '/a', '/c')[k % 3], BEGIN + k // 4) for k in range(60)]
    path = write(tmp_path / 'bag', dict.fromkeys(('/a', '/b', '/c'), HEADER), [
        (topic, time, bytes(8)) for topic, time in wanted], storage)
    kept = []
    Bag(path, {'/a', '/b'}, keep=lambda topic, time, *_: kept.append((topic.name, time)))
    assert kept == [(topic, time) for topic, time in wanted if topic != '/c']


@pytest.mark.parametrize('storage', [MCAP, SQLITE])
def test_what_the_receiver_of_messages_raises_is_no_damage(tmp_path, storage):
    def keep(*message):
        raise OSError(errno.ENOSPC, 'No space left on device')

    with pytest.raises(OSError, match='No space left on device'):
        Bag(write_bag(tmp_path / 'bag', storage), ['/points'], keep=keep)


def test_a_pause_has_no_jobs_of_timers(tmp_path):
    outcome = rescheduled(
        tmp_path / 'paused', ARRIVALS[:20] + [time + 3600 * S for time in ARRIVALS[20:]])
    assert outcome.warnings == []
    assert 'none in 1 pause of over a minute' in outcome.notes[1]
    tick = outcome.result()['dags']['/control']['jobs']
    assert tick <= 2 * (N * 25 * MS // 2 // TIMER + 1)


@pytest.mark.parametrize('storage', [MCAP, SQLITE])
def test_a_clock_that_was_set_back_is_said(tmp_path, storage):
    def warnings(*seconds):
        path = tmp_path / str(len(seconds))
        write(path, {'/points': HEADER}, [
            ('/points', BEGIN + round(at * 1000) * MS, header(BEGIN)) for at in seconds], storage)
        return [text for text in Bag(path, ['/points']).warnings if 'set back' in text]

    assert warnings(0, 1, 0.5, 2) == []
    assert warnings(0, 100, 97.5, 98, 99) == [
        f'{tmp_path / "5"}: the clock was set back by 2.5 s while it was recorded: messages '
        'from before and after that are judged as if they were from one time']


@pytest.mark.parametrize('topics', [(), ('/a',), ('/rare',), ('/a', '/b', '/rare')])
def test_the_clock_was_not_set_back_in_chunks_of_seconds(tmp_path, topics):
    """The indexes of a chunk are by topic, and not all chunks are unpacked."""
    def warnings(set_back):
        path = tmp_path / 'a.mcap'
        with open(path, 'wb') as file:
            writer = McapWriter(file, chunk_size=400)
            writer.start(profile='ros2')
            schema = writer.register_schema('std_msgs/msg/Header', 'ros2msg', b'')
            channels = [writer.register_channel(topic, 'cdr', schema)
                        for topic in ('/a', '/b', '/rare')]
            for i in range(100):
                at = BEGIN + i * 500 * MS - (set_back if i >= 50 else 0)
                writer.add_message(channels[i % 2 if i % 30 else 2], at, bytes(20), at)
            writer.finish()
        return Bag(path, topics).warnings

    assert warnings(0) == []
    text, = warnings(5000 * MS)
    assert 'the clock was set back by 4.5 s' in text


@pytest.mark.parametrize('storage', [MCAP, SQLITE])
def test_messages_that_are_years_from_the_others_are_left_out(tmp_path, storage):
    """Until the first /clock, a recorder with --use-sim-time stamps messages with 0."""
    sound = rescheduled(tmp_path / 'sound', ARRIVALS[2:], storage)
    outcome = rescheduled(tmp_path / 'odd', [0, 0, *ARRIVALS[2:]], storage)
    warning, = outcome.warnings
    assert ': left out: 2 messages more than a year from the others, the first at 0 ns (' in \
        warning
    assert outcome.result()['dags'] == sound.result()['dags']
    assert outcome.result()['duration_ns'] == sound.result()['duration_ns']
    simulated = rescheduled(tmp_path / 'simulated', [time - BEGIN for time in ARRIVALS], storage)
    assert simulated.warnings == []


@pytest.mark.parametrize('metadata', ['', 'rosbag2_bagfile_information:\n', '[' * 100_000])
def test_damaged_metadata_is_as_if_it_were_missing(tmp_path, metadata):
    path = write_bag(tmp_path / 'bag')
    (path / 'metadata.yaml').write_text(metadata)
    warning, = (outcome := reschedule_bag(path, TASK_SET)).warnings
    assert 'metadata.yaml: this is not the metadata of a bag (' in warning
    assert 'NoneType' not in warning and warning.endswith(': used 1 bag file from the folder')
    assert outcome.result()['dags']['/lidar']['jobs'] == 10


def test_messages_that_metadata_has_and_the_files_have_not_are_said(tmp_path):
    path = write_bag(tmp_path / 'bag')
    metadata = path / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 11', 'message_count: 500'))
    warning, = reschedule_bag(path, TASK_SET).warnings
    assert warning.endswith(
        ': it has 11 messages, but metadata.yaml says 500: some may be missing')


@pytest.mark.parametrize('topics, unpacked', [((), 0), (('/points',), 1), (('/chatter',), 6)])
def test_chunks_without_the_topics_are_not_unpacked(tmp_path, monkeypatch, topics, unpacked):
    """The times of their messages are in the index."""
    path, calls = tmp_path / 'a.mcap', []
    with open(path, 'wb') as file:
        writer = McapWriter(file, chunk_size=400)
        writer.start('ros2', '')
        schema = writer.register_schema(STRING, 'ros2msg', b'string data')
        channels = [writer.register_channel(topic, 'cdr', schema)
                    for topic in ('/chatter', '/points')]
        for i, arrival in enumerate(ARRIVALS[:20]):
            writer.add_message(channels[i == 7], arrival, bytes(100), arrival)
        writer.finish()
    decompress = blocks._decompress
    monkeypatch.setattr(blocks, '_decompress', lambda *args: calls.append(decompress(*args)))
    bag = Bag(path, topics)
    assert (bag.count, bag.start, bag.end, bag.warnings) == (20, ARRIVALS[0], ARRIVALS[19], [])
    assert bag.topics == {'/chatter', '/points'} and len(calls) == unpacked
    assert [len(bag.stamps[topic].arrival) for topic in topics] == [
        1 if topic == '/points' else 19 for topic in topics]


def test_a_file_that_becomes_huge_is_not_unpacked(tmp_path):
    path = tmp_path / 'bag.mcap.zstd'
    path.write_bytes(zstandard.compress(bytes(100 << 20)))
    with pytest.raises(BagError, match='unpacked it is more than 1000 times as large'):
        Bag(path, ())


def test_views_are_not_read(tmp_path):
    """Such a view has no end."""
    path = tmp_path / 'a.db3'
    with closing(sqlite3.connect(path)) as storage:
        storage.execute('CREATE TABLE topics(id, name, type, serialization_format)')
        storage.execute('CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL '
                        'SELECT id + 1 FROM n) SELECT id, 1 topic_id, id timestamp, 0 data FROM n')
    with pytest.raises(BagError, match='it has views'):
        Bag(path, ())


ROWS = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data{computed});
INSERT INTO topics VALUES (1, '/points', 'std_msgs/msg/Header', 'cdr');
WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n WHERE id < {count})
INSERT INTO messages(id, topic_id, timestamp{data}) SELECT id, 1, id{zeros} FROM n;
"""


def storage_of(path, count=2000, computed=''):
    """Write the SQLite file of a bag, and return its bytes."""
    with closing(sqlite3.connect(path)) as storage:
        storage.execute('PRAGMA page_size = 512')
        storage.executescript(ROWS.format(
            count=count, computed=computed, data='' if computed else ', data',
            zeros='' if computed else ", x'00'"))
    return bytearray(path.read_bytes())


def test_what_a_file_computes_is_not_read(tmp_path):
    """Each message would have a gigabyte."""
    storage_of(tmp_path / 'a.db3', computed=' AS (zeroblob(1000000000))')
    with pytest.raises(BagError, match='it has computed columns'):
        Bag(tmp_path / 'a.db3', {'/points'})


def test_pages_that_are_there_many_times_are_not_read_for_ever(tmp_path):
    """All pointers of a page are to one page, and those of this to another one, ten times."""
    path = tmp_path / 'a.db3'
    data = storage_of(path)
    pages = [data[at:at + 512] for at in range(0, len(data), 512)]
    inner = [number for number, page in enumerate(pages, 1) if number > 1 and page[0] == 5]

    def pointing_to(page, child):
        """Return a page of a table whose children are all the same one."""
        page, n = bytearray(page), struct.unpack('>H', page[3:5])[0]
        for place in [8, *struct.unpack(f'>{n}H', page[12:12 + 2 * n])]:
            page[place:place + 4] = struct.pack('>I', child)
        return page

    child = next(number for number, page in enumerate(pages, 1) if page[0] == 13 and number > 3)
    for _ in range(10):
        pages.append(pointing_to(pages[inner[0] - 1], child))
        child = len(pages)
    for number in inner:
        pages[number - 1] = pointing_to(pages[number - 1], child)
    data = bytearray(b''.join(pages))
    data[28:32] = struct.pack('>I', len(pages))
    path.write_bytes(data)
    for topics, says in (((), 'it would take longer than any bag of its size'),
                         ({'/points'}, 'its messages are larger than itself')):
        bag = Bag(path, topics)
        assert f'its SQLite storage cannot be read ({says}): used' in bag.warnings[0]
        assert 2000 < bag.count < 1_000_000


def test_a_topic_with_many_types_is_not_read_for_ever(tmp_path):
    """Each would be parsed."""
    path = tmp_path / 'a.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file)
        writer.start()
        for number in range(300):
            schema = writer.register_schema(
                f'a/msg/B{number}', 'ros2msg', b'int32 a\n' * 1000)
            channel = writer.register_channel('/points', 'cdr', schema)
            writer.add_message(channel, BEGIN, bytes(20), BEGIN)
        writer.finish()
    with pytest.raises(BagError, match='the definitions of its message types are too large'):
        Bag(path, {'/points'})


def test_a_file_that_metadata_names_twice_is_read_once(tmp_path):
    path = write_bag(tmp_path / 'bag', MCAP)
    metadata = path / 'metadata.yaml'
    name = next(each.name for each in path.iterdir() if each.name != 'metadata.yaml')
    metadata.write_text(
        f'rosbag2_bagfile_information: {{relative_file_paths: [{name}, {name}]}}\n')
    assert Bag(path, {'/points'}).count == 11


GRAPH_OF_DRAWN = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: a, subscription: /in, period: 10ms, publishes: [/out], execution_time: 1us}
      - name: b
        subscription: /out
        deadline: 5ms
        execution_time: {quantiles_us: [1, 2, 3]}
"""


def test_drawn_execution_times_take_no_more_memory_than_their_table():
    dag, = loads(GRAPH_OF_DRAWN, 'g.yaml').dags
    tracemalloc.start()
    try:
        drawn = _drawn(dag, 20_000, random.Random(1))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert drawn.shape == (20_000, 2) and drawn[:, 0].tolist() == [1000] * 20_000
    assert 1000 < np.median(drawn[:, 1]) < 3000
    assert peak < 1.5 * drawn.nbytes

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Damaged and hostile files: a prefix of the events and one warning, or a one-line error.

The sample has several chunks, each with a definition that the ones before do not have, so every
way to lose or to mistake one shows.
"""

import os
import random
import struct
import zlib

import lz4.frame
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mddag_executor.trace import records, TraceError, TraceReader
from mddag_executor.trace.schema import EVENTS
from mddag_executor.trace.trace_file import written
import pytest
import zstandard

from ..conftest import run_program
from . import helpers
from .helpers import read, read_back, records_of, write_chunks

SIZES = [3, 4, 1, 6]
KINDS = ['ros2:callback_start', 'mddag:drop', 'ros2:rmw_take', 'ros2:rcl_node_init',
         'ros2:callback_end', 'mddag:dispatch']
HEADER_END = 8 + 9 + 4 + len('ros2') + 4 + len('mddag_executor')


@pytest.fixture(scope='module')
def sample(tmp_path_factory):
    """Return a finished file and what was recorded in each of its chunks."""
    path = tmp_path_factory.mktemp('sample') / 'a.mcap'
    recorded = [helpers.sample(EVENTS[KINDS[number // 2 % len(KINDS)]], number)
                for number in range(sum(SIZES))]
    chunks = []
    for size in SIZES:
        chunks.append(recorded[:size])
        recorded = recorded[size:]
    write_chunks(path, chunks)
    return path.read_bytes(), [read_back(chunk) for chunk in chunks]


def check(path, data, chunks, number, warns=False):
    """
    Check that a changed file gives a prefix, and return of how many chunks.

    Every third one is read in the order of time as well.  A warning says which part is missing,
    or, with ``warns``, that a part may be missing.
    """
    path.write_bytes(data)
    results = []
    for in_time_order in (False, True)[:1 + (number % 3 == 0)]:
        try:
            events, warnings = read(path, in_time_order)
        except TraceError as error:
            assert str(error).startswith(f'{path}: ') and '\n' not in str(error)
            results.append(-1)
            continue
        # the index of a chunk may become a message that cannot be decoded: one more warning
        assert len(warnings) in ((1,) if warns else (0, 1, 2))
        for text in warnings:
            assert text.startswith(f'{path}: ') and '\n' not in text
        prefix = []
        whole = 0
        while len(prefix) < len(events):
            prefix += chunks[whole]
            whole += 1
        assert events == prefix
        assert whole == len(chunks) or len(warnings) > 0
        results.append(whole)
    assert results[-1] <= results[0]
    return results[0]


def test_cut_at_every_byte(tmp_path, sample):
    data, chunks = sample
    path = tmp_path / 'a.mcap'
    ends = [end for opcode, _, end in records_of(data) if opcode == Opcode.CHUNK]
    for length in range(len(data)):
        found = check(path, data[:length], chunks, length, warns=True)
        assert found == (-1 if length < HEADER_END else sum(end <= length for end in ends))


def test_warnings_have_counts(tmp_path, sample):
    data, _ = sample
    path = tmp_path / 'a.mcap'
    chunk = [(start, end) for opcode, start, end in records_of(data) if opcode == Opcode.CHUNK][2]
    unread = len(data) - chunk[0]
    path.write_bytes(data[:chunk[0] + 20])
    assert read(path)[1] == [
        f'{path}: a record is cut off, or its length is wrong (at byte {chunk[0]}): read 2 chunks '
        'with 7 messages before it, ignored the last 20 bytes; the file has no index, so the loss '
        'is unknown']
    changed = bytearray(data)
    changed[chunk[1] - 10] ^= 1
    path.write_bytes(changed)
    text = read(path)[1][0]
    assert f': read 2 chunks with 7 messages before it, ignored the last {unread} bytes; ' \
           'the file says that it holds 4 chunks with 14 messages' in text
    path.write_bytes(data[:spans(data)[2][0]])
    assert read(path)[1] == [
        f'{path}: the file ends without a finish record (at byte {chunk[0]}): read 2 chunks with '
        '7 messages before it; the file has no index, so the loss is unknown']
    begin, end = spans(data)[3]
    padding = struct.pack('<BQ', 0x90, end - begin - 9) + bytes(end - begin - 9)
    path.write_bytes(data[:begin] + padding + data[end:])
    assert read(path)[1] == [
        f'{path}: events are missing or doubled: read 3 chunks with 8 messages; the file says '
        'that it holds 4 chunks with 14 messages']
    path.write_bytes(data[:-1])
    assert read(path)[1] == [f'{path}: the summary at the end is damaged or missing: read all of '
                             'the data, 4 chunks with 14 messages']


def test_flipped_bits(tmp_path, sample):
    data, chunks = sample
    path = tmp_path / 'a.mcap'
    in_summary = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX,
                  Opcode.FOOTER)
    where = {position: opcode for opcode, start, end in records_of(data)
             for position in range(start, end)}
    generator = random.Random(1)
    for position in range(len(data)):
        changed = bytearray(data)
        changed[position] ^= 1 << generator.randrange(8)
        is_summary = where.get(position) in in_summary      # which has a CRC
        found = check(path, bytes(changed), chunks, position, warns=is_summary)
        assert not is_summary or found == len(chunks)


def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    for path, says in (
            (tmp_path / 'pipe', 'is not a file: give the .mcap file itself'),
            ('/dev/zero', 'is not a file: give the .mcap file itself'),
            (tmp_path / 'missing/a.mcap', 'no such file or directory: check the path'),
            (tmp_path / ('x' * 1000), r'cannot be read \(.*\): check its name'),
            ('a\0b', 'is not a file name'),
            ('/proc/self/mem', r'/proc/self/mem: cannot be read \(Input/output error\)')):
        with pytest.raises(TraceError, match=says):
            TraceReader(path)
    if os.getuid() != 0:
        (tmp_path / 'secret').write_bytes(records.MAGIC)
        (tmp_path / 'secret').chmod(0)
        with pytest.raises(TraceError, match='Permission denied'):
            TraceReader(tmp_path / 'secret')


@pytest.mark.parametrize(('files', 'says'), [
    (['run.mcap', 'notes.txt'], 'is a folder: give the trace {}/run.mcap'),
    (['a.mcap', 'b.mcap'], 'is a folder: give the trace {}/a.mcap or another one in it'),
    (['ust/uid/1/metadata'], "is a folder that LTTng recorded to: make a trace of it with 'mddag "
     "import ctf'"),
])
def test_a_folder_says_what_is_in_it(tmp_path, files, says):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(TraceError) as error:
        TraceReader(tmp_path)
    assert str(error.value) == f'{tmp_path}: {says.format(tmp_path)}'


def spans(data):
    """Return where each chunk with its indexes begins and ends."""
    starts = [start for opcode, start, _ in records_of(data)
              if opcode in (Opcode.CHUNK, Opcode.DATA_END)]
    return list(zip(starts, starts[1:]))


def test_too_little_memory_for_a_chunk(tmp_path, sample, monkeypatch):
    data, chunks = sample
    path = tmp_path / 'a.mcap'
    path.write_bytes(data)
    pread = os.pread
    for number, (begin, _) in enumerate(spans(data)[:2]):
        def limited(file, length, position, begin=begin):
            if begin < position < begin + 100:      # the packed records, not the head
                raise MemoryError
            return pread(file, length, position)

        monkeypatch.setattr(os, 'pread', limited)
        events, warnings = read(path)
        assert events == [event for each in chunks[:number] for event in each]
        assert f'a chunk does not fit into the memory (at byte {begin})' in warnings[0]


def test_a_file_that_goes_away_or_shrinks(tmp_path, sample):
    data, chunks = sample
    path = tmp_path / 'a.mcap'
    path.write_bytes(data)
    reader = TraceReader(path)
    events = reader.events()
    assert next(events) == chunks[0][0]
    os.truncate(path, HEADER_END)
    rest = list(events)
    assert [chunks[0][0], *rest] == [event for chunk in chunks for event in chunk][:len(rest) + 1]
    path.write_bytes(data)
    reader = TraceReader(path)
    path.unlink()
    assert list(reader.events()) == [event for chunk in chunks for event in chunk]     # it is open


def prefixed(data):
    """Return bytes with their length in front."""
    return records.UINT32.pack(len(data)) + data


def chunk(content, **changes):
    """Return a chunk record around packed content, with some of its head changed."""
    head = {'size': 100, 'crc': 0, 'compression': 'zstd', 'length': len(content), **changes}
    return records.record(
        Opcode.CHUNK,
        struct.pack('<QQQI', 0, 0, head['size'], head['crc'])
        + prefixed(head['compression'].encode()) + struct.pack('<Q', head['length']) + content)


def definitions(text=EVENTS['ros2:callback_end'].text):
    """Return the records that make channel 1 one of callback_end."""
    schema = Schema(1, text.encode(), 'ros2msg', 'a')
    return written(schema) + channel('/trace/ros2/callback_end')


def channel(topic):
    """Return the record that makes channel 1 one of a topic."""
    return written(Channel(1, topic, 'cdr', {}, 1))


def message(fields):
    """Return a message record on channel 1."""
    return records.record(Opcode.MESSAGE, records.MESSAGE_HEAD.pack(1, 0, 1, 1)
                          + b'\0\1\0\0' + struct.pack('<qii', 1, 2, 3) + fields)


def hostile():
    """Return data sections that claim more than there is, or hold more than they say."""
    zeros = bytes(1 << 20)
    bomb = zstandard.ZstdCompressor().compress(zeros * 300)
    packer = zstandard.ZstdCompressor().compressobj(size=800 << 20)
    large_bomb = b''.join(packer.compress(zeros) for _ in range(800)) + packer.flush()
    compressor = zstandard.ZstdCompressor(write_content_size=False)
    unsized = compressor.compress(zeros * 300)
    window = zstandard.ZstdCompressionParameters(window_log=27, write_content_size=False)
    claims = b'\x28\xb5\x2f\xfd\xe0' + (1 << 40).to_bytes(8, 'little') + b'\1\0\0'
    lz4_bomb = lz4.frame.compress(zeros * 300)
    good = definitions() + message(bytes(8))

    def one(content, **changes):
        packed = zstandard.compress(content)
        return chunk(packed, size=len(content), crc=zlib.crc32(content), **changes)
    empty, hollow = struct.pack('<BQ', 0x90, 0), message(b'')
    full = bytes(64 << 20)

    def full_of(record):
        return one(good + record * (len(full) // len(record)))
    preamble = 'int64 timestamp\nint32 vpid\nint32 vtid\n'

    def of_schema(text):
        return one(definitions(preamble + text) + message(b'\xff' * 4))
    large_schema = definitions(preamble + 'int8 a\n#' + 'x' * 100_000)
    many_channels = b''.join(written(Channel(number, f'/trace/a/b{number}', 'cdr', {}, 1))
                             for number in range(2, 20_000))
    equal_messages = one(good + message(bytes(8)) * 200_000)
    return {     # each is read in less than 5 s
        'empty chunks': chunk(b'', size=0, compression='') * 60_000,
        'attachments': records.record(Opcode.ATTACHMENT, bytes(10)) * 60_000,
        'indexes of a chunk': one(good) + records.record(
            Opcode.MESSAGE_INDEX, b'\1\0' + bytes(4)) * 100_000,
        'chunks of equal messages': equal_messages * 20,
        'channels of a large schema': one(large_schema + many_channels),
        'chunks of a message': one(good) * 5_000,
        'record of 2**63 bytes': struct.pack('<BQ', 6, 2**63) + bytes(100),
        'record of 2**64-1 bytes': struct.pack('<BQ', 6, 2**64 - 1) + bytes(100),
        'message of 2**62 bytes': struct.pack('<BQ', 5, 2**62) + bytes(100),
        'schema of 2**40 bytes': struct.pack('<BQ', 3, 2**40) + bytes(100),
        'uncompressed size of 2**60': chunk(bomb, size=2**60),
        'uncompressed size of 255 MiB': chunk(bomb[:100], size=255 << 20),
        'records length of 2**60': chunk(bomb, length=2**60),
        'compression name of 2**32-1 bytes': records.record(
            Opcode.CHUNK, struct.pack('<QQQI', 0, 0, 1, 0) + b'\xff' * 40),
        'zstd bomb': chunk(large_bomb), 'zstd bomb of unknown size': chunk(unsized),
        'zstd frame of 2**40 bytes': chunk(claims),
        'zstd frame as it claims': chunk(claims, size=2**40),
        'zstd bomb with a large window': chunk(
            zstandard.ZstdCompressor(compression_params=window).compress(zeros * 300)),
        'lz4 bomb': chunk(lz4_bomb, compression='lz4'),
        'lz4 bomb of 255 MiB': chunk(lz4_bomb, compression='lz4', size=255 << 20),
        'no zstd': chunk(b'nonsense'), 'no lz4': chunk(b'nonsense', compression='lz4'),
        'empty zstd': chunk(b''), 'empty lz4': chunk(b'', compression='lz4'),
        'zstd of no bytes': chunk(b'', size=0), 'content but size 0': chunk(bomb, size=0),
        'unknown compression': chunk(bomb, compression='snappy' * 50),
        'record longer than its chunk': one(struct.pack('<BQ', 5, 2**63) + bytes(50)),
        'record cut off in its chunk': one(good + b'\x05\x01'),
        'schema longer than its record': one(records.record(
            Opcode.SCHEMA, b'\1\0' + b'\xff' * 20)),
        'channel changes': one(definitions() + channel('/other')),
        'short definition': one(records.record(Opcode.CHANNEL, b'\1')),
        'schemas of 70 MiB': one(b''.join(records.record(
            Opcode.SCHEMA, struct.pack('<H', number) + b'\1\0\0\0a\1\0\0\0b'
            + prefixed(zeros)) for number in range(1, 71))),
        'undefined channel': one(message(bytes(8))),
        'message without a head': one(definitions() + records.record(Opcode.MESSAGE, b'\1\0')),
        'string of 4 GiB': of_schema('string s\n'),
        'sequence of 4 G': of_schema('float64[] s\n'),
        'array of 10**12': of_schema('uint8[1000000000000] s\n'),
        'names of 10**6': of_schema(''.join(f'int8 a{number}\n' for number in range(30_000))),
        'a line of 10**6': one(definitions('int8 ' + 'a ' * 500_000) + message(bytes(8))),
        'a chunk in a chunk': one(chunk(bomb)),
        'a tail of zeros': one(good) + bytes(100_000),
        'a row of empty records': one(good) + empty * 10_000,
        'zeros': chunk(zstandard.compress(full), size=len(full)),
        'zeros in lz4': chunk(lz4.frame.compress(full), size=len(full), compression='lz4'),
        'a chunk of empty records': full_of(empty),
        'a chunk of undefined messages': full_of(hollow.replace(b'\1\0', b'\2\0', 1)),
    }


ODD_BUT_SOUND = {'chunks of a message', 'a row of empty records'}

READ_ALL = """
import resource, sys, time
from mddag_executor.trace import TraceError, TraceReader
resource.setrlimit(resource.RLIMIT_AS, (1400 << 20, 1400 << 20))
for path in sys.argv[1:]:
    for in_time_order in (False, True):
        start = time.process_time()
        try:
            reader = TraceReader(path)
            list(reader.events(sorted=in_time_order))
            text = reader.warnings[0] if reader.warnings else 'no warning'
        except TraceError as error:
            text = f'error {error}'
        assert time.process_time() - start < 5, path
        print(text)
    for read in (lambda reader: reader.messages({'/trace/ros2/callback_end'}),
                 lambda reader: reader.batches({'ros2:callback_end'}, as_table=False)):
        start = time.process_time()
        try:
            for _ in read(TraceReader(path)):
                pass
        except TraceError as error:
            assert str(error).startswith(path)
        assert time.process_time() - start < 5, path
print(int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0]) // 1024)
"""


@pytest.mark.parametrize('finished', [False, True])
def test_hostile_lengths(tmp_path, finished):
    start = records.MAGIC + records.record(Opcode.HEADER, prefixed(b'ros2') * 2)
    end = (records.record(Opcode.DATA_END, bytes(4))
           + records.record(Opcode.FOOTER, bytes(20)) + records.MAGIC) if finished else b''
    paths = []
    for name, data in hostile().items():
        paths.append(tmp_path / f'{name.replace("/", "-")}.mcap')
        paths[-1].write_bytes(start + data + end)
    texts = []
    for some in (paths[:8], paths[8:24], paths[24:]):       # a busy machine takes long for all
        *more, megabytes = run_program(READ_ALL, *some)[0].splitlines()
        texts += more
        assert int(megabytes) < 700     # the interpreter, and a chunk of at most 256 MiB, twice
    assert len(texts) == 2 * len(paths)
    for path, text in zip(paths, texts[::2]):
        if finished and path.stem in ODD_BUT_SOUND:
            assert text == 'no warning'
            continue
        assert text.startswith(str(path)), (path, text)
        assert len(text) < 600
    assert texts[::2] == texts[1::2]


def test_a_damaged_definition_loses_only_what_follows(tmp_path):
    """Outside of chunks too, and in a chunk whose CRC is right."""
    path = tmp_path / 'a.mcap'
    sound = definitions() + message(bytes(8)) * 3
    data = sound + channel('/other') + message(bytes(8))
    head = records.MAGIC + records.record(Opcode.HEADER, prefixed(b'ros2') * 2)
    for checked in (False, True):
        for content in (data, chunk(zstandard.compress(data), size=len(data), crc=zlib.crc32(
                data) if checked else 0)):
            path.write_bytes(head + content)
            events, (warning,) = read(path)
            is_used = content is data or checked
            assert len(events) == 3 * is_used
            assert f'changes its meaning (at byte {len(head)}' in warning or content is data
            assert f'with {3 * is_used} messages before it' in warning
    path.write_bytes(head + data)
    assert f'(at byte {len(head) + len(sound)})' in read(path)[1][0]


def test_records_may_be_longer_than_what_is_known_of_them(tmp_path, sample):
    """As later versions of MCAP may write them."""
    data, chunks = sample
    path, padded = tmp_path / 'a.mcap', data[:8]
    for opcode, start, end in records_of(data):
        if opcode == Opcode.DATA_END:
            break
        more = b'' if opcode == Opcode.MESSAGE else b'more'
        padded += records.record(opcode, data[start + 9:end] + more)
    padded += records.record(Opcode.DATA_END, bytes(7)) + records.record(
        Opcode.FOOTER, bytes(20)) + records.MAGIC
    path.write_bytes(padded)
    assert read(path) == ([event for chunk in chunks for event in chunk], [])


def test_two_files_in_one(tmp_path, sample):
    data, chunks = sample
    (tmp_path / 'a.mcap').write_bytes(data * 2)
    events, (warning,) = read(tmp_path / 'a.mcap')
    assert events == [event for chunk in chunks for event in chunk]
    assert f'another one had been appended to it (at byte {len(data)}): read 4 chunks' in warning


SPARSE = """
import resource, sys
from mddag_executor.trace import TraceReader
resource.setrlimit(resource.RLIMIT_AS, (1400 << 20, 1400 << 20))
reader = TraceReader(sys.argv[1])
print(len(list(reader.events())), *reader.warnings)
"""


def test_a_damaged_footer_is_not_believed(tmp_path, sample):
    """It says that the summary is nearly all of a large file."""
    path = tmp_path / 'a.mcap'
    path.write_bytes(sample[0])
    with open(path, 'r+b') as file:
        file.truncate(8 << 30)
        file.seek(0, os.SEEK_END)
        file.write(records.record(Opcode.FOOTER, struct.pack('<QQI', 40, 0, 1)) + records.MAGIC)
    text = run_program(SPARSE, path)[0]
    assert text.startswith('14 ') and 'read 4 chunks' in text


@pytest.mark.parametrize(('data', 'says'), [
    (b'version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n',
     "is a pointer to a file in Git LFS, not the file itself: get the file with 'git lfs pull'"),
    (b'#ROSBAG V2.0\n' + bytes(99),
     "is a bag of ROS 1: convert it, as with 'rosbags-convert'"),
])
@pytest.mark.parametrize('name', ['a.mcap', 'a.db3', 'a.bag'])
def test_other_files_are_named(tmp_path, monkeypatch, call, name, data, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(data)
    done = call('replay', name)
    assert (done.returncode, done.stderr) == (2, f'error: {name}: {says}\n')
    (tmp_path / 'bag').mkdir()
    (tmp_path / name).rename(tmp_path / 'bag' / name)
    (tmp_path / 'bag/metadata.yaml').write_text(
        f'rosbag2_bagfile_information: {{relative_file_paths: [{name}]}}')
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nnodes: [{node: /n, callbacks: [{name: c, subscription: /t, deadline: 1ms, '
        'period: 9ms, execution_time: 1ms}]}]\n')
    done = call('replay', 'bag', 'g.yaml', '--reschedule')
    assert (done.returncode, done.stderr.count('\n')) == (2, 1) and says in done.stderr

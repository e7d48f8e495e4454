# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A mutation fuzzer: thousands of damaged files through everything that reads them.

`make fuzz` runs it for as long as FUZZ_SECONDS says (ten minutes), with seeds that are printed.  A
file that failed is kept, and its seed makes it again.

What must hold for each: a result, or an error of one line; soon, and in bounded memory; and where
what is counted differs from the sound file's, there is a warning, and nothing is counted more
often than there (unless whole chunks were doubled).  A chunk that was changed under a right CRC
says something else: of those only the first three are asked.
"""

from itertools import chain
import os
from pathlib import Path
import random
import resource
import struct
import time
import zlib

from mcap.opcode import Opcode
from mcap.records import Chunk
from mddag_executor.errors import MddagError
from mddag_executor.replay import replay, reschedule
from mddag_executor.replay.bags import Bag
from mddag_executor.trace import import_ctf, records
from mddag_executor.trace.blocks import Content
from mddag_executor.trace.trace_file import written
from msg_graph import GraphError
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
import zstandard

from ..trace.ctf_session import session
from ..trace.helpers import records_of
from .helpers import MS, small, VirtualRun
from .test_ordinary_bags import write_bag

ROUNDS = 200
LONG_S = float(os.environ.get('FUZZ_SECONDS', '0'))
SLOW_S = 5.0
MEMORY = 400 << 20
INTERESTING = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1)


def rounds(seed):
    """Yield seeds: a fixed number of fixed ones, or fresh ones for as long as asked."""
    if not LONG_S:
        yield from range(seed * ROUNDS, (seed + 1) * ROUNDS)
        return
    first = random.SystemRandom().randrange(2**40)
    print(f'first seed {first}')
    end = time.monotonic() + LONG_S
    while time.monotonic() < end:
        yield first
        first += 1


def flip(data, rng):
    for _ in range(rng.choice((1, 1, 2, 8))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def cut(data, rng):
    del data[rng.randrange(len(data)):]


def stretch(data, rng):
    """Overwrite, take out, double or move a stretch."""
    first = rng.randrange(len(data))
    last = min(len(data), first + rng.choice((1, 2, 4, 8, 64, 1000)))
    data[first:last] = rng.choice((
        bytes(last - first), b'\xff' * (last - first), b'', rng.randbytes(last - first),
        bytes(data[first:last]) * 2, bytes(data[last:last + 64] + data[first:last])))


def length(data, rng):
    """Give a record, or a number at any place, a hostile value."""
    found = records_of(bytes(data))
    _, start, end = rng.choice(found)
    value = rng.choice((*INTERESTING, end - start, len(data) - start, rng.randrange(len(data))))
    where = start + 1 if rng.random() < 0.5 else rng.randrange(start, max(start + 1, end - 8))
    if where + 8 <= len(data):
        struct.pack_into('<Q', data, where, value % 2**64)


def row(data, rng):
    """Take out, double, move or rename whole records."""
    found = records_of(bytes(data))
    parts = [bytes(data[start:end]) for _, start, end in found]
    i, j = rng.randrange(len(parts)), rng.randrange(len(parts))
    what = rng.randrange(4)
    if what == 0:
        del parts[i]
    elif what == 1:
        parts.insert(j, parts[i])
    elif what == 2:
        parts[i], parts[j] = parts[j], parts[i]
    else:
        parts[i] = bytes([rng.randrange(256)]) + parts[i][1:]
    data[:] = records.MAGIC + b''.join(parts) + records.MAGIC


def summary(data, rng):
    """Damage what follows the data: the summary and the footer."""
    start = next(
        start for opcode, start, _ in records_of(bytes(data)) if opcode == Opcode.DATA_END)
    for _ in range(rng.choice((1, 3))):
        data[rng.randrange(start, len(data))] = rng.randrange(256)


STRUCTURAL = (
    flip, flip, cut, stretch, length, row, summary)


def inside(data, rng):
    """Change the records in a chunk, and give it the right size, CRC and compression again."""
    chunks = [span for span in records_of(bytes(data)) if span[0] == Opcode.CHUNK]
    _, start, end = rng.choice(chunks)
    chunk = Chunk.read(Content(bytes(data[start + records.RECORD.size:end])))
    content = bytearray(zstandard.decompress(chunk.data, chunk.uncompressed_size))
    for _ in range(rng.choice((1, 1, 4))):
        where = rng.randrange(len(content))
        if rng.random() < 0.5:
            content[where] = rng.randrange(256)
        elif where + 8 <= len(content):
            struct.pack_into('<Q', content, where, rng.choice(INTERESTING))
    chunk.data, chunk.uncompressed_size = zstandard.compress(bytes(content)), len(content)
    chunk.uncompressed_crc = zlib.crc32(content)
    data[start:end] = written(chunk)


def counts(result):
    """Return what can only grow with a trace's length."""
    found = {}
    for name, dag in result['dags'].items():
        found[f'{name} jobs'] = dag['jobs']
        for sink_name, sink in dag['sinks'].items():
            found[f'{sink_name} completed'] = sink['completed']
            found[f'{sink_name} late'] = sink['late'] - sink['overdue']
            found[f'{sink_name} expired'] = sink['expired']
            found[f'{sink_name} missed'] = sink['late'] + sink['expired'] + sink['aborted']
    for key, use in result['callbacks'].items():
        found[f'{key} executions'] = use['executions']
        found[f'{key} busy'] = use['busy_ns']
    found['dropped'] = sum(result['dropped'].values())
    return found


def never_above(result, whole):
    ours, all_of_it = counts(result), counts(whole)
    assert {key: n for key, n in ours.items() if n > all_of_it[key]} == {}


@pytest.fixture(scope='module')
def sound(tmp_path_factory):
    """Give a trace of several chunks, and what it says."""
    path = tmp_path_factory.mktemp('fuzz') / 'sound.mcap'
    VirtualRun(path, small(), 2, duration=60 * MS, flush_every=20)
    return path.read_bytes(), replay(path).result()


def attempt(path, read, seed):
    """Return what reading gives, None for an error of one line; a file that fails is kept."""
    begin = time.process_time()
    try:
        return read(path)
    except (MddagError, GraphError) as error:
        assert '\n' not in str(error)
        assert str(path.parent) in str(error)
        return None
    except BaseException:
        kept = Path(f'fuzz-{seed}{path.suffix}').resolve()
        kept.write_bytes(path.read_bytes())
        print(f'seed {seed}: kept as {kept}')
        raise
    finally:
        assert time.process_time() - begin < SLOW_S, seed


@pytest.fixture(autouse=True)
def bounded_memory():
    """Fail where the fuzzed readers took much memory, or all there is."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert (after - before) * 1024 < MEMORY


@pytest.mark.timeout(180 + 2 * LONG_S)
def test_damaged_files(sound, tmp_path):
    """What is counted is right, or less is and that is said."""
    data, whole = sound
    path = tmp_path / 'a.mcap'
    expected = counts(whole)
    replayed = 0
    for seed in rounds(0):
        rng = random.Random(seed)
        changed = bytearray(data)
        mutate = rng.choice(STRUCTURAL)
        mutate(changed, rng)
        path.write_bytes(changed)
        outcome = attempt(path, replay, seed)
        if outcome is None:
            continue
        replayed += 1
        result = outcome.result()
        if counts(result) != expected:
            assert outcome.warnings, seed
            if mutate not in (row, stretch):    # which may double sound chunks
                never_above(result, whole)
        if seed % 8 == 0:
            attempt(path, lambda path: reschedule(path, workers=1).result(), seed)
    assert replayed > ROUNDS // 5


@pytest.mark.timeout(180 + 2 * LONG_S)
def test_changes_under_a_right_crc(sound, tmp_path):
    """Such a file says what it says; it must not break anything."""
    data, _ = sound
    path = tmp_path / 'a.mcap'
    for seed in chain((8371,), rounds(1)):  # 8371: a leg that its callback does not have
        rng = random.Random(seed)
        changed = bytearray(data)
        inside(changed, rng)
        path.write_bytes(changed)
        if seed % 4 == 0:
            attempt(path, lambda path: reschedule(path, workers=1).result(), seed)
        else:
            attempt(path, lambda path: replay(path).result(), seed)


@pytest.mark.timeout(180 + 2 * LONG_S)
@pytest.mark.parametrize(('storage', 'compression'), [
    (StoragePlugin.MCAP, CompressionMode.STORAGE), (StoragePlugin.SQLITE3, None),
    (StoragePlugin.SQLITE3, CompressionMode.FILE)])
def test_damaged_bags(tmp_path, storage, compression):
    """Arrivals are those of the sound bag, or an error or a warning says what is missing."""
    path = write_bag(tmp_path / 'bag', storage, compression)
    file = next(p for p in path.iterdir() if p.name != 'metadata.yaml')
    data = file.read_bytes()
    whole = list(Bag(path, {'/points'}).stamps['/points'].arrival)
    for number, seed in enumerate(rounds(2)):
        if number == 120 and not LONG_S:
            break
        rng = random.Random(seed)
        changed = bytearray(data)
        mutate = rng.choice((flip, cut, stretch))
        mutate(changed, rng)
        file.write_bytes(changed)
        bag = attempt(file, lambda file: Bag(file.parent, {'/points'}), seed)
        if bag is not None and mutate is cut:
            found = list(bag.stamps['/points'].arrival) if bag.stamps else []
            assert found == whole[:len(found)]
            assert bag.warnings or found == whole


@pytest.mark.needs('babeltrace2')
@pytest.mark.timeout(180 + 2 * LONG_S)
def test_damaged_ctf_sessions(tmp_path):
    """babeltrace2 reads them in a process of its own: a trace, or an error."""
    kinds = [(f'ros2:callback_{what}', [('callback', 'u64')]) for what in ('start', 'end')]
    folder = session(tmp_path / 'session', kinds, [
        (at % 2, at, 1, 1, 'p', 0x5550) for at in range(40)])
    files = {name: (folder / name).read_bytes() for name in ('metadata', 'channel_0')}
    for number, seed in enumerate(rounds(3)):
        if number == 20 and not LONG_S:
            break
        rng = random.Random(seed)
        name = rng.choice(list(files))
        changed = bytearray(files[name])
        rng.choice((flip, cut, stretch))(changed, rng)
        (folder / name).write_bytes(changed)
        attempt(folder / name, lambda _: import_ctf(
            folder, tmp_path / 'trace.mcap', overwrite=True), seed)
        (folder / name).write_bytes(files[name])

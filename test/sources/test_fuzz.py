# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A mutation fuzzer: hundreds of damaged files through everything that replays them.

`make fuzz` runs it for as long as FUZZ_SECONDS says (ten minutes), with seeds that are printed.  A
file that failed is kept, and its seed makes it again.

What must hold for each: a result, or an error of one line; soon, and in bounded memory; and where
what is counted differs from the sound file's, there is a warning, and nothing is counted more
often than there (unless whole chunks were doubled).  Sound files of which the events say something
else make no more jobs than they warrant (`test/hardening/test_random_traces.py` has more of them;
`test/trace/test_damage.py` damages each byte).
"""

import os
from pathlib import Path
import random
import resource
import struct
import time

from mddag_executor import open_recording, replay, reschedule
from mddag_executor.core import NEVER
from mddag_executor.errors import MddagError
from mddag_executor.sources.bags import Bag
from mddag_executor.trace import import_ctf, records, TraceReader
from msg_graph import GraphError, loads
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from ..trace.ctf2 import to_ctf2
from ..trace.ctf_session import session
from ..trace.helpers import records_of
from .bags import write_bag
from .helpers import MS, SMALL, small, VirtualRun, Written
from .imported import GRAPH, record
from .lies import events_of, tell_lies, write_events
from .mixed import detector, robot
from .mixed import GRAPH as MIXED
from .of_processes import Trace
from .recorded import Recorded

LONG_S = float(os.environ.get('FUZZ_SECONDS', '0'))
SLOW_S = 5.0
MEMORY = 400 << 20
pytestmark = pytest.mark.timeout(180 + 2 * LONG_S)


def rounds(count):
    """Yield this many fixed seeds, or fresh ones for as long as asked."""
    if not LONG_S:
        yield from range(count)
        return
    seed = random.SystemRandom().randrange(2**40)
    print(f'first seed {seed}')
    end = time.monotonic() + LONG_S
    while time.monotonic() < end:
        yield seed
        seed += 1


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


def row(data, rng):
    """Take out, double, move or rename whole records."""
    parts = [bytes(data[start:end]) for _, start, end in records_of(bytes(data))]
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


def counts(result):
    """Return what can only grow with a trace's length."""
    found = {}
    for name, dag in result['dags'].items():
        found[f'{name} jobs'] = dag['jobs']
        for sink_name, sink in dag['sinks'].items():
            found[f'{sink_name} completed'] = sink['completed']
            found[f'{sink_name} late'] = sink['late'] - sink['overdue']
            found[f'{sink_name} expired'] = sink['expired']
            found[f'{sink_name} missed'] = sink['late'] + sink['expired']
    for key, use in result['callbacks'].items():
        found[f'{key} executions'] = use['executions']
        found[f'{key} busy'] = use['busy_ns']
    found['dropped'] = sum(result['dropped'].values())
    return found


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
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert (after - before) * 1024 < MEMORY


def sound(folder, kind):
    """
    Write the recordings of a run, each in several chunks.

    :return: their paths, and the declaration to judge by, if none is in them.
    """
    graph = None
    if kind == 'own':
        VirtualRun(folder / 'a.mcap', small(), 2, duration=60 * MS, flush_every=20)
        return [folder / 'a.mcap'], None
    if kind == 'several':
        up, down = Trace(folder, 'up', 0), Trace(folder, 'down', 1)
        for job, took in enumerate((2, 2, 7, 3)):
            up.runs(job * 10 * MS, job * 10 * MS + MS)
            down.runs(job * 10 * MS + 5, (job * 10 + 3) * MS, took * MS)
        written = [up.end(60 * MS), down.end(60 * MS)]
    elif kind == 'imported':
        graph = loads(GRAPH, 'graph.yaml')
        written = [record(Recorded(folder / 'imported')).write()]
    else:
        graph = loads(MIXED, 'graph.yaml')
        written = [detector(folder / 'detector', 4, declared=kind == 'mixed declared')]
        if kind != 'undeclared':
            written.append(robot(folder / 'robot', n=4, until=4).write())
    paths = [folder / f'run.{place}.mcap' for place in range(len(written))]
    for source, target in zip(written, paths):
        write_events(events_of(source), target, chunk=12)
    return paths, graph


KINDS = ['own', 'several', 'imported', 'undeclared', 'mixed', 'mixed declared']


@pytest.mark.parametrize('kind', KINDS)
def test_damaged_files(tmp_path, kind):
    """All figures are those of the sound files, or a warning says that something is missing."""
    paths, graph = sound(tmp_path, kind)
    data = [path.read_bytes() for path in paths]

    def read(_, judge=replay, **options):
        return judge(paths if len(paths) > 1 else paths[0], graph, **options)

    whole = read(None)
    expected, figures, replayed = counts(whole.result()), plain(whole), 0
    for seed in rounds(40):
        rng = random.Random(seed)
        place, mutate = rng.randrange(len(paths)), rng.choice((flip, flip, cut, stretch, row))
        changed = bytearray(data[place])
        mutate(changed, rng)
        paths[place].write_bytes(changed)
        outcome = attempt(paths[place], read, seed)
        if outcome is not None:
            replayed += 1
            found = counts(outcome.result())
            if plain(outcome) != figures:
                assert {*outcome.warnings} - {*whole.warnings}, seed
            if kind == 'own' and mutate not in (row, stretch):    # which may double sound chunks
                assert {key: n for key, n in found.items() if n > expected[key]} == {}
            if seed % 8 == 0:
                attempt(paths[place], lambda path: read(
                    path, reschedule, policy='rad', workers=1).result(), seed)
        paths[place].write_bytes(data[place])
    assert replayed > 8


def plain(outcome):
    """Return all figures, without the warnings."""
    return {key: value for key, value in outcome.result().items() if key != 'warnings'}


def size(result):
    return sum(dag['jobs'] for dag in result['dags'].values())


@pytest.mark.parametrize('kind', KINDS)
def test_any_event_may_lack_or_be_changed(tmp_path, kind):
    """Every kind of recording with lies in it is read, or refused in one line."""
    paths, graph = sound(tmp_path, kind)
    events, replayed = [events_of(path) for path in paths], 0
    for seed in rounds(15):
        rng = random.Random(seed)
        for path, mine in zip(paths, events):
            tell_lies(mine, path, rng)
        result = attempt(paths[0], lambda path: replay(
            paths if len(paths) > 1 else path, graph).result(), seed)
        if result is not None:
            replayed += 1
            for dag in result['dags'].values():
                assert all(0 <= sink['completed'] <= dag['jobs'] for sink in dag['sinks'].values())
    assert replayed > 5


@pytest.mark.parametrize('kind', ['own', 'undeclared', 'mixed declared'])
def test_each_field_of_each_event_may_be_missing(tmp_path, kind):
    """As in recordings of other versions, or of damaged ones."""
    paths, graph = sound(tmp_path, kind)
    events, count = events_of(paths[0]), 0
    for name, fields in sorted({layout for layout, *_ in events}):
        for place, field in enumerate(fields, 3):
            write_events([
                ((name, tuple(each for each in fields if each != field)), *values[:place],
                 *values[place + 1:]) if layout == (name, fields) else (layout, *values)
                for layout, *values in events], paths[0])
            result = attempt(paths[0], lambda path: replay(
                paths if len(paths) > 1 else path, graph).result(), f'{name} without {field}')
            count += result is not None
    assert count > 20


@pytest.mark.parametrize('kind', ['own', 'imported'])
def test_events_that_say_something_else(tmp_path, kind):
    sound, path = tmp_path / 'sound.mcap', tmp_path / 'a.mcap'
    graph = None
    if kind == 'own':
        VirtualRun(sound, small(), 1, duration=80 * MS)
    else:
        record(Recorded(sound)).write()
        graph = loads(GRAPH, 'graph.yaml')
    events = events_of(sound)
    whole = reschedule(sound, graph, policy='rad', workers=2)
    jobs, replayed = size(whole.result()), 0
    for seed in rounds(40):
        lies = tell_lies(events, path, random.Random(seed))
        result = attempt(path, lambda path: replay(path, graph).result(), seed)
        if result is None:
            continue
        replayed += 1
        assert size(result) <= jobs + lies, seed
        for dag in result['dags'].values():
            for sink in dag['sinks'].values():
                assert 0 <= sink['completed'] <= dag['jobs']
                response = sink['response_ns']
                assert response is None or response['min'] <= response['max']
                assert response is None or response['min'] >= 0 or (
                    kind == 'own' and 'before the release' in ' '.join(result['warnings']))
        for each in result['paths'].values():
            for figures in (each['data_age'], each['reaction_time']):
                assert figures is None or 0 <= figures['min'] <= figures['max']
        if graph is not None:
            attempt(path, replay, seed)
        again = attempt(
            path, lambda path: reschedule(path, graph, policy='rad', workers=2), seed)
        if again is not None:
            assert len(again.decisions) <= 2 * len(whole.decisions) + 2 * lies, seed
            assert len(again.log) <= 2 * len(whole.log) + 2 * lies, seed
    assert replayed > 20


def test_an_event_at_the_end_of_all_times(tmp_path):
    """The run ends before the time that means never, so the scheduler's does."""
    trace = Written(tmp_path / 'a.mcap', SMALL)
    trace.release(0, 0, 0)
    trace.file.add('expire', 2 ** 63 - 1, 1, 1, 0, 0)
    trace.file.finish()
    assert open_recording(trace.path).end == NEVER - 1
    assert size(reschedule(trace.path).result()) == 1


@pytest.mark.parametrize(('storage', 'compression'), [
    (StoragePlugin.MCAP, CompressionMode.STORAGE), (StoragePlugin.SQLITE3, None),
    (StoragePlugin.SQLITE3, CompressionMode.FILE)])
def test_damaged_bags(tmp_path, storage, compression):
    """Arrivals are those of the sound bag, or an error or a warning says what is missing."""
    path = write_bag(tmp_path / 'bag', storage, compression)
    file = next(p for p in path.iterdir() if p.name != 'metadata.yaml')
    data = file.read_bytes()
    whole = list(Bag(path, {'/points'}).stamps['/points'].arrival)
    for seed in rounds(60):
        rng, changed = random.Random(seed), bytearray(data)
        mutate = rng.choice((flip, cut, stretch))
        mutate(changed, rng)
        file.write_bytes(changed)
        bag = attempt(file, lambda file: Bag(file.parent, {'/points'}), seed)
        if bag is not None and mutate is cut:
            found = list(bag.stamps['/points'].arrival) if bag.stamps else []
            assert found == whole[:len(found)]
            assert bag.warnings or found == whole


@pytest.mark.parametrize(('head', 'metadata'), [
    ('plain', 'CTF 1.8'), ('compact', 'CTF 1.8'), ('large', 'CTF 1.8'), ('compact', 'CTF 2')])
def test_damaged_ctf_sessions(head, metadata, tmp_path):
    """What is cut is missing with a warning; no damage is more than one line."""
    kinds = [*((f'ros2:callback_{what}', [('callback', 'u64')]) for what in ('start', 'end')),
             ('my:text', [('label', 'str'), ('values', 'u8[]')])]
    folder = session(tmp_path / 'session', kinds, [
        (at % 3, at * 2 ** 25, 1, 1, 'p', *([0x5550] if at % 3 < 2 else ['label', [1, 2]]))
        for at in range(60)], head=head, packets=[0, 1, 2])
    if metadata == 'CTF 2':
        to_ctf2(folder, packets=True)
    files = {name: (folder / name).read_bytes() for name in ('metadata', 'channel_0')}
    trace = tmp_path / 'trace.mcap'
    borders = [0]       # of the packets: a file that is cut there is whole
    while borders[-1] < len(files['channel_0']):
        bits, = struct.unpack_from('<Q', files['channel_0'], borders[-1] + 32)
        borders.append(borders[-1] + bits // 8)

    def events():
        return [event for event in TraceReader(trace).events() if event[0] != 'mddag:lost']

    import_ctf(folder, trace)
    whole = events()
    for seed in rounds(100):
        rng = random.Random(seed)
        name = rng.choice(list(files))
        changed = bytearray(files[name])
        mutate = rng.choice((flip, cut, stretch))
        mutate(changed, rng)
        (folder / name).write_bytes(changed)
        result = attempt(folder / name, lambda _: import_ctf(folder, trace, overwrite=True), seed)
        if result is not None and mutate is cut and name == 'channel_0':
            found = events()
            assert found == whole[:len(found)]
            assert result.warnings or len(changed) in borders
        (folder / name).write_bytes(files[name])

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Damage of times and of files: what is left is right, and what is left out is said.

The bounds are on jobs, decisions and steps of the schedule, never on wall time.
"""

from pathlib import Path
import random
import tempfile

from hypothesis import example, given
from hypothesis import strategies as st
from mddag_executor.core import NEVER
from mddag_executor.errors import MddagError
from mddag_executor.replay import open_recording, replay, reschedule
from mddag_executor.replay.bags_reschedule import reschedule_bag
from mddag_executor.trace import times, TraceFile, TraceReader
from msg_graph import loads
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from ..conftest import examples
from .helpers import MS, SMALL, small, START_TIME, VirtualRun
from .recorded import CAMERA, four_jobs
from .test_ordinary_bags import BEGIN, GRAPH, header, STORE

S = 1_000 * MS
N = 40                  # messages, 25 ms apart: 1 s
TIMER = 30 * MS
BITS = st.integers(0, 63)
PLACE = st.integers(0, N - 1)
STORAGES = (StoragePlugin.MCAP, StoragePlugin.SQLITE3)


def scans(path, arrivals, storage=StoragePlugin.MCAP, stamps=None):
    """Write a bag of scans, in the order given."""
    writer = Writer(path, version=9, storage_plugin=storage)
    with writer:
        points = writer.add_connection('/points', 'std_msgs/msg/Header', typestore=STORE)
        for arrival, stamp in zip(arrivals, stamps or [BEGIN] * len(arrivals)):
            writer.write(points, arrival, header(stamp))
    return path


def arrivals():
    return [BEGIN + k * 25 * MS for k in range(N)]


def rescheduled(path, graph=GRAPH):
    """Reschedule a bag; there may not be more than each message warrants."""
    outcome = reschedule_bag(path, loads(graph, 'g.yaml'))
    jobs = [dag['jobs'] for dag in outcome.result()['dags'].values()]
    assert jobs[0] <= N
    # a message further away is there alone: one more stretch of time, with one job at most
    assert jobs[1] <= (1 * S + times.GAP_NS) // TIMER + 2
    assert len(outcome.decisions) <= 2 * sum(jobs)
    assert len(outcome.log) <= 2 * (2 * jobs[0] + jobs[1])
    return outcome


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('odd', [2**62, 2**63 - 1])
def test_a_message_at_a_time_that_cannot_be(tmp_path, storage, odd):
    whole = arrivals()
    sound = rescheduled(scans(tmp_path / 'sound', whole[:20] + whole[21:], storage))
    whole[20] = odd
    outcome = rescheduled(scans(tmp_path / 'odd', whole, storage))
    assert [line.split(': ', 1)[1] for line in outcome.warnings] == [
        'left out: 1 message at an impossible time']
    assert outcome.result()['dags'] == sound.result()['dags']


@given(PLACE, BITS, st.sampled_from(STORAGES))
@example(N - 1, 45, StoragePlugin.MCAP)
@examples(40)
def test_any_bit_of_a_bag(place, bit, storage):
    flipped = arrivals()
    flipped[place] = (flipped[place] ^ 1 << bit) & 2**63 - 1
    with tempfile.TemporaryDirectory() as folder:
        rescheduled(scans(Path(folder, 'bag'), flipped, storage))


def test_a_pause_has_no_jobs_of_timers(tmp_path):
    later = [time + 3600 * S for time in arrivals()]
    outcome = rescheduled(scans(tmp_path / 'paused', arrivals()[:20] + later[20:]))
    assert outcome.warnings == []
    assert 'none in 1 pause of over a minute' in outcome.notes[1]
    tick = outcome.result()['dags']['/control']['jobs']
    assert tick <= 2 * (N * 25 * MS // 2 // TIMER + 1)


def changed(source, target, rng):
    """Write a trace once more, with one bit of one integer that is as large as a time flipped."""
    reader = TraceReader(source)
    events = [list(event) for event in reader.events()]
    while True:
        event = rng.choice(events)
        places = [place for place in (1, *range(4, len(event)))
                  if isinstance(event[place], int) and event[place] > 10**9]
        if places and not isinstance(event[4], str):
            event[place := rng.choice(places)] ^= 1 << rng.randrange(63)
            if event[place] < 2**63:
                break
    with TraceFile(target, overwrite=True) as file:
        for name, time, pid, thread, *fields in events:
            file.extend(((name, time, thread, *fields),), pid)


def sizes(result):
    """Return how many jobs there are, and what became of them."""
    return [dag['jobs'] for dag in result['dags'].values()]


@pytest.mark.parametrize('kind', ['own', 'imported'])
def test_any_bit_of_a_trace(tmp_path, kind):
    sound, odd = tmp_path / 'sound.mcap', tmp_path / 'odd.mcap'
    graph = None
    if kind == 'own':
        VirtualRun(sound, small(), 1, duration=200 * MS)
    else:
        four_jobs(sound)
        graph = loads(CAMERA, 'g.yaml')
    whole = reschedule(sound, graph, policy='rad', workers=2)
    for seed in range(70):
        changed(sound, odd, random.Random(seed))
        try:
            found = replay(odd, graph).result()
            outcome = reschedule(odd, graph, policy='rad', workers=2)
        except MddagError:
            continue
        assert all(a <= b for a, b in zip(sizes(found), sizes(whole.result()))), seed
        assert len(outcome.decisions) <= 2 * len(whole.decisions), seed
        assert len(outcome.log) <= 2 * len(whole.log), seed


def test_an_event_at_the_end_of_all_times(tmp_path):
    """The run ends before the time that means never, so the scheduler's does."""
    path = tmp_path / 'a.mcap'
    with TraceFile(path) as file:
        file.add('task_set', START_TIME, 1, 1, SMALL, 'g.yaml', 'rad', 2, MS, 3, False)
        file.add('job_release', START_TIME, 1, 1, 0, 0, START_TIME)
        file.add('expire', 2 ** 63 - 1, 1, 1, 0, 0)
    recording = open_recording(path)
    assert recording.end == NEVER - 1
    result = reschedule(path).result()
    assert sum(dag['jobs'] for dag in result['dags'].values()) == 1

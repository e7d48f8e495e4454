# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The compiled replay says what the plain one says, to the last digit, or leaves it to that."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import random
import tempfile
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from mddag_executor.core import NEVER
from mddag_executor.errors import MddagError
from mddag_executor.replay import fast_compile, replay
from mddag_executor.replay.as_recorded import replay_compiled, replay_recording
from mddag_executor.replay.drift import WatchedRecording
from mddag_executor.replay.following import map_recording
from mddag_executor.replay.mapping import Mapping
from mddag_executor.replay.measure import write_long_trace
from mddag_executor.replay.recording import Recording
from mddag_executor.replay.usage import PoolUse
from mddag_executor.simulate import Settings, simulate
from mddag_executor.trace import TraceFile, TraceReader
from msg_graph import load, loads, TaskSet
import numpy as np
import pytest

from .helpers import Chances, declarations, MS, SMALL, small, START_TIME, VirtualRun
from .test_damage import nonsense, write_events

pytest.importorskip('numba')

TOP = Path(__file__).resolve().parents[2]
PATHS = """\
paths:
  - {name: a, callbacks: ['/camera:grab', '/left:detect', '/fuse:join']}
  - {name: b, callbacks: ['/camera:grab', '/right:rectify', '/fuse:join']}
  - {name: c, callbacks: ['/imu:tick', '/imu:use']}
"""


def said(
    path: Path, compiled: bool, graph: TaskSet | None = None, skip: int = 0
) -> tuple[str, Any] | None:
    """Return the result and the drift of a replay; None where it is declined."""
    recording = WatchedRecording(path)
    if compiled:
        outcome = replay_compiled(recording, map_recording(recording, graph), skip=skip)
        if outcome is None:
            return None
    else:
        outcome = replay_recording(recording, graph, compiled=False, skip=skip)
    drift = [each.result() for each in recording.drift(outcome.task_set)]
    return json.dumps(outcome.result(), indent=0), drift


def compare(path: Path, graph: TaskSet | None = None, skip: int = 0) -> bool:
    """Compare the two; tell whether the compiled one took it."""
    found = said(path, True, graph, skip)
    if found is None:
        return False
    expected = said(path, False, graph, skip)
    assert expected is not None
    assert found[0].split('\n') == expected[0].split('\n')
    assert found[1] == expected[1]
    return True


@given(declarations(), st.integers(0, 2**32), st.integers(1, 4),
       st.sampled_from(['rad', 'fifo', 'rm']), st.integers(1, 25))
@settings(max_examples=60)
def test_random_runs(text: str, seed: int, workers: int, policy: str, longest: int) -> None:
    """Messages are lost, jobs expire and are aborted, coroutines are suspended."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'run.mcap')
        VirtualRun(path, loads(text, 'g.yaml'), seed, workers, policy, longest=longest * MS)
        assert compare(path)


@pytest.mark.parametrize('seed', range(6))
def test_paths_and_every_kind_of_verdict(tmp_path: Path, seed: int) -> None:
    text = SMALL.replace('timer: 20ms,', 'timer: 20ms, on_miss: abort,') + PATHS
    path = tmp_path / 'a.mcap'
    VirtualRun(path, loads(text, 'g.yaml'), seed, duration=400 * MS,
               chances=Chances(undeclared=1))
    assert compare(path)


@pytest.mark.parametrize('skip', [1, 100 * MS, 399 * MS])
def test_a_warm_up(tmp_path: Path, skip: int) -> None:
    path = tmp_path / 'a.mcap'
    VirtualRun(path, loads(SMALL + PATHS, 'g.yaml'), 4, duration=400 * MS)
    assert compare(path, skip=skip)


def test_another_declaration(tmp_path: Path) -> None:
    path = tmp_path / 'a.mcap'
    VirtualRun(path, loads(SMALL + PATHS, 'g.yaml'), 4, duration=400 * MS)
    for old, new in (
            ('deadline: 18ms', 'deadline: 9ms'), ('  - node: /imu', '  - node: /imu2'),
            ('sync: [/boxes, /flat]', 'sync: [/flat, /boxes]'),
            ('subscription: /info, deadline: 12ms', 'timer: 12ms, deadline: 12ms')):
        assert old in SMALL
        assert compare(path, loads(SMALL.replace(old, new), 'other.yaml'))


def test_a_process_that_has_a_part_of_a_dag(tmp_path: Path) -> None:
    path = tmp_path / 'a.mcap'
    VirtualRun(path, loads(SMALL + PATHS, 'g.yaml'), 4, duration=400 * MS)
    events = list(TraceReader(path).events(sorted=True))
    for vertices in ('0,1,2', '0,2,4', ''):
        with TraceFile(path) as file:
            for i, (name, time, pid, thread, *fields) in enumerate(events):
                file.add(name, time, pid, thread, *fields)
                if i == len(events) // 4:
                    file.add('mddag:hosted', time, pid, thread, 0, vertices)
        assert compare(path)


@pytest.mark.parametrize('skip', [0, 100 * MS])
def test_verdicts_begin_when_all_programs_have_started(tmp_path: Path, skip: int) -> None:
    path = tmp_path / 'a.mcap'
    VirtualRun(path, loads(SMALL, 'g.yaml'), 4, duration=400 * MS)
    events = list(TraceReader(path).events(sorted=True))
    start = events[len(events) // 3][1]
    jobs = sum(name == 'mddag:job_release' and release >= start + skip
               for name, *_, release in events)
    with TraceFile(path) as file:
        for i, (name, time, pid, thread, *fields) in enumerate(events):
            file.add(name, time, pid, thread, *fields)
            if i in (0, len(events) // 3):
                file.add('mddag:judge_from', time, pid, thread, start if i else NEVER)
    assert compare(path, skip=skip)
    found = replay(path, skip=skip).result()['dags'].values()
    assert sum(dag['jobs'] for dag in found) == jobs > 0


@given(st.integers(0, 2**32), st.sampled_from([0.5, 0.9, 1.3]),
       st.sampled_from(['rad', 'rm', 'ros2']), st.booleans())
@settings(max_examples=6, deadline=None)
def test_simulated_runs(seed: int, load_factor: float, policy: str, preemptive: bool) -> None:
    task_set = load(TOP / 'config' / 'autoware.yaml')
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'run.mcap')
        simulate_to(path, task_set, seed, load_factor, policy, preemptive and policy != 'ros2')
        assert compare(path)


def simulate_to(
    path: Path, task_set: TaskSet, seed: int, utilisation: float, policy: str, preemptive: bool
) -> None:
    """Simulate two seconds of a workload."""
    from mddag_executor.simulate import (
        draw_execution_times,
        periodic_load,
        scale_execution_times,
    )
    from mddag_executor.simulate.recording import write_trace
    chosen = Settings(policy=policy, workers=7, preemptive=preemptive, duration_ns=2000 * MS)
    times_of = scale_execution_times(
        task_set, draw_execution_times(task_set, seed), 7, utilisation)
    arrivals = periodic_load(task_set, times_of, 2000 * MS)
    run = simulate(task_set, arrivals, chosen, log=True)
    write_trace(path, task_set, arrivals, run)


def test_what_is_compiled_beforehand_can_be_replayed() -> None:
    """Its declaration is one that is accepted: else nothing would ever be compiled, silently."""
    assert loads(fast_compile._NOTHING, 'nothing.yaml').paths
    fast_compile.compile_here()


def test_a_live_run() -> None:
    assert compare(TOP / 'bags' / 'demo_short.mcap')


def test_a_long_trace_in_which_all_tables_grow(tmp_path: Path) -> None:
    path = tmp_path / 'long.mcap'
    write_long_trace(str(path), load(TOP / 'config' / 'autoware.yaml'), 150_000)
    assert compare(path)


# --- damage --------------------------------------------------------------------------------------

@pytest.fixture(scope='module')
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[bytes]:
    """Give a trace of many chunks."""
    path = tmp_path_factory.mktemp('damage') / 'sound.mcap'
    VirtualRun(path, small(), 1, duration=400 * MS, flush_every=30)
    yield path.read_bytes()


def outcome_of(path: Path, compiled: bool) -> Any:
    try:
        return said(path, compiled)
    except MddagError as error:
        return str(error)


def test_a_trace_cut_anywhere(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / 'cut.mcap'
    for size in range(0, len(sound), len(sound) // 60):
        path.write_bytes(sound[:size])
        found = outcome_of(path, True)
        assert found is not None
        assert found == outcome_of(path, False)


def test_flipped_bits(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / 'flipped.mcap'
    rng = random.Random(5)
    taken = 0
    for _ in range(120):
        data = bytearray(sound)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        found = outcome_of(path, True)
        if found is not None:
            taken += 1
            assert found == outcome_of(path, False)
    assert taken > 100


@given(st.lists(nonsense(), max_size=60), st.booleans())
@settings(max_examples=150)
def test_events_with_any_values(events: list[tuple[Any, ...]], in_order: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'a.mcap')
        write_events(path, events, in_order)
        compare(path)


def test_events_that_are_lost_or_doubled_or_changed(tmp_path: Path) -> None:
    """What contradicts itself is counted as the plain replay counts it."""
    path = tmp_path / 'a.mcap'
    taken = contradicting = 0
    for seed in range(40):
        rng = random.Random(seed)
        VirtualRun(path, loads(SMALL + PATHS, 'g.yaml'), seed, duration=200 * MS,
                   chances=Chances(undeclared=1))
        events = list(TraceReader(path).events(sorted=True))
        for _ in range(rng.randrange(1, 8)):
            place = rng.randrange(1, len(events))
            event = list(events[place])
            what = rng.randrange(3)
            if what == 0:
                del events[place]
            elif what == 1:
                events.insert(rng.randrange(place, len(events)), events[place])
            else:
                field = rng.randrange(3, len(event))
                if type(event[field]) is int:
                    event[field] = max(0, event[field] + rng.choice([-1, 1]))
                    events[place] = tuple(event)
        with TraceFile(path) as file:
            for name, time, pid, thread, *fields in events:
                file.add(name, time, pid, thread, *fields)
        taken += compare(path)
        contradicting += any('contradict' in w for w in replay(path, compiled=False).warnings)
    assert taken > 20
    assert contradicting > 3


def test_what_is_wrong_is_left_to_the_plain_replay(tmp_path: Path) -> None:
    """Its warnings are those of the plain one, and nothing is counted twice."""
    path = tmp_path / 'a.mcap'
    VirtualRun(path, small(), 1)
    data = path.read_bytes()
    with TraceFile(path) as file:
        file.add('task_set', START_TIME, 77, 1, small().text, 'small.yaml', 'rad', 2, 100 * MS,
                 64, False)
        file.add('job_release', START_TIME + MS, 77, 2, 99, 0, START_TIME)
    assert data != path.read_bytes()
    expected = replay(path)
    assert replay_compiled(Recording(path), Mapping(Recording(path), None)) is None
    found = replay(path, compiled=True)
    assert found.warnings == expected.warnings
    assert any('DAG that is not declared' in warning for warning in found.warnings)
    assert found.result() == expected.result()


# --- parts ---------------------------------------------------------------------------------------

@given(st.lists(st.tuples(st.integers(0, 10**13), st.integers(0, 10**11)), max_size=30),
       st.integers(1, 10))
def test_pool_use_of_many(runs: list[tuple[int, int]], size: int) -> None:
    one, many = PoolUse(), PoolUse()
    for start, took in runs:
        one.add(start, start + took)
    for i in range(0, len(runs), size):
        some = np.array(runs[i:i + size], dtype=np.int64)
        many.add_many(some[:, 0], some[:, 0] + some[:, 1])
    assert many.result() == one.result()

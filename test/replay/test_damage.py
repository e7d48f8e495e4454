# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Damaged traces: everything before the damage, one line about the rest, never a wrong figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.errors import MddagError
from mddag_executor.replay import open_recording, replay, reschedule
from mddag_executor.trace import TraceFile
import pytest

from .helpers import MS, SMALL, small, START_TIME, VirtualRun


@pytest.fixture(scope='module')
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Give a trace of many chunks."""
    path = tmp_path_factory.mktemp('damage') / 'sound.mcap'
    VirtualRun(path, small(), 1, duration=400 * MS, flush_every=30)
    return path.read_bytes()


@pytest.fixture(scope='module')
def whole(sound: bytes, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Give what the whole trace says."""
    path = tmp_path_factory.mktemp('damage') / 'whole.mcap'
    path.write_bytes(sound)
    return replay(path).result()


def counts(result: dict[str, Any]) -> dict[str, int]:
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


def never_above(result: dict[str, Any], whole: dict[str, Any]) -> None:
    ours, all_of_it = counts(result), counts(whole)
    assert {key: n for key, n in ours.items() if n > all_of_it[key]} == {}


def test_a_trace_cut_anywhere(sound: bytes, whole: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / 'cut.mcap'
    jobs = []
    for size in range(0, len(sound), len(sound) // 150):
        path.write_bytes(sound[:size])
        try:
            outcome = replay(path)
        except MddagError as error:
            assert str(error).startswith(f'{path}: ')
            assert '\n' not in str(error)
            assert size < 4000  # before the first chunk is whole
            continue
        result = outcome.result()
        never_above(result, whole)
        # The first says what is missing of the file, the second, if any, that the end is.
        assert outcome.warnings[0].startswith(f'{path}: ')
        assert all(
            'the end of the run is not recorded' in text or 'no job was released in it' in text
            for text in outcome.warnings[1:])
        jobs.append(sum(dag['jobs'] for dag in result['dags'].values()))
        assert reschedule(path, workers=1).tally.jobs
    assert jobs == sorted(jobs)
    assert jobs[0] < jobs[-1]


def test_an_event_at_the_end_of_all_times(tmp_path: Path) -> None:
    """The run ends before the time that stands for never, so the scheduler's does."""
    path = tmp_path / 'a.mcap'
    with TraceFile(path) as file:
        file.add('task_set', START_TIME, 1, 1, SMALL, 'g.yaml', 'rad', 2, MS, 3, False)
        file.add('job_release', START_TIME, 1, 1, 0, 0, START_TIME)
        file.add('expire', 2 ** 63 - 1, 1, 1, 0, 0)
    recording = open_recording(path)
    assert recording.end == NEVER - 1
    result = reschedule(path).result()
    assert sum(dag['jobs'] for dag in result['dags'].values()) == 1

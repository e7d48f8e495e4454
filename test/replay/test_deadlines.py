# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Verdicts from tables are those of the scheduler core that is fed event by event."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import tempfile

from hypothesis import example, given, settings
from hypothesis import strategies as st
from mddag_executor.core.state import DROP, JOB_END
from mddag_executor.recording.tables import ABORTED, EXPIRED, FAILED, Recording, WITHDRAWN
from mddag_executor.replay import open_recording
from mddag_executor.replay.deadlines import Judged
from msg_graph import loads
import numpy as np
import pytest

from .helpers import Chances, declarations, MS, PATHS, SMALL, VirtualRun
from .oracle import Oracle

BAGS = Path(__file__).resolve().parents[2] / 'bags'


def check(recording: Recording, skip: int = 0) -> None:
    judged, oracle = Judged(recording, skip), Oracle(recording, skip)
    assert judged.tally.result() == oracle.tally.result()
    expected = [each for each in oracle.decisions if each[0] not in (JOB_END, DROP)]
    columns = ('kind', 'dag', 'sink', 'job', 'deadline', 'completed')
    assert judged.verdicts[list(columns)].tolist() == expected
    assert {v: list(jobs) for v, jobs in judged.tally.missed_jobs.items()} == {
        v: list(jobs) for v, jobs in oracle.tally.missed_jobs.items()}


@given(declarations(), st.integers(0, 2**32), st.integers(1, 4), st.integers(1, 25),
       st.sampled_from([0, 70 * MS]))
@settings(max_examples=100)
@example(SMALL, 1, 2, 8, 0)
def test_verdicts_of_any_run(text: str, seed: int, workers: int, longest: int, skip: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'run.mcap')
        VirtualRun(path, loads(text, 'g.yaml'), seed, workers, longest=longest * MS,
                   shut_down=seed % 3 > 0)
        check(open_recording(path), skip)
        try:
            other = open_recording(path, loads(SMALL, 'other.yaml'))
        except Exception as error:
            assert 'none of the callbacks' in str(error)
        else:
            check(other, skip)


def test_verdicts_of_a_bag() -> None:
    check(open_recording(BAGS / 'demo_short.mcap'))


@given(st.integers(0, 2**32), st.data())
@settings(max_examples=100)
def test_verdicts_of_any_tables(seed: int, data: st.DataObject) -> None:
    """Tables that no executor records: ends and completions in any order, twice, or of no job."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'run.mcap')
        VirtualRun(path, loads(SMALL + PATHS, 'g.yaml'), seed, duration=150 * MS,
                   chances=Chances(undeclared=1))
        recording = open_recording(path)
    generator = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    tables = [recording.releases, recording.executions, recording.job_ends]
    tables = [table[generator.integers(0, len(table), len(table))] if place and len(table)
              else table for place, table in enumerate(tables)]
    orders = np.concatenate([table['order'][table['order'] >= 0] for table in tables])
    ranks = generator.permutation(len(orders)) if data.draw(st.booleans()) else \
        np.argsort(np.argsort(orders, kind='stable'), kind='stable')
    at = 0
    for table in tables:
        known = table['order'] >= 0
        table['order'][known] = 2 * ranks[at:at + int(known.sum())]
        at += int(known.sum())
    tables[2]['reason'] = generator.choice([EXPIRED, ABORTED, FAILED, WITHDRAWN], len(tables[2]))
    releases = tables[0][np.argsort(tables[0]['order'])]
    for dag in np.unique(releases['dag']).tolist():     # jobs are released by their numbers
        mine = releases['dag'] == dag
        releases['job'][mine] = np.sort(releases['job'][mine])
    hosted = [] if data.draw(st.booleans()) else [
        (-1, 0, frozenset(generator.choice(
            5, int(generator.integers(0, 5)), replace=False).tolist()))]
    start = recording.start or 0
    changed = replace(
        recording,
        releases=releases, executions=tables[1], job_ends=tables[2], hosted=hosted,
        judged_order=int(generator.integers(0, len(orders) + 1)) * 2 - 1,
        judge_from=[(int(generator.integers(0, len(orders))) * 2 + 1, start + 50 * MS)]
        if data.draw(st.booleans()) else [])
    check(changed)


@pytest.mark.parametrize('text', ['deadline: 12ms', 'deadline: 18ms'])
def test_the_oracle_sees_a_difference(tmp_path: Path, text: str) -> None:
    """Another deadline is another verdict: the comparison can fail."""
    path = tmp_path / 'run.mcap'
    VirtualRun(path, loads(SMALL, 'g.yaml'), 3, duration=500 * MS)
    recording = open_recording(path)
    stricter = open_recording(path, loads(SMALL.replace(text, 'deadline: 1ms'), 'g.yaml'))
    assert Judged(recording).tally.result() != Oracle(stricter).tally.result()

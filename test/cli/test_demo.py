# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import subprocess
from typing import Any

from mddag_executor.cli.demo import agreement, results_table, side_by_side
import pytest


def sink(completed: int, late: int = 0) -> dict[str, Any]:
    return {
        'relative_deadline_ns': 30_000_000, 'completed': completed, 'late': late, 'expired': 0,
        'response_ns': {'min': 1, 'median': 2_000_000, 'p99': 3_000_000, 'max': 4_000_000}}


def test_the_demo_says_where_recording_and_live_differ() -> None:
    live = {'dags': {'d': {'sinks': {'/a:x': sink(10), '/b:y': sink(20, 2)}}}}
    same = {'dags': {'d': {'sinks': {'/a:x': sink(10), '/b:y': sink(20, 2)}}}}
    other = {'dags': {'d': {'sinks': {'/a:x': sink(10), '/b:y': sink(20, 3)}}}}
    assert 'for all 2 sinks' in agreement(live, same)
    assert agreement(live, other) == (
        'The replay counts otherwise for 1 of 2 sinks: /b:y (live 20 completed, 2 late; '
        'recorded 20, 3)')
    table = results_table(**{name: each['dags'] for name, each in (
        ('live', live), ('recorded', same), ('rescheduled', other))}).splitlines()
    assert table[2].split()[:10] == [
        'b:y', '18', 'of', '20', '18', 'of', '20', '17', 'of', '20']
    assert table[3].split()[0] == 'all'


def test_the_demo_sets_both_executors_side_by_side() -> None:
    def measured(on_time: int) -> dict[str, Any]:
        s = {'relative_deadline_ns': 30_000_000, 'due': 10, 'on_time': on_time, 'late': 0,
             'missing': 10 - on_time, 'response_ns': None}
        return {
            'dags': {'d': {'sinks': {'/a:x': s}}}, 'sink_jobs_due': 10, 'on_time': on_time,
            'late': 0, 'missing': 10 - on_time, 'callbacks_per_s': 99.6,
            'cpu_us_per_callback': 75.2}

    text = side_by_side(measured(10), measured(1))
    assert text.splitlines()[1].split() == [
        'd', 'a:x', '30', 'ms', '100.00', '%', '-', '10.00', '%', '-']
    assert 'CPU each' in text
    assert '75 us' in text


@pytest.mark.slow
def test_the_main_job_end_to_end(
    tmp_path: Path, mddag: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    process = mddag(
        'demo', '--duration', '3s', '--utilisation', '0.3',
        '--output', tmp_path / 'made', '--json', tmp_path / 'result.json', timeout=150.0)
    assert process.returncode == 0, process.stderr
    # A busy machine skips periods, and that is said.
    assert all(line.startswith('[WARN] ') for line in process.stderr.splitlines())
    result = json.loads((tmp_path / 'result.json').read_text())
    live = result['live']
    assert len(live['dags']) == 11
    sinks = [name for dag in live['dags'].values() for name in dag['sinks']]
    assert len(sinks) == 18
    # What the replayer counts is exactly what the executor counted.
    assert agreement(live, result['recorded']).endswith(', for all 18 sinks.')
    assert result['recorded']['dags'].keys() == live['dags'].keys()
    assert result['rescheduled']['dags'].keys() == live['dags'].keys()
    assert live['never_ran'] == []
    for measured in (live['measured'], result['baseline']):
        assert measured['seed'] == 0
        assert measured['utilisation'] == pytest.approx(0.3, abs=0.001)
        verdicts = measured['on_time'] + measured['late'] + measured['missing']
        assert verdicts == measured['sink_jobs_due'] > 200
    assert live['measured']['attribution'] == {'wrong': 0, 'none': 0}
    trace = tmp_path / 'made' / 'demo.mcap'
    assert trace.read_bytes()[:5] == b'\x89MCAP'
    for text in ('one draw', 'seed 0', 'No critical path', str(trace), 'MultiThreadedExecutor'):
        assert text in process.stdout


def test_a_step_that_fails_is_one_line(
    tmp_path: Path, mddag: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    (tmp_path / 'demo.mcap').mkdir()  # the trace cannot be written
    process = mddag('demo', '--duration', '1s', '--output', tmp_path)
    assert process.returncode == 2
    assert process.stderr == (
        f'error: mddag run: {tmp_path}/demo.mcap: this is a directory: name a file\n')

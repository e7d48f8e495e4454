# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `bench core`: its figures, and bad input in one line."""

from __future__ import annotations

import json
from pathlib import Path

from mddag_executor.core import POLICIES, Tables
from mddag_executor.simulate import draw_execution_times, periodic_load
from mddag_executor.simulate.measure import drive_live, time_core
from msg_graph import load, loads, TaskSet
import pytest

from .helpers import caller

call = caller('bench', 'core')

AUTOWARE = Path(__file__).parents[2] / 'config' / 'autoware.yaml'
GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: s, timer: 50ms, publishes: [/a, /b], execution_time: 2ms}
      - {name: x, subscription: /a, publishes: [/x], execution_time: 1ms}
      - {name: join, sync: [/x, /b], deadline: 9ms, execution_time: 1ms}
"""


def vertex_jobs(task_set: TaskSet, duration_ns: int) -> int:
    return sum(-(-duration_ns // dag.period_ns) * len(dag.vertices) for dag in task_set.dags)


def test_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'g.yaml').write_text(GRAPH)
    status, out, err = call(
        capsys, '--graph', tmp_path / 'g.yaml', '--duration', '1s', '--repeat', 2,
        '--json', tmp_path / 'out.json')
    assert (status, err) == (0, '')
    lines = out.splitlines()
    assert lines[0].split()[:2] == ['policy', 'preemptive']
    assert [line.split()[0] for line in lines[1:1 + len(POLICIES)]] == list(POLICIES)
    result = json.loads((tmp_path / 'out.json').read_text())
    assert (result['workers'], result['duration_ns']) == (7, 10 ** 9)
    assert [row['policy'] for row in result['core']] == list(POLICIES)
    for row in result['core']:
        # 20 jobs of three vertices, each with a start and an end; 20 releases; nobody preempts.
        assert (row['vertex_jobs'], row['events']) == (60, 140)
        assert row['preemptive'] == POLICIES[row['policy']].preemptive
        assert 0.1 < row['us_per_event'] < row['us_per_vertex_job'] < 10_000
        assert row['us_per_vertex_job'] == pytest.approx(row['us_per_event'] * 140 / 60)
        assert 0.1 < row['live_us_per_vertex_job'] < 10_000


def test_no_vertex_job_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that is longer than the run has no time for each."""
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nnodes: [{node: /n, callbacks: [{name: a, timer: 50ms, deadline: 9ms, '
        'execution_time: 2ms}]}]')
    status, out, err = call(
        capsys, '--graph', tmp_path / 'g.yaml', '--duration', '1ms', '--policies', 'rad',
        '--repeat', 1, '--json', '-')
    assert (status, err) == (0, '')
    row, = json.loads(out)['core']
    assert (row['vertex_jobs'], row['us_per_vertex_job']) == (0, None)


def test_the_paper_s_workload(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = call(
        capsys, '--policies', 'rad', '--duration', '100ms', '--repeat', 1)
    assert (status, err) == (0, '')
    assert out.splitlines()[1].split()[:2] == ['rad', 'yes']


@pytest.mark.parametrize('policy', POLICIES)
def test_live_calls_run_all_there_is(policy: str) -> None:
    """Every vertex of every job completes, syncs with the last of their legs."""
    task_set = load(AUTOWARE)
    duration_ns = 200_000_000
    load_ = periodic_load(task_set, draw_execution_times(task_set, 0), duration_ns)
    tables = Tables.build(task_set, legs=True)
    assert drive_live(tables, policy, load_) == vertex_jobs(task_set, duration_ns)


def test_what_is_counted() -> None:
    task_set = loads(GRAPH, 'g.yaml')
    row = time_core(task_set, 'ros2', workers=1, duration_ns=120_000_000, repeat=1)
    assert row['vertex_jobs'] == 3 * 3
    assert row['events'] == 3 + 2 * 9


@pytest.mark.parametrize(('arguments', 'line'), [
    (['--policies', 'x'], "policy 'x': there is no such policy: choose one of rad, "),
    (['--policies', 'rad,rad'], "--policies: 'rad' stands there twice: "),
    (['--repeat', '0'], "mddag bench core: argument --repeat: '0' is no whole number from 1 up"),
    (['--workers', '0'], "mddag bench core: argument --workers: '0' is no whole number from 1"),
    (['--duration', '61s'], '--duration: that is too long: '),
    (['--graph', 'nowhere.yaml'], 'nowhere.yaml: '),
    (['--json', 'nowhere/x'], 'nowhere/x: there is no directory nowhere: '),
])
def test_bad_input(
    capsys: pytest.CaptureFixture[str], arguments: list[str], line: str
) -> None:
    status, out, err = call(capsys, *arguments)
    assert (status, out) == (2, '')
    assert err.startswith(f'error: {line}') and err.count('\n') == 1

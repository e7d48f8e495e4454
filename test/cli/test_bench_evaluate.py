# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `bench evaluate`: its figures, and bad input in one line."""

from __future__ import annotations

import json
from pathlib import Path

from mddag_executor.simulate import compiling
from mddag_executor.simulate.draws import Draws, utilisations
from mddag_executor.simulate.measure import random_task_set, WORKERS
import pytest

from .helpers import caller

call = caller('bench', 'evaluate')

GRAPH = """\
mddag: 1
nodes: [{node: /n, callbacks: [{name: a, timer: 50ms, deadline: 9ms, execution_time: 2ms}]}]
"""


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do without compiling."""
    monkeypatch.setattr(compiling, 'available', lambda: False)


def test_figures(
    plain: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'g.yaml').write_text(GRAPH)
    arguments = ('--graph', tmp_path / 'g.yaml', '--runs', 100, '--policies', 'rad,wc', '--jobs',
                 '1', '--vertices', '10,25', '--repeat', 1, '--json')
    status, out, err = call(capsys, *arguments, tmp_path / 'out.json')
    assert (status, err) == (0, '')
    assert 'ms a run and policy' in out and 'ns a vertex job, plain' in out
    result = json.loads((tmp_path / 'out.json').read_text())
    run, = result['runs']
    assert (run['core'], run['jobs'], run['runs']) == ('plain', 1, 2)
    assert run['ms'] == pytest.approx(1000 * run['s'] / 2 / 2)
    assert [row['vertices'] for row in result['vertex_jobs']] == [10, 24]
    for row in result['vertex_jobs']:
        assert row['vertex_jobs'] >= 20_000 and 300 < row['ns'] < 1_000_000
    assert result['peak_memory_mb'] > 10


@pytest.mark.parametrize('n_vertices', [1, 10, 55])
def test_random_task_sets(n_vertices: int) -> None:
    task_set = random_task_set(n_vertices)
    assert len(task_set.vertices) == n_vertices
    assert any(len(v.predecessors) > 1 for v in task_set.vertices) == (n_vertices > 1)
    load, = utilisations(task_set, Draws(task_set, 0).times(0, 1), WORKERS)
    assert 0.3 <= load <= 0.9


@pytest.mark.parametrize(('arguments', 'line'), [
    (['--policies', 'x'], "policy 'x': there is no such policy: "),
    (['--runs', '0'], "mddag bench evaluate: argument --runs: '0' is no whole number from 1 up"),
    (['--jobs', '1,0'], "mddag bench evaluate: argument --jobs: '0' is no whole number from 1"),
    (['--vertices', '1000000'], '--vertices: that is too many: '),
    (['--graph', 'nowhere.yaml'], 'nowhere.yaml: '),
    (['--json', 'nowhere/x'], 'nowhere/x: there is no directory nowhere: '),
])
def test_bad_input(
    plain: None, capsys: pytest.CaptureFixture[str], arguments: list[str], line: str
) -> None:
    status, out, err = call(capsys, *arguments)
    assert (status, out) == (2, '')
    assert err.startswith(f'error: {line}') and err.count('\n') == 1

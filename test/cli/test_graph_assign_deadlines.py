# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph assign-deadlines`."""

from __future__ import annotations

import io
import json
from pathlib import Path

from msg_graph import load
import pytest

from .helpers import caller

call = caller('graph', 'assign-deadlines')

GRAPH = """\
# Mine.
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 20ms, publishes: [/a, /b], dag: one, execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 5ms, execution_time: 1ms}  # urgent
      - {name: y, subscription: /b, execution_time: 9ms}  # no deadline yet
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give the working directory, with a declaration."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'g.yaml').write_text(GRAPH)
    return tmp_path


def test_by_path(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = call(
        capsys, 'g.yaml', '-o', 'o.yaml', '--runs', 20, '--duration', '200ms', '--json', 'o.json')
    assert (status, err) == (0, '')
    assert (folder / 'o.yaml').read_text() == GRAPH.replace('5ms', '4ms').replace(
        'subscription: /b,', 'subscription: /b, deadline: 20ms,').replace(
            '{name: y, subscription: /b, deadline: 20ms', '{name: y, deadline: 20ms, '
            'subscription: /b')
    assert [line.split()[-4:] for line in out.splitlines()[1:3]] == [
        ['20', 'ms', '4', 'ms'], ['20', 'ms', '20', 'ms']]
    assert out.splitlines()[-1] == (
        'rad accepts 100.0 % (95 % confidence: 83.9 to 100.0 %) of 20 runs with seed 0')
    result = json.loads((folder / 'o.json').read_text())
    assert result['deadlines_ns'] == {'/n:x': 4_000_000, '/n:y': 20_000_000}
    assert result['acceptance']['runs'] == 20 and result['acceptance']['ratio'] == 1.0


def test_by_search(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = call(
        capsys, 'g.yaml', '-o', 'o.yaml', '--target', 0.9, '--runs', 40,
        '--seed', 7, '--duration', '200ms', '--budget', 'max', '--json', 'o.json')
    assert (status, err) == (0, '')
    result = json.loads((folder / 'o.json').read_text())
    # x runs first: 1 + 1 of 2 ms; y has to wait for it: 1 + 1 + 9 of 10 ms.
    assert 1.1 <= result['scale'] <= 1.112
    assert result['target'] == 0.9 and len(result['tried']) > 4
    assert result['acceptance']['seed'] == 8
    deadlines = {c.key: c.deadline_ns for c in load('o.yaml').callbacks if c.deadline_ns}
    assert deadlines == result['deadlines_ns']
    assert deadlines['/n:y'] == pytest.approx(11_050_000, rel=0.01)
    assert 'of 40 runs with seed 8, none of which the search used' in out
    assert 'scales tried' in out


def test_standard_input_and_output(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stdin:
        buffer = io.BytesIO(GRAPH.encode())

    monkeypatch.setattr('sys.stdin', Stdin())
    status, out, err = call(capsys, '-', '--runs', 5)
    assert status == 0
    assert out.startswith('# Mine.\n') and 'deadline: 4ms, execution_time: 1ms}  # urgent' in out
    assert 'rad accepts' in err

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph assign-deadlines`."""

from __future__ import annotations

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

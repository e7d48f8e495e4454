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


def test_by_critical_path(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = call(
        capsys, 'g.yaml', '-o', 'o.yaml', '--budget', 'max', '--json', 'o.json')
    assert (status, err) == (0, '')
    result = json.loads((folder / 'o.json').read_text())
    assert result['deadlines_ns'] == {'/n:x': 4_000_000, '/n:y': 20_000_000}
    deadlines = {c.key: c.deadline_ns for c in load('o.yaml').callbacks if c.deadline_ns}
    assert deadlines == result['deadlines_ns']
    assert '# urgent' in (folder / 'o.yaml').read_text()
    assert [line.split() for line in out.splitlines()[1:3]] == [
        ['one', '/n:x', '20', 'ms', '4', 'ms'], ['/n:y', '20', 'ms', '20', 'ms']]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the commands about recordings print, and their JSON, compared with files in ``golden``.

After a wanted change: ``UPDATE_GOLDEN=1 python -m pytest test/report/test_golden.py``; look at the
difference before you commit it.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

from mddag_executor.cli import main as program
import pytest

from . import runs, test_pictures

GOLDEN = Path(__file__).with_name('golden')
TIGHTER = runs.GRAPH.replace('deadline: 8ms', 'deadline: 5ms')


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give a working directory with a recorded run, and declarations."""
    monkeypatch.chdir(tmp_path)
    runs.by_hand(tmp_path / 'run.mcap')
    (tmp_path / 'tight.yaml').write_text(TIGHTER)
    (tmp_path / 'graph.yaml').write_text(test_pictures.GRAPH)
    return tmp_path


def compare(name: str, text: str) -> None:
    path = GOLDEN / name
    if os.environ.get('UPDATE_GOLDEN'):
        path.write_text(text, encoding='utf-8')
    assert text == path.read_text(encoding='utf-8')


@pytest.mark.parametrize(('name', 'arguments'), [
    ('explain', ['explain', 'run.mcap']),
    ('explain_job', ['explain', 'run.mcap', '--sink', 'filter:run', '--job', '2']),
    ('slack', ['slack', 'run.mcap', '--jobs', '1']),
    ('diff', ['diff', 'run.mcap', 'run.mcap', 'tight.yaml', '--callbacks']),
    ('replay', ['replay', 'run.mcap', '--callbacks']),
    ('reschedule', ['replay', 'run.mcap', '--reschedule', '--workers', '1']),
])
def test_text_and_json(
    name: str, arguments: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main([*arguments, '--json', 'result.json']) == 0
    compare(f'{name}.txt', capsys.readouterr().out)
    result = json.loads((folder / 'result.json').read_text())
    compare(f'{name}.json', json.dumps(result, indent=1) + '\n')


@pytest.mark.parametrize(('name', 'arguments'), [
    ('executions.csv', ['export', 'run.mcap', '-o', 'out.csv']),
    ('jobs.csv', ['export', 'run.mcap', '-o', 'out.csv', '--rows', 'jobs']),
    ('graph.dot', ['graph', 'draw', 'graph.yaml', '-o', 'out.dot']),
    ('graph.mmd', ['graph', 'draw', 'graph.yaml', '-o', 'out.mmd']),
])
def test_files(name: str, arguments: list[str], folder: Path) -> None:
    assert program.main(arguments) == 0
    data = (folder / f'out{Path(name).suffix}').read_bytes().decode()
    compare(name, data.replace('\r\n', '\n'))

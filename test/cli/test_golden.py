# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What commands about declarations print and write, as files in golden/.

Those about recordings are in test/report. After a wanted change: `UPDATE_GOLDEN=1 python -m pytest
test/cli/test_golden.py`; look at the difference before you commit it.
"""

from __future__ import annotations

import os
from pathlib import Path
import re
import shutil

from mddag_executor import __version__
from mddag_executor.cli import main as program
import pytest

GOLDEN = Path(__file__).parent / 'golden'
# The files that a command writes are appended to what it prints.
COMMANDS = {
    'check': 'graph check graph.yaml',
    'check_json': 'graph check graph.yaml --json -',
    'analyse': 'graph analyse graph.yaml --budget mean',
    'analyse_json': 'graph analyse graph.yaml --json -',
    'assign': 'graph assign-deadlines graph.yaml --runs 20 -o out.yaml',
    'assign_target': 'graph assign-deadlines graph.yaml --target 0.8 --runs 40 --json out.json',
    'place': 'graph place graph.yaml --processes 2 --cpus 2 --duration 200ms -o out.yaml',
    'place_json': (
        'graph place graph.yaml --processes 2 --cpus 2 --duration 200ms --json - -o out.yaml'),
    'generate': 'generate --dags 2 --vertices 3:5 --sinks 2 --or-share 0.5 --seed 4',
    'simulate': 'simulate graph.yaml --duration 200ms',
    'simulate_json': 'simulate graph.yaml --duration 200ms --policy fifo --json -',
    'evaluate': 'evaluate graph.yaml --runs 30 --policies rad,fifo --jobs 1 --duration 200ms',
    'from_caret': 'graph from-caret architecture.yaml -o out.yaml',
    'evaluate_json': 'evaluate graph.yaml --runs 30 --policies rad --jobs 1 --json -',
}
_CHANGING = (
    (re.compile(r'"(elapsed_s)": [0-9.e-]+'), r'"\1": 0'),
    (re.compile(r'in \d+\.\d s, \d+\.\d\d ms for'), 'in 0.0 s, 0.00 ms for'),
    (re.compile(f'"mddag": "{re.escape(__version__)}"'), '"mddag": "VERSION"'))


@pytest.mark.parametrize('name', COMMANDS)
def test_output(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for file in GOLDEN.glob('*.yaml'):
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert program.main(COMMANDS[name].split()) == 0
    out, err = capsys.readouterr()
    found = f'$ mddag {COMMANDS[name]}\n{out}' + (f'--- standard error\n{err}' if err else '')
    for path in sorted(tmp_path.glob('out.*')):
        found += f'--- {path.name}\n{path.read_text()}'
    for pattern, constant in _CHANGING:
        found = pattern.sub(constant, found)
    golden = GOLDEN / f'{name}.txt'
    if os.environ.get('UPDATE_GOLDEN'):
        golden.write_bytes(found.encode())
    assert found == golden.read_bytes().decode()


def test_quiet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With -q nothing is printed that was not asked for."""
    graph, trace = str(GOLDEN / 'graph.yaml'), str(tmp_path / 'run.mcap')
    for words in (['graph', 'check', graph], ['simulate', graph, '--trace', trace],
                  ['replay', trace]):
        assert program.main([*words, '-q']) == 0
        assert capsys.readouterr() == ('', '')
    assert program.main(['graph', 'check', graph, '-q', '--json', '-']) == 0
    assert capsys.readouterr().out.startswith('{')

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph draw`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

Mddag = Callable[..., subprocess.CompletedProcess[str]]

CONFIG = Path(__file__).resolve().parents[2] / 'config'


@pytest.mark.needs('graphviz')
@pytest.mark.parametrize(('ending', 'begin'), [
    ('svg', b'<?xml'), ('png', b'\x89PNG'), ('pdf', b'%PDF')])
def test_graphviz(call: Mddag, tmp_path: Path, ending: str, begin: bytes) -> None:
    text = (CONFIG / 'autoware.yaml').read_text()
    done = call('graph', 'draw', '-', '-o', f'o.{ending}', cwd=tmp_path, stdin=text)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
    assert (tmp_path / f'o.{ending}').read_bytes().startswith(begin)


@pytest.mark.needs('graphviz')
def test_a_large_graph(call: Mddag, tmp_path: Path) -> None:
    lines = ['mddag: 1', 'nodes:']
    for dag in range(60):
        lines += [f'  - node: /n{dag}', '    callbacks:',
                  f'      - {{name: c, timer: 10ms, publishes: [/t{dag}]}}']
        lines += [f'      - {{name: c{i}, subscription: /t{dag}, deadline: 20ms}}'
                  for i in range(20)]
    done = call('graph', 'draw', '-', '-o', 'o.svg', cwd=tmp_path, stdin='\n'.join(lines))
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
    text = (tmp_path / 'o.svg').read_text()
    assert text.count('class="edge"') == 60 * 20


def test_without_graphviz(
        call: Mddag, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('PATH', str(Path(sys.executable).parent))
    if shutil.which('dot') is not None:
        pytest.skip('Graphviz lies beside Python')
    done = call('graph', 'draw', CONFIG / 'autoware.yaml', '-o', 'o.svg', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == (
        "error: o.svg: this needs Graphviz, and its program 'dot' is not there: install it with "
        "'sudo apt install graphviz', or name an OUT.dot or OUT.mmd\n")


def test_graphviz_that_fails(
        call: Mddag, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / 'dot'
    program.write_text('#!/bin/sh\ncat >/dev/null\necho no fonts >&2\nexit 3\n')
    program.chmod(0o755)
    monkeypatch.setenv('PATH', f'{tmp_path}:/usr/bin:/bin')
    done = call('graph', 'draw', CONFIG / 'autoware.yaml', '-o', 'o.svg', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith('error: o.svg: Graphviz failed (no fonts): ')
    assert not (tmp_path / 'o.svg').exists()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `graph schema` and `graph fmt`."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import subprocess

from msg_graph.language import schema

Mddag = Callable[..., subprocess.CompletedProcess[str]]

UGLY = """\
mddag:   1  # format
nodes:
- {node: /n,   callbacks: [{name: t, timer: 10ms, deadline: 5ms}]}
"""
NORMAL = """\
mddag: 1    # format
nodes:
  - {node: /n, callbacks: [{name: t, timer: 10ms, deadline: 5ms}]}
"""


def test_schema(call: Mddag, tmp_path: Path) -> None:
    done = call('graph', 'schema')
    assert (done.returncode, done.stderr) == (0, '')
    assert json.loads(done.stdout) == schema()
    done = call('graph', 'schema', '-o', 's.json', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, '')
    assert json.loads((tmp_path / 's.json').read_text()) == schema()


def test_fmt_in_place(call: Mddag, tmp_path: Path) -> None:
    path = tmp_path / 'g.yaml'
    path.write_text(UGLY)
    done = call('graph', 'fmt', '--check', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr == "g.yaml: not in normal form: run 'mddag graph fmt' on it\n"
    assert path.read_text() == UGLY
    done = call('graph', 'fmt', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
    assert path.read_text() == NORMAL
    done = call('graph', 'fmt', '--check', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


def test_fmt_standard_input(call: Mddag) -> None:
    done = call('graph', 'fmt', '-', stdin=UGLY)
    assert (done.returncode, done.stdout, done.stderr) == (0, NORMAL, '')


def test_fmt_leaves_a_wrong_declaration_alone(call: Mddag, tmp_path: Path) -> None:
    path = tmp_path / 'g.yaml'
    path.write_text(UGLY.replace('timer', 'tmer'))
    done = call('graph', 'fmt', 'g.yaml', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith('error: g.yaml:3: ')
    assert path.read_text() == UGLY.replace('timer', 'tmer')

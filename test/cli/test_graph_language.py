# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph schema`."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import subprocess

from msg_graph.language import schema

Mddag = Callable[..., subprocess.CompletedProcess[str]]


def test_schema(call: Mddag, tmp_path: Path) -> None:
    done = call('graph', 'schema')
    assert (done.returncode, done.stderr) == (0, '')
    assert json.loads(done.stdout) == schema()
    done = call('graph', 'schema', '-o', 's.json', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, '')
    assert json.loads((tmp_path / 's.json').read_text()) == schema()

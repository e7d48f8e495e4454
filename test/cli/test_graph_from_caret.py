# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph from-caret`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import subprocess

Mddag = Callable[..., subprocess.CompletedProcess[str]]

TEXT = """\
nodes:
- node_name: /a
  callbacks:
  - {callback_name: /a/callback_0, callback_type: timer_callback, period_ns: 5000000}
"""


def test_from_caret(call: Mddag, tmp_path: Path) -> None:
    (tmp_path / 'arch.yaml').write_text(TEXT)
    done = call('graph', 'from-caret', 'arch.yaml', '-o', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout == "1 blank to fill in, marked 'FILL IN'\n"
    done = call('graph', 'check', 'g.yaml', cwd=tmp_path)
    assert done.returncode == 2
    assert 'deadline: is a blank to fill in (a sink' in done.stderr
    text = (tmp_path / 'g.yaml').read_text()
    done = call('graph', 'check', '-', stdin=text.replace('# deadline: 5ms', 'deadline: 5ms'))
    assert (done.returncode, done.stderr) == (0, '')


def test_standard_input_and_output(call: Mddag) -> None:
    done = call('graph', 'from-caret', '-', stdin=TEXT)
    assert (done.returncode, done.stderr) == (0, '')
    assert '        timer: 5ms\n' in done.stdout
    done = call('graph', 'from-caret', '-', stdin='mddag: 1')
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith('error: <stdin>: this is no architecture file of CARET: ')
    assert done.stderr.count('\n') == 1

# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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


def test_from_caret(mddag: Mddag, tmp_path: Path) -> None:
    (tmp_path / 'arch.yaml').write_text(TEXT)
    done = mddag('graph', 'from-caret', 'arch.yaml', '-o', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout == "1 blank to fill in, marked 'FILL IN'\n"
    done = mddag('graph', 'check', 'g.yaml', cwd=tmp_path)
    assert done.returncode == 2
    assert 'it is a sink' in done.stderr
    text = (tmp_path / 'g.yaml').read_text()
    done = mddag('graph', 'check', '-', input=text.replace('# deadline: 5ms', 'deadline: 5ms'))
    assert (done.returncode, done.stderr) == (0, '')


def test_standard_input_and_output(mddag: Mddag) -> None:
    done = mddag('graph', 'from-caret', '-', input=TEXT)
    assert (done.returncode, done.stderr) == (0, '')
    assert '        timer: 5ms\n' in done.stdout
    done = mddag('graph', 'from-caret', '-', input='mddag: 1')
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith('error: <stdin>: this is no architecture file of CARET: ')
    assert done.stderr.count('\n') == 1


def test_help_has_an_example(mddag: Mddag) -> None:
    done = mddag('graph', 'from-caret', '--help')
    assert done.returncode == 0
    assert 'mddag graph from-caret architecture.yaml -o graph.yaml' in done.stdout

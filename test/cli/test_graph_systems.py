# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `graph from-trace` and `graph from-ros`, `--trace` of `from-caret`, and drift."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import re
import subprocess

from mddag_executor.report.tables import drift_lines, MOST_LINES
import msg_graph
import pytest

Mddag = Callable[..., subprocess.CompletedProcess[str]]

BAG = Path(__file__).resolve().parents[2] / 'bags' / 'demo_short.mcap'
ARCHITECTURE = """\
nodes:
- node_name: /sensing/imu/imu_corrector
  callbacks:
  - {callback_name: /sensing/imu/imu_corrector/callback_0, callback_type: timer_callback,
     period_ns: 33000000}
- node_name: /nobody
  callbacks:
  - {callback_name: /nobody/callback_0, callback_type: timer_callback, period_ns: 5000000}
"""


def test_from_trace(call: Mddag, tmp_path: Path) -> None:
    done = call('graph', 'from-trace', BAG, '-o', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'no blanks to fill in\n', '')
    task_set = msg_graph.load(tmp_path / 'g.yaml')
    assert len(task_set.dags) == 11 and len(task_set.vertices) == 86
    done = call('graph', 'from-trace', '-', stdin=BAG.read_bytes())
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.splitlines()[1:] == (tmp_path / 'g.yaml').read_text().splitlines()[1:]


def test_from_trace_keeps_what_was_declared(
        call: Mddag, mddag: Mddag, tmp_path: Path) -> None:
    pytest.importorskip('rclpy')
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nnodes:\n  - node: /n\n    callbacks:\n      - {name: t, timer: 10ms, '
        'deadline: 5s, on_miss: abort, max_active_jobs: 900, holds_interpreter: false}\n')
    done = mddag('run', 'g.yaml', '--synthetic', 'sleep', '--duration', '0.3s', '--trace',
                 'r.mcap', cwd=tmp_path)
    assert done.returncode == 0
    done = call('graph', 'from-trace', 'r.mcap', '-o', 'again.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    callback, = msg_graph.load(tmp_path / 'again.yaml').callbacks
    assert (callback.on_miss, callback.max_active_jobs, callback.holds_interpreter) == (
        'abort', 900, False)


def test_from_trace_of_something_else(call: Mddag, tmp_path: Path) -> None:
    (tmp_path / 'x').write_text('no trace')
    (tmp_path / 'empty').mkdir()
    done = call('graph', 'from-trace', 'empty', '-o', 'g.yaml', cwd=tmp_path)
    assert done.stderr == 'error: empty: is an empty folder: give a trace, an .mcap file\n'
    for name in ('x', 'none', str(tmp_path)):
        done = call('graph', 'from-trace', name, '-o', 'g.yaml', cwd=tmp_path)
        assert (done.returncode, done.stdout) == (2, '')
        assert done.stderr.startswith(f'error: {name}: ') and done.stderr.count('\n') == 1
    assert not (tmp_path / 'g.yaml').exists()


def test_from_caret_with_a_trace(call: Mddag, tmp_path: Path) -> None:
    (tmp_path / 'a.yaml').write_text(ARCHITECTURE)
    done = call('graph', 'from-caret', 'a.yaml', '--trace', BAG, '-o', 'g.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "2 blanks to fill in, marked 'FILL IN'\n")
    assert done.stderr == f'warning: {BAG}: 1 of the 2 callbacks of a.yaml did not run\n'
    text = (tmp_path / 'g.yaml').read_text()
    assert len(re.findall(r'# measured in \d+ executions\n        execution_time: {quant', text)
               ) == 1
    done = call('graph', 'from-caret', '-', '--trace', '-', stdin=ARCHITECTURE)
    assert (done.returncode, done.stdout) == (2, '')


def test_from_ros_where_nothing_runs(mddag: Mddag, tmp_path: Path) -> None:
    pytest.importorskip('rclpy')
    done = mddag('graph', 'from-ros', '--timeout', '0.3', '-o', 'g.yaml', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith('error: ROS graph: no node ')
    assert not (tmp_path / 'g.yaml').exists()
    done = mddag('graph', 'from-ros', '--timeout', '-1')
    assert (done.returncode, done.stderr.count('\n')) == (2, 1)


def test_replay_tells_of_drift(call: Mddag, tmp_path: Path) -> None:
    done = call('replay', BAG, '--json', '-')
    assert done.returncode == 0
    assert json.loads(done.stdout)['drift'] == []
    assert 'difference' not in call('replay', BAG).stdout
    call('graph', 'from-trace', BAG, '-o', 'g.yaml', cwd=tmp_path)
    text = (tmp_path / 'g.yaml').read_text()
    (tmp_path / 'h.yaml').write_text(text.replace('timer: 100ms', 'timer: 200ms'))
    done = call('replay', BAG, 'h.yaml', '--json', 'r.json', cwd=tmp_path)
    assert done.returncode == 0
    found = json.loads((tmp_path / 'r.json').read_text())['drift']
    assert {each['kind'] for each in found} == {'rate'}
    assert done.stdout.splitlines()[-1 - min(len(found), MOST_LINES)].startswith(
        f'{len(found)} difference')


def test_drift_lines() -> None:
    assert list(drift_lines([])) == []
    assert list(drift_lines([{'text': 'a\x1b'}])) == [
        '1 difference between the run and the declaration:', '  a\\x1b']
    many = list(drift_lines([{'text': str(i)} for i in range(MOST_LINES + 3)]))
    assert (len(many), many[-1]) == (MOST_LINES + 2, '  … (3 more)')


def test_includes(call: Mddag, tmp_path: Path) -> None:
    (tmp_path / 'part.yaml').write_text(
        'mddag: 1\narguments:\n  d:\nnodes:\n  - {node: /n, callbacks: '
        '[{name: t, timer: 10ms, deadline: $(d)}]}\n')
    top = tmp_path / 'top.yaml'
    top.write_text('mddag: 1\ninclude:\n  - {file: part.yaml, namespace: /a, set: {d: 5ms}}\n'
                   '  - {file: part.yaml, namespace: /b, set: {d: 6}}\n')
    done = call('graph', 'check', 'top.yaml', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith("error: part.yaml:5: callback '/b/n:t': 'deadline': '6' has no")
    top.write_text(top.read_text().replace('d: 6', 'd: 6ms'))
    done = call('graph', 'check', 'top.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert '2 DAGs, 2 vertices' in done.stdout
    done = call('graph', 'check', '-', stdin=top.read_text(), cwd=tmp_path)
    assert done.returncode == 2
    assert 'not read from a file includes nothing' in done.stderr
    done = call('simulate', 'top.yaml', '--policy', 'rad', '--workers', '1', '--duration',
                '100ms', '--trace', 's.mcap', '--execution-times', '-', cwd=tmp_path,
                stdin='{"/a/n": {"/a/n:t": 10}, "/b/n": {"/b/n:t": 10}}')
    assert (done.returncode, done.stderr) == (0, '')
    top.unlink()  # the trace holds all of the declaration
    done = call('replay', 's.mcap', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    done = call('graph', 'fmt', 'part.yaml', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph check`."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import subprocess

from benchmarks import autoware_multi
import pytest

Mddag = Callable[..., subprocess.CompletedProcess[str]]

CONFIG = Path(__file__).resolve().parents[2] / 'config'
GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a], dag: one, execution_time: 2ms}
      - {name: x, subscription: /a, deadline: 5ms, execution_time: {quantiles_us: [1000, 3000]}}
      - {name: y, subscription: /a, deadline: 50ms, reads: [x], execution_time: 5ms}
      - {name: u, timer: 20ms, deadline: 20ms}
paths:
  - {name: p, callbacks: ['/n:t', '/n:x', '/n:y']}
"""


def test_standard_input_and_output(call: Mddag, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('mddag_executor.defaults.processors', lambda: 8)
    text = autoware_multi.task_set().text
    done = call('graph', 'check', '-', '--json', '-', stdin=text)
    assert done.returncode == 0
    warned = [line.partition(': its deadline is longer than its period, and ')[0]
              for line in done.stderr.splitlines()]
    assert warned == ['warning: perception', 'warning: planning']
    result = json.loads(done.stdout)
    assert len(result['dags']) == 11
    control = result['dags']['control']
    assert control['rad_offset_ns'] == [15_000_000, 30_000_000, *[15_000_000] * 3]
    assert list(control['sinks'].values()) == [30_000_000, 15_000_000]


def test_utilisation_is_one_thing_in_all_commands(call: Mddag, tmp_path: Path) -> None:
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nworkers: 2\nnodes:\n  - node: /n\n    callbacks:\n'
        '      - {name: t, timer: 10ms, deadline: 10ms, execution_time: 4ms}\n')
    trace = ['simulate', 'g.yaml', '--duration', '1s', '--trace', 'g.mcap']
    for command in (
            ['graph', 'check', 'g.yaml'], ['graph', 'analyse', 'g.yaml'], trace,
            ['replay', 'g.mcap'], ['replay', 'g.mcap', '--reschedule']):
        done = call(*command, '--json', '-', cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        result = json.loads(done.stdout)
        assert result['utilisation'] == pytest.approx(0.2, abs=0.002), command
        assert result.get('load', 0.4) == 0.4


@pytest.mark.parametrize(('text', 'workers', 'says'), [
    ('deadline: 10ms, execution_time: 25ms', 4,
     '/n:t: the longest path to it takes 25 ms, more than its deadline of 10 ms: no scheduler'),
    ('deadline: 10s, execution_time: 5s', 7,
     'g.yaml: a load of 250.000 is more than 7 workers can do: no scheduler can keep the deadlin'),
    ('deadline: 10s, execution_time: 5s', 512,
     'g.yaml: a load of 250.000 is more than the 2 CPUs of this machine can do, unless callbacks'),
    ('deadline: 20ms, execution_time: 19ms', 1, None),
    ('deadline: 10ms', 1, None)])
def test_what_cannot_hold_is_warned_of(
    call: Mddag, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, workers: int,
    says: str | None,
) -> None:
    monkeypatch.setattr('mddag_executor.defaults.processors', lambda: 2)
    (tmp_path / 'g.yaml').write_text(
        f'mddag: 1\nworkers: {workers}\nnodes:\n'
        f'  - {{node: /n, callbacks: [{{name: t, timer: 20ms, {text}}}]}}\n')
    done = call('graph', 'check', 'g.yaml', '--json', '-', cwd=tmp_path)
    assert done.returncode == 0
    if says is None:
        assert done.stderr == ''
    else:
        assert any(line.startswith(f'warning: {says}') for line in done.stderr.splitlines())
    assert 'dags' in json.loads(done.stdout)

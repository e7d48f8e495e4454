# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `graph …`: what `golden/` cannot show, such as Graphviz and runs of rclpy."""

import json
from pathlib import Path
import shutil
import sys

from mddag_executor import open_recording
import msg_graph
from msg_graph.language import schema
import pytest

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / 'config'
BAG = ROOT / 'bags' / 'demo_short.mcap'


def test_utilisation_is_one_thing_in_all_commands(call, tmp_path):
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nworkers: 2\nnodes:\n  - node: /n\n    callbacks:\n'
        '      - {name: t, timer: 10ms, deadline: 10ms, execution_time: 4ms}\n')
    for command in (
            'graph check g.yaml',
            'simulate g.yaml --duration 1s --trace g.mcap', 'replay g.mcap',
            'replay g.mcap --reschedule'):
        result = call(*command.split(), '--json', '-', cwd=tmp_path).result
        assert result['utilisation'] == pytest.approx(0.2, abs=0.002), command
        assert result.get('load', 0.4) == 0.4


@pytest.mark.parametrize('untimed', [
    '{name: slow, timer: 1s, dag: slow, deadline: 1s}',
    '{name: start, timer: 1s, dag: start, once: true, deadline: 1s}'])
def test_without_an_execution_time_nothing_is_tested_and_a_line_says_so(call, tmp_path, untimed):
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nworkers: 2\nnodes:\n  - node: /n\n    callbacks:\n'
        '      - {name: t, timer: 10ms, dag: t, deadline: 10ms, execution_time: 4ms}\n'
        f'      - {untimed}\n')
    status, out, err = call('graph', 'check', 'g.yaml', cwd=tmp_path)
    assert (status, err) == (0, '')
    name = untimed[7:].partition(',')[0]
    assert ('\nwhether the deadlines can hold is not tested, as 1 callback declares no '
            f'execution_time: /n:{name}\n') in out
    assert call('graph', 'check', 'g.yaml', '--json', '-', cwd=tmp_path).result['tests'] == []


def test_a_draft_needs_the_traces_of_one_run(call, tmp_path):
    done = call('graph', 'from-trace', BAG, '-', '-o', 'g.yaml', cwd=tmp_path)
    assert done.returncode == 2 and 'of several traces none can be standard input' in done.stderr
    (tmp_path / 'run').mkdir()
    shutil.copy(BAG, tmp_path / 'run')
    assert call('graph', 'from-trace', 'run', '-o', 'g.yaml', cwd=tmp_path).returncode == 0


def test_schema(call, tmp_path):
    assert call('graph', 'schema').result == schema()
    assert call('graph', 'schema', '-o', 's.json', cwd=tmp_path) == (0, '', '')
    assert json.loads((tmp_path / 's.json').read_text()) == schema()


# --- draw ----------------------------------------------------------------------------------------


@pytest.mark.needs('graphviz')
@pytest.mark.parametrize(('ending', 'begin'), [
    ('svg', b'<?xml'), ('png', b'\x89PNG'), ('pdf', b'%PDF')])
def test_graphviz(call, tmp_path, ending, begin):
    text = (CONFIG / 'autoware.yaml').read_text()
    done = call('graph', 'draw', '-', '-o', f'o.{ending}', cwd=tmp_path, stdin=text)
    assert done == (0, '', '')
    assert (tmp_path / f'o.{ending}').read_bytes().startswith(begin)


@pytest.mark.needs('graphviz')
def test_a_large_graph(call, tmp_path):
    lines = ['mddag: 1', 'nodes:']
    for dag in range(60):
        lines += [f'  - node: /n{dag}', '    callbacks:',
                  f'      - {{name: c, timer: 10ms, publishes: [/t{dag}]}}']
        lines += [f'      - {{name: c{i}, subscription: /t{dag}, deadline: 20ms}}'
                  for i in range(20)]
    done = call('graph', 'draw', '-', '-o', 'o.svg', cwd=tmp_path, stdin='\n'.join(lines))
    assert done == (0, '', '')
    assert (tmp_path / 'o.svg').read_text().count('class="edge"') == 60 * 20


def test_a_dense_graph_is_drawn_quickly(call, tmp_path):
    """Graphviz would need minutes for 30 boxes, each of which starts all later ones."""
    lines = ['mddag: 1', 'nodes:',
             '  - {node: /n0, callbacks: [{name: c, timer: 1s, publishes: [/t0]}]}']
    for i in range(1, 30):
        topics = ', '.join(f'/t{j}' for j in range(i))
        starts = f'sync: [{topics}]' if i > 1 else 'subscription: /t0'
        ends = f'publishes: [/t{i}]' if i < 29 else 'deadline: 1s'
        lines.append(f'  - {{node: /n{i}, callbacks: [{{name: c, {starts}, {ends}}}]}}')
    assert call('graph', 'draw', '-', '-o', 'o.dot', cwd=tmp_path, stdin='\n'.join(lines)) == (
        0, '', '')
    assert 'nslimit' in (tmp_path / 'o.dot').read_text()


@pytest.mark.parametrize(('dot', 'status', 'says'), [
    (None, 2, "error: o.svg: this needs Graphviz, whose program 'dot' was not found: install it "
     "with 'sudo apt install graphviz', or name an OUT.dot or OUT.mmd\n"),
    ('cat >/dev/null\necho no fonts >&2\nexit 3\n', 2,
     'error: o.svg: Graphviz failed (no fonts): '),
    ('sleep 0.7\ncat\n', 0, 'warning: o.svg: Graphviz takes long')])
def test_graphviz_that_is_missing_fails_or_is_slow(
        call, tmp_path, monkeypatch, dot, status, says):
    path = str(Path(sys.executable).parent)
    if dot is not None:
        (tmp_path / 'dot').write_text(f'#!/bin/sh\n{dot}')
        (tmp_path / 'dot').chmod(0o755)
        path = f'{tmp_path}:/usr/bin:/bin'
    elif shutil.which('dot', path=path):
        pytest.skip('Graphviz is in the folder of Python')
    monkeypatch.setenv('PATH', path)
    monkeypatch.setattr('mddag_executor.cli.text.SLOW_S', 0.0)
    done = call('graph', 'draw', CONFIG / 'autoware.yaml', '-o', 'o.svg', cwd=tmp_path)
    assert (done.returncode, done.stderr.count('\n')) == (status, 1)
    assert done.stderr.startswith(says)
    assert (tmp_path / 'o.svg').exists() == (status == 0)


# --- from recordings and from ROS ----------------------------------------------------------------


def test_from_trace(call, tmp_path):
    done = call('graph', 'from-trace', BAG, '-o', 'g.yaml', cwd=tmp_path)
    assert done == (0, 'no blanks to fill in\n', '')
    before, again = ([
        (dag.name, dag.period_ns, dag.edges, [(v.name, v.deadline_ns) for v in dag.vertices])
        for dag in task_set.dags] for task_set in (
            open_recording(BAG).task_set, msg_graph.load(tmp_path / 'g.yaml')))
    assert before == again and len(again) == 11
    text = (tmp_path / 'g.yaml').read_text()
    done = call('graph', 'from-trace', '-', stdin=BAG.read_bytes())
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.splitlines()[1:] == text.splitlines()[1:]
    # What differs from it is reported.
    assert call('replay', BAG, '--json', '-').result['drift'] == []
    (tmp_path / 'h.yaml').write_text(text.replace('timer: 100ms', 'timer: 200ms'))
    found = call('replay', BAG, tmp_path / 'h.yaml', '--json', '-').result['drift']
    assert {each['kind'] for each in found} == {'rate'}


def test_a_trace_holds_what_its_declaration_includes(call, tmp_path):
    (tmp_path / 'part.yaml').write_text(
        'mddag: 1\narguments:\n  d:\nnodes:\n  - {node: /n, callbacks: '
        '[{name: t, timer: 10ms, deadline: $(d)}]}\n')
    top = tmp_path / 'top.yaml'
    top.write_text('mddag: 1\ninclude:\n  - {file: part.yaml, namespace: /a, set: {d: 5ms}}\n'
                   '  - {file: part.yaml, namespace: /b, set: {d: 6ms}}\n')
    done = call('simulate', 'top.yaml', '--duration', '100ms', '--trace', 's.mcap',
                '--execution-times', '-', cwd=tmp_path,
                stdin='{"/a/n": {"/a/n:t": 10}, "/b/n": {"/b/n:t": 10}}')
    assert (done.returncode, done.stderr) == (0, '')
    top.unlink()
    done = call('replay', 's.mcap', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')

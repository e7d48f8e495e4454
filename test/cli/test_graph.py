# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs `graph check`, `place`, `analyse`, `draw`, `from-caret` and `schema`."""

import json
from pathlib import Path
import shutil
import sys

import msg_graph
from msg_graph.language import schema
import pytest

CONFIG = Path(__file__).resolve().parents[2] / 'config'
GRAPH = """\
mddag: 1  # the robot
nodes:
  - node: /a
    callbacks: [{name: t, timer: 100ms, deadline: 40ms, execution_time: 30ms}]
  - node: /b
    callbacks: [{name: t, timer: 100ms, deadline: 40ms, execution_time: 30ms}]
  - node: /c
    callbacks: [{name: t, timer: 100ms, deadline: 100ms, execution_time: 10ms}]
"""


def test_standard_input_and_output(call, monkeypatch):
    monkeypatch.setattr('mddag_executor.defaults.processors', lambda: 8)
    text = msg_graph.load(CONFIG / 'autoware_multi.yaml').text
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
    for workers, shown in (('', '0.100 of 7 workers'),
                           ('workers: 2\n', '0.350 of 2 workers')):
        done = call('graph', 'check', '-', stdin=GRAPH.replace('nodes:', f'{workers}nodes:'))
        assert done.stdout.endswith(f', load 0.700, utilisation {shown}\n')


def test_utilisation_is_one_thing_in_all_commands(call, tmp_path):
    (tmp_path / 'g.yaml').write_text(
        'mddag: 1\nworkers: 2\nnodes:\n  - node: /n\n    callbacks:\n'
        '      - {name: t, timer: 10ms, deadline: 10ms, execution_time: 4ms}\n')
    trace = ['simulate', 'g.yaml', '--duration', '1s', '--trace', 'g.mcap']
    for command in (
            ['graph', 'check', 'g.yaml'], ['graph', 'analyse', 'g.yaml'], trace,
            ['replay', 'g.mcap'], ['replay', 'g.mcap', '--reschedule']):
        result = json.loads(call(*command, '--json', '-', cwd=tmp_path).stdout)
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
def test_what_cannot_hold_is_warned_of(call, tmp_path, monkeypatch, text, workers, says):
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


def test_rules_of_the_user(graph, call):
    place = ['graph', 'place', 'graph.yaml', '--processes', '2', '-o', 'placed.yaml']
    assert call(*place, '--together', '/a, /b').returncode == 0
    assert msg_graph.load('placed.yaml').process_of('/a') == msg_graph.load(
        'placed.yaml').process_of('/b')
    assert call(*place, '--apart', '/a,/c', '--apart', '/b,/c').returncode == 0
    assert [p.nodes for p in msg_graph.load('placed.yaml').processes] == [('/a', '/b'), ('/c',)]


def test_times_of_a_recorded_run(graph, call):
    Path('times.json').write_text(json.dumps(
        {f'/{n}': {f'/{n}:t': us} for n, us in (('a', 45_000), ('b', 5_000), ('c', 40_000))}))
    recorded = call('simulate', 'graph.yaml', '--execution-times', 'times.json', '--trace',
                    'run.mcap', '--duration', '1s')
    assert recorded.returncode == 0, recorded.stderr
    run = call('graph', 'place', 'graph.yaml', '--processes', '2', '--trace', 'run.mcap',
               '-o', 'placed.yaml', '--json', 'out.json')
    assert run.returncode == 0, run.stderr
    result = json.loads(Path('out.json').read_text())
    assert sorted(result['loads']) == pytest.approx([0.45, 0.45], abs=0.01)


GRAPH_ANALYSE = """\
mddag: 1
workers: 2
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, deadline: 5ms, execution_time: {quantiles_us: [1000, 2000, 9000]}}
"""


def test_ci_learns_of_deadlines_that_cannot_hold(call):
    for budget, status in (('mean', 0), ('max', 1)):
        done = call('graph', 'analyse', '-', '--budget', budget, '--fail-on-unschedulable',
                    stdin=GRAPH_ANALYSE)
        assert (done.returncode, done.stderr) == (status, '')
        assert ('no scheduler can keep' in done.stdout) == bool(status)


@pytest.mark.needs('graphviz')
@pytest.mark.parametrize(('ending', 'begin'), [
    ('svg', b'<?xml'), ('png', b'\x89PNG'), ('pdf', b'%PDF')])
def test_graphviz(call, tmp_path, ending, begin):
    text = (CONFIG / 'autoware.yaml').read_text()
    done = call('graph', 'draw', '-', '-o', f'o.{ending}', cwd=tmp_path, stdin=text)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
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
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
    text = (tmp_path / 'o.svg').read_text()
    assert text.count('class="edge"') == 60 * 20


def test_a_dense_graph_is_drawn_quickly(call, tmp_path):
    """Graphviz would need minutes for 30 boxes, each of which starts all later ones."""
    lines = ['mddag: 1', 'nodes:',
             '  - {node: /n0, callbacks: [{name: c, timer: 1s, publishes: [/t0]}]}']
    for i in range(1, 30):
        topics = [f'/t{j}' for j in range(i)]
        starts = f'sync: [{", ".join(topics)}]' if i > 1 else 'subscription: /t0'
        ends = f'publishes: [/t{i}]' if i < 29 else 'deadline: 1s'
        lines.append(f'  - {{node: /n{i}, callbacks: [{{name: c, {starts}, {ends}}}]}}')
    done = call('graph', 'draw', '-', '-o', 'o.dot', cwd=tmp_path, stdin='\n'.join(lines))
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
    assert 'nslimit' in (tmp_path / 'o.dot').read_text()


def test_without_graphviz(call, tmp_path, monkeypatch):
    monkeypatch.setenv('PATH', str(Path(sys.executable).parent))
    if shutil.which('dot') is not None:
        pytest.skip('Graphviz is in the folder of Python')
    done = call('graph', 'draw', CONFIG / 'autoware.yaml', '-o', 'o.svg', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == (
        "error: o.svg: this needs Graphviz, and its program 'dot' is not there: install it with "
        "'sudo apt install graphviz', or name an OUT.dot or OUT.mmd\n")


def test_graphviz_that_fails(call, tmp_path, monkeypatch):
    program = tmp_path / 'dot'
    program.write_text('#!/bin/sh\ncat >/dev/null\necho no fonts >&2\nexit 3\n')
    program.chmod(0o755)
    monkeypatch.setenv('PATH', f'{tmp_path}:/usr/bin:/bin')
    done = call('graph', 'draw', CONFIG / 'autoware.yaml', '-o', 'o.svg', cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith('error: o.svg: Graphviz failed (no fonts): ')
    assert not (tmp_path / 'o.svg').exists()


def test_a_slow_graphviz_is_reported(call, tmp_path, monkeypatch):
    program = tmp_path / 'dot'
    program.write_text('#!/bin/sh\nsleep 0.7\ncat\n')
    program.chmod(0o755)
    monkeypatch.setenv('PATH', f'{tmp_path}:/usr/bin:/bin')
    monkeypatch.setattr('mddag_executor.cli.text.SLOW_S', 0.0)
    done = call('graph', 'draw', CONFIG / 'autoware.yaml', '-o', 'o.svg', cwd=tmp_path)
    assert done.returncode == 0 and (tmp_path / 'o.svg').exists()
    assert done.stderr.startswith('warning: o.svg: Graphviz takes long')
    assert done.stderr.count('\n') == 1


def test_schema(call, tmp_path):
    assert call('graph', 'schema').result == schema()
    done = call('graph', 'schema', '-o', 's.json', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, '')
    assert json.loads((tmp_path / 's.json').read_text()) == schema()

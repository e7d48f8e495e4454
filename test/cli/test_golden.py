# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What commands print and write, as files in golden/.

After a wanted change: `UPDATE_GOLDEN=1 python -m pytest test/cli`; look at the difference before
you commit it.
"""

import json
from pathlib import Path
import re
import shutil

import pytest

from ..report import runs
from ..report.drawn import GRAPH
from ..sources.recorded import four_jobs, MS, Recorded
from ..trace.ctf_session import session
from . import golden

ROOT = Path(__file__).resolve().parents[2]
# The files that the last command writes are appended to what they print.
COMMANDS = {
    'check': 'graph check graph.yaml',
    'check_json': 'graph check graph.yaml --json -',
    'check_stdin': (
        'graph check - < ROOT/config/autoware.yaml; '
        'graph check - < ROOT/config/autoware_multi.yaml; '
        'graph check - < ROOT/config/reference_system.yaml'),
    'check_warnings': '; '.join(f'graph check {name}.yaml' for name in (
        'hopeless', 'overloaded', 'many_workers', 'timed')),
    'check_status': (
        'graph check graph.yaml --fail-on-unschedulable -q; '
        'graph check timed.yaml --fail-on-unschedulable --budget max --workers 3'),
    'assign': 'graph assign-deadlines graph.yaml --runs 20 -o out.yaml',
    'place': 'graph place graph.yaml --processes 2 -o out.yaml',
    'place_json': 'graph place graph.yaml --processes 2 --json - -o out.yaml',
    'place_trace': 'graph place graph.yaml own.mcap --processes 2 -o -',
    'generate': 'generate --dags 2 --vertices 3:5 --sinks 2 --or-share 0.5 --seed 4',
    'simulate': 'simulate graph.yaml --duration 200ms',
    'simulate_options': '; '.join(f'simulate graph.yaml --duration 200ms {how}' for how in (
        '--execution-times times.json', '--judge completions', '--preemptive',
        '--on-late demote', '--stop-at-first-miss --report out.html')),
    'simulate_json': 'simulate graph.yaml --duration 200ms --policy fifo --json -',
    'evaluate': 'evaluate graph.yaml --runs 30 --policies rad,fifo --parallel 1 --duration 200ms',
    'evaluate_json': 'evaluate graph.yaml --runs 30 --policies rad --parallel 1 --json -',
    'evaluate_several': (
        'generate --sets 2 --utilisation 0.2:0.6 --workers 2 -o sets; '
        'evaluate graph.yaml sets --runs 5 --policies rad --no-preemptive --duration 100ms '
        '--parallel 1 --json -'),
    'draw_dot': 'graph draw picture.yaml -o out.dot',
    'draw_mermaid': 'graph draw picture.yaml -o out.mmd',
    'draw_autoware': 'graph draw - -o out.mmd < ROOT/config/autoware.yaml',
    'from_caret': 'graph from-caret architecture.yaml -o out.yaml',
    'from_trace': 'graph from-trace drive.mcap -o out.yaml',
    'from_trace_accept': 'graph from-trace drive.mcap --accept -o out.yaml',
    'from_trace_left_out': (
        'graph from-trace odd.mcap -o blank.yaml; graph check blank.yaml; '
        'graph from-trace odd.mcap --accept -o out.yaml; replay odd.mcap out.yaml'),
    'within_a_process': (
        'graph from-trace within.mcap --accept -o out.yaml; replay within.mcap out.yaml; '
        'graph from-caret architecture.yaml within.mcap'),
    'import_ctf': 'import ctf session -o drive_2.mcap',
    'explain': 'explain run.mcap --json out.json',
    'explain_job': 'explain run.mcap --sink filter:run --job 2 --json out.json',
    'slack': 'slack run.mcap --parallel 1 --json out.json',
    'diff': 'diff run.mcap run.mcap tight.yaml --callbacks --json out.json',
    'diff_tolerance': 'diff run.mcap slow.mcap tolerant.yaml',
    'diff_status': '; '.join(f'diff {words} --fail-on-worse' for words in (
        'slow.mcap run.mcap', 'run.mcap slow.mcap', 'run.mcap slow.mcap wide.yaml',
        'run.mcap slow.mcap tight.yaml', 'run.mcap slow.mcap wide.yaml --allow-growth 5%',
        'run.mcap slow.mcap wide.yaml --allow-growth 1.0')),
    'diff_kinds': '; '.join(f'diff {words}' for words in (
        'own.mcap drive.mcap --json out.json', 'drive.mcap own.mcap',
        'drive.mcap drive.mcap seen.yaml')),
    'replay': 'replay run.mcap --callbacks --json out.json',
    'replay_imported': 'replay drive.mcap seen.yaml --json out.json',
    'replay_drift': 'replay drive.mcap other.yaml',
    'replay_part': '; '.join(f'{words} --from 200ms --to 500ms' for words in (
        'replay own.mcap', 'replay drive.mcap seen.yaml', 'explain own.mcap',
        'explain drive.mcap seen.yaml', 'export own.mcap --rows jobs -o out.csv')),
    'replay_undeclared': 'replay drive.mcap',
    'replay_preemptive': (
        'replay run.mcap --reschedule --policy fifo --preemptive --overheads none '
        '--report out.html'),
    'replay_tolerance': 'replay run.mcap tolerant.yaml --junit out.xml --github --report out.html',
    'reschedule': 'replay run.mcap --reschedule --workers 1 --json out.json',
    'export_executions': 'export run.mcap -o out.csv',
    'export_jobs': 'export run.mcap -o out.csv --rows jobs',
    'export_imported': 'export drive.mcap seen.yaml -o out.csv --rows jobs',
    'export_perfetto': 'export drive.mcap seen.yaml -o out.pftrace',
}
SEEN = """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
  - {node: /detect, callbacks: [{name: detect, subscription: /image, deadline: 8ms}]}
paths:
  - {name: seen, callbacks: ['/camera:grab', '/detect:detect']}
"""
LOAD = """\
mddag: 1
workers: 4
nodes:
  - {node: /n, callbacks: [{name: t, timer: 20ms, deadline: 10ms, execution_time: 25ms}]}
"""
TIMES = {'vision': {'/camera:grab': 2000, '/detector:detect': 7000.5, '/detector:stop': 1000,
                    '/detector:log': 1},
         'wheels': {'/wheels:odometry': 1500, '/wheels:brake': 1000}}


def within_a_process(path):
    """Write five messages within a process: rclcpp runs the subscription's second callback."""
    r = Recorded(path)
    r.node(1, '/camera')
    r.node(2, '/brake')
    r.timer(11, 1, 50 * MS)
    r.publisher(100, 1, '/image')
    r.subscription(12, 2, '/image', within=13)
    for k in range(1, 6):
        at = k * 50 * MS
        r.run(11, 1, at, at + 2 * MS)
        r.add('ros2:rclcpp_intra_publish', at + MS, 1, 100, 0x500)
        r.add('ros2:rclcpp_ring_buffer_enqueue', at + MS + 1, 1, 0xB, 0, 1, 0)
        r.add('ros2:rclcpp_ring_buffer_dequeue', at + 3 * MS, 2, 0xB, 0, 0)
        r.run(13, 2, at + 3 * MS + 1, at + 7 * MS + 1, within=True)
    r.write()


def odd(path):
    """Write a recording with two sources in a node, and callbacks without a rate."""
    r = Recorded(path)
    r.node(1, '/n')
    r.node(2, '/quiet')
    r.timer(11, 1, 10 * MS)
    r.timer(16, 1, 100_000_000 * MS)                # longer than a declaration allows
    r.publisher(100, 1, '/out')
    r.publisher(101, 1, '/status')                  # which no callback was seen to publish
    r.publisher(102, 2, '/alone')
    for callback, topic in ((12, '/in'), (13, '/never'), (14, '/once'), (15, '/status')):
        r.subscription(callback, 1, topic)
    r.subscription(17, 1, '/out')
    for k in range(1, 11):
        at = k * 10 * MS
        r.run(11, 1, at, at + MS)
        stamp = r.publish(100, 1, at + MS // 2)
        r.receive(17, 2, at + 2 * MS, at + (11 if k == 5 else 3) * MS, stamp)
        for callback in (12, 15) if k % 2 else ():
            r.receive(callback, callback, at, at + MS, at - MS)
    r.receive(14, 4, 50 * MS, 51 * MS, 49 * MS)
    r.write()


@pytest.fixture
def files(folder, call):
    """Give a working directory with declarations and recordings."""
    for file in golden.FOLDER.glob('*.yaml'):
        shutil.copy(file, folder)
    overloaded = LOAD.replace('10ms', '10s').replace('25ms', '5s')
    unpublished = SEEN.partition('paths')[0].replace('publishes: [/image]', 'deadline: 9ms')
    timed = SEEN.replace('/image]', '/image], execution_time: 2ms')
    for name, text in {
            'seen': SEEN, 'picture': GRAPH, 'hopeless': LOAD, 'overloaded': overloaded,
            'many_workers': overloaded.replace('workers: 4', 'workers: 512'),
            'other': unpublished.replace('image,', 'image, period: 100ms,'),
            'timed': timed.replace('8ms', '8ms, execution_time: 4ms'),
            'late': timed.replace('8ms', '1ms, execution_time: 4ms'),
            'tight': runs.GRAPH.replace('8ms', '5ms'), 'wide': runs.GRAPH.replace('8ms', '20ms'),
            'tolerant': runs.GRAPH.replace('8ms', '5ms, tolerate: 1 of 3')}.items():
        (folder / f'{name}.yaml').write_text(text)
    (folder / 'times.json').write_text(json.dumps(TIMES))
    runs.by_hand(folder / 'run.mcap')
    runs.by_hand(folder / 'slow.mcap', extra_ms=1)
    four_jobs(folder / 'drive.mcap')
    odd(folder / 'odd.mcap')
    within_a_process(folder / 'within.mcap')
    assert call('simulate', 'timed.yaml', '--duration', '1s', '--workers', '2', '--trace',
                'own.mcap', '-q') == (0, '', '')
    session(folder / 'session', [('ros2:callback_end', [('callback', 'u64')]),
                                 ('sensors:sample', [('value', 'u64')])],
            [(kind, 5 + kind, 1, 2, 'p', 3) for kind in (0, 1)])
    return folder


@pytest.mark.parametrize('name', COMMANDS)
def test_output(name, files, call, monkeypatch):
    if name.startswith('check'):
        monkeypatch.setattr('mddag_executor.defaults.processors', lambda: 8)
    found = ''
    for command in COMMANDS[name].split('; '):
        words, _, given = command.replace('ROOT', str(ROOT)).partition(' < ')
        status, out, err = call(*words.split(), stdin=Path(given).read_bytes() if given else b'')
        found += f'$ mddag {command}\n{out}' + (f'--- standard error\n{err}' if err else '')
        found += f'--- status {status}\n' if status else ''
    for path in sorted(files.glob('out.*')):
        if path.suffix == '.pftrace':
            text = ' '.join(sorted({*re.findall(r'/\w+:\w+', path.read_text(errors='replace'))}))
        elif path.suffix == '.html':      # its title and tables
            text = '\n'.join(re.findall('<h1>.*?</h1>|<table>.*?</table>', path.read_text(), re.S))
        else:
            text = path.read_bytes().decode()
        found += f'--- {path.name}\n{text.rstrip()}\n'
    golden.compare(name, found)


def test_quiet(files, call):
    """With -q nothing is printed that was not asked for."""
    for words in (['graph', 'check', 'graph.yaml'], ['replay', 'run.mcap'],
                  ['simulate', 'graph.yaml', '--trace', 'new.mcap']):
        assert call(*words, '-q') == (0, '', '')
    assert call('graph', 'check', 'graph.yaml', '-q', '--json', '-').stdout.startswith('{')

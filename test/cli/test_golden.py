# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What commands print and write, as files in golden/.

After a wanted change: `UPDATE_GOLDEN=1 python -m pytest test/cli`; look at the difference before
you commit it.
"""

import re
import shutil

import pytest

from ..replay.recorded import four_jobs
from ..report import runs
from ..report.test_pictures import GRAPH
from ..trace.ctf_session import session
from . import golden

# The files that a command writes are appended to what it prints.
COMMANDS = {
    'check': 'graph check graph.yaml',
    'check_json': 'graph check graph.yaml --json -',
    'analyse': 'graph analyse graph.yaml --budget mean',
    'analyse_json': 'graph analyse graph.yaml --json -',
    'assign': 'graph assign-deadlines graph.yaml --runs 20 -o out.yaml',
    'assign_target': 'graph assign-deadlines graph.yaml --target 0.8 --runs 40 --json out.json',
    'place': 'graph place graph.yaml --processes 2 --cpus 2 --duration 200ms -o out.yaml',
    'place_json': (
        'graph place graph.yaml --processes 2 --cpus 2 --duration 200ms --json - -o out.yaml'),
    'generate': 'generate --dags 2 --vertices 3:5 --sinks 2 --or-share 0.5 --seed 4',
    'simulate': 'simulate graph.yaml --duration 200ms',
    'simulate_json': 'simulate graph.yaml --duration 200ms --policy fifo --json -',
    'evaluate': 'evaluate graph.yaml --runs 30 --policies rad,fifo --jobs 1 --duration 200ms',
    'evaluate_json': 'evaluate graph.yaml --runs 30 --policies rad --jobs 1 --json -',
    'draw_dot': 'graph draw picture.yaml -o out.dot',
    'draw_mermaid': 'graph draw picture.yaml -o out.mmd',
    'from_caret': 'graph from-caret architecture.yaml -o out.yaml',
    'from_trace': 'graph from-trace drive.mcap -o out.yaml',
    'from_trace_accept': 'graph from-trace drive.mcap --accept -o out.yaml',
    'import_ctf': 'import ctf session -o drive_2.mcap',
    'explain': 'explain run.mcap --json out.json',
    'explain_job': 'explain run.mcap --sink filter:run --job 2 --json out.json',
    'slack': 'slack run.mcap --jobs 1 --json out.json',
    'diff': 'diff run.mcap run.mcap tight.yaml --callbacks --json out.json',
    'diff_tolerance': 'diff run.mcap slow.mcap tolerant.yaml',
    'replay': 'replay run.mcap --callbacks --json out.json',
    'replay_imported': 'replay drive.mcap seen.yaml --json out.json',
    'replay_undeclared': 'replay drive.mcap',
    'replay_preemptive': (
        'replay run.mcap --reschedule --policy fifo --preemptive --overheads none'),
    'replay_tolerance': 'replay run.mcap tolerant.yaml --junit out.xml --github --report out.html',
    'reschedule': 'replay run.mcap --reschedule --workers 1 --json out.json',
    'export_executions': 'export run.mcap -o out.csv',
    'export_jobs': 'export run.mcap -o out.csv --rows jobs',
}
SEEN = """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
  - {node: /detect, callbacks: [{name: detect, subscription: /image, deadline: 8ms}]}
paths:
  - {name: seen, callbacks: ['/camera:grab', '/detect:detect']}
"""


@pytest.fixture
def files(folder):
    """Give a working directory with declarations and recordings."""
    for file in golden.FOLDER.glob('*.yaml'):
        shutil.copy(file, folder)
    for name, text in (
            ('seen', SEEN), ('picture', GRAPH),
            ('tight', runs.GRAPH.replace('deadline: 8ms', 'deadline: 5ms')),
            ('tolerant', runs.GRAPH.replace('8ms', '5ms, tolerate: 1 of 3'))):
        (folder / f'{name}.yaml').write_text(text)
    runs.by_hand(folder / 'run.mcap')
    runs.by_hand(folder / 'slow.mcap', extra_ms=1)
    four_jobs(folder / 'drive.mcap')
    return folder


@pytest.mark.parametrize('name', [
    pytest.param(name, marks=[pytest.mark.needs('babeltrace2')] * (name == 'import_ctf'))
    for name in COMMANDS])
def test_output(name, files, call):
    if '.html' in COMMANDS[name]:
        pytest.importorskip('bokeh', reason='Bokeh is not installed')
    session(files / 'session', [('ros2:callback_end', [('callback', 'u64')]),
                                ('sensors:sample', [('value', 'u64')])],
            [(kind, 5 + kind, 1, 2, 'p', 3) for kind in (0, 1)])
    status, out, err = call(*COMMANDS[name].split())
    assert status == 0
    found = f'$ mddag {COMMANDS[name]}\n{out}' + (f'--- standard error\n{err}' if err else '')
    for path in sorted(files.glob('out.*')):
        text = path.read_bytes().decode()
        if path.suffix == '.html':      # its tables
            text = '\n'.join(re.findall('<table>.*?</table>', text, re.DOTALL)) + '\n'
        found += f'--- {path.name}\n{text}'
    golden.compare(name, found)


def test_quiet(files, call):
    """With -q nothing is printed that was not asked for."""
    for words in (['graph', 'check', 'graph.yaml'], ['replay', 'run.mcap'],
                  ['simulate', 'graph.yaml', '--trace', 'new.mcap']):
        assert call(*words, '-q') == (0, '', '')
    assert call('graph', 'check', 'graph.yaml', '-q', '--json', '-').stdout.startswith('{')

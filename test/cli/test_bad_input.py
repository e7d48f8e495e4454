# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Bad input of each command: one line on standard error, status 2, and nothing is written."""

import json

from mddag_executor.cli import main as program
from mddag_executor.trace import TraceFile
import numpy as np
import pytest

from ..sources.bags import write_bag
from ..sources.of_processes import Trace, TWO
from ..sources.recorded import four_jobs
from . import golden

GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 20ms, publishes: [/a], dag: one, execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 5ms, execution_time: 1ms}
  - {node: /m, callbacks: [{name: t, timer: 20ms, deadline: 9ms, execution_time: 1ms}]}
"""
DETECT = """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
  - {node: /detect, callbacks: [{name: detect, subscription: /image, deadline: 8ms}]}
"""
HASHES = ('warning: hashes of strings are not the same in each run: start Python with '
          'PYTHONHASHSEED=0, without -E and -I\n')
TIMES = {'one': {'/n:t': 1, '/n:x': 1}, '/m': {'/m:t': 1}}


@pytest.fixture
def files(folder):
    """Give a working directory with good and bad files."""
    for name, text in {
            'g.yaml': GRAPH, 'empty.yaml': '', 'no_times.yaml': GRAPH.replace(
                ', execution_time: 1ms', ''), 'detect.yaml': DETECT,
            'wrong.yaml': GRAPH.replace('timer: 20ms, publishes', 'tmer: 20ms, publishes'),
            'unpublished.yaml': GRAPH.replace('subscription: /a', 'subscription: /b'),
            'busy.yaml': GRAPH.replace('execution_time: 1ms', 'execution_time: 90ms'),
            'precious.txt': 'precious',
            'up.yaml': GRAPH + 'processes: {up: [/n], new: [/m]}\n',
            'down.yaml': GRAPH + 'processes: {new: [/n], down: [/m]}\n',
            'other.yaml': GRAPH.replace('/n', '/other').replace('/m', '/another'),
            'nodes.yaml': 'processes: {p: [/x]}\n', 'times.json': json.dumps(TIMES),
            'no.json': '{', 'list.json': '[]', 'typo.json': json.dumps({'oen': TIMES['one']}),
            'few.json': json.dumps({'one': {'/n:t': 1}}),
            'more.json': json.dumps({'one': {**TIMES['one'], '/n:y': 1}}),
            'zero.json': json.dumps({**TIMES, 'one': {'/n:t': 0, '/n:x': 1}}),
            'hostile.json': json.dumps({'one': {'/n:t': '\x1b[31m\n', '/n:x': 1}})}.items():
        (folder / name).write_text(text)
    for name, data in {
            'binary.yaml': bytes(range(256)), 'latin.yaml': b'mddag: 1\n# \xe4\n',
            'empty.mcap': b'', 'short.mcap': b'8 bytes!', 'head.mcap': b'\x89MCAP0\r\n',
            'zip.mcap': b'PK\x03\x04' * 100}.items():
        (folder / name).write_bytes(data)
    for name, *event in (('nothing.mcap', 'caret_init', 5, 'jazzy'), (
            'undeclared.mcap', 'task_set', '', '', 'rad', 7, 0, 0, False)):
        with TraceFile(name) as file:
            file.add(event[0], 10 ** 18, 1, 1, *event[1:])
    np.savez(folder / 'few.npz', **{'/n:t': [1]})
    (folder / 'link').symlink_to('link')
    for name in ('folder', 'full', 'cache'):
        (folder / name).mkdir()
    (folder / 'full' / 'file').touch()
    (folder / 'cache' / 'caret_converted').touch()
    four_jobs('imported.mcap')
    write_bag('bag')
    for dag, name in enumerate(('up', 'down')):
        Trace(folder, name, 0, dag=dag, graph=TWO).end(10 ** 9)
    assert program.main(['simulate', 'g.yaml', '-q', '--duration', '1s', '--trace', 'run.mcap'
                         ]) == 0
    data = (folder / 'run.mcap').read_bytes()
    (folder / 'other.dat').write_bytes(data)
    (folder / 'damaged.mcap').write_bytes(b'\0' + data[1:])
    (folder / 'link.csv').symlink_to('run.mcap')
    return folder


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


def test_bad_input(files, call):
    """Each command of the golden file ends with the error that follows it there."""
    text, before = '', contents(files)
    for line in (golden.FOLDER / 'errors.txt').read_text().splitlines():
        if line.startswith('$ mddag'):
            words = line.encode().decode('unicode_escape').split(' ')[2:]
            status, out, err = call(*words)
            err = err.removeprefix(HASHES)
            assert (status, out, err.count('\n')) == (2, '', 1), (line, out, err)
            assert '\x1b' not in err and contents(files) == before, line
            text += f'{line}\n{err}'
    golden.compare('errors', text)


@pytest.mark.parametrize('command', [
    'top --once', 'run g.yaml --synthetic sleep'])
def test_where_rclpy_cannot_write_its_log_one_line_says_so(files, mddag, monkeypatch, command):
    monkeypatch.setenv('ROS_LOG_DIR', '/proc/none')
    done = mddag(*command.split())
    assert (done.returncode, done.stderr.count('\n')) == (2, 1), done.stderr
    assert done.stderr.endswith(': correct the environment, for instance HOME or ROS_LOG_DIR\n')

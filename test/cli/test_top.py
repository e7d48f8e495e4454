# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from contextlib import nullcontext, suppress
import json
import os
from pathlib import Path
import pty
import re
import select
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

from mddag_executor.cli import top
from mddag_executor.report.board import Board, GONE_AFTER_S, tables
from msg_graph import load
import pytest

from . import golden
from .declared import GRAPH

CONFIG = Path(__file__).resolve().parents[2] / 'config'
EVIL = 'mddag: \x1b]0;owned\x07\x1b[2J[bold]x[/bold]\nrm'


def array(*statuses):
    return SimpleNamespace(status=[
        SimpleNamespace(
            hardware_id=process, name=name, level=bytes([level]), message='fine\x1b[31m',
            values=[SimpleNamespace(key=k, value=v) for k, v in values.items()])
        for process, name, level, values in statuses])


DAG = {'window_missed_ratio': '0', 'jobs': '7', 'period_ms': '20.000'}
POOL = {'idle_workers': '5', 'callbacks_per_s': '12.5', 'busy_ratio': '0.250'}


def test_a_board():
    now = [0.0]
    board = Board(lambda: now[0])
    board.take(array(('a/1', 'mddag: workers', 0, POOL)))
    assert tables(board.statuses(), 120).split()[0] == 'workers'    # no table of DAGs
    board.take(array(('a/1', 'mddag: x', 0, DAG)))
    now[0] = GONE_AFTER_S
    assert board.statuses()[0].level == 'OK'
    now[0] += 1
    assert (board.statuses()[0].level, board.statuses()[0].message) == (
        'GONE', 'nothing heard for 6 s')
    # Names cannot command the terminal.
    board.take(array((EVIL, EVIL, 1, {**DAG, 'jobs': EVIL}), (EVIL + 'b', EVIL, 9, POOL)))
    for text in (tables(board.statuses()), tables(board.statuses(), 400)):
        assert '\x1b' not in text and '\x07' not in text and '\\x1b]0;owned' in text


def of_sink(name, level, share, p99, deadline, wrong=''):
    return {f'level {name}': level, f'window_results {name}': '100', f'wrong {name}': wrong,
            f'in_time_ratio {name}': share, f'response_p99_ms {name}': p99,
            f'deadline_ms {name}': deadline, f'margin_ms {name}': '-23.456'}


def board_of_autoware(*processes, prefix='mddag'):
    """Return what a run of Autoware's workload reports."""
    pool = {'workers': '7', 'idle_workers': '3', 'queue': '12', 'callbacks_per_s': '1234.5',
            'busy_ratio': '0.712', 'cpu_ratio': '0.950', 'cpu_us_per_callback': '123.4',
            'computing': '2'}
    board = Board()
    dags = load(CONFIG / 'autoware.yaml').dags
    for process in processes:
        statuses = []
        for dag in dags:
            values = {'window_missed_ratio': '0.0123', 'jobs': '12345', 'period_ms': '100.000'}
            for sink in dag.sinks:
                name = dag.vertices[sink].name
                values |= of_sink(name, 'ERROR', '0.2000', '393.210', '300.000',
                                  '60 late, 15 dropped, 5 expired') if (
                    dag.name == 'planning') else of_sink(name, 'OK', '1.0000', '9.321', '100.000')
            statuses.append((process, f'{prefix}: {dag.name}', 2 * (dag.name == 'planning'),
                             values))
        board.take(array(*statuses, (process, f'{prefix}: workers', 1, pool)))
    return board


@pytest.mark.parametrize('processes', [('robot/4711',), ('robot/4711', 'robot/4712')])
@pytest.mark.parametrize('width', [60, 80, 100, 120, 150, 170, 200, 240])
def test_every_sink_has_a_line_in_every_terminal(width, processes):
    statuses = board_of_autoware(*processes).statuses()
    lines = tables(statuses, width).splitlines()
    assert max(map(len, lines)) <= width
    assert 'mddag' not in ''.join(lines)
    titles, first = lines[0], lines[1]
    n_sinks = sum(len(dag.sinks) for dag in load(CONFIG / 'autoware.yaml').dags)
    assert lines.index('') == 1 + n_sinks * len(processes)
    assert ('process' in titles) == (len(processes) > 1)
    # the worst one is the first; its faults are named if there is room for them
    assert 'ERROR' in first and '20 %' in first and 'alidator:callback_2' in first or width == 60
    if width >= 80:
        assert '393 ms' in first and '300 ms' in first
        assert '60 late, 15 dro' in first or (width, len(processes)) == (80, 2)
    assert '…' not in ''.join(lines) or width < 200
    if processes == ('robot/4711',) and width in (80, 200):
        golden.compare(f'top_{width}', tables(statuses, width))


def test_processes_with_names_are_called_by_them():
    board = board_of_autoware('robot/4711', prefix='front')
    for key, status in board_of_autoware('robot/4712', prefix='rear')._statuses.items():
        board._statuses[key] = status
    text = tables(board.statuses(), 160)
    assert re.search('^front +/', text, re.M) and re.search('^rear +/', text, re.M)
    assert '4711' not in text


def test_the_worst_sinks_come_first():
    board = Board()
    values = {'window_missed_ratio': '0'}
    for sink in (
        ('/a', 'OK', '1.0000', '10', '100'), ('/b', 'OK', '1.0000', '99', '100'),
        ('/c', 'WARN', '0.9996', '99', '100'), ('/d', 'ERROR', '0.5000', '1', '100'),
        ('/e', 'ERROR', '0.1000', '1', '100'), ('/f', 'STALE', '', '', '100', 'nothing'),
        ('/g', 'OK', '', 'nan', 'inf'),
    ):
        values |= of_sink(*sink)
    # a DAG without a sink here is not forgotten
    board.take(array(('p', 'mddag: x', 3, values), ('p', 'mddag: source', 3, DAG)))
    assert [sink['sink'] for sink in board.result()['sinks']] == [
        '/e', '/d', '/f', '/c', '/b', '/a', '/g']
    assert board.result()['sinks'][0] == {
        'process': 'p', 'dag': 'x', 'sink': '/e', 'level': 'ERROR', 'wrong': '',
        'window_results': 100.0, 'in_time_ratio': 0.1, 'response_p99_ms': 1.0,
        'deadline_ms': 100.0, 'margin_ms': -23.456}
    text = tables(board.statuses(), 80)
    assert ' 99.9 % ' in text and text.endswith('\nSTALE source: fine\\x1b[31m\n')


@pytest.fixture
def running(tmp_path):
    """Run a graph in another process; its diagnostics come every 0.2 s."""
    graph = tmp_path / 'graph.yaml'
    graph.write_text(GRAPH)
    process = subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'run', str(graph), '--synthetic', 'sleep',
         '--diagnostics', '200ms'], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    yield process
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode == 0


def test_once_shows_another_process(running, mddag):
    result = mddag('top', '--once', '--json', '-').result
    statuses = result['statuses']
    found = {s['name']: s for s in statuses}
    assert set(found) == {'mddag: main', 'mddag: workers'}
    assert found['mddag: main']['process'].endswith(f'/{running.pid}')
    assert found['mddag: main']['values']['period_ms'] == '20.000'
    names = {name: [key for key in found[name]['values'] if not key.startswith((
        'response', 'deadline', 'margin'))] for name in sorted(found)}      # not before a result
    golden.compare('top_json', json.dumps(names, indent=1) + '\n')
    assert {(s['sink'], s['dag'], s['deadline_ms']) for s in result['sinks']} == {
        ('/slow:cb', 'main', 10.0), ('/quick:cb', 'main', 500.0)}
    done = mddag('top', '--once')
    assert done.returncode == 0
    assert re.search(r'/\d+ +/slow:cb +ERROR +0 % .* 10 ms +\d+ late', done.stdout)
    assert done.stdout.index('/slow:cb') < done.stdout.index('/quick:cb')
    done = mddag('top', '--duration', '6s')
    assert done.returncode == 0 and done.stdout.count('workers') >= 2


def test_live_in_a_terminal_until_the_user_ends_it(running):
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(TERM='xterm-256color', COLUMNS='80', LINES='40')
        os.execv(sys.executable, [sys.executable, '-m', 'mddag_executor', 'top'])
    shown, ended = b'', False
    end = time.monotonic() + 30
    with suppress(OSError):     # how Linux says that the other side is closed
        while time.monotonic() < end:
            if select.select([terminal], [], [], 0.2)[0]:
                shown += os.read(terminal, 65536)
            if shown.count(b'/quick:cb') >= 3 and not ended:
                ended = True
                os.kill(pid, signal.SIGINT)
    if not ended:
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 0
    text = shown.decode()
    assert '\x1b[H\x1b[J' in text and 'workers' in text and 'Traceback' not in text


def test_no_process_to_hear(call, monkeypatch):
    done = call('top', '--once', '--timeout', '300ms')
    assert done.returncode == 2 and done.stdout == ''
    assert done.stderr.startswith('error: /diagnostics: no executor has published its state')
    done = call('top', '--duration', '300ms')
    assert done.returncode == 2
    with monkeypatch.context() as patch:    # Ctrl-C before
        patch.setattr(top, '_listening', lambda board: nullcontext(
            lambda seconds: signal.raise_signal(signal.SIGINT)))
        assert call('top', '--once') == (0, '', '')
    spent = []
    board = Board()
    list(top._ticks(spent.append, board, 3600 * 10**9, 50_000_000))     # not for an hour
    assert spent

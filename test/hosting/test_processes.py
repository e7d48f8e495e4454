# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Real `mddag run`s of several processes."""

from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from mddag_executor import replay, Traces
from mddag_executor.analysis.drafting import System
from mddag_executor.cli.main import user_line
from mddag_executor.clocks import boot
from mddag_executor.core.tally import counts
from mddag_executor.defaults import SAME_SIGNAL_S
from mddag_executor.executor.session import Session
from mddag_executor.hosting import processes, run, RunOptions, RunWarning
from mddag_executor.shared_memory import segments_removed
from mddag_executor.trace import read_events
from msg_graph import loads
from msg_graph.draft import accept, declaration_of
import pytest

from ..conftest import wait_for_run
from .conftest import GUESTS, TWO_PROCESSES, wait_for
from .helpers import Idle, segments_of

CHAIN = """\
mddag: 1
workers: 2
nodes:
  - node: /sensor
    callbacks: [{name: tick, timer: 20ms, publishes: [/raw], dag: chain, execution_time: 1ms,
                 release_from: header_stamp}]
  - node: /first
    callbacks: [{name: relay, subscription: /raw, publishes: [/half], execution_time: 1ms}]
  - node: /second
    callbacks: [{name: relay, subscription: /half, publishes: [/whole], execution_time: 1ms}]
  - node: /last
    callbacks: [{name: sink, subscription: /whole, deadline: 60s, execution_time: 1ms}]
"""
PROCESSES = 'processes: {up: [/first], down: [/second, /last]}\n'
NODES = [argument for name in ('sensor', 'first', 'second', 'last')
         for argument in ('--node', f'relay:{name}')]


@pytest.fixture
def world(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('PYTHONPATH', str(GUESTS), prepend=os.pathsep)
    monkeypatch.setenv('RELAY_MARK', str(tmp_path / 'enough'))
    (tmp_path / 'graph.yaml').write_text(CHAIN + PROCESSES)
    return tmp_path


@contextmanager
def running(*arguments):
    with subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'run', *arguments, '--json', 'result.json'],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()  # its processes end with it


def pids(process):
    """Return the processes of a run that there are now, by name."""
    found = {}
    children = Path(f'/proc/{process.pid}/task/{process.pid}/children')
    for pid in children.read_text().split():
        words = Path(f'/proc/{pid}/cmdline').read_bytes().decode().split('\0')
        if '--process' in words:
            found[words[words.index('--process') + 1]] = int(pid)
    return found


def end(process):
    """Wait for the end of a run; return the result, and what it printed."""
    out, err = process.communicate(timeout=60)
    assert Path('result.json').exists(), err
    return json.loads(Path('result.json').read_text()), out, err


def test_synthetic_nodes_in_two_processes_are_one_run(world, mddag):
    (world / 'chain.yaml').write_text(CHAIN.replace('60s', '500ms'))
    run = mddag('run', 'chain.yaml', '--synthetic', 'sleep', '--processes', '2',
                '--duration', '1s', '--trace', 'out.mcap', '--json', 'result.json')
    assert run.returncode == 0, run.stderr
    result = json.loads(Path('result.json').read_text())
    assert [p['name'] for p in result['processes']] == ['p1', 'p2']
    assert sorted(n for p in result['processes'] for n in p['nodes']) == [
        '/first', '/last', '/second', '/sensor']
    sink = result['dags']['chain']['sinks']['/last:sink']
    assert counts(sink).due >= sink['completed'] > 0
    assert result['undeclared'] == sum(
        each['unattributed'] for each in result['callbacks'].values())
    assert result['never_ran'] == result['drift'] == []
    for name in ('p1', 'p2'):
        assert f'trace: {world / f"out.{name}.mcap"}' in run.stdout
        said = next(e for e in read_events(f'out.{name}.mcap')
                    if e['_name'] == 'mddag:task_set')
        assert len(loads(said['yaml']).processes) == 2
        assert said['file'] == 'chain.yaml'
    assert 'declared callback' not in run.stdout


def test_a_process_by_itself_does_not_judge_the_jobs_of_others(world, mddag):
    (world / 'two.yaml').write_text(TWO_PROCESSES)
    run = mddag('run', 'two.yaml', '--synthetic', 'sleep', '--process', 'one', '--duration',
                '100ms', '--json', 'result.json')
    assert run.returncode == 0, run.stderr
    result = json.loads(Path('result.json').read_text())
    assert result['callbacks']['/a:t']['ran'] > 0 and result['measured'] is None


def test_processes_start_together(tmp_path, monkeypatch):
    """However late another process is: it is waited for until its nodes are made, and ready."""
    processes.Part.make(str(tmp_path), CHAIN, {})
    monkeypatch.setattr(processes.time, 'monotonic_ns', lambda: 5 * 10 ** 9)
    part = processes.Part.read(str(tmp_path))
    session = Session(Idle())
    unmatched, seen, waits = ['/half'], [], []

    def note(step, at):
        seen.append(sorted(path.name for path in tmp_path.glob('first.*')))
        (tmp_path / f'second.{step}').write_text(str(at))

    happens = [lambda: note('made', 6 * 10 ** 9), unmatched.clear,
               lambda: note('ready', 7 * 10 ** 9)]

    def wait(seconds):
        (happens.pop(0) if happens else lambda: waits.append(seconds))()
        return False

    monkeypatch.setattr(session, 'wait', wait)
    at = part.start_together('first', ['first', 'second'], session, lambda: unmatched)
    assert seen == [['first.made'], ['first.made', 'first.ready']]
    assert at == 7 * 10 ** 9 + processes.LEAD_NS and waits == [2 + processes.LEAD_NS / 1e9]


def test_programs_run_in_the_process_of_their_nodes(world):
    """What is lost until the processes have met, one of which starts late, is of no job."""
    (world / 'slow.py').write_text(
        'import time\ntime.sleep(1)\nfrom relay import last, second\n')
    (world / 'graph.yaml').write_text(PROCESSES + CHAIN.replace('60s', '1s').replace(
        ',\n                 release_from: header_stamp', ''))
    nodes = ['--node', 'up=relay:sensor', *NODES[2:4], '--node', 'down=slow:second', '--node',
             'down=slow:last']
    with running('graph.yaml', *nodes, '--trace', 'run/') as run:
        wait_for_run(run, (world / 'enough').exists)
        run.send_signal(signal.SIGINT)
        result, _, errors = end(run)
    assert run.returncode == 0, errors
    assert {p['name']: p['nodes'] for p in result['processes']} == {
        'up': ['/sensor', '/first'], 'down': ['/second', '/last']}
    assert result['callbacks']['/sensor:tick']['ran'] >= 60
    assert result['never_ran'] == [] and not any(p['died'] for p in result['processes'])
    for name in ('up', 'down'):
        assert {e['dag'] for e in read_events(f'run/{name}.mcap', {'mddag:complete'})} == {0}
    live, replayed = (counts(dags['chain']['sinks']['/last:sink']) for dags in (
        result['dags'], replay(['run/up.mcap', 'run/down.mcap']).result()['dags']))
    # on a busy machine also those whose message waited 0.1 s for its announcement, or did not run
    lost = sum(each[how] for each in result['callbacks'].values()
               for how in ('dropped', 'skipped', 'lost'))
    assert 0 <= replayed.due - live.due <= result['undeclared'] + lost
    assert live.due > 0
    # all traces together make a declaration, with the processes and the measured times
    draft = System(Traces(['run/up.mcap', 'run/down.mcap'])).draft()
    accept(draft)
    drafted = declaration_of(draft, True)
    assert {p.name: {'/sensor', '/first', '/second', '/last'} & set(p.nodes)
            for p in loads(drafted).processes} == {
        'up': {'/sensor', '/first'}, 'down': {'/second', '/last'}}
    assert '/mddag/jobs' not in drafted


def test_an_end_while_processes_start_is_quiet(world):
    """As if it had come to a run that has not begun."""
    (world / 'slow.py').write_text(
        'import pathlib, time\n'
        'pathlib.Path("begun").touch()\n'
        'time.sleep(60)\n')
    with running('graph.yaml', '--node', 'up=slow:first', '--node', 'down=slow:last',
                 '--trace', 'out.mcap') as run:
        wait_for_run(run, (world / 'begun').exists)
        run.send_signal(signal.SIGINT)
        said = run.communicate(timeout=60)
    assert (run.returncode, *said) == (130, '', '')
    assert not list(world.glob('*.mcap')) and not (world / 'result.json').exists()


HANGS = """\
from pathlib import Path
import time
from rclpy.node import Node

def make(name):
    node = Node(name, start_parameter_services=False)
    node.create_timer(0.009, lambda: (Path(name).touch(), time.sleep(600.0)))
    return node

def a():
    return make('a')

def b():
    return make('b')
"""


def test_a_second_interrupt_abandons_what_hangs_in_any_process(world):
    (world / 'hangs.py').write_text(HANGS)
    (world / 'two.yaml').write_text(TWO_PROCESSES)
    with running('two.yaml', '--node', 'one=hangs:a', '--node', 'two=hangs:b') as run:
        wait_for_run(run, lambda: (world / 'a').exists() and (world / 'b').exists())
        run.send_signal(signal.SIGINT)
        time.sleep(2 * SAME_SIGNAL_S)       # before, another one counts as the same
        assert run.poll() is None
        run.send_signal(signal.SIGINT)
        result, out, errors = end(run)
    assert run.returncode == 0 and errors.count('a callback has not ended in time') == 2
    assert sorted(each['callback'] for each in result['unfinished']) == ['/a:t', '/b:t']
    assert result['never_ran'] == [] and 'never ran' not in out


def test_what_a_program_destroyed_is_reported_of_each_process(world, mddag):
    (world / 'two.yaml').write_text(TWO_PROCESSES)
    run = mddag('run', 'two.yaml', '--node', 'quits:a', '--node', 'quits:b',
                '--duration', '2500ms', '--json', 'result.json')
    result = json.loads(Path('result.json').read_text())
    assert [each['callback'] for each in result['drift'] if 'was destroyed' in each['text']] == [
        '/a:t', '/b:t'], run.stderr


def test_a_killed_process_is_named_and_the_others_go_on_if_asked(world):
    with running('graph.yaml', *NODES, '--on-exit', 'continue', '--trace', 'out.mcap') as run:
        wait_for_run(run, (world / 'enough').exists)
        killed = pids(run)['up']
        with segments_removed(killed):
            os.kill(killed, signal.SIGKILL)
            wait_for_run(run, lambda: 'up' not in pids(run))
        run.send_signal(signal.SIGTERM)
        result, out, errors = end(run)
    assert run.returncode == 70
    assert 'process up was ended by signal 9 (Killed)' in errors
    # what ran in it is not known
    assert not [each for each in result['drift'] if each['kind'] == 'never ran']
    assert not result['never_ran']
    up, down = result['processes']
    assert (up['died'], up['how'], down['died']) == (True, 'was ended by signal 9 (Killed)', False)
    assert result['dags']['chain']['sinks']['/last:sink']['completed'] > 0
    assert sum(e['_name'] == 'mddag:complete' for e in read_events('out.down.mcap')) >= 60
    assert f'trace: {world / "out.up.mcap"}' in out
    assert [e['boot'] for name in ('up', 'down') for e in read_events(
        f'out.{name}.mcap', {'mddag:host'})] == [boot()] * 2
    replayed = replay(['out.up.mcap', 'out.down.mcap']).result()
    assert any(warning.startswith('out.up.mcap: its end is not recorded (the process was killed')
               and 'with it' in warning or warning.endswith('no job was open in it')
               for warning in replayed['warnings']), replayed['warnings']
    sink = replayed['dags']['chain']['sinks']['/last:sink']
    assert sink['completed'] > 0 and set(replayed['callbacks']) >= {'/first:relay', '/last:sink'}


def test_a_killed_run_leaves_nothing(world, monkeypatch):
    """Its processes end, and remove the folder of the run."""
    temporary = world / 'temporary'
    temporary.mkdir()
    monkeypatch.setenv('TMPDIR', str(temporary))
    with running('graph.yaml', *NODES) as run:
        wait_for_run(run, (world / 'enough').exists)
        parts = pids(run).values()
        segments = [path for pid in parts for path in segments_of(pid)]
        assert len(segments) >= 2 and len([*temporary.iterdir()]) == 1
        run.kill()
        run.communicate(timeout=60)     # until they have ended as well
    assert wait_for(lambda: not any(Path('/proc', str(pid)).exists() for pid in parts), 60.0)
    assert not [*temporary.iterdir()] and not any(path.exists() for path in segments)


def test_synthetic_processes_leave_no_shared_memory(world):
    """Though they do not destroy their nodes."""
    with running('graph.yaml', '--synthetic', 'sleep', '--duration', '2s') as run:
        wait_for_run(run, lambda: sum(len(segments_of(pid)) for pid in pids(run).values()) == 2)
        segments = [path for pid in pids(run).values() for path in segments_of(pid)]
        end(run)
    assert run.returncode == 0
    assert len(segments) == 2 and not any(path.exists() for path in segments)


def test_a_process_without_the_others_begins_after_a_while(world, monkeypatch):
    """As a launch file may start it before them, or alone."""
    monkeypatch.syspath_prepend(str(GUESTS))
    monkeypatch.setattr('mddag_executor.hosting.run_here._ALONE_S', 0.1)
    with pytest.warns(RunWarning, match='/raw: .* have not discovered each other .* messages '
                      'that are lost meanwhile count as missed$'):
        result = run(RunOptions(nodes=['relay:first'], graph='graph.yaml', process='up',
                                duration='200ms', diagnostics='off'))
    assert result.status == 0 and result.has_started


def test_a_full_disk_is_named(tmp_path):
    (tmp_path / 'run.part').symlink_to('/dev/full')
    with pytest.raises(OSError) as error:
        processes.Part.make(str(tmp_path), 'mddag: 1', {})
    assert (user_line(error.value) or '').startswith(f'{tmp_path}: no space left on device: free')


def test_a_run_that_cannot_begin_leaves_no_trace(world, mddag):
    """Except one of an earlier run."""
    (world / 'bad.py').write_text(
        'import pathlib, time\n'
        'def exits():\n'
        '    while not pathlib.Path("out.up.mcap").exists():\n'
        '        time.sleep(0.01)\n'
        '    raise SystemExit(3)\n')
    done = mddag('run', 'graph.yaml', '--node', 'up=relay:first', '--node', 'down=bad:exits',
                 '--trace', 'out.mcap', '--overwrite')
    assert (done.returncode, done.stderr.count('error: ')) == (2, 1), done.stderr
    assert not list(world.glob('*.mcap'))
    mddag('run', 'graph.yaml', '--node', 'up=bad:missing', '--node', 'down=bad:missing',
          '--trace', 'new/')
    assert not (world / 'new').exists()
    (world / 'out.up.mcap').write_text('earlier')
    mddag('run', 'graph.yaml', '--node', 'up=bad:missing', '--node', 'down=bad:missing',
          '--trace', 'out.mcap', '--overwrite')
    assert (world / 'out.up.mcap').read_text() == 'earlier'


def test_an_exception_in_one_ends_the_run_with_its_status(world):
    (world / 'bad.py').write_text(
        'from relay import sensor as good\n'
        'def sensor():\n'
        '    node = good()\n'
        '    def fail():\n'
        '        timer.cancel()\n'
        '        raise ValueError("boom")\n'
        '    timer = node.create_timer(0.05, fail)\n'
        '    return node\n')
    nodes = ('--node', 'up=bad:sensor', '--node', 'down=relay:last')
    with running('graph.yaml', *nodes, '--duration', '3s') as run:
        result, _, errors = end(run)
    assert run.returncode == 70
    assert ('warning: process up ended with status 70: error: /sensor: fail (timer 50ms): '
            'it raised ValueError: boom, ') in errors
    assert '[up] Traceback' in errors
    assert result['processes'][0]['died']

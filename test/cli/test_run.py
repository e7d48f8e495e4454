# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from contextlib import contextmanager, suppress
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time

from mddag_executor.core.tally import counts, total
from mddag_executor.report.tables import percent, sink_table
from mddag_executor.trace import read_events, TraceError, TraceReader
from msg_graph import load
import pytest

from ..conftest import run_program, wait_for_run
from ..declared_path import imu_to_wheels
from . import golden
from .declared import GRAPH

SENSED = imu_to_wheels(reaction='40ms', age='20ms')


def test_a_run_judges_paths_as_its_replay_does(folder, mddag):
    Path('g.yaml').write_text(SENSED)
    run = mddag('run', 'g.yaml', '--synthetic', 'sleep', '--duration', '1s', '--trace', 'r.mcap',
                '--json', 'live.json')
    assert run.returncode == 0, run.stderr
    assert re.search('^imu_to_wheels reaction +[1-9]', run.stdout, re.MULTILINE)
    found = json.loads(Path('live.json').read_text())['requirements']
    assert found['imu_to_wheels']['reaction']['completed'] > 20
    again = json.loads(mddag('replay', 'r.mcap', '--json', '-').stdout)['requirements']
    assert again == found


def test_a_path_over_several_processes_is_left_to_the_replay(folder, mddag):
    Path('g.yaml').write_text(SENSED)
    run = mddag('run', 'g.yaml', '--synthetic', 'sleep', '--duration', '1s', '--processes', '2',
                '--trace', 'r.mcap', '--json', 'live.json')
    assert run.returncode == 0, run.stderr
    assert ('warning: path imu_to_wheels: its callbacks run in several processes, so this run '
            'leaves it out: judge its traces with mddag replay'
            ) in run.stderr.splitlines()
    assert json.loads(Path('live.json').read_text())['requirements'] == {}
    traces = sorted(map(str, Path().glob('r*.mcap')))
    again = mddag('replay', *traces, '--json', '-')
    assert json.loads(again.stdout)['requirements']['imu_to_wheels']['age']['completed'] > 10


def test_a_synthetic_run_is_counted_measured_and_recorded(graph, mddag):
    process = mddag(
        'run', graph, '--synthetic', 'sleep', '--duration', '2s', '--workers', '3',
        '--trace', 'out.mcap', '--json', 'result.json')
    assert process.returncode == 0, process.stderr
    assert ('warning: /slow:cb: no scheduler can keep its deadline of 10.0 ms: with seed 0 its '
            'critical path takes 17.0 ms') in process.stderr.splitlines()
    result = json.loads(Path('result.json').read_text())
    assert (result['policy'], result['workers'], result['synthetic']) == ('rad', 3, 'sleep')
    sinks = result['dags']['main']['sinks']
    quick, slow = sinks['/quick:cb'], sinks['/slow:cb']
    assert slow['late'] >= slow['completed'] > 0
    assert slow['response_ns']['min'] >= 16 * 10 ** 6
    # The executor's books and the nodes' own agree.  A busy machine skips some releases.
    measured = result['measured']['dags']['main']['sinks']
    for counts_ in measured.values():
        assert abs(counts_['due'] - result['measured']['window_ns'] / 20e6) <= 1
    assert 0 < measured['/quick:cb']['on_time'] <= quick['completed'] - quick['late']
    assert measured['/slow:cb']['on_time'] == 0
    assert 0 < measured['/slow:cb']['late'] <= slow['completed']
    assert result['measured']['attribution'] == {'wrong': 0, 'none': 0}
    assert result['measured']['utilisation'] == pytest.approx(18 / 20 / 3)
    assert result['measured']['utilisation_taken'] > 0.99 * 18 / 20 / 3
    assert Path('out.mcap').read_bytes()[:5] == b'\x89MCAP'
    assert f'trace: {graph.parent / "out.mcap"}\n' in process.stdout
    golden.compare('run', golden.words(process.stdout.replace(f'{graph.parent}/', '')))
    golden.compare('run_json', json.dumps(golden.shape(result), indent=1) + '\n')
    # A declaration from the recording keeps what was declared.
    done = mddag('graph', 'from-trace', 'out.mcap', '-o', 'again.yaml')
    assert (done.returncode, done.stderr) == (0, '')
    again, before = load('again.yaml'), load(graph)
    assert again.paths == before.paths
    for name in ('on_late', 'max_active_jobs', 'holds_interpreter', 'deadline_ns', 'publishes'):
        assert {getattr(c, name) for c in again.callbacks} == {
            getattr(c, name) for c in before.callbacks}


ROBOT = (Path(__file__).resolve().parents[2] / 'examples/rerun/robot.py').read_text()
NODES = ('--node', 'robot:Lidar', '--node', 'robot:Tracker')


def robot(seconds):
    """Write the example with a tracker that takes long, so that most messages are dropped."""
    text = ROBOT
    for old, new in (('timer(0.1', 'timer(0.02'), ('self.track, 10)', 'self.track, 1)'),
                     ('track(self, message):', f'track(self, message, sleep=time.sleep):\n'
                      f'        sleep({seconds})')):
        assert old in text
        text = text.replace(old, new)
    Path('robot.py').write_text(f'import time\n{text}')


LATE = """
mddag: 1
nodes:
  - node: /one
    callbacks: [{name: run, timer: 50ms, deadline: 1ms, execution_time: 10ms}]
  - node: /other
    callbacks: [{name: run, timer: 50ms, deadline: 1ms, execution_time: 10ms}]
"""


@pytest.mark.parametrize('processes', [1, 2])
def test_quiet_runs_log_no_misses_unless_they_are_asked_for(folder, mddag, processes):
    Path('late.yaml').write_text(LATE)
    words = ['run', 'late.yaml', '--synthetic', 'sleep', '--duration', '1s', '-q',
             '--processes', processes]
    assert mddag(*words) == (0, '', '')
    done = mddag(*words, '--ros-args', '--log-level', 'mddag_executor:=warn')
    assert (done.returncode, done.stdout) == (0, '')
    assert re.search(r'\[WARN\] .* deadlines? missed', done.stderr)


def test_three_commands_from_a_robot_to_a_verdict(folder, mddag):
    """Recorded without a declaration, which then comes from the recording (see docs/start.md)."""
    robot(0.05)
    done = mddag('run', *NODES, '--duration', '1s', '--trace', 'a.mcap')
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == 'no declaration was given, so no deadline was judged'
    assert lines[-1] == ('to judge it: mddag graph from-trace a.mcap --accept -o graph.yaml, then '
                         'mddag replay a.mcap graph.yaml')
    dropped, = re.findall(r'^(\d+) dropped', done.stdout, re.MULTILINE)
    (total_runs, runs), = re.findall(
        r'^(\d+) runs of undeclared callbacks: (.*)', done.stdout, re.MULTILINE)
    assert int(dropped) > 10
    assert int(total_runs) == sum(map(int, re.findall(r' (\d+)(?:,|$)', runs)))
    done = mddag('graph', 'from-trace', 'a.mcap', '--accept', '-o', 'g.yaml')
    assert (done.returncode, done.stderr) == (0, '')
    dag = mddag('replay', 'a.mcap', 'g.yaml', '--json', '-').result['dags']['/lidar']
    ran, = re.findall(r'/tracker: track \(subscription /distance\) (\d+)', runs)
    assert dag['sinks']['/tracker:track']['completed'] == int(ran) > 0
    assert dag['sinks']['/tracker:track']['relative_deadline_ns'] == 20_000_000


@pytest.mark.parametrize(('tolerate', 'status', 'processes'), [
    ('1 of 1000', 1, '1'), ('1 of 1000', 1, '2'), ('999 of 1000', 0, '2')])
def test_fail_on_miss_judges_by_what_the_declaration_tolerates(
        folder, mddag, tolerate, status, processes):
    """The slow sink misses every deadline; the other one may miss what a busy machine costs."""
    text = GRAPH.replace('500ms,', '500ms, tolerate: 999 of 1000,')
    done = mddag('run', '-', '--synthetic', 'sleep', '--duration', '300ms', '--processes',
                 processes, '--fail-on-miss', '--json', 'out.json',
                 input=text.replace('10ms,', f'10ms, tolerate: {tolerate},'))
    assert done.returncode == status, done.stderr
    assert re.search(r'in time +late .* tolerates +worst\n', done.stdout)
    result = json.loads(Path('out.json').read_text())
    assert result['file'] == '<stdin>'
    found = result['dags']['main']['sinks']['/slow:cb']
    assert found['tolerate']['worst'] == counts(found).missed > 1


@contextmanager
def started(graph):
    """Give a synthetic run that continues until a signal ends it."""
    with subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'run', str(graph), '--synthetic', 'sleep',
         '--workers', '3', '--trace', 'out.mcap', '--json', 'result.json'],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def releases():
    """Return when the jobs were due of which /slow:cb was late, as far as the trace has them."""
    with suppress(OSError, TraceError):
        return [deadline - 10_000_000 for *_, vertex, _, deadline, completed
                in TraceReader('out.mcap').events({'mddag:deadline'})
                if vertex == 2 and completed >= 0]
    return []


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_run_also_if_it_comes_twice(graph, number):
    """A shell signals the whole process group, and `ros2 launch` sends a signal of its own."""
    with started(graph) as process:
        # The window begins after the warm-up of 1 s.
        wait_for_run(process, lambda: max(found := releases() or [0]) - found[0] > 2 * 10 ** 9)
        begin = time.monotonic()
        while process.poll() is None and time.monotonic() < begin + 0.3:  # on to its very end
            process.send_signal(number)
            time.sleep(0.02)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0 and 'Traceback' not in err, err
    assert 'results due' in out and 'trace: ' in out
    result = json.loads(Path('result.json').read_text())
    assert result['measured']['window_ns'] > 0
    assert result['dags']['main']['sinks']['/slow:cb']['completed'] >= len(releases()) > 0
    assert [event['_name'] for event in read_events('out.mcap')].count('mddag:task_set') == 1


def test_a_stop_of_the_machine_is_told_from_the_executors_own_misses(graph):
    with started(graph) as process:
        wait_for_run(process, lambda: bool(releases()))
        for _ in range(3):  # on a busy machine it may come when no thread waits: it proves nothing
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.3)
            process.send_signal(signal.SIGCONT)
            # It ends when what was due meanwhile has been taken in.
            after = time.time_ns()
            wait_for_run(process, lambda after=after: releases()[-1] > after)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    line = re.search(
        r'^(\d+) of (\d+) misses are due to (\d+) stops? \((\d+\.\d\d) s\), in which no '
        r'thread of this process ran$', out, re.MULTILINE)
    assert line is not None, out
    result = json.loads(Path('result.json').read_text())
    stops = result['stops']
    assert stops['count'] == int(line[3]) >= 1
    assert f'{stops["total_ns"] / 1e9:.2f}' == line[4]
    assert stops['total_ns'] >= 200_000_000     # a busy machine adds short ones
    # The slow sink was due every 20 ms meanwhile; it is late all the time besides.
    assert 10 <= stops['misses'] == int(line[1]) <= int(line[2]) == total(result['dags']).missed


def test_what_is_late_is_red_on_a_terminal(monkeypatch):
    def sink(late):
        return {'relative_deadline_ns': 30_000_000, 'completed': 10, 'late': late, 'expired': 0,
                'response_ns': {'min': 1, 'median': 2_000_000, 'p99': 3_000_000, 'max': 4_000_000}}

    dags = {'one': {'sinks': {'/n:good': sink(0), '/n:some': sink(2)}},
            'two': {'sinks': {'/n:most': sink(9)}}}
    plain = sink_table(dags)
    monkeypatch.setattr(sys.stdout, 'isatty', lambda: True)
    monkeypatch.setenv('TERM', 'xterm')
    monkeypatch.delenv('NO_COLOR', raising=False)
    assert [line.startswith('\x1b[31m') and line.endswith('\x1b[0m')
            for line in sink_table(dags).splitlines()] == [False, True, True, False]
    for name, value in (('TERM', 'dumb'), ('NO_COLOR', '1')):
        with monkeypatch.context() as here:
            here.setenv(name, value)
            assert sink_table(dags) == plain


@pytest.mark.parametrize(('part', 'whole', 'text'), [
    (0, 0, '-'), (0, 9, '0.00 %'), (9, 9, '100.00 %'), (99_999, 100_000, '99.99 %'),
    (1, 100_000, '0.01 %'), (1, 3, '33.33 %')])
def test_a_share_is_never_rounded_to_all_or_nothing(part, whole, text):
    assert percent(part, whole) == text


ONE_TIMER = """\
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: tick, timer: 20ms, deadline: 10ms, execution_time: 1ms}]}
"""
BAD_NODES = """\
import os
from rclpy.node import Node
start = os.getcwd()


class Calibrated(Node):

    def __init__(self):
        super().__init__('n')
        self.create_timer(0.02, self.tick)

    def tick(self):
        open('/calibration/lidar.yaml')


class Uncalibrated(Node):

    def __init__(self):
        open('/calibration/lidar.yaml')


def main():
    open('/calibration/lidar.yaml')


class Odd(BaseException):

    def __str__(self):
        raise ValueError('it has no text')


class Talker(Calibrated):

    def __init__(self):
        super().__init__()
        os.chdir('elsewhere')

    def tick(self):
        raise Odd


def odd():
    os.chdir('elsewhere')
    raise Odd


def leave():
    import shutil
    os.chdir('../other/deep')
    shutil.rmtree(start)
    return Node('n')
"""


@pytest.mark.parametrize(('verb', 'spec'), [
    ('run', 'bad:Calibrated'), ('run', 'bad:Uncalibrated'), ('run', 'bad:main'),
    ('run', 'bad_module:main'), ('rerun', 'bad:Calibrated'), ('rerun', 'bad:main')])
def test_what_a_node_raises_has_its_traceback_and_is_no_bad_input(
        folder, call, mddag, verb, spec):
    Path('n.yaml').write_text(ONE_TIMER)
    Path('bad.py').write_text(BAD_NODES)
    Path('bad_module.py').write_text("open('/calibration/lidar.yaml')\n")
    recording = ['drive.mcap'] * (verb == 'rerun')
    assert call('simulate', 'n.yaml', '--duration', '100ms', '--trace', 'drive.mcap')[0] == 0
    done = mddag(verb, *recording, 'n.yaml', '--node', spec)
    # a main() that raises ends as without us
    of_main = verb == 'run' and spec in ('bad:main', 'bad:Uncalibrated')
    assert done.returncode == (1 if of_main else 70), done.stderr
    lines = done.stderr.splitlines()
    assert 'Traceback (most recent call last):' in lines
    assert any('bad' in line and "open('/calibration/lidar.yaml')" in after
               for line, after in zip(lines, lines[1:]))
    place = '/n:tick: it raised' if spec == 'bad:Calibrated' else f'--node {spec}:'
    assert lines[-1].startswith(f'error: {place} ') and 'FileNotFoundError' in lines[-1]


def test_a_traceback_begins_in_the_users_code(folder, mddag):
    """And an error of its syntax is located there."""
    Path('bad.py').write_text(BAD_NODES)
    done = mddag('run', '--node', 'bad:Calibrated')
    traceback = done.stderr[done.stderr.index('Traceback'):].splitlines()
    assert re.match(r'  File ".*bad\.py", line \d+, in tick$', traceback[1]), done.stderr
    Path('half.py').write_text('x = 1\ndef main(:\n')
    done = mddag('run', '--node', 'half:main')
    assert f"(SyntaxError: invalid syntax, {folder / 'half.py'}:2)" in done.stderr
    assert (done.returncode, done.stderr.count('\n')) == (2, 1)


def test_the_declaration_of_another_robot_is_an_error(folder, mddag):
    """But a run too short for a job to be due is none."""
    Path('n.yaml').write_text(ONE_TIMER.replace('/n,', '/robot2/n,'))
    Path('good.py').write_text(
        'from rclpy.node import Node\n\n\nclass Good(Node):\n\n    def __init__(self):\n'
        "        super().__init__('n')\n        self.create_timer(0.02, lambda: None)\n")
    for more in ((), ('--processes', 'two.yaml')):
        Path('two.yaml').write_text('processes: {one: [/robot2/n]}\n')
        done = mddag('run', 'n.yaml', '--node', 'good:Good', '--duration', '300ms', *more)
        assert done.returncode == 2, done.stderr
        assert done.stderr.splitlines()[-1].startswith(
            'error: n.yaml: none of its callbacks was in the nodes that ran, so nothing ')
    Path('n.yaml').write_text(ONE_TIMER.replace('20ms', '20s').replace('10ms', '10s'))
    Path('good.py').write_text(Path('good.py').read_text().replace('0.02', '20.0'))
    assert mddag('run', 'n.yaml', '--node', 'good:Good', '--duration', '10ms').returncode == 0


@pytest.mark.parametrize('spec', ['bad:Talker', 'bad:odd'])
def test_nodes_that_change_the_folder_and_raise_what_has_no_text(folder, mddag, spec):
    Path('n.yaml').write_text(ONE_TIMER)
    Path('bad.py').write_text(BAD_NODES)
    Path('elsewhere').mkdir()
    Path('elsewhere', 'out.mcap').touch()
    done = mddag('run', 'n.yaml', '--node', spec, '--trace', 'out.mcap', '--json', 'result.json')
    ran = spec == 'bad:Talker'
    assert done.returncode == (70 if ran else 1), done.stderr
    assert 'Odd: <' in done.stderr.splitlines()[-1]
    assert os.listdir('elsewhere') == ['out.mcap']
    assert [Path(name).exists() for name in ('out.mcap', 'result.json')] == [ran, ran]


def test_a_recording_that_cannot_be_written_is_an_error(graph, mddag):
    """Its reader goes away, as a disk that gets full; and a pipe stays when nothing ran."""
    Path('bad.py').write_text(BAD_NODES)
    for trace, status, what in (
            ('out.mcap', 2, ('--synthetic', 'sleep')),
            ('out.p1.mcap', 2, ('--synthetic', 'sleep', '--processes', '2')),
            ('bad.mcap', 1, ('--node', 'bad:main'))):
        os.mkfifo(trace)
        with subprocess.Popen(['head', '-c', '1000', trace], stdout=subprocess.DEVNULL):
            done = mddag('run', graph, *what, '--duration', '1s', '--trace',
                         trace.replace('p1.', ''))
        says = f'{trace}: writing failed (Broken pipe): ' if status == 2 else '--node bad:main: '
        assert done.returncode == status and says in done.stderr.splitlines()[-1], done.stderr
        assert Path(trace).is_fifo()


def test_a_node_may_remove_the_folder_in_which_the_run_began(folder, mddag):
    """The trace is where it was named, and the summary is printed."""
    Path('start').mkdir()
    Path('other/deep').mkdir(parents=True)
    Path('start/bad.py').write_text(BAD_NODES)
    done = mddag('run', '--node', 'bad:leave', '--duration', '100ms', '--trace', '../out.mcap',
                 cwd='start')
    assert done.returncode == 0, done.stderr
    assert 'there is nothing to judge' in done.stdout
    assert sorted(os.listdir()) == ['other', 'out.mcap'] and os.listdir('other') == ['deep']


def test_an_end_that_takes_too_long_shows_the_stack_of_each_thread(folder):
    robot(3)
    code = ('import sys; from mddag_executor.cli import main; '
            'from mddag_executor.hosting import run_here; run_here.STUCK_S = 0.5\n'
            'sys.exit(main.main(sys.argv[1:]))')
    _, err = run_program(code, 'run', *NODES, '--duration', '500ms')
    assert (err.count('Timeout'), err.count(' in track')) == (1, 1)

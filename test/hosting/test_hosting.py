# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Unmodified programs on our executor, each a real `mddag run --node`; how they are found."""

from contextlib import contextmanager
import gc
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time

from mddag_executor import MultiDeadlineExecutor, open_recording
from mddag_executor.defaults import SAME_SIGNAL_S
from mddag_executor.executor import publishing
from mddag_executor.executor.session import Session
from mddag_executor.hosting.guest import Guest
from mddag_executor.hosting.host import Host
from mddag_executor.hosting.loading import LoadingError, Program, resolve
import pytest
import rclpy
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
import rclpy.experimental
from rclpy.node import Node

from ..cli import golden
from ..conftest import Done
from ..executor.inside import engine_of, pool_of
from .conftest import GUESTS, wait_for

GRAPH = """\
mddag: 1
nodes:
  - node: /talker
    callbacks: [{name: tick, timer: 50ms, publishes: [/chatter]}]
  - node: /listener
    callbacks: [{name: heard, subscription: /chatter, deadline: 50ms}]
"""


@pytest.fixture
def world(tmp_path, monkeypatch):
    """Go to a workspace with an ament package and modules that people could have written."""
    prefix = tmp_path / 'ws'
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'chat_nodes').touch()
    (index / 'empty_nodes').touch()
    library = prefix / 'lib' / 'chat_nodes'
    library.mkdir(parents=True)
    for name, text in {
        **{name: '#!/usr/bin/env python3\n' + (GUESTS / f'{name}.py').read_text()
           for name in ('talker', 'pools')},
        'shell': '#!/bin/sh\nexit 0\n', 'broken.py': 'def (\n', 'native': '\x7fELF\x02\x01',
    }.items():
        (library / name).write_text(text)
        (library / name).chmod(0o755)
    site = tmp_path / 'site'
    site.mkdir()
    (site / 'chat.py').write_text((GUESTS / 'chat.py').read_text())
    (site / 'half.py').write_text('import not_installed_anywhere\n')
    (site / 'wrong.py').write_text('x = 1\nraise RuntimeError("no licence\\nhere")\n')
    (tmp_path / 'graph.yaml').write_text(GRAPH)
    # Before what is there: rclpy and this package may come from a sourced ROS or workspace.
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(prefix), prepend=os.pathsep)
    monkeypatch.setenv('PYTHONPATH', str(site), prepend=os.pathsep)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.chdir(tmp_path)
    for name in ('chat', 'half', 'wrong'):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


def heard(result):
    sink = result['dags']['/talker']['sinks']['/listener:heard']
    return int(sink['completed'])


# What each program prints until it only waits; what it prints when the run ends.
GOES_ON = {
    'two': ['first heard five', 'another heard five'],
    'spins_in_thread': ['in_thread heard five', 'thread joined, ok: False'],
    'spins_once_for_ever': ['for_ever heard five'],
    'steps': ['30 steps'],
    'calls_a_service': ['answer: forty-two'],
    'handles_its_exceptions': [
        'rclpy raised odd', 'executor raised odd', 'has handled its exceptions'],
    'spins_in_callbacks': [
        f'{way} forty-two' for way in (
            'of the node', 'of rclpy', 'step by step', 'step by step of rclpy')],
    'main': ['listener heard five'],
}
AT_THE_END = ['listener interrupted, ok: False', 'interrupted in a step']


def test_unmodified_programs_run_on_our_executor(world):
    """All side by side."""
    def missing(lines):
        said = Path('out.txt').read_text()
        return [line for line in lines if line not in said]  # threads may share a line

    lines = [line for some in GOES_ON.values() for line in some]
    nodes = [word for name in ('chat_nodes/talker', *(f'chat:{name}' for name in GOES_ON))
             for word in ('--node', name)]
    with open('out.txt', 'w') as out, subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'run', 'graph.yaml', *nodes, '--json',
         'result.json'], stdout=out, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
    ) as process:
        try:
            assert wait_for(lambda: not missing(lines), 110.0), missing(lines)
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0, err
    assert missing(lines + AT_THE_END) == []
    # A busy machine misses deadlines, and this is said.
    assert [line for line in err.splitlines()
            if not re.search(r'\d deadlines? missed', line)] == []
    result = json.loads(Path('result.json').read_text())
    assert result['never_ran'] == []
    assert result['callbacks']['/talker:tick']['ran'] >= heard(result) > 0
    # Every message was attributed to a job of the talker's timer.
    assert result['callbacks']['/listener:heard']['unattributed'] <= 2


def test_a_run_ends_with_its_last_program(world, mddag):
    done = mddag('run', '-q', '--node', 'chat:never_spins')
    assert (done.returncode, done.stdout, done.stderr) == (0, 'typed w\n', '')
    done = mddag('run', '--node', 'chat:never_spins', '--trace', 'typed.mcap')
    assert 'there is nothing to judge: ' in done.stdout and 'from-trace' not in done.stdout
    # a node may have what could be declared
    done = mddag('run', '--node', 'chat:hears_nothing', '--trace', 'heard.mcap')
    assert done.stdout.splitlines()[-1] == (
        'there is nothing to judge: no timer, subscription or service of the nodes ran, and '
        'actions and parameters cannot be declared')


def test_a_node_of_a_library_stays_as_long_as_a_program_uses_it(world, mddag):
    done = mddag('run', '-q', '--node', 'chat:uses_a_library_briefly',
                 '--node', 'chat:uses_a_library')
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout == 'heard after the end of the other program: True\n'


def test_what_a_node_raises_while_it_is_removed_ends_the_run(world, mddag):
    """An object that passes on to a node counts as that node, as for rclpy."""
    done = mddag('run', '--node', 'chat:refuses')
    assert done.returncode == 1 and 'OSError: the device is gone' in done.stderr
    done = mddag('run', '--node', 'chat:passes_on')
    assert (done.returncode, done.stderr) == (0, '')
    assert 'passed on' in done.stdout and '/behind: ' in done.stdout


PLAIN = 'import sys, chat; sys.exit(getattr(chat, sys.argv[1])())'


@pytest.mark.parametrize(('name', 'status'), [
    ('returns_status', 4), ('returns_reason', 1), ('has_a_loop', 0), ('handles_signals', 3),
    ('stops_the_robot', 0), ('is_interrupted', 130), ('is_interrupted_before_it_begins', 130),
    ('works_with_asyncio', 1), ('fails_at_the_end', 1), ('exits_early', 5),
    ('destroys_a_node', 0)])
def test_a_program_behaves_as_without_the_host(world, mddag, name, status):
    """It has the main thread: what it prints, what it raises and its exit status are the same."""
    plain = subprocess.run(
        [sys.executable, '-c', PLAIN, name], capture_output=True, text=True, timeout=60)
    hosted = mddag('run', '--node', f'chat:{name}')
    assert hosted.returncode == status, hosted.stderr
    assert status == (plain.returncode if plain.returncode >= 0 else 128 - plain.returncode)
    assert hosted.stdout.startswith(plain.stdout), hosted.stdout
    if 'Traceback' in plain.stderr or name == 'returns_reason':
        assert plain.stderr.splitlines()[-1] in hosted.stderr
    elif name != 'exits_early':
        assert hosted.stderr == plain.stderr
    assert ('Traceback' in hosted.stderr) == ('Traceback' in plain.stderr)


def test_a_script_may_start_processes(world, mddag):
    """They find its functions and end with SIGTERM; a forked one has no context of its own."""
    plain = subprocess.run([sys.executable, GUESTS / 'pools.py'], capture_output=True, text=True,
                           timeout=60)
    assert plain.stdout == (
        'fork [0, 1, 4, 9]\nspawn [0, 1, 4, 9]\nended by {-15}\n'), plain.stderr
    hosted = mddag('run', '-q', '--node', 'chat_nodes/pools')
    assert (hosted.returncode, hosted.stdout, hosted.stderr) == (0, plain.stdout, '')
    hosted = mddag('run', '-q', '--node', 'chat:forks_a_node')
    assert (hosted.returncode, hosted.stdout) == (0, 'ended with 1\n')
    assert hosted.stderr.splitlines()[-1].endswith(
        '--node chat:forks_a_node: it has forked a process that uses rclpy, whose context is that '
        "of the run: start it with subprocess, or multiprocessing.get_context('spawn')")


EARLY = """\
import os, signal, threading, time

has_begun = False

def hit():
    while not has_begun and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        time.sleep(0)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread(target=hit, daemon=True).start()

def main():
    global has_begun
    has_begun = True
    time.sleep(20.0)
"""


def test_an_interrupt_between_the_start_of_the_run_and_that_of_the_program_is_not_lost(
        world, mddag, default_context):
    Path('site/early.py').write_text(EARLY)
    done = mddag('run', '--node', 'early:main', '--trace', 'early.mcap')
    assert done.returncode == 130, done.stderr
    # wherever the interrupt comes: it either reaches the program or ends the run
    with Host() as host:
        guest = Guest(Program('early', 'early', list))
        guest.thread = host._main = threading.current_thread()
        host.guests.append(guest)
        assert host.ends_run(signal.SIGINT)
        guest.has_begun = True
        assert not host.ends_run(signal.SIGINT)
        guest.done.set()


ANYWHERE = """\
import signal, sys, time, types
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

left = [0]

def in_frame(frame, event, arg):
    return in_package if '/mddag_executor/' in frame.f_code.co_filename else None

def at_line(frame, event, arg):
    left[0] -= event == 'line'
    if left[0] == 0:
        sys.settrace(None)
        signal.raise_signal(NUMBER)
    return frame.f_trace

# the interrupted function is that of the package, and not the one above
in_package = types.FunctionType(at_line.__code__, globals() | {'__name__': 'mddag_executor'})

def ring(number, frame):
    raise BlockingIOError

def main():
    signal.signal(NUMBER, ring)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node, executor, ticks, received, rung = Node('n'), SingleThreadedExecutor(), [], [], 0
    node.create_timer(0.001, lambda: ticks.append(1))
    node.create_subscription(String, 't', lambda message: received.append(message.data), 10)
    publisher = node.create_publisher(String, 't', 10)
    executor.add_node(node)
    while not ticks:
        executor.spin_once()
    for n in range(1, 200, 3):
        publisher.publish(String(data=str(n)))
        left[0] = n
        try:
            sys.settrace(in_frame)
            executor.spin_once(timeout_sec=0.01)
            executor.spin_until_future_complete(rclpy.Future(), 0.01)
        except BlockingIOError:
            rung += 1
        finally:
            sys.settrace(None)
        seen = len(ticks)
        time.sleep(0.005)
        if len(ticks) > seen:
            print('a callback runs, but the program does not spin', n)
        while str(n) not in received or len(ticks) <= seen:
            executor.spin_once()
    print('rung:', rung > 20, len(received))
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGUSR1])
def test_what_a_handler_raises_at_any_line_of_a_spin_loses_nothing(world, mddag, number):
    """No callback runs until the program spins again, and then nothing is missing."""
    Path('site/anywhere.py').write_text(ANYWHERE.replace('NUMBER', str(int(number))))
    done = mddag('run', '-q', '--node', 'anywhere:main')
    assert (done.returncode, done.stdout, done.stderr) == (0, 'rung: True 67\n', '')


def test_what_was_exclusive_stays_exclusive(world, mddag, monkeypatch):
    """Callbacks of one program run one at a time, or as many as its executor has threads."""
    monkeypatch.setenv('PYTHONPATH', str(GUESTS), prepend=os.pathsep)
    specs = [f'overlap:{name}' for name in ('spins', 'steps', 'has_threads')]
    done = mddag('run', *(word for spec in specs for word in ('--node', spec)),
                 '--json', 'result.json', '--trace', 'run.mcap')
    assert done.returncode == 0, done.stderr
    says = done.stdout.splitlines()
    assert {'spins: 0 overlaps', 'steps: 0 overlaps'} < {*says}
    assert any(line in says for line in ('threads: 2 at a time', 'threads: 3 at a time'))
    waited = json.loads(Path('result.json').read_text())['exclusion']
    assert all(each['waited_ns'] > 0 for each in waited)
    assert 'overlap:spins' in [each['program'] for each in waited]
    assert any(line.startswith('callbacks of --node overlap:spins waited ') for line in says)
    names = open_recording('run.mcap').names
    programs = {names.by_number[each].node.name: n for each, n in names.programs.items()}
    assert programs.keys() == {'/spins', '/spins_other', '/steps', '/steps_other'}
    assert len({*programs.values()}) == 2


def test_callbacks_and_tasks_of_programs_may_await_asyncio(world, mddag, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(GUESTS), prepend=os.pathsep)
    for name, says in (
        ('serves_slowly', "['slept', 'slept'] 2 True"),
        ('runs_steps', 'starboard\nport\nnot that far'),
        ('fails_in_a_step', 'rudder stuck'), ('polls_in_a_loop', '1.5'),
    ):
        done = mddag('run', '-q', '--node', f'coroutines:{name}')
        assert (done.returncode, done.stdout) == (0, f'{says}\n'), done.stderr


def test_nodes_may_be_concurrent(world, mddag, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(GUESTS), prepend=os.pathsep)
    for given, arguments in (('', ['--concurrent', 'spins', '--concurrent', '/spins_other']),
                             (', concurrent: true', [])):
        Path('spins.yaml').write_text(f"""\
mddag: 1
nodes:
  - {{node: /spins, callbacks: [{{name: t, timer: 4ms, deadline: 1s}}]{given}}}
  - {{node: /spins_other, callbacks: [{{name: t, timer: 3ms, deadline: 1s}}]{given}}}
""")
        done = mddag('run', 'spins.yaml', '--node', 'overlap:spins', *arguments)
        # what still runs when the program shuts rclpy down may raise
        assert re.search(r'^spins: [1-9]\d* overlaps$', done.stdout, re.M), done.stdout
        waited = re.search(r'callbacks of --node \S+ waited ([\d.]+) s', done.stdout)
        assert waited is None or float(waited[1]) < 0.2, done.stdout


def test_a_step_ends_with_what_a_concurrent_callback_did_before_it(world, mddag, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(GUESTS), prepend=os.pathsep)
    for arguments in ([], ['--concurrent', 'waits']):
        done = mddag('run', '-q', '--node', 'overlap:waits_between_steps', *arguments)
        assert (done.returncode, done.stdout, done.stderr) == (0, 'waits: 1 has run\n', '')


def test_a_response_ends_a_step(world, mddag, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(GUESTS), prepend=os.pathsep)
    done = mddag('run', '-q', '--node', 'overlap:answers', '--node', 'overlap:asks_in_steps')
    assert (done.returncode, done.stdout) == (0, 'asks: answered\n'), done.stderr


def test_a_context_of_a_programs_own_is_left_alone(world, mddag):
    done = mddag('run', '--node', 'chat:has_another_context')
    assert done.returncode == 0 and 'Traceback' not in done.stderr, done.stderr
    assert 'chat:has_another_context: it has a context of its own' in done.stderr
    assert 'no declaration was given' in done.stdout


@pytest.mark.parametrize(('names', 'lines'), [
    (['waits_for_a_task'], ['Traceback', '--node chat:waits_for_a_task: ']),
    (['raises_in_a_callback', 'shuts_down_in_a_callback'], [
        '--node chat:raises_in_a_callback: its main has raised ZeroDivisionError',
        'its nodes no longer run', 'shut down', 'results due'])])
def test_exceptions_come_out_behind_the_summary(world, mddag, names, lines):
    """A callback that shuts rclpy down ends the run, one that raises ends its program."""
    done = mddag('run', 'graph.yaml', '--duration', '50s', *(
        word for name in names for word in ('--node', f'chat:{name}')))
    assert done.returncode == 1
    assert 'ZeroDivisionError' in done.stderr.splitlines()[-1]
    for line in lines:
        assert line in done.stdout + done.stderr


FULL = """\
import resource
from rclpy.node import Node

class Full(Node):
    def __init__(self):
        super().__init__('full')
        self.create_timer(0.001, lambda: None)
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, resource.RLIM_INFINITY))
"""


def test_a_run_goes_on_when_the_disk_is_full(world, mddag):
    """What was recorded before is there, and the last line says what is not."""
    Path('site/full.py').write_text(FULL)
    done = mddag('run', '--node', 'full:Full', '--trace', 'run.mcap', '--duration', '4s',
                 '--json', 'out.json')
    result = json.loads(Path('out.json').read_text())
    ran, = (each['ran'] for name, each in result['callbacks'].items() if '/full: ' in name)
    recorded = len(open_recording('run.mcap').executions)
    assert ran > recorded > 0 and result['trace']['lost'] >= ran - recorded, done.stderr
    assert 'events lost: writing failed)' in done.stdout
    assert done.returncode == 2
    failed = (f'{world}/run.mcap: writing failed (File too large): what was written before is '
              'there; free space, then try again')
    at_once, at_the_end = (line for line in done.stderr.splitlines() if failed in line)
    assert at_once.endswith(f': the trace is incomplete: {failed}')
    assert at_the_end == f'error: {failed}'


@contextmanager
def begun(*arguments):
    """Begin a command whose output goes to out.txt and err.txt."""
    with open('out.txt', 'w') as out, open('err.txt', 'w') as err, subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', *arguments], stdout=out, stderr=err,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_callbacks_that_run_see_the_end_and_finish(world, number):
    """Also those that sleep with a Rate; they may still publish."""
    with begun('run', '--node', 'chat:finishes_its_callbacks') as process:
        assert wait_for(lambda: 'loop begins' in Path('out.txt').read_text(), 60.0)
        process.send_signal(number)
        assert process.wait(60) == 0
    assert 'stops the motors' in Path('out.txt').read_text()
    assert Path('err.txt').read_text() == ''


def test_rclpy_is_no_longer_ok_as_soon_as_a_callback_shuts_it_down(world, mddag):
    done = mddag('run', '--node', 'chat:shuts_down_in_one_of_two_callbacks')
    assert done.returncode == 0, done.stderr
    assert 'closing: ok is False, the loop has ended: True' in done.stdout


def test_what_does_not_end_is_left_behind(world):
    """ROS arguments reach all nodes, and what they print stays out of the JSON."""
    (world / 'graph.yaml').write_text(GRAPH.replace('/chatter', '/talk'))
    specs = ('chat_nodes/talker', 'chat:Listener', 'chat:leaves_a_thread', 'chat:never_ends',
             'chat:blocks_in_a_callback')
    with begun('run', 'graph.yaml', *(word for spec in specs for word in ('--node', spec)),
               '--json', '-', '--ros-args', '-r', 'chatter:=talk') as process:
        assert wait_for(lambda: 'blocked' in Path('err.txt').read_text(), 60.0)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        time.sleep(2 * SAME_SIGNAL_S)       # before, another one counts as the same
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        process.wait(60)
    done = Done(process.returncode, Path('out.txt').read_text(), Path('err.txt').read_text())
    assert heard(done.result) >= 3 and done.result['nodes'] == [*specs]
    for line in (
        'not JSON', 'warning: a callback has not ended in time and is abandoned: let it return '
        'when rclpy.ok() is False',
        'warning: --node chat:never_ends: its main() has not ended in time and is abandoned: '
        'let it return when rclpy.ok() is False',
        'warning: threads that nodes started still run and are abandoned: stubborn',
    ):
        assert line in done.stderr.splitlines()


def test_each_program_has_ros_arguments_of_its_own(world, mddag):
    """Those of the command line hold for all. A node made in a callback has them as well."""
    (world / 'lidar.py').write_text("""
import rclpy
from rclpy.node import Node
from std_msgs.msg import Header

class Lidar(Node):
    def __init__(self, name='lidar', **more):
        super().__init__(name, **more)
        rate = self.declare_parameter('rate', 10).value
        scans = self.create_publisher(Header, 'scan', 1)
        # one write for each line, as two programs print
        name = self.get_fully_qualified_name()
        print(f'{name} {scans.topic_name} {rate}\\n', end='', flush=True)

def main():
    rclpy.init()
    node, others = Lidar(), []
    own = Lidar('own', cli_args=['--ros-args', '-r', '__ns:=/own'])
    apart = Lidar('apart', use_global_arguments=False)
    node.create_timer(0.05, lambda: others or others.append(Lidar('later')))
    rclpy.spin(node)
""")
    done = mddag(
        'run', '--node', 'lidar:main --ros-args -r __ns:=/front -p rate:=20',
        '--node', 'lidar:main --ros-args -r __ns:=/back', '--duration', '3s', '--trace', 't.mcap',
        '--ros-args', '-r', 'scan:=cloud')
    assert done.returncode == 0, done.stderr
    assert {line for line in done.stdout.splitlines() if line.startswith('/')} >= {
        '/front/lidar /front/cloud 20', '/back/lidar /back/cloud 10',
        '/front/later /front/cloud 20', '/back/later /back/cloud 10',
        '/own/own /own/cloud 20', '/own/own /own/cloud 10', '/apart /scan 10'}


@pytest.fixture
def default_context(no_thread_leak):
    """Initialise the default context, in which programs are hosted."""
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def host(default_context):
    """Give a host whose executor does not spin."""
    with Host() as host:
        host.start(SingleThreadedExecutor(), [])
        yield host
    host.executor.shutdown()


def test_rclpy_is_as_before_when_the_host_is_left(default_context):
    def main():
        rclpy.init()

    def parts():
        context = rclpy.get_default_context()
        return [
            rclpy.shutdown, rclpy.try_shutdown, rclpy.get_global_executor,
            rclpy.install_signal_handlers, rclpy.uninstall_signal_handlers,
            rclpy.experimental.EventsExecutor, Executor.__init__, threading.Thread.start,
            {*vars(context)}]

    publishing.install()
    before = parts()
    with Host() as host:
        host.start(SingleThreadedExecutor(), [Program('main', 'main', main)])
        assert not any(now == was for now, was in zip(parts(), before))
    assert parts() == before
    host.executor.shutdown()


@pytest.mark.parametrize('kind', [
    SingleThreadedExecutor, MultiThreadedExecutor, rclpy.experimental.EventsExecutor])
def test_another_executor_gives_its_nodes_to_ours_when_it_spins(host, kind):
    other = (getattr(rclpy.experimental, kind.__name__) if kind.__name__ == 'EventsExecutor'
             else kind)()
    first, second = Node('first'), Node('second')
    other.add_node(first)
    assert host.executor.get_nodes() == []
    other.spin_once(timeout_sec=0.01)
    assert host.executor.get_nodes() == [first]
    assert first.executor is other
    done = rclpy.Future()
    done.set_result(None)
    other.spin_once_until_future_complete(done, 60.0)
    assert not other.is_spinning
    spinning = threading.Thread(target=other.spin)
    spinning.start()
    assert wait_for(lambda: other.is_spinning)
    other.add_node(second)
    assert set(host.executor.get_nodes()) == {first, second}
    other.remove_node(first)
    assert host.executor.get_nodes() == [second]
    assert spinning.is_alive()
    other.shutdown()
    spinning.join(2.0)
    assert not spinning.is_alive()
    assert host.executor.get_nodes() == []


def test_executors_that_a_program_makes_again_and_again_leave_nothing_behind(default_context):
    def main():
        rclpy.init()
        node = Node('again')
        node.create_timer(0.0, lambda: None)
        for _ in range(40):
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            executor.create_task(lambda: None)
            executor.spin_once(timeout_sec=0.0)
            executor.shutdown()
            del executor
            gc.collect()

    executor = MultiDeadlineExecutor(num_workers=2)
    with Session(executor) as session:
        with Host() as host:
            host.start(executor, [Program('main', 'main', main)])
            assert wait_for(lambda: host.guests[0].done.is_set(), 60.0)
            assert host.guests[0].error is None
            assert len(engine_of(executor).scheduler.state.outer_limit) < 10
            assert len(pool_of(executor).outer_groups) + len(host._opened) < 10
        assert wait_for(lambda: session.stopped)


@pytest.mark.parametrize(('spec', 'message'), [
    ('chat:exits_early', 'it ended while starting (SystemExit: 5'),
    ('chat:own_context', 'node /alone has a context of its own: let it use the default context'),
    ('chat:other_domain', 'it asks for ROS domain 7, and this process is in another: set '),
    ('chat:returns_text', 'it returned a str, which is not an rclpy node'),
    ('chat:returns_nothing', 'it ended and neither returned a node nor initialised rclpy'),
])
def test_a_program_that_cannot_start(world, default_context, spec, message):
    with Host() as host, pytest.raises(LoadingError) as error:
        host.start(SingleThreadedExecutor(), host.load([spec]))
    assert str(error.value).startswith(f'--node {spec}: {message}')
    host.executor.shutdown()


@pytest.mark.parametrize(('spec', 'error'), [
    ('chat:starts_slowly', type(None)), ('chat:fails_after_a_loop', OSError)])
def test_a_program_whose_start_the_end_of_the_run_cuts_off_has_not_failed(
        world, default_context, monkeypatch, spec, error):
    """But one that never spins, and raises at its end, has."""
    monkeypatch.setattr('mddag_executor.hosting.host.START_TIMEOUT_S', 0.1)
    with Host() as host:
        host.start(SingleThreadedExecutor(), host.load([spec]))
        assert host.end(lambda: True) == [] and type(host.guests[0].error) is error
    host.executor.shutdown()


@pytest.mark.parametrize(('text', 'message'), [
    ('rclpy.spin(rclpy.create_node("early"))\n', 'it spins a node while it is imported: call'),
    ('rclpy.init(domain_id=7)\n', 'it asks for ROS domain 7, and this process is in another: ')])
def test_what_a_module_must_not_do_while_it_is_imported(world, default_context, text, message):
    (world / 'site' / 'at_import.py').write_text(
        f'import rclpy\nrclpy.init()\n{text}\n\ndef main():\n    pass\n')
    with Host() as host, pytest.raises(LoadingError) as error:
        host.load(['at_import:main'])
    assert str(error.value).startswith(f'--node at_import:main: {message}')
    assert 'at_import' not in sys.modules


def test_a_program_that_cannot_start_ends_the_run_with_one_line(world, mddag):
    done = mddag('run', 'graph.yaml', '--node', 'chat:exits_early', '--trace', 'out.mcap')
    assert (done.returncode, done.stderr.count('\n')) == (5, 1), done.stderr
    assert not Path('out.mcap').exists()
    Path('null').symlink_to('/dev/null')    # a device stays, even if root names it
    done = mddag('run', 'graph.yaml', '--node', 'chat:exits_early', '--trace', 'null')
    assert done.returncode == 5
    assert Path('null').is_symlink()


def test_a_program_has_a_command_line_of_its_own_while_it_is_imported(world, monkeypatch):
    (world / 'mine_argv.py').write_text(
        'import sys\nseen = [*sys.argv]\ndef main():\n    return seen\n')
    monkeypatch.syspath_prepend(world)
    before = sys.argv
    program = resolve("mine_argv:main --rate '2 Hz'", ['--ros-args', '-r', 'a:=b'])
    seen = sys.modules.pop('mine_argv').seen
    assert seen == ['mine_argv', '--rate', '2 Hz', '--ros-args', '-r', 'a:=b']
    assert program.arguments == ('--rate', '2 Hz') and sys.argv is before
    assert (program.spec, program.argv0) == ("mine_argv:main --rate '2 Hz'", 'mine_argv')
    assert resolve('chat_nodes/talker').argv0 == f'{world}/ws/lib/chat_nodes/talker'


def test_what_does_not_exist_is_said_on_one_line(world):
    """Each line of the golden file that begins with a quote is the specification of a node."""
    found = ''
    for line in (golden.FOLDER / 'node_specs.txt').read_text().splitlines():
        if line.startswith('"'):
            spec = json.loads(line)
            with pytest.raises(LoadingError, match=f'^--node {re.escape(spec)}: .*$') as error:
                resolve(spec)
            found += f'{line}\n{error.value}\n'
    golden.compare('node_specs', found.replace(str(world), 'WORLD'))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Unmodified programs on our executor, each a real `mddag run --node`; how they are found."""

from contextlib import suppress
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time

from mddag_executor.hosting.host import Host
from mddag_executor.hosting.loading import LoadingError, Program, resolve
from mddag_executor.trace import TraceError, TraceReader
import pytest
import rclpy
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
import rclpy.experimental
from rclpy.node import Node

from ..cli import golden
from .conftest import wait_for
from .workspace import GRAPH, make_workspace


@pytest.fixture
def world(tmp_path, monkeypatch):
    return make_workspace(tmp_path, monkeypatch)


def run(*specs, until=None, number=signal.SIGINT):
    """
    Run programs until something is true, which a signal ends then, or until they end.

    Return the result, and what they printed.
    """
    nodes = [argument for spec in specs for argument in ('--node', spec)]
    with open('out.txt', 'w') as out, subprocess.Popen(
        [sys.executable, '-m', 'mddag_executor', 'run', 'graph.yaml', *nodes, '--json',
         'result.json', '--trace', 'out.mcap'], stdout=out, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
    ) as process:
        try:
            if until is not None:
                assert wait_for(until, 60.0), (process.poll(), Path('out.txt').read_text())
                process.send_signal(number)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0, err
    # A busy machine skips releases and misses deadlines, and this is said; nodes of one name, too.
    expected = 'cannot keep its rate', 'Publisher already registered'
    assert [line for line in err.splitlines() if not any(text in line for text in expected)
            and not re.search(r'\d deadlines? missed', line)] == []
    result = json.loads(Path('result.json').read_text())
    return result, Path('out.txt').read_text()


def has_heard():
    """Tell whether the trace has the listener's callback, the second of the graph, ten times."""
    with suppress(OSError, TraceError):
        complete = TraceReader('out.mcap').events({'mddag:complete'})
        return sum(event[6] == 1 for event in complete) > 10
    return False


def heard(result):
    sink = result['dags']['/talker']['sinks']['/listener:heard']
    return int(sink['completed'])


@pytest.mark.parametrize(('listener', 'said'), [
    ('chat:main', 'listener ended after its spin'),
    ('chat:two', ''),
    ('chat:own_executor', 'own executor ended'),
    ('chat:events_executor', ''),
    ('chat:spins_once_for_ever', 'no longer ok'),
    ('chat:catches_signals', 'read the settings again'),
])
def test_unmodified_programs_run_on_our_executor(world, listener, said):
    result, output = run('chat_nodes/talker', listener, until=has_heard)
    assert heard(result) > 5
    assert result['never_ran'] == []
    assert result['callbacks']['/talker:tick']['ran'] >= heard(result)
    # Every message was attributed to a job of the talker's timer.
    assert result['undeclared'] <= 2
    assert said in output


@pytest.mark.parametrize(('specs', 'lines'), [
    ('chat:spins_in_thread chat:calls_a_service chat:steps', [
        'heard five', 'thread joined', 'answer: forty-two', '30 steps']),
    ('chat:spins_once chat:ends_in_a_thread', ['heard enough', 'over']),
    ('chat:handles_a_signal', [
        f'while it worked: signal {signal.SIGUSR1:d}', f'while it spun: signal {signal.SIGUSR1:d}',
        'one handler: True']),
    ('chat:handles_its_exceptions', ['<lambda> raised odd', 'spin raised odd']),
    ('chat:spins_in_callbacks', [
        'of the node forty-two', 'of rclpy forty-two', 'step by step forty-two',
        'step by step of rclpy forty-two']),
])
def test_programs_go_on_while_their_callbacks_run(world, specs, lines):
    run('chat_nodes/talker', *specs.split(),
        until=lambda: set(lines) <= set(Path('out.txt').read_text().splitlines()))


def test_the_run_ends_when_a_callback_shuts_rclpy_down(world):
    _, output = run('chat_nodes/talker', 'chat:shuts_down_in_a_callback')
    assert 'shut down' in output


def test_the_run_ends_when_all_programs_have_ended(world):
    _, output = run('chat:never_spins')
    assert 'typed w' in output.splitlines()


@pytest.mark.parametrize(('spec', 'message'), [
    ('chat:exits', 'it failed while starting (SystemExit: 3'),
    ('chat:own_context', 'node /alone has a context of its own: let it use the default context'),
    ('chat:other_domain', 'it asks for ROS domain 7, and this process is in another: set '),
    ('chat:returns_text', 'it returned a str, which is no rclpy node'),
    ('chat:returns_nothing', 'it ended and neither returned a node nor initialised rclpy'),
])
def test_a_program_that_cannot_start_ends_the_run_with_one_line(world, mddag, spec, message):
    process = mddag('run', 'graph.yaml', '--node', spec, '--trace', 'out.mcap')
    assert process.returncode == 2
    assert process.stderr.startswith(f'error: --node {spec}: {message}')
    assert process.stderr.count('\n') == 1
    assert not Path('out.mcap').exists()


def test_an_exception_during_the_run_comes_out_behind_the_summary(world, mddag):
    spec, message = 'chat:raises_in_a_callback', 'ZeroDivisionError'
    process = mddag(
        'run', 'graph.yaml', '--node', 'chat_nodes/talker', '--node', spec, '--duration', '2s')
    assert process.returncode == 70
    assert message in process.stderr.splitlines()[-1]
    assert f'--node {spec}: its main has raised {message}' in process.stderr
    assert 'its nodes run no more' in process.stderr
    assert 'results due' in process.stdout


def test_exceptions_that_no_spin_waits_for_end_the_run(world, mddag):
    process = mddag('run', 'graph.yaml', '--node', 'chat:no_longer_spins', '--duration', '50s')
    assert process.returncode == 70
    assert 'ZeroDivisionError' in process.stderr.splitlines()[-1]
    assert 'results due' in process.stdout


@pytest.mark.parametrize(('spec', 'warning'), [
    ('chat:leaves_a_thread', 'threads that nodes started still run and are left behind: stubborn'),
    ('chat:never_ends', '--node chat:never_ends: its main() has not ended in time'),
    ('chat:blocks_in_a_callback', 'a callback has not ended in time; it is left behind'),
])
def test_what_does_not_end_is_left_behind(world, mddag, spec, warning):
    process = mddag(
        'run', 'graph.yaml', '--node', 'chat_nodes/talker', '--node', spec, '--duration', '1s')
    assert process.returncode == 0
    assert warning in process.stderr
    assert 'results due' in process.stdout


def test_what_nodes_print_stays_out_of_the_json(world, mddag):
    process = mddag('run', 'graph.yaml', '--node', 'chat:prints', '--duration', '0.2s',
                    '--json', '-')
    assert json.loads(process.stdout)['nodes'] == ['chat:prints']
    assert 'not JSON' in process.stderr


def test_ros_arguments_reach_the_nodes(world, mddag):
    (world / 'graph.yaml').write_text(GRAPH.replace('/chatter', '/talk'))
    process = mddag(
        'run', 'graph.yaml', '--node', 'chat_nodes/talker', '--node', 'chat:Listener',
        '--duration', '1s', '--json', '-', '--ros-args', '-r', 'chatter:=talk')
    assert process.returncode == 0, process.stderr
    assert heard(json.loads(process.stdout)) >= 3


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
        signal.signal(signal.SIGUSR1, lambda *_: None)

    def parts():
        context = rclpy.get_default_context()
        return [
            rclpy.shutdown, rclpy.try_shutdown, rclpy.get_global_executor,
            rclpy.install_signal_handlers, rclpy.experimental.EventsExecutor, signal.signal,
            signal.getsignal, Executor.__init__, threading.Thread.start, {*vars(context)},
            signal.getsignal(signal.SIGUSR1)]

    before = parts()
    with Host() as host:
        host.start(SingleThreadedExecutor(), [Program('main', 'main', main)])
        assert not any(now == was for now, was in zip(parts()[:-1], before))
    assert parts() == before
    host.executor.shutdown()


@pytest.mark.parametrize('ends', [False, True])
def test_a_hangup_ends_the_run_unless_a_running_program_handles_it(
        default_context, monkeypatch, ends):
    """Programs that have ended handle nothing."""
    got = []

    def main():
        rclpy.init()
        signal.signal(signal.SIGHUP, lambda *_: got.append('program'))
        if ends:
            rclpy.shutdown()
            return None
        return Node('node')

    before = signal.signal(signal.SIGHUP, lambda *_: got.append('run'))
    try:
        with Host() as host:
            host.start(SingleThreadedExecutor(), [Program('main', 'main', main)])
            assert wait_for(lambda: host.guests[0].ended == ends)
            os.kill(os.getpid(), signal.SIGHUP)
            assert wait_for(lambda: got == ['run' if ends else 'program'])
    finally:
        signal.signal(signal.SIGHUP, before)
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
    spinning = threading.Thread(target=other.spin)
    spinning.start()
    time.sleep(0.05)
    other.add_node(second)
    assert set(host.executor.get_nodes()) == {first, second}
    other.remove_node(first)
    assert host.executor.get_nodes() == [second]
    assert spinning.is_alive()
    other.shutdown()
    spinning.join(2.0)
    assert not spinning.is_alive()
    assert host.executor.get_nodes() == []


@pytest.mark.parametrize(('spec', 'argv0'), [
    ('chat_nodes/talker', '{world}/ws/lib/chat_nodes/talker'),
    ('chat:main', 'chat'),
    ('chat:Listener', 'chat'),
])
def test_what_exists_is_found(world, spec, argv0):
    program = resolve(spec)
    assert (program.spec, program.argv0) == (spec, argv0.format(world=world))


def test_a_program_has_a_command_line_of_its_own_while_it_is_imported(world, monkeypatch):
    (world / 'mine_argv.py').write_text(
        'import sys\nseen = [*sys.argv]\ndef main():\n    return seen\n')
    monkeypatch.syspath_prepend(world)
    before = sys.argv
    program = resolve("mine_argv:main --rate '2 Hz'", ['--ros-args', '-r', 'a:=b'])
    seen = sys.modules.pop('mine_argv').seen
    assert seen == ['mine_argv', '--rate', '2 Hz', '--ros-args', '-r', 'a:=b']
    assert program.arguments == ('--rate', '2 Hz') and sys.argv is before


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

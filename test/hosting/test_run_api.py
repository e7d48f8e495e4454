# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""``hosting.run``: what tests and notebooks call instead of `mddag run`."""

import gc
import json
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

from mddag_executor.errors import MddagError, UsageError, UserCodeError
from mddag_executor.hosting import run, RunOptions, RunResult, RunWarning
from mddag_executor.trace import read_events
import msg_graph
from msg_graph import GraphError
import pytest
import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node

GRAPH = """\
mddag: 1
nodes:
  - {node: /api, callbacks: [{name: tick, timer: 20ms, deadline: 20ms, execution_time: 1ms}]}
"""


class Api(Node):
    """A node without surprises."""

    def __init__(self):
        super().__init__('api')
        self.create_timer(0.02, self.tick)

    def tick(self):
        pass


class Broken(Api):
    """A node whose callback raises."""

    def tick(self):
        raise FileNotFoundError(2, 'No such file', '/calibration.yaml')


def returns_three():
    rclpy.init()
    rclpy.spin_once(Api(), timeout_sec=0.1)
    rclpy.shutdown()
    return 3


def waits_for_its_threads():
    rclpy.init()
    node, begun, done = Node('waits'), threading.Event(), []

    def work():
        timer.cancel()
        begun.set()
        time.sleep(0.3)
        done.append(1)

    timer = node.create_timer(0.01, work)
    executor = MultiThreadedExecutor(2)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    assert begun.wait(60.0)
    executor.shutdown(wait_for_threads=True)
    has_waited = bool(done)
    rclpy.shutdown()
    thread.join()
    return 3 if has_waited else 4


def wrong():
    raise ValueError('no licence')


def sleeps_with_a_rate():
    rclpy.init()
    node = Api()
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    rate = node.create_rate(50)
    while rclpy.ok():
        rate.sleep()


def steps_for_ever():
    rclpy.init()
    node = Node('steps')
    node.create_timer(0.02, lambda: None)
    while True:
        rclpy.spin_once(node)


def fails_at_the_end():
    try:
        sleeps_with_a_rate()
    finally:
        raise OSError('the device is gone')


@pytest.fixture
def here(tmp_path, monkeypatch, no_thread_leak):
    monkeypatch.chdir(tmp_path)
    Path('graph.yaml').write_text(GRAPH)
    return tmp_path


def test_nodes_run_twice_in_one_process_and_leave_everything_as_it_was(here):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    argv = [*sys.argv]
    for number in range(2):
        result = run(RunOptions(
            nodes=[Api], graph=msg_graph.load('graph.yaml'), duration='300ms', diagnostics=None,
            trace=f'{number}.mcap'))
        assert isinstance(result, RunResult)
        assert result.dags['/api']['sinks']['/api:tick']['completed'] > 0
        assert result.callbacks['/api:tick']['ran'] > 0
        assert (result.status, result.error, result.warnings) == (0, None, ())
        assert result.in_time == (not result.to_json()['deadline_missed'])
        found = json.loads(json.dumps(result.to_json()))
        assert found['nodes'] == [f'{__name__}:Api'] and found['file'] == 'graph.yaml'
        assert [*read_events(f'{number}.mcap')]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert sys.argv == argv and not rclpy.ok() and gc.get_freeze_count() == 0


def test_it_runs_in_a_thread_and_nodes_made_from_a_declaration(here):
    done = []
    thread = threading.Thread(target=lambda: done.append(run(RunOptions(
        nodes=[returns_three], diagnostics=None))))
    thread.start()
    thread.join()
    result, = done
    assert result.status == 3
    assert [(each.spec, each.status) for each in result.programs] == [
        (f'{__name__}:returns_three', 3)]
    with pytest.warns(RunWarning, match='no scheduler can keep its deadline of 20.0 ms'):
        result = run(RunOptions(
            synthetic='sleep', graph=msg_graph.loads(GRAPH.replace('1ms', '30ms'), name='g'),
            duration='200ms'))
    assert not result.in_time and len(result.warnings) == 1
    assert result.to_json()['measured']['mode'] == 'sleep'


def test_the_executor_of_a_program_may_wait_for_its_threads(here):
    """Kilted's MultiThreadedExecutor has this argument."""
    assert run(RunOptions(nodes=[waits_for_its_threads])).status == 3


def test_what_a_node_raises_has_the_result_with_it(here):
    with pytest.raises(UserCodeError, match=r'^/api:tick: it raised FileNotFoundError: ') as info:
        run(RunOptions(nodes=[Broken], graph='graph.yaml', duration='20s'))
    assert isinstance(info.value.__cause__, FileNotFoundError)
    assert info.value.result.callbacks['/api:tick']['failed'] >= 1
    assert info.value.result.status == 70
    with pytest.raises(MddagError, match=f'--node {__name__}:wrong: it failed while starting'):
        run(RunOptions(nodes=[wrong]))
    assert run(RunOptions(nodes=[Api], duration='100ms')).status == 0  # nothing is left of it


def test_a_program_that_the_end_of_the_time_interrupts_has_not_failed(here):
    """By itself, it would not end; what it raises of its own is an error."""
    result = run(RunOptions(nodes=[sleeps_with_a_rate, steps_for_ever], duration='500ms'))
    assert (result.status, result.error) == (0, None)
    assert [(each.status, each.message) for each in result.programs] == [(0, '')] * 2
    with pytest.raises(MddagError, match='fails_at_the_end: it raised OSError: the device is go'):
        run(RunOptions(nodes=[fails_at_the_end], duration='500ms'))


@pytest.mark.parametrize(('given', 'line'), [
    ({}, 'nodes: give nodes to run, or synthetic, and not both'),
    ({'nodes': Api}, 'give a list, even for one node'),
    ({'nodes': ['a:b'], 'duration': '2 parsecs'}, "duration='2 parsecs': "),
    ({'nodes': ['a:b'], 'duration': 'off'}, "duration='off': "),
    ({'nodes': ['a:b'], 'duration': -1}, "duration=-1: give a time such as '20s'"),
    ({'synthetic': 'sleep'}, '--synthetic: it needs the nodes of a declaration: give a GRAPH'),
    ({'synthetic': 'nap', 'graph': 'graph.yaml'}, "synthetic='nap': give one of sleep, spin, "),
    ({'nodes': ['a:b'], 'utilisation': 0.5}, '--utilisation: it scales synthetic nodes only'),
    ({'nodes': ['a:b'], 'graph': 'graph.yaml', 'processes': 0}, '--processes 0: give 1 or more'),
    ({'nodes': ['a:b'], 'on_exit': 'panic'}, "on_exit='panic': give end or continue"),
    ({'nodes': ['no_such_module:main']}, "there is no module 'no_such_module'"),
    ({'nodes': [Api], 'policy': 'best'}, 'best'),
    ({'nodes': [Api], 'workers': 0}, 'workers=0: give an integer from 1 up'),
    ({'nodes': [Api], 'trace': 'nowhere/x.mcap'}, 'there is no directory nowhere'),
    ({'nodes': [Api], 'trace': 'new/'}, 'new/: this is a directory: name a file'),
    ({'nodes': [Api], 'graph': 'graph.yaml', 'processes': 2},
     'several processes need its name: give '),
    ({'nodes': [4]}, 'makes no node'),
])
def test_what_is_wrong_is_said_in_one_line(here, given, line):
    with pytest.raises(MddagError) as info:
        run(RunOptions(**{'duration': '1s', **given}))
    assert line in str(info.value) and '\n' not in str(info.value)
    assert not rclpy.ok()


@pytest.mark.parametrize('where', ['MultiDeadlineExecutor', '_Run'])
def test_an_interrupt_before_the_run_leaves_no_trace_but_an_earlier_one(here, monkeypatch, where):
    """The first comes before the trace replaces the earlier file, the second after that."""
    Path('run.mcap').write_text('earlier')

    def interrupted(*args, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(f'mddag_executor.hosting.run_here.{where}', interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(RunOptions(nodes=[Node], trace='run.mcap', overwrite=True))
    gc.collect()  # of the second, which has no one to shut it down
    assert Path('run.mcap').exists() == (where != '_Run')


def test_the_state_of_the_process_is_checked_first(here):
    with pytest.raises(GraphError, match='nowhere.yaml'):
        run(RunOptions(nodes=[Api], graph='nowhere.yaml'))
    rclpy.init()
    with pytest.raises(UsageError, match=r'initialised already .*: call rclpy\.shutdown\(\)'):
        run(RunOptions(nodes=[Api]))
    assert rclpy.ok()
    rclpy.shutdown()


INTERRUPTED = """\
from mddag_executor.hosting import run, RunOptions
from rclpy.node import Node

class Api(Node):
    def __init__(self):
        super().__init__('api')
        self.timer = self.create_timer(0.02, self.tick)

    def tick(self):
        self.timer.cancel()
        print('runs', flush=True)

for _ in range(2):
    result = run(RunOptions(nodes=[Api], diagnostics=None))
    print(sum(each['ran'] for each in result.callbacks.values()), flush=True)
"""


def test_ctrl_c_ends_the_run_and_may_end_the_next_one(here):
    with subprocess.Popen(
        [sys.executable, '-c', INTERRUPTED], stdout=subprocess.PIPE, text=True,
    ) as process:
        for _ in range(2):
            assert process.stdout.readline() == 'runs\n'
            process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == '1\n'
    assert process.returncode == 0

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What rclpy promises of executors: spins, several executors, contexts and processes."""

import multiprocessing
import re
import signal
import threading
import time

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ..conftest import run_program
from .conftest import is_idle, Spinning, wait_for


def counting(node, period=0.005):
    """Give a node a timer; return what grows with its calls."""
    calls = []
    node.create_timer(period, lambda: calls.append(threading.get_native_id()))
    return calls


def goes_on(calls):
    before = len(calls)
    return wait_for(lambda: len(calls) >= before + 3)


# --- as the global executor, and as a context manager --------------------------------------------


@pytest.fixture
def as_global(make_executor, monkeypatch):
    executor = make_executor()
    monkeypatch.setattr(rclpy, '__executor', executor)
    assert rclpy.get_global_executor() is executor
    return executor


def test_rclpy_spin_as_the_global_executor(as_global, make_node, ros_context):
    """And on all workers, as with ``executor.spin()``."""
    node, together = make_node(), threading.Barrier(3)
    group = ReentrantCallbackGroup()
    met = []

    def meet():
        if not met:
            met.append(together.wait(5.0))
            rclpy.try_shutdown(context=ros_context)

    for _ in range(3):
        node.create_timer(0.01, meet, group)
    rclpy.spin(node)
    assert met and as_global.get_nodes() == []


def test_rclpy_spin_once_as_the_global_executor(as_global, make_node):
    node = make_node()
    calls = counting(node)
    for count in range(1, 4):
        rclpy.spin_once(node, timeout_sec=5.0)
        assert calls == [threading.get_native_id()] * count
        assert as_global.get_nodes() == []
    node.destroy_timer(next(iter(node.timers)))
    begin = time.monotonic()
    rclpy.spin_once(node, timeout_sec=0.05)
    assert time.monotonic() - begin >= 0.05


def test_rclpy_spin_until_future_complete_as_the_global_executor(as_global, make_node):
    node, future = make_node(), Future()
    node.create_timer(0.01, lambda: future.set_result('done') if not future.done() else None)
    rclpy.spin_until_future_complete(node, future, timeout_sec=5.0)
    assert future.result() == 'done' and as_global.get_nodes() == []
    rclpy.spin_until_future_complete(node, Future(), timeout_sec=0.05)
    node.create_service(Trigger, '/ask', lambda request, response: response)
    asked = node.create_client(Trigger, '/ask')
    assert asked.wait_for_service(5.0)
    answer = asked.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, answer, timeout_sec=5.0)
    assert answer.done()


# --- several at once -----------------------------------------------------------------------------


def test_several_contexts_in_one_process(make_executor, make_node, ros_context):
    """One is shut down, the other goes on; what signals do is not touched."""
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    other = Context()
    rclpy.init(context=other)
    second = make_executor(context=other)
    far = Node('far', context=other, start_parameter_services=False, enable_rosout=False)
    near = make_node('near')
    of_far, of_near = counting(far), counting(near)
    first = make_executor()
    first.add_node(near)
    second.add_node(far)
    heard = []
    near.create_subscription(Header, '/across', heard.append, 10)
    publisher = far.create_publisher(Header, '/across', 10)
    with Spinning(first) as spinning:
        ended = Spinning(second)
        with ended:
            assert goes_on(of_far) and goes_on(of_near)
            assert wait_for(lambda: publisher.publish(Header()) or heard)
            rclpy.shutdown(context=other)
            ended.join()
        assert isinstance(ended.error, ExternalShutdownException)
        assert ros_context.ok() and goes_on(of_near)
    assert spinning.error is None
    assert handlers == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))


CONTEXTS = """
import sys, threading
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from mddag_executor import MultiDeadlineExecutor


def spin(name, executor):
    try:
        rclpy.spin(nodes[name], executor) if name == 'own' else executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException) as end:
        ends.append((name, type(end).__name__))

ends, executors, nodes, events = [], {}, {}, []
rclpy.init()
other = Context()
rclpy.init(context=other)
for name, context in ('own', None), ('other', other):
    node = nodes[name] = rclpy.create_node(name, context=context)
    executor = executors[name] = MultiDeadlineExecutor(context=context)
    executor.add_node(node)
    ran = threading.Event()
    events.append(ran)
    node.create_timer(0.01, ran.set)
threading.Thread(target=lambda: [e.wait() for e in events] and print('ready', flush=True)).start()
thread = threading.Thread(target=spin, args=('other', executors['other']))
thread.start()
spin('own', executors['own'])
thread.join()
for executor in executors.values():
    executor.shutdown()
print(sorted(ends), [t.name for t in threading.enumerate() if t.name.startswith('mddag')])
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_executors_of_all_contexts(number):
    """And no thread goes on."""
    out, err = run_program(CONTEXTS, send=number)
    own = r"('KeyboardInterrupt'|'ExternalShutdownException')"
    assert re.fullmatch(
        rf"\[\('other', 'ExternalShutdownException'\), \('own', {own}\)\] \[\]\n", out), out
    assert 'Traceback' not in err  # a busy machine skips periods of the timers, which is logged


DEPTH = 1000


def test_one_of_rclpys_executors_in_the_same_process(make_executor, make_node, ros_context):
    """
    They pass a number to each other, a thousand times.

    rclpy's MultiThreadedExecutor needs 150 ms for each, whatever the other executor is.
    """
    here, there, done = make_node('here'), make_node('there'), threading.Event()
    to_there = here.create_publisher(Header, '/to_there', DEPTH)
    to_here = there.create_publisher(Header, '/to_here', DEPTH)
    got = []

    def back(message):
        got.append(message.stamp.sec)
        message.stamp.sec += 1
        to_there.publish(message) if message.stamp.sec < 1000 else done.set()

    here.create_subscription(Header, '/to_here', back, DEPTH)
    there.create_subscription(Header, '/to_there', to_here.publish, DEPTH)
    executor = make_executor(nodes=[here])
    other = SingleThreadedExecutor(context=ros_context)
    other.add_node(there)
    assert wait_for(lambda: to_there.get_subscription_count() == 1
                    and to_here.get_subscription_count() == 1)
    with Spinning(executor), Spinning(other):
        to_there.publish(Header())
        assert done.wait(30.0), got[-1:]
    assert got == list(range(1000))


def test_a_node_moves_between_executors_that_spin(make_executor, make_node):
    """Nothing that was published is heard twice, and what is published after the move is heard."""
    node, source, heard = make_node(), make_node('source'), []
    node.create_subscription(Header, '/a', lambda m: heard.append(m.stamp.sec), DEPTH)
    ticks = []
    node.create_timer(0.001, lambda: ticks.append(1))
    publisher = source.create_publisher(Header, '/a', DEPTH)
    executors = [make_executor(num_workers=2) for _ in range(2)]
    assert wait_for(lambda: publisher.get_subscription_count() == 1)
    message = Header()
    expected = []
    with Spinning(executors[0]) as first, Spinning(executors[1]) as second:
        for number in range(40):
            to = executors[number % 2]
            to.add_node(node)  # which removes it from the other one
            assert node.executor is to
            message.stamp.sec = number
            publisher.publish(message)
            expected.append(number)
            before = len(ticks)
            assert wait_for(lambda n=number: n in heard), number
            assert wait_for(lambda n=before: len(ticks) > n)
    assert first.error is second.error is None
    assert heard == expected


# --- fork ----------------------------------------------------------------------------------------


def wait_until_told(connection):
    connection.send('here')
    connection.recv()


def raise_in_the_child():
    raise SystemExit(3)


@pytest.mark.filterwarnings('ignore:.*use of fork')
def test_a_forked_process_disturbs_nothing_and_ends(make_executor, make_node):
    """From a callback and from elsewhere, as ``multiprocessing`` does it."""
    fork = multiprocessing.get_context('fork')
    node, heard, ticks = make_node(), [], []
    publisher = node.create_publisher(Header, '/a', DEPTH)
    node.create_subscription(
        Header, '/a', lambda m: heard.append(m.stamp.sec), DEPTH,
        callback_group=ReentrantCallbackGroup())
    node.create_timer(0.002, lambda: ticks.append(1))
    executor = make_executor(num_workers=3, nodes=[node])
    assert wait_for(lambda: publisher.get_subscription_count() == 1)

    def start(target, *args):
        process = fork.Process(target=target, args=args)
        process.start()
        return process

    with Spinning(executor) as spinning:
        mine, theirs = fork.Pipe()
        task = executor.create_task(start, wait_until_told, theirs)
        assert wait_for(task.done)
        children = [task.result(), start(raise_in_the_child)]
        assert mine.recv() == 'here'
        message = Header()
        for number in range(50):  # while there is a child that has all the descriptors
            message.stamp.sec = number
            publisher.publish(message)
        before = len(ticks)
        assert wait_for(lambda: len(heard) == 50 and len(ticks) > before + 10)
        mine.send('go')
        for child in children:
            child.join(15.0)
    assert [child.exitcode for child in children] == [0, 3]
    assert spinning.error is None and sorted(heard) == list(range(50))
    assert is_idle(executor)
    mine.close()
    theirs.close()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Contexts that end, signals, and programs that end while an executor spins: the spin ends."""

import contextlib
import itertools
import signal
import sys
import threading
import time

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor.shutdown import call_at_shutdown
import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    ShutdownException,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from std_msgs.msg import Empty

from ..conftest import run_program

ENDS = {
    'shutdown': Context.try_shutdown, 'destroy': Context.destroy,
    'both': lambda context: (context.try_shutdown(), context.destroy())}


@pytest.mark.parametrize('inside', [False, True], ids=['outside', 'callback'])
@pytest.mark.parametrize('end', ENDS)
@pytest.mark.parametrize('way', ['spin', 'steps'])
def test_spin_ends_with_its_context(way, end, inside, no_thread_leak, monkeypatch):
    in_threads = []
    monkeypatch.setattr(threading, 'excepthook', in_threads.append)
    context = Context()
    rclpy.init(context=context)
    node = Node('node', context=context)
    node.create_subscription(Empty, '/topic', lambda m: None, 10)
    errors = []
    ran = threading.Event()

    def callback():
        ran.set()
        if inside:
            ENDS[end](context)

    def spin():
        try:
            while way == 'steps':
                executor.spin_once(0.02)
            executor.spin()
        except BaseException as error:
            errors.append(error)

    node.create_timer(0.01, callback)
    executor = MultiDeadlineExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=spin)
    thread.start()
    assert ran.wait(5.0)
    if not inside:
        ENDS[end](context)
    thread.join(10.0)
    assert not thread.is_alive()
    # As rclpy's: spin returns when a callback has shut the context down.
    returns = inside and end != 'destroy' and way != 'steps'
    assert [type(error) for error in errors] == (
        [] if returns else [ExternalShutdownException])
    assert executor.shutdown(5.0)
    assert in_threads == []
    with contextlib.suppress(Exception):
        node.destroy_node()


@pytest.mark.parametrize('kind', [
    SingleThreadedExecutor, MultiThreadedExecutor, MultiDeadlineExecutor])
def test_spin_returns_when_a_callback_shuts_down_as_rclpy_s_do(
        kind, ros_context, make_node, capfd):
    """Also those that fail meanwhile, just because the context has ended, end nothing."""
    node = make_node()
    publisher = node.create_publisher(Empty, '/topic', 1)
    node.create_timer(0.01, lambda: publisher.publish(Empty()), ReentrantCallbackGroup())
    node.create_timer(0.1, lambda: rclpy.shutdown(context=ros_context))
    executor = kind(context=ros_context)
    rclpy.spin(node, executor)
    assert not ros_context.ok()
    executor.spin()     # and at once when it has ended before
    executor.shutdown()
    if kind is MultiThreadedExecutor:  # rclpy's leaves its threads to the garbage collector
        executor._executor.shutdown()
    assert 'Traceback' not in capfd.readouterr().err


def test_what_the_callback_raises_that_shuts_down_comes_out(make_executor, make_node, ros_context):
    node = make_node()

    def end():
        rclpy.shutdown(context=ros_context)
        time.sleep(0.05)
        raise SystemExit('done')

    node.create_timer(0.01, end)
    executor = make_executor(nodes=[node])
    with pytest.raises(SystemExit, match='done'):
        executor.spin()


def test_no_interrupt_gets_lost_where_something_of_a_context_dies(ros_context, monkeypatch):
    """A KeyboardInterrupt in the Python code of a weak reference is printed and forgotten."""
    class Thing:

        def wake(self):
            pass

    lost = []
    monkeypatch.setattr(sys, 'unraisablehook', lost.append)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    interrupts = 0
    try:
        for number in itertools.count():
            try:
                signal.setitimer(signal.ITIMER_REAL, 0.0005)
                while True:
                    call_at_shutdown(ros_context, Thing().wake)
            except KeyboardInterrupt:
                interrupts += 1
            if number >= 200:
                break
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert interrupts > 200 and lost == []


PROGRAM = """
import os, sys, threading, time
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from mddag_executor import MultiDeadlineExecutor


def sleep():  # in C++, without the interpreter lock
    ran.set()
    node.get_clock().sleep_for(Duration(nanoseconds=10_000_000))


def block():
    ran.set()
    threading.Event().wait()


def spin():
    {spin}

rclpy.init()
node = rclpy.create_node('node')
ran = threading.Event()
group = ReentrantCallbackGroup()
for _ in range(7):
    node.create_timer(0.005, {callback}, callback_group=group)
executor = MultiDeadlineExecutor()
executor.add_node(node)
threading.Thread(target=spin, daemon=True).start()
assert ran.wait(10)
time.sleep(0.1)
{end}
print('end', flush=True)
"""

SPIN = 'executor.spin()'
STEPS = 'while rclpy.ok(): executor.spin_once(timeout_sec=0.005)'
# threads of a spin are parked then
SPUN_BEFORE = """executor.spin_until_future_complete(rclpy.Future(), 0.1)
    while True: executor.spin_once(0.3)"""


def run(**parts):
    out, err = run_program(PROGRAM.format(**{'callback': 'sleep', 'end': '', **parts}))
    assert out.splitlines()[-1] == 'end'
    expected = 'cannot keep its rate', 'use of fork() may lead to deadlocks'
    noise = [line for line in err.splitlines()
             if not any(text in line for text in expected)]
    assert noise == []


@pytest.mark.parametrize('spin', [SPIN, STEPS, SPUN_BEFORE], ids=range(3))
def test_a_program_may_end_while_a_daemon_thread_spins(spin):
    run(spin=spin)


def test_a_callback_that_never_ends_does_not_keep_a_program_from_ending():
    run(spin=SPIN, callback='block')


def test_a_program_may_shut_the_executor_down_right_before_it_ends():
    run(spin=SPIN, end='executor.shutdown(0)')


def test_a_forked_child_ends_without_what_the_parent_has():
    # Only what Python does at exit: Fast DDS itself does not survive the end of such a child.
    end = (
        'import atexit, warnings\n'
        'warnings.simplefilter("ignore", DeprecationWarning)  # of a fork with threads\n'
        'with executor._pool.lock:\n'
        '    child = os.fork()\n'
        '    if not child:\n'
        '        atexit._run_exitfuncs()\n'
        '        os._exit(3)\n'
        'assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3')
    run(spin=SPIN, callback='ran.set', end=end)


PUBLISHES = """
import faulthandler, signal, sys, threading, time
import rclpy
from std_msgs.msg import String
from mddag_executor import MultiDeadlineExecutor
from msg_graph import loads

faulthandler.dump_traceback_later(40, exit=True)
rclpy.init()
node = rclpy.create_node('node')
publisher = node.create_publisher(String, '/command', 10)
heard = []
node.create_subscription(String, '/command', lambda message: heard.append(message.data), 10000)
timer = node.create_timer(0.001, lambda: publisher.publish(String(data='job')))
executor = MultiDeadlineExecutor(loads('''
mddag: 1
nodes:
  - node: /node
    callbacks:
      - {name: tick, timer: 1ms, publishes: [/command]}
      - {name: obey, subscription: /command, deadline: 1s}
'''))
executor.add_node(node)
where = sys.argv[1]
stops = 0


def stop(*_):
    global stops
    publisher.publish(String(data='stop'))
    stops += 1
    if stops < 200:
        signal.setitimer(signal.ITIMER_REAL, 0.001)

signal.signal(signal.SIGALRM, stop)
signal.setitimer(signal.ITIMER_REAL, 0.001)


def done():
    return stops == 200 and heard.count('stop') >= 200

if where == 'spin':
    thread = threading.Thread(target=lambda: [time.sleep(0.01) for _ in iter(done, True)])
    thread.start()
    future = rclpy.Future()
    threading.Thread(target=lambda: (thread.join(), future.set_result(None))).start()
    executor.spin_until_future_complete(future)
elif where == 'spin_once':
    while not done():
        executor.spin_once(0.1)
else:
    thread = threading.Thread(target=executor.spin)
    thread.start()
    while not done():
        publisher.publish(String(data='go'))
        executor.statistics()
        executor.create_task(lambda: None)
    executor.shutdown()
    thread.join()
print(stops, heard.count('stop'))
"""


@pytest.mark.parametrize('where', ['spin', 'spin_once', 'other thread'])
def test_a_signal_s_handler_may_publish(where):
    """Whatever the main thread does when the signal comes: it holds locks now and then."""
    assert run_program(PUBLISHES, where)[0] == '200 200\n'


def test_a_callback_of_spin_once_may_shut_down(make_executor, make_node):
    """After a spin, threads are parked; the shutdown ends them though a step is running."""
    node, future, done = make_node(), rclpy.Future(), []
    executor = make_executor(num_workers=2, nodes=[node])

    def callback():
        if threading.current_thread() is threading.main_thread():
            done.append(executor.shutdown(5.0))
        elif not future.done():  # a worker may run it again before the spin has ended
            future.set_result(None)
    node.create_timer(0.01, callback)
    executor.spin_until_future_complete(future, 10.0)
    with contextlib.suppress(ExternalShutdownException, ShutdownException):
        for _ in range(100):
            executor.spin_once(0.1)
            if done:
                break
    assert done == [True]

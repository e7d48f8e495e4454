# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Spinning: what comes out of it, one callback at a time, and what ends it."""

import contextlib
from functools import partial
import itertools
import math
import signal
import sys
import threading
import time
import types

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor import lending, workers
from mddag_executor.executor.interrupts import interruptible_sleep, InterruptsDeferred
from mddag_executor.executor.shutdown import call_at_shutdown
import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, ShutdownException
from rclpy.node import Node
from rclpy.task import Future
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import Empty, Header
from std_srvs.srv import Trigger

from ..conftest import run_program
from .conftest import patience, Pulse, Spinning, wait_for
from .declared import graph
from .inside import pool_of, replace_method

# --- what comes out ------------------------------------------------------------------------------


@pytest.mark.parametrize('kind', [
    'timer', 'subscription', 'service', 'guard', 'waitable', 'take', 'task', 'coroutine'])
def test_an_exception_comes_out_of_spin(make_executor, make_node, kind):
    """The only worker ends the spin right after it: who swallows it is found out at once."""
    node = make_node()
    executor = make_executor(num_workers=1, nodes=[node])
    after = Future(executor=executor)

    def fail(*args):
        if not after.done():
            executor.create_task(after.set_result, None)
        raise ZeroDivisionError(kind)

    async def fail_later(*args):
        fail()

    if kind == 'timer':
        node.create_timer(0.01, fail)
    elif kind == 'subscription':
        node.create_subscription(Header, '/topic', fail, 10)
        publisher = node.create_publisher(Header, '/topic', 10)
        node.create_timer(0.05, lambda: publisher.publish(Header()))
    elif kind == 'service':
        node.create_service(Trigger, '/ask', fail)
        client = node.create_client(Trigger, '/ask')
        node.create_timer(0.05, lambda: client.call_async(Trigger.Request()))
    elif kind == 'guard':
        node.create_guard_condition(fail).trigger()
    elif kind in ('waitable', 'take'):
        pulse = Pulse(node, node.default_callback_group)
        if kind == 'take':
            pulse.take_data = fail
        else:
            pulse.execute = fail_later
        node.add_waitable(pulse)
        pulse.guard.trigger()
    else:
        executor.create_task(fail if kind == 'task' else fail_later)
    with pytest.raises(ZeroDivisionError, match=kind):
        executor.spin_until_future_complete(after, patience(5.0))


@pytest.mark.parametrize('seconds', [1e7, 1e300, math.inf])
def test_a_timeout_may_be_as_long_as_you_like(make_executor, seconds):
    """Also longer than a system call accepts."""
    executor = make_executor()
    future = Future(executor=executor)
    threading.Timer(0.05, executor.create_task, (future.set_result, 1)).start()
    executor.spin_until_future_complete(future, seconds)
    assert future.done()
    threading.Timer(0.05, executor.create_task, (len, ())).start()
    executor.spin_once(seconds)
    with pytest.raises(ValueError, match='NaN'):
        executor.spin_once(math.nan)
    assert executor.shutdown(seconds)


def test_a_callback_that_outlasts_a_spin_leaves_the_next_ones_to_spin_once(make_executor):
    """Its worker ran them, so that spin_once waited for something that had happened already."""
    executor = make_executor(num_workers=2)
    begun, may_end, ended = threading.Event(), threading.Event(), threading.Event()

    def outlast():
        begun.set()
        may_end.wait(10)
        ended.set()

    def go_on():
        time.sleep(0.02)
        may_end.set()
        ended.wait(10)
        time.sleep(0.02)  # its worker has nothing more to do
        executor.create_task(run)

    def run():
        ran.append(threading.get_ident())
        if len(ran) < 20:
            executor.create_task(run)

    executor.create_task(outlast)
    future, ran = Future(executor=executor), []
    threading.Thread(target=lambda: begun.wait(10) and future.set_result(1)).start()
    executor.spin_until_future_complete(future)
    threading.Thread(target=go_on).start()
    for number in range(20):
        executor.spin_once(10.0)
        assert len(ran) == number + 1
    assert {*ran} == {threading.get_ident()}


def test_a_callback_that_outlasts_a_spin_leaves_what_waits_to_spin_once(make_executor):
    """The thread of that callback runs nothing else."""
    executor, begun, go_on, ran_in = make_executor(), [], threading.Event(), []

    def outlasts():
        begun.append(1)
        go_on.wait(30.0)
        for _ in range(50):
            executor.create_task(lambda: ran_in.append(threading.current_thread()))

    executor.create_task(outlasts)
    assert wait_for(lambda: executor.spin_until_future_complete(Future(), 0.01) or begun)
    go_on.set()
    assert wait_for(lambda: executor.spin_once(0.1) or len(ran_in) == 50)
    assert {*ran_in} == {threading.current_thread()}


def test_a_step_runs_one_though_a_group_refuses_another_one(make_executor, make_node):
    """Another executor runs a callback of that group."""
    node, ran, group = make_node(), [], MutuallyExclusiveCallbackGroup()
    executor = make_executor(nodes=[node])
    guards = [node.create_guard_condition(partial(ran.append, number), callback_group=each)
              for number, each in enumerate((group, ReentrantCallbackGroup()))]
    executor.spin_once(0)
    assert group.beginning_execution(guards[0])
    for guard in guards:
        guard.trigger()
    executor.spin_once(10.0)
    assert ran == [1]
    group.ending_execution(guards[0])
    executor.spin_once(10.0)
    assert ran == [1, 0]


def test_a_callback_that_waits_for_its_worker_goes_on_when_a_step_ends(
        make_executor, monkeypatch):
    """It has outlasted the spin before, and that step was the last one."""
    monkeypatch.setattr(lending, 'REJOIN_NS', 3600 * 10 ** 9)
    executor, ran, bell = make_executor(num_workers=1), [], threading.Event()
    waiting = pool_of(executor).lending.rejoining

    def lends():
        ran.append('begins')
        with executor.lend():
            bell.wait(30.0)
        ran.append('goes on')

    def answers():
        bell.set()
        assert wait_for(lambda: waiting)

    executor.create_task(lends)
    assert wait_for(lambda: executor.spin_until_future_complete(Future(), 0.01) or ran)
    answer = executor.create_task(answers)
    executor.spin_once(10.0)
    assert answer.done() and answer.exception() is None
    assert wait_for(lambda: ran == ['begins', 'goes on'])


def test_the_end_is_not_put_off_by_a_callback_that_waits_for_a_service(
        make_executor, monkeypatch):
    """The service may have ended already; but what runs is waited for."""
    monkeypatch.setattr('mddag_executor.executor.executor._ANSWER_S', 0.05)
    executor, begun, go_on = make_executor(num_workers=2), [], threading.Event()

    def waits(lend):
        with lend():
            begun.append(1)
            go_on.wait(60.0)

    def is_done(seconds):
        end = time.monotonic() + seconds
        return executor.finish_callbacks(lambda: time.monotonic() < end)

    with Spinning(executor):
        for lend in (executor.lend, contextlib.nullcontext):
            executor.create_task(waits, lend)
        assert wait_for(lambda: len(begun) == 2)
        assert not is_done(0.2)
        go_on.set()
        assert is_done(15.0)
        go_on.clear()
    executor, begun = make_executor(num_workers=2), []
    with Spinning(executor):
        executor.create_task(waits, executor.lend)
        assert wait_for(lambda: begun)
        assert is_done(patience(15.0))
        go_on.set()


def test_spin_once_goes_on_when_the_only_worker_is_free_again(make_executor):
    """A callback had outlasted the spin before it."""
    executor, begun, go_on, ran = make_executor(num_workers=1), [], threading.Event(), []
    executor.create_task(lambda: (begun.append(1), go_on.wait(60.0)))
    assert wait_for(lambda: executor.spin_until_future_complete(Future(), 0.01) or begun)
    executor.create_task(ran.append, 1)
    step = threading.Thread(target=executor.spin_once, args=(60.0,))
    step.start()
    assert not wait_for(lambda: ran, 0.05)  # it waits
    go_on.set()
    assert wait_for(lambda: ran)
    step.join()


def test_a_spin_wakes_a_worker_that_did_not_leave_after_the_last_one(make_executor, monkeypatch):
    """As it was not scheduled in time, or a second interrupt ended the wait for it."""
    executor = make_executor(num_workers=1)
    pool, future = pool_of(executor), Future()
    with monkeypatch.context() as patched:
        patched.setattr(workers, 'END_S', 0.0)
        patched.setattr(pool.loop, 'wake_all', lambda: None)
        patched.setattr(pool.loop, 'let_wait', lambda: None)
        threading.Thread(
            target=lambda: wait_for(lambda: pool.polling) and future.set_result(1)).start()
        executor.spin_until_future_complete(future, patience(10.0))
    assert future.done() and pool.polling == 1
    task = executor.create_task(int)
    executor.spin_until_future_complete(task, patience(10.0))
    assert task.done()


def test_an_interrupt_while_a_spin_ends_lets_threads_wait_in_the_next_one(
        make_executor, monkeypatch):
    pool = pool_of(make_executor())
    pool.start()
    assert wait_for(lambda: pool.polling)
    wake_all = pool.loop.wake_all

    def wake_and_raise():
        wake_all()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pool.loop, 'wake_all', wake_and_raise)
        with pytest.raises(KeyboardInterrupt):
            pool.pause()
    assert not pool._leaving
    for _ in range(2):
        pool.start()
        assert wait_for(lambda: pool.polling)
        pool.pause()


def test_nothing_starts_after_the_callback_that_completes_the_future(make_executor):
    """As in a single thread; what waits runs in the next spin."""
    executor, ran = make_executor(num_workers=1), []
    for _ in range(300):
        ran.clear()
        future = executor.create_future()
        executor.create_task(ran.append, 'first')
        executor.create_task(future.set_result, None)
        executor.create_task(ran.append, 'last')
        executor.spin_until_future_complete(future, 15.0)
        assert len(ran) == 1    # the newest task comes first in some versions
        executor.spin_once(15.0)
        assert {*ran} == {'first', 'last'}


def test_spinning_twice_is_an_error(make_executor):
    executor = make_executor()
    assert not executor.is_spinning
    with Spinning(executor):
        assert wait_for(lambda: executor.is_spinning)
        with pytest.raises(RuntimeError, match='already spinning'):
            executor.spin_once(0)
    assert not executor.is_spinning


def test_spinning_in_a_callback_of_spin_once_is_an_error(make_executor):
    """And signals are not watched any more when that has ended."""
    executor = make_executor()
    task = executor.create_task(executor.spin)
    with pytest.raises(RuntimeError, match='already spinning'):
        executor.spin_once(5.0)
    assert task.done() and signal.set_wakeup_fd(-1) == -1


def test_a_callback_of_spin_once_may_call_a_service_of_the_same_executor(make_executor, make_node):
    node = make_node()
    node.create_service(Trigger, '/ask', lambda request, response: response)
    client = node.create_client(Trigger, '/ask')
    executor = make_executor(num_workers=1, nodes=[node])
    assert client.wait_for_service(60.0)
    task = executor.create_task(client.call, Trigger.Request(), 5.0)
    executor.spin_once(5.0)
    assert task.result() is not None


def test_wait_for_message_while_another_thread_spins(make_executor, make_node):
    node = make_node()
    publisher = node.create_publisher(Header, '/topic', 10)
    node.create_timer(0.01, lambda: publisher.publish(Header(frame_id='it')))
    with Spinning(make_executor(nodes=[node])):
        found, message = wait_for_message(Header, node, '/topic', time_to_wait=5.0)
    assert found and message.frame_id == 'it'


# --- a shutdown of the executor ------------------------------------------------------------------


def test_shutdown_waits_for_a_running_callback(make_executor):
    executor = make_executor()
    begun, done = threading.Event(), []

    def work():
        begun.set()
        time.sleep(0.2)
        done.append(1)

    executor.create_task(work)
    with Spinning(executor):
        assert begun.wait(5.0)
        assert not executor.shutdown(0.01)
        assert executor.shutdown(5.0)
        assert done


def test_shutdown_may_wait_for_threads_beyond_its_timeout(make_executor):
    """As Kilted's MultiThreadedExecutor does."""
    executor = make_executor()
    may_end, begun, done = threading.Event(), threading.Event(), []

    def work():
        begun.set()
        assert may_end.wait(60.0)
        done.append(1)

    executor.create_task(work)
    with Spinning(executor):
        assert begun.wait(60.0)
        assert not executor.shutdown(0.01, wait_for_threads=False)
        threading.Timer(0.05, may_end.set).start()
        assert not executor.shutdown(0.01, wait_for_threads=True)
        assert done


@pytest.mark.parametrize('timeout', [0, None])
def test_a_callback_may_shut_the_executor_down(make_executor, make_node, timeout):
    """It hangs in rclpy: rclpy#1646."""
    node, calls = make_node(), []
    executor = make_executor(nodes=[node])
    node.create_timer(0.01, lambda: calls.append(executor.shutdown(timeout)))
    node.create_timer(0.001, lambda: time.sleep(0.002), ReentrantCallbackGroup())
    with Spinning(executor) as spinning:
        spinning.join()
    assert len(calls) == 1


def test_a_callback_of_spin_once_may_shut_down(make_executor, make_node):
    """After a spin, threads are parked; the shutdown ends them though a step is running."""
    node, future, done = make_node(), Future(), []
    executor = make_executor(num_workers=2, nodes=[node])

    def callback():
        if threading.current_thread() is threading.main_thread():
            done.append(executor.shutdown(5.0))
        elif not future.done():  # a worker may run it again before the spin has ended
            future.set_result(None)
    node.create_timer(0.01, callback)
    executor.spin_until_future_complete(future, patience(10.0))
    with contextlib.suppress(ExternalShutdownException, ShutdownException):
        for _ in range(100):
            executor.spin_once(0.1)
            if done:
                break
    assert done == [True]


def test_no_thread_goes_on_though_the_context_does(make_executor, make_node, ros_context):
    before = set(threading.enumerate())
    node, calls, heard = make_node(), [], []
    node.create_timer(0.001, lambda: calls.append(publisher.publish(Header())))
    node.create_subscription(Header, '/topic', heard.append, 10)
    publisher = node.create_publisher(Header, '/topic', 10)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(calls) > 10 and heard)
    assert ros_context.ok()
    assert wait_for(lambda: not set(threading.enumerate()) - before), threading.enumerate()


# --- the end of a context ------------------------------------------------------------------------

ENDS = {
    'shutdown': Context.try_shutdown, 'destroy': Context.destroy,
    'both': lambda context: (context.try_shutdown(), context.destroy())}


@pytest.mark.parametrize('inside', [False, True], ids=['outside', 'callback'])
@pytest.mark.parametrize('end', ENDS)
@pytest.mark.parametrize('way', ['spin', 'steps'])
def test_spin_ends_with_its_context(way, end, inside, no_thread_leak, monkeypatch, capfd):
    """Callbacks that fail just because the context has ended make no noise (rclpy#944)."""
    in_threads = []
    monkeypatch.setattr(threading, 'excepthook', in_threads.append)
    context = Context()
    rclpy.init(context=context)
    node = Node('node', context=context)
    node.create_subscription(Empty, '/topic', lambda m: None, 10)
    publisher = node.create_publisher(Empty, '/topic', 1)
    node.create_timer(0.005, lambda: publisher.publish(Empty()), ReentrantCallbackGroup())
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
            executor.spin()  # and at once when it has ended before
        except BaseException as error:
            errors.append(error)

    node.create_timer(0.02, callback)
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
    assert in_threads == [] and 'Traceback' not in capfd.readouterr().err
    with contextlib.suppress(Exception):
        node.destroy_node()


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


class Injector:
    """Sends a signal to this thread at the n-th line that it runs in the package."""

    def __init__(self, number=signal.SIGINT):
        self.number = number
        self.left = 0
        # the interrupted function is that of the package, and not the one below
        self._in_package = types.FunctionType(
            Injector._at_line.__code__, {**globals(), '__name__': 'mddag_executor'}).__get__(self)

    def _of_frame(self, frame, event, arg):
        return self._in_package if '/mddag_executor/' in frame.f_code.co_filename else None

    def _at_line(self, frame, event, arg):
        if event == 'line':
            self.left -= 1
            if self.left == 0:
                sys.settrace(None)
                signal.raise_signal(self.number)
        return self._in_package

    def interrupts(self, function, n):
        """Call a function; return whether KeyboardInterrupt came out of it."""
        before, self.left = sys.gettrace(), n
        try:
            sys.settrace(self._of_frame)
            function()
        except KeyboardInterrupt:
            return True
        finally:
            sys.settrace(before)
        return False


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGALRM])
@pytest.mark.parametrize('steps', [True, False])
def test_an_interrupt_at_any_line_of_a_spin_loses_nothing(
        make_executor, make_node, request, steps, number):
    """A program that catches what a handler raises, and spins again, goes on as if none came."""
    before = signal.signal(number, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(number, before))
    node, fired, received = make_node(), [], []
    node.create_timer(0.001, lambda: fired.append(1))
    node.create_subscription(Header, '/topic', lambda msg: received.append(msg.frame_id), 10)
    node.create_service(Trigger, '/ask', lambda request, response: response)
    publisher, client = node.create_publisher(Header, '/topic', 10), node.create_client(
        Trigger, '/ask')
    executor, injector = make_executor(num_workers=2, nodes=[node]), Injector(number)
    interrupts = 0

    def turn():
        if steps:
            executor.spin_once(0.01)
        else:
            executor.spin_until_future_complete(Future(), 0.01)

    def until(done):
        end = time.monotonic() + 15
        while not done() and time.monotonic() < end:
            turn()
        return done()

    assert client.wait_for_service(60.0) and until(lambda: len(fired) > 5)
    for n in range(1, 700, 17):
        publisher.publish(Header(frame_id=str(n)))
        answer, task = client.call_async(Trigger.Request()), executor.create_task(bool)
        interrupts += injector.interrupts(lambda: [turn(), turn(), turn()], n)
        seen = len(fired)
        assert until(lambda: str(n) in received and answer.done() and task.done()), n  # noqa: B023
        assert until(lambda: len(fired) > seen), n  # noqa: B023
    assert interrupts > 20


def test_an_interrupt_at_any_line_of_a_deferral_restores_all_handlers(request):
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGALRM
    handlers = [signal.default_int_handler, lambda *_: None, lambda *_: None]
    for number, handler in zip(numbers, handlers):
        before = signal.signal(number, handler)
        request.addfinalizer(lambda number=number, before=before: signal.signal(number, before))
    injector, line, interrupts = Injector(signal.SIGINT), 0, 0

    def defer():
        with InterruptsDeferred():
            pass

    while injector.left <= 0:   # until there is no such line
        line += 1
        interrupts += injector.interrupts(defer, line)
        assert list(map(signal.getsignal, numbers)) == handlers, line
    assert interrupts > 20


def test_a_second_signal_at_any_line_of_a_deferred_one_is_no_error(request):
    handled = []
    before = signal.signal(signal.SIGINT, lambda *_: handled.append(1))
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    injector, line = Injector(signal.SIGINT), 0
    of_package = types.FunctionType(
        signal_inside.__code__, {**globals(), '__name__': 'mddag_executor'})
    while injector.left <= 0:
        line += 1
        injector.interrupts(of_package, line)
        assert 1 <= len(handled) <= 2, line
        handled.clear()
    assert line > 20


def signal_inside():
    """Send a signal while all are deferred, and wait."""
    with InterruptsDeferred():
        signal.raise_signal(signal.SIGINT)
        interruptible_sleep(0)


def test_a_deferred_signal_is_handled_once(request, monkeypatch):
    """Also if one of its repetitions is on its way to the main thread just then."""
    handled = []
    before = signal.signal(signal.SIGALRM, lambda *_: handled.append(1))
    request.addfinalizer(lambda: signal.signal(signal.SIGALRM, before))
    monkeypatch.setattr('mddag_executor.executor.interrupts.REPEAT_S', 0)
    request.addfinalizer(partial(sys.setswitchinterval, sys.getswitchinterval()))
    sys.setswitchinterval(1e-6)
    of_package = types.FunctionType(
        alarm_inside.__code__, {**globals(), '__name__': 'mddag_executor'})
    for n in range(2000):
        of_package(n % 500, waits=n % 2)
        time.sleep(0)
        assert len(handled) == n + 1


def alarm_inside(n, waits):
    """Send a signal while all are deferred, do something, and wait or leave that to the end."""
    with InterruptsDeferred():
        signal.raise_signal(signal.SIGALRM)
        for _ in range(n):
            pass
        if waits:
            interruptible_sleep(0)


@pytest.mark.parametrize('kind', ['sleep', 'call', 'coroutine', 'publish'])
def test_a_callback_is_interrupted_at_once(make_executor, make_node, kind):
    """One in a call of the package by the second SIGINT at the latest."""
    node, begun, interrupts, slept = make_node(), threading.Event(), [], []
    publisher = node.create_publisher(Header, '/topic', 10)
    client = node.create_client(Trigger, '/nobody')

    def sleep():
        begun.set()
        time.sleep(10)
        slept.append(1)

    def call():
        begun.set()
        client.call(Trigger.Request())

    async def coroutine():
        sleep()

    def publish():
        begun.set()
        while True:
            publisher.publish(Header())

    def raise_once(number, frame):
        interrupts.append(number)
        if len(interrupts) == 1:
            raise KeyboardInterrupt

    def interrupt():
        begun.wait(15)
        while not is_over.wait(0.1):
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            if kind in ('sleep', 'coroutine'):
                break

    executor, is_over = make_executor(nodes=[node]), threading.Event()
    executor.create_task({'sleep': sleep, 'call': call, 'coroutine': coroutine,
                          'publish': publish}[kind])
    thread = threading.Thread(target=interrupt)
    before = signal.signal(signal.SIGINT, raise_once)
    try:
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            while True:
                executor.spin_once()
        assert not slept
    finally:
        is_over.set()
        thread.join()
        assert signal.signal(signal.SIGINT, before) == raise_once


def test_a_second_interrupt_comes_at_once(make_executor, make_node):
    """The callback is in a call of the package, which may never end."""
    node, come, before = make_node(), [], sys.gettrace()
    publisher = node.create_publisher(Header, '/topic', 10)

    def at_line(frame, event, arg):
        if event == 'line':
            sys.settrace(None)
            for number in range(3):
                come.append(number)
                signal.raise_signal(signal.SIGINT)
        return at_line

    def publish():
        sys.settrace(lambda frame, event, arg: (
            at_line if '/mddag_executor/' in frame.f_code.co_filename else None))
        publisher.publish(Header())

    executor = make_executor(nodes=[node])
    executor.create_task(publish)
    try:
        with pytest.raises(KeyboardInterrupt):
            executor.spin_once(15.0)
    finally:
        sys.settrace(before)
    assert come == [0, 1]


PROGRAM = """
import os, threading, time
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
for _ in range(7):
    node.create_timer(0.005, {callback}, callback_group=ReentrantCallbackGroup())
executor = MultiDeadlineExecutor()
executor.add_node(node)
threading.Thread(target=spin, daemon=True).start()
assert ran.wait(10)
time.sleep(0.1)
{end}
print('end', flush=True)
"""
SPIN = 'executor.spin()'
# threads of a spin are parked then
SPUN_BEFORE = """executor.spin_until_future_complete(rclpy.Future(), 0.1)
    while True: executor.spin_once(0.3)"""
# Only what Python does at exit: Fast DDS itself does not survive the end of such a child.
FORK = """
import atexit, warnings
warnings.simplefilter("ignore", DeprecationWarning)  # of a fork with threads
with executor._pool.lock:
    child = os.fork()
    if not child:
        atexit._run_exitfuncs()
        os._exit(3)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
"""
SPIN_UNTIL_SHUTDOWN = """try:
        executor.spin()
    except rclpy.executors.ExternalShutdownException:
        pass"""
OTHER_CONTEXT = """
context = rclpy.Context()
rclpy.init(context=context)
other = MultiDeadlineExecutor(context=context)
other.create_task(print, 'ready', flush=True)
try:
    other.spin()
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    while executor.is_spinning:
        time.sleep(0.01)
    assert executor.shutdown(5.0) and other.shutdown(5.0)
    assert not [each for each in threading.enumerate() if each.name.startswith('mddag')]
"""


@pytest.mark.parametrize('parts', [
    {'end': 'executor.shutdown(0)'},
    {'spin': 'while rclpy.ok(): executor.spin_once(timeout_sec=0.005)'},
    {'spin': SPUN_BEFORE},
    {'callback': 'block'},
    {'callback': 'ran.set', 'end': FORK},
], ids=['shut down', 'steps', 'spun before', 'never ends', 'forked'])
def test_a_program_may_end_while_a_daemon_thread_spins(parts):
    end_with_it(parts)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_spins_of_all_contexts(number):
    end_with_it({'spin': SPIN_UNTIL_SHUTDOWN, 'callback': 'ran.set', 'end': OTHER_CONTEXT}, number)


def end_with_it(parts, send=None):
    out, err = run_program(
        PROGRAM.format(**{'spin': SPIN, 'callback': 'sleep', 'end': '', **parts}), send=send)
    assert out.splitlines()[-1] == 'end'
    assert [line for line in err.splitlines()
            if 'use of fork() may lead to deadlocks' not in line] == []


PUBLISHES = """
from collections import Counter
import signal, sys, threading, time
import rclpy
from std_msgs.msg import String
from mddag_executor import MultiDeadlineExecutor
from msg_graph import loads

rclpy.init()
node = rclpy.create_node('node')
publisher = node.create_publisher(String, '/command', 10)
heard = Counter()
node.create_subscription(
    String, '/command', lambda message: heard.update([message.data]), 10000)
timer = node.create_timer(0.01, lambda: publisher.publish(String(data='job')))
executor = MultiDeadlineExecutor(loads(sys.argv[2]))
executor.add_node(node)
stops = 0


def stop(*_):
    global stops
    publisher.publish(String(data='stop'))
    stops += 1
    signal.setitimer(signal.ITIMER_REAL, 0.001 * (stops < 200))

signal.signal(signal.SIGALRM, stop)
signal.setitimer(signal.ITIMER_REAL, 0.001)


def done():
    return stops == 200 and heard['stop'] >= 200

if sys.argv[1] == 'spin':
    future = rclpy.Future()
    threading.Thread(target=lambda: (
        [time.sleep(0.01) for _ in iter(done, True)], future.set_result(None))).start()
    executor.spin_until_future_complete(future)
elif sys.argv[1] == 'spin_once':
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
print(stops, heard['stop'])
"""


@pytest.mark.parametrize('where', ['spin', 'spin_once', 'other thread'])
def test_a_signal_s_handler_may_publish(where):
    """Whatever the main thread does when the signal comes: it holds locks now and then."""
    text = graph(node="""
        name: tick, timer: 10ms, publishes: [/command]
        name: obey, subscription: /command, deadline: 1s""")
    assert run_program(PUBLISHES, where, text)[0] == '200 200\n'


def test_what_arrives_while_a_spin_ends_is_for_the_next_one(
        make_executor, make_node, monkeypatch):
    """The thread that waits for events may get the last one after the end has begun."""
    node, ran, handled = make_node(), [], threading.Event()
    guard = node.create_guard_condition(lambda: ran.append(1))
    executor, future = make_executor(num_workers=1, nodes=[node]), Future()
    pool = pool_of(executor)
    receive = pool._receive

    def end_before(me, events):
        ends = is_to_end and events is not None
        if ends:
            pool.start_no_more()
        try:
            return receive(me, events)
        finally:
            if ends:
                handled.set()

    is_to_end = []
    replace_method(monkeypatch, pool, '_receive', end_before)
    thread = threading.Thread(target=executor.spin_until_future_complete, args=(future,))
    thread.start()
    assert wait_for(lambda: pool.is_current and pool.polling)
    is_to_end.append(1)
    guard.trigger()
    assert handled.wait(15.0)
    future.set_result(None)
    thread.join(15.0)
    is_to_end.clear()
    assert not ran
    with Spinning(executor):
        assert wait_for(lambda: ran)

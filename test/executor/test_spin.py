# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Spinning: what ends it, what comes out of it, one callback at a time, waiting inside."""

import threading
import time

import pytest
from rclpy.task import Future
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import Spinning, wait_for
from .pulse import Pulse


@pytest.mark.parametrize(
    'kind', ['timer', 'subscription', 'service', 'guard', 'waitable', 'task', 'coroutine'])
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
    elif kind == 'waitable':
        pulse = Pulse(node, node.default_callback_group)
        pulse.execute = fail_later
        node.add_waitable(pulse)
        pulse.guard.trigger()
    else:
        executor.create_task(fail if kind == 'task' else fail_later)
    with pytest.raises(ZeroDivisionError, match=kind):
        executor.spin_until_future_complete(after, 5.0)


def test_what_fails_when_it_is_taken_comes_out_of_spin(make_executor, make_node):
    class Broken(Pulse):

        def take_data(self):
            raise ZeroDivisionError('taken')

    node = make_node()
    broken = Broken(node, node.default_callback_group)
    node.add_waitable(broken)
    executor = make_executor(nodes=[node])
    broken.guard.trigger()
    with pytest.raises(ZeroDivisionError, match='taken'):
        executor.spin_until_future_complete(Future(), 2.0)


class Turn:
    """What a coroutine may await as well: nothing that says when it is ready."""

    def __await__(self):
        yield


@pytest.mark.parametrize('stepwise', [False, True])
def test_a_coroutine_that_awaits_something_unknown_is_asked_again(make_executor, stepwise):
    executor, turns = make_executor(), []

    async def work():
        for turn in range(5):
            await Turn()
            turns.append(turn)
        return 'done'

    task = executor.create_task(work)
    if stepwise:
        for step in range(6):
            executor.spin_once(0.1)
            assert turns == [*range(step)]
    else:
        executor.spin_until_future_complete(task, 3.0)
    assert task.done() and task.result() == 'done' and turns == [0, 1, 2, 3, 4]
    assert not getattr(executor, '_ready_tasks', ())  # rclpy's own, which are not used here


def test_spin_once_runs_one_callback_and_has_finished_it(make_executor, make_node):
    node, calls = make_node(), []
    for _ in range(3):
        node.create_timer(0.001, lambda: calls.append(threading.get_ident()))
    executor = make_executor(nodes=[node])
    time.sleep(0.01)
    for count in range(1, 6):
        executor.spin_once(1.0)
        assert len(calls) == count
    assert set(calls) == {threading.get_ident()}


@pytest.mark.parametrize('what', ['task', 'node', 'entity'])
def test_what_is_new_wakes_a_spin_once_that_waits(make_executor, make_node, what):
    executor, ran = make_executor(), threading.Event()
    node = make_node()
    if what == 'entity':
        executor.add_node(node)
    waiting = threading.Thread(target=executor.spin_once, args=(4.0,))
    waiting.start()
    time.sleep(0.2)
    if what == 'task':
        executor.create_task(ran.set)
    else:
        node.create_timer(0.001, ran.set)
        executor.add_node(node)
    try:
        assert ran.wait(3.0)
    finally:
        waiting.join()


def test_every_task_wakes_a_loop_of_spin_once_and_a_spin_after_it(make_executor, make_node):
    """Not only the first one: what wakes has to be ready to wake again."""
    executor, ran = make_executor(), [threading.Event() for _ in range(20)]

    def loop():
        while not ran[9].is_set():
            executor.spin_once()
        executor.spin_until_future_complete(done, 30.0)

    done = Future()
    thread = threading.Thread(target=loop)
    thread.start()
    try:
        for event in ran:
            time.sleep(0.01)  # it waits
            executor.create_task(event.set)
            assert event.wait(5.0)
    finally:
        done.set_result(None)
        while thread.is_alive():  # where it waits for ever, it may do so for each of them
            executor.wake()
            ran[9].set()
            thread.join(0.1)


def test_spinning_twice_is_an_error(make_executor):
    executor = make_executor()
    assert not executor.is_spinning
    with Spinning(executor):
        time.sleep(0.05)
        assert executor.is_spinning
        with pytest.raises(RuntimeError, match='already spinning'):
            executor.spin_once(0)
    assert not executor.is_spinning


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


@pytest.mark.parametrize('end', ['shutdown', 'future'])
def test_no_thread_goes_on_though_the_context_does(make_executor, make_node, ros_context, end):
    before = set(threading.enumerate())
    node, calls = make_node(), []
    done = Future()

    def tick():
        calls.append(1)
        if len(calls) > 10 and not done.done():
            done.set_result(None)

    node.create_timer(0.001, tick)
    node.create_subscription(Header, '/topic', calls.append, 10)
    node.create_guard_condition(lambda: calls.append(2)).trigger()
    publisher = node.create_publisher(Header, '/topic', 10)
    executor = make_executor(nodes=[node])
    if end == 'shutdown':
        with Spinning(executor):
            assert wait_for(lambda: publisher.get_subscription_count() and done.done())
            publisher.publish(Header())
    else:
        executor.spin_until_future_complete(done, 5.0)
    assert done.done() and ros_context.ok()

    def left():
        names = {thread.name for thread in set(threading.enumerate()) - before}
        if end == 'shutdown':
            return names
        # between two spins these wait for the next one
        return {name for name in names if 'worker' not in name and 'wait-set' not in name}
    assert wait_for(lambda: not left()), left()


def test_wait_for_message_from_a_callback(make_executor, make_node, ros_context):
    node = make_node()
    publisher = node.create_publisher(Header, '/topic', 10)
    node.create_timer(0.01, lambda: publisher.publish(Header(frame_id='it')))
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        found, message = wait_for_message(Header, node, '/topic', time_to_wait=5.0)
    assert found and message.frame_id == 'it'

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Executors beside others: in one process, one after the other, and in a forked process."""

from __future__ import annotations

import multiprocessing
import os
import threading
from typing import Any

import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import is_idle, Spinning, wait_for

DEPTH = 1000


def test_one_of_rclpys_executors_beside_it(make_executor, make_node, ros_context):
    """They pass a number to each other, a thousand times."""
    here, there, done = make_node('here'), make_node('there'), threading.Event()
    to_there = here.create_publisher(Header, '/to_there', DEPTH)
    to_here = there.create_publisher(Header, '/to_here', DEPTH)
    got: list[int] = []

    def back(message: Header) -> None:
        got.append(message.stamp.sec)
        message.stamp.sec += 1
        to_there.publish(message) if message.stamp.sec < 1000 else done.set()

    here.create_subscription(Header, '/to_here', back, DEPTH)
    there.create_subscription(Header, '/to_there', to_here.publish, DEPTH)
    executor = make_executor(nodes=[here])
    other = MultiThreadedExecutor(context=ros_context)
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
    ticks: list[int] = []
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


def test_a_node_may_go_and_come_back_while_messages_come(make_executor, make_node):
    node, source, heard = make_node(), make_node('source'), []
    node.create_subscription(Header, '/a', lambda m: heard.append(m.stamp.sec), DEPTH)
    publisher = source.create_publisher(Header, '/a', DEPTH)
    executor = make_executor()
    message, done = Header(), threading.Event()

    def publish() -> None:
        while not done.wait(0.0005):
            message.stamp.sec += 1
            publisher.publish(message)

    assert wait_for(lambda: publisher.get_subscription_count() == 1)
    with Spinning(executor) as spinning:
        thread = threading.Thread(target=publish)
        thread.start()
        try:
            for _ in range(30):
                executor.add_node(node)
                before = len(heard)
                assert wait_for(lambda n=before: len(heard) > n)
                executor.remove_node(node)
        finally:
            done.set()
            thread.join()
    assert spinning.error is None
    assert heard == sorted(set(heard))  # what had been taken when it was removed is dropped


def test_spinning_until_a_future_is_done_150_times(make_executor, make_node):
    """Each time it is the right answer, and nothing grows."""
    node, group = make_node(), ReentrantCallbackGroup()

    def answer(request: Any, response: Any) -> Any:
        answered.append(1)
        response.message = str(len(answered))
        return response

    answered: list[int] = []
    node.create_service(Trigger, '/ask', answer, callback_group=group)
    client = node.create_client(Trigger, '/ask', callback_group=group)
    executor = make_executor(num_workers=2, nodes=[node])
    assert client.wait_for_service(15.0)
    files = 0
    for number in range(150):
        future = client.call_async(Trigger.Request())
        executor.spin_until_future_complete(future, 15.0)
        assert future.done() and future.result().message == str(number + 1)
        if number == 10:
            files = len(os.listdir('/proc/self/fd'))
            threads = threading.active_count()
    assert len(os.listdir('/proc/self/fd')) <= files
    assert threading.active_count() <= threads
    done = Future()
    done.set_result(None)
    for _ in range(50):
        executor.spin_until_future_complete(done, 15.0)


# --- fork ----------------------------------------------------------------------------------------


def wait_until_told(connection: Any) -> None:
    connection.send('here')
    connection.recv()


def raise_in_the_child() -> None:
    raise SystemExit(3)


@pytest.mark.filterwarnings('ignore:.*use of fork')
def test_a_process_that_is_forked_disturbs_nobody_and_ends(make_executor, make_node):
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

    def start(target: Any, *args: Any) -> Any:
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
    assert spinning.error is None and heard == list(range(50))
    assert is_idle(executor)
    mine.close()
    theirs.close()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Executors beside others: in one process, one after the other, and in a forked process."""

from __future__ import annotations

import multiprocessing
import threading
from typing import Any

import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from std_msgs.msg import Header

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

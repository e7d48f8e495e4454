# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A context that is shut down or destroyed while an executor spins: the spin ends."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import itertools
import signal
import sys
import threading
import time
from typing import Any

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor.shutdown import call_at_shutdown
import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from std_msgs.msg import Empty

ENDS: dict[str, Callable[[Context], Any]] = {
    'shutdown': Context.try_shutdown, 'destroy': Context.destroy,
    'both': lambda context: (context.try_shutdown(), context.destroy())}


@pytest.mark.parametrize('inside', [False, True], ids=['outside', 'callback'])
@pytest.mark.parametrize('end', ENDS)
@pytest.mark.parametrize('way', ['spin', 'steps'])
def test_spin_ends_with_its_context(way, end, inside, no_thread_leak, monkeypatch):
    in_threads: list[Any] = []
    monkeypatch.setattr(threading, 'excepthook', in_threads.append)
    context = Context()
    rclpy.init(context=context)
    node = Node('node', context=context)
    node.create_subscription(Empty, '/topic', lambda m: None, 10)
    errors: list[BaseException] = []
    ran = threading.Event()

    def callback() -> None:
        ran.set()
        if inside:
            ENDS[end](context)

    def spin() -> None:
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
        kind: Any, ros_context, make_node, capfd) -> None:
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
    assert 'Traceback' not in capfd.readouterr().err


def test_what_the_callback_raises_that_shuts_down_comes_out(make_executor, make_node, ros_context):
    node = make_node()

    def end() -> None:
        rclpy.shutdown(context=ros_context)
        time.sleep(0.05)
        raise SystemExit('done')

    node.create_timer(0.01, end)
    executor = make_executor(nodes=[node])
    with pytest.raises(SystemExit, match='done'):
        executor.spin()


def test_what_a_callback_raises_of_a_context_that_is_there_comes_out(make_executor):
    executor = make_executor()

    def publish() -> None:
        publisher.publish(Empty())

    context = Context()
    rclpy.init(context=context)
    publisher = Node('node', context=context).create_publisher(Empty, '/topic', 1)
    publisher.destroy()
    executor.create_task(publish)
    with pytest.raises(Exception, match='destruction was requested'):
        executor.spin_once(1.0)
    context.try_shutdown()


def test_no_interrupt_gets_lost_where_something_of_a_context_dies(ros_context, monkeypatch):
    """A KeyboardInterrupt in the Python code of a weak reference is printed and forgotten."""
    class Thing:

        def wake(self) -> None:
            pass

    lost: list[Any] = []
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


def test_an_interrupt_while_a_thread_begins_comes_out_of_the_spin(make_executor, monkeypatch):
    """Also where it comes before its thread has begun."""
    start = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        if thread.name.startswith('mddag-wait-set'):
            raise KeyboardInterrupt
        start(thread)

    executor = make_executor()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', interrupted)
        with pytest.raises(KeyboardInterrupt):
            executor.spin()
    executor.spin_until_future_complete(executor.create_task(lambda: None), 5.0)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What users have asked rclpy for, by issue: exceptions of tasks, shutdown, Ctrl-C."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.task import Future

from .conftest import interrupted, Spinning, wait_for

# --- tasks ---------------------------------------------------------------------------------------


def fails() -> None:
    raise KeyError('handled')


async def fails_later() -> None:
    fails()


@pytest.mark.parametrize('kind', [fails, fails_later])
@pytest.mark.parametrize('late', [False, True])
def test_an_exception_that_is_handled_does_not_end_the_executor(make_executor, kind, late):
    """Whether the task fails before its maker awaits it or after (rclpy#1215, #1098)."""
    executor = make_executor()

    async def handle() -> int:
        handled = 0
        for _ in range(10):
            task = executor.create_task(kind)
            if late:
                assert wait_for(task.done)
            try:
                await task
            except KeyError:
                handled += 1
        return handled

    def look() -> str:  # with rclpy's example, in a function
        task = executor.create_task(kind)
        assert wait_for(task.done)
        try:
            task.result()
        except KeyError as error:
            return str(error)
        return ''

    tasks = [executor.create_task(work) for work in (handle, look)]
    with Spinning(executor) as spinning:
        assert wait_for(lambda: all(task.done() for task in tasks))
        time.sleep(0.15)  # somebody looks for exceptions every 100 ms
    assert spinning.error is None
    assert [task.result() for task in tasks] == [10, "'handled'"]


@pytest.mark.parametrize('kept', [False, True])
def test_an_exception_that_nobody_handles_ends_the_spin(make_executor, kept):
    """One that was put by since its maker could have handled it comes out as well."""
    executor = make_executor()
    tasks: list[Any] = []
    gate: Future = Future()

    async def make() -> None:
        task = executor.create_task(fails)
        assert wait_for(task.done)
        if kept:
            tasks.append(task)
        else:
            del task
            await gate  # it is under way for as long as this test lasts

    maker = executor.create_task(make)
    with Spinning(executor) as spinning:
        assert wait_for(lambda: spinning.error is not None)
        spinning.join()
    assert isinstance(spinning.error, KeyError)
    assert maker.done() == kept


# --- ends ----------------------------------------------------------------------------------------


@pytest.mark.parametrize('what', ['context', 'executor', 'executor, waiting'])
def test_shutdown_from_inside_a_callback(make_executor, make_node, ros_context, what):
    """It hangs in rclpy: rclpy#944, and #1646 of an executor's own shutdown."""
    node = make_node()
    executor = make_executor(nodes=[node])
    calls: list[int] = []

    def end() -> None:
        calls.append(1)
        if what == 'context':
            rclpy.shutdown(context=ros_context)
        else:
            executor.shutdown(None if 'waiting' in what else 0)

    node.create_timer(0.01, end, MutuallyExclusiveCallbackGroup())
    node.create_timer(0.001, lambda: time.sleep(0.002))
    spinning = Spinning(executor)
    with spinning:
        spinning.join()
    assert calls == [1]
    assert spinning.error is None


def test_nothing_starts_after_the_context_has_ended(make_executor, make_node, ros_context):
    """What was ready by then neither: a worker is quicker than the thread that spins."""
    node = make_node()
    executor = make_executor(num_workers=1, nodes=[node])
    calls: list[int] = []

    def end() -> None:
        calls.append(1)
        time.sleep(0.05)  # the others become ready
        rclpy.shutdown(context=ros_context)

    for _ in range(5):
        node.create_timer(0.02, end, ReentrantCallbackGroup())
    with Spinning(executor) as spinning:
        spinning.join()
    assert calls == [1]
    assert spinning.error is None


def test_shutdown_while_spin_dispatches(make_executor, make_node):
    """Nothing is handed to a pool that has been closed meanwhile (rclpy#1724)."""
    node = make_node()
    timers = [node.create_timer(0.001, lambda: None, ReentrantCallbackGroup()) for _ in range(5)]
    assert timers
    for turn in range(15):
        executor = make_executor(num_workers=3, nodes=[node])
        stop = threading.Event()

        def feed(executor: Any = executor, stop: threading.Event = stop) -> None:
            while not stop.is_set():
                executor.create_task(lambda: None)
                time.sleep(0.0001)

        feeder = threading.Thread(target=feed)
        try:
            with Spinning(executor) as spinning:
                feeder.start()
                time.sleep(0.002 * turn)
        finally:
            stop.set()
            feeder.join()
        assert spinning.error is None
        executor.remove_node(node)


PROGRAM = """
import sys, threading, time
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from std_srvs.srv import Trigger
from mddag_executor import MultiDeadlineExecutor


def busy():
    running.add(threading.get_ident())
    if len(running) >= 5:
        ready.set()
    end = time.monotonic() + 0.02
    while time.monotonic() < end:
        node.get_logger().debug('busy')


def ask():
    client.call(Trigger.Request())
    asked.set()

running, ready, asked = set(), threading.Event(), threading.Event()
rclpy.init()
node = rclpy.create_node('node')
group = ReentrantCallbackGroup()
node.create_service(Trigger, '/ask', lambda request, response: response, callback_group=group)
client = node.create_client(Trigger, '/ask', callback_group=group)
for period in range(40, 47):
    node.create_timer(period / 1000, busy, group)
node.create_timer(0.05, ask, group)
executor = MultiDeadlineExecutor()
threading.Thread(target=lambda: ready.wait() and asked.wait() and print('ready', flush=True),
                 daemon=True).start()
try:
    rclpy.spin(node, executor)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
finally:
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
"""


def test_ctrl_c_is_quiet():
    """While all workers are busy, with the idiom of rclpy's own examples (rclpy#1279)."""
    status, out, err = interrupted(PROGRAM)
    assert status == 0, err
    assert out == ''
    # On a busy machine the timers skip periods, and that is said.
    assert [line for line in err.splitlines() if 'cannot keep its rate' not in line] == []

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Orders that rclpy's own tests rely on, with seven workers as with one thread."""

from __future__ import annotations

from collections.abc import AsyncIterator
import threading
import time

from mddag_executor.executor.compat import TASKS_NEWEST_FIRST
import pytest
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from test_msgs.action import Fibonacci

from .conftest import Spinning, wait_for


def test_tasks_created_while_nobody_spins_run_in_rclpys_order(make_executor, ros_context):
    orders = []
    for executor in make_executor(), SingleThreadedExecutor(context=ros_context):
        order: list[str] = []
        orders.append(order)
        for name in 'abc':
            executor.create_task(order.append, name)
        for _ in range(3):
            executor.spin_once(timeout_sec=0)
        executor.shutdown()
    assert orders[0] == orders[1] and sorted(orders[0]) == ['a', 'b', 'c']


def test_tasks_created_while_nobody_spins_run_in_a_spin_too(make_executor):
    executor, order = make_executor(num_workers=1), []
    tasks = [executor.create_task(order.append, name) for name in 'abc']
    executor.spin_until_future_complete(tasks[0 if TASKS_NEWEST_FIRST else 2], 5.0)
    assert order == (['c', 'b', 'a'] if TASKS_NEWEST_FIRST else ['a', 'b', 'c'])


def test_a_coroutine_goes_on_in_the_step_after_its_future_is_done(make_executor):
    executor = make_executor()
    future: Future = Future(executor=executor)

    async def wait() -> str:
        await future
        return 'done'

    task = executor.create_task(wait)
    executor.spin_once(timeout_sec=0)
    assert not task.done()
    future.set_result(None)
    executor.spin_once(timeout_sec=1)
    assert task.done() and task.result() == 'done'


@pytest.mark.parametrize('mine', [True, False], ids=['own', 'free'])
@pytest.mark.parametrize('generates', [False, True], ids=['await', 'for'])
def test_a_task_awaits_one_future_after_another(make_executor, mine, generates):
    """Since rclpy 7.1.9 a coroutine must not go on before the future that it awaits is done."""
    executor = make_executor()
    futures = [executor.create_future() if mine else Future() for _ in range(20)]
    got = []

    async def one_by_one() -> AsyncIterator[int]:
        for future in futures:
            yield await future

    async def inner(future: Future) -> None:
        got.append(await future)

    async def outer() -> str:
        if generates:
            async for value in one_by_one():
                got.append(value)
        else:
            for future in futures:
                await inner(future)
        return 'done'

    task = executor.create_task(outer)
    with Spinning(executor) as spinning:
        for number, future in enumerate(futures):
            time.sleep(0.003)
            future.set_result(number)
        assert wait_for(task.done)
    assert task.result() == 'done' and got == list(range(20))
    assert spinning.error is None
    # where rclpy's own executors keep tasks that are to go on, which nobody would take out here
    assert not getattr(executor, '_ready_tasks', ())


def test_feedback_is_handled_before_a_goals_future_ends_the_spin(make_executor, make_node):
    """The server publishes it before it succeeds, right after it has accepted the goal."""
    node, feedback = make_node(), []
    group = ReentrantCallbackGroup()

    def execute(goal_handle):
        goal_handle.publish_feedback(Fibonacci.Feedback(sequence=[1, 1, 2, 3]))
        goal_handle.succeed()
        return Fibonacci.Result()

    server = ActionServer(node, Fibonacci, 'fibonacci', execute, callback_group=group)
    client = ActionClient(node, Fibonacci, 'fibonacci', callback_group=group)
    executor = make_executor()
    executor.add_node(node)
    assert client.wait_for_server(5.0)
    # A subscription that has not been matched yet gets nothing, whoever runs its callback.
    assert wait_for(lambda: node.count_subscribers('/fibonacci/_action/feedback') == 1)
    in_time = 0
    for number in range(1, 6):
        sent = client.send_goal_async(
            Fibonacci.Goal(), feedback_callback=lambda m: feedback.append(m))
        executor.spin_until_future_complete(sent, 5.0)
        assert sent.done() and sent.result().accepted
        in_time += len(feedback) == number
        end = time.monotonic() + 10.0
        while len(feedback) < number and time.monotonic() < end:
            executor.spin_once(0.1)
        assert len(feedback) == number
    assert in_time >= 4  # of what is on its way on a busy machine it knows nothing
    server.destroy()
    client.destroy()


def test_default_deadline_orders_undeclared_callbacks(make_executor):
    """Undeclared ones go by ready time plus default_deadline: in the order of becoming ready."""
    executor = make_executor(num_workers=1, default_deadline='100ms')
    ran: list[int] = []
    gate = threading.Event()
    with Spinning(executor):
        assert wait_for(lambda: executor._pool.running)
        executor.create_task(gate.wait, 5.0)
        for i in range(5):
            executor.create_task(ran.append, i)
        gate.set()
        assert wait_for(lambda: len(ran) == 5)
    assert ran == [0, 1, 2, 3, 4]


def test_a_step_does_not_wait_for_a_future_that_is_done_already(make_executor):
    """Also when what woke it up has been polled away by then."""
    executor = make_executor()
    future: Future = Future(executor=executor)
    future.set_result(True)
    begin = time.monotonic()
    executor.spin_once_until_future_complete(future, 10)
    assert time.monotonic() - begin < 5.0

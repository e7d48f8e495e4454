# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Orders that rclpy's own tests rely on, with seven workers as with one thread."""

import threading
import time

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future

from .conftest import Spinning, wait_for


def test_tasks_created_before_spin_run_in_rclpys_order(make_executor, ros_context):
    orders = []
    for executor in make_executor(), SingleThreadedExecutor(context=ros_context):
        order = []
        orders.append(order)
        for name in 'abc':
            executor.create_task(order.append, name)
        for _ in range(3):
            executor.spin_once(timeout_sec=0)
        executor.shutdown()
    assert orders[0] == orders[1] and sorted(orders[0]) == ['a', 'b', 'c']


def test_a_coroutine_goes_on_in_the_step_after_its_future_is_done(make_executor):
    executor = make_executor()
    future = Future(executor=executor)

    async def wait():
        await future
        return 'done'

    task = executor.create_task(wait)
    executor.spin_once(timeout_sec=0)
    assert not task.done()
    future.set_result(None)
    executor.spin_once(timeout_sec=1)
    assert task.done() and task.result() == 'done'


def test_other_callbacks_of_an_awaited_future_run_where_rclpy_runs_them(
        make_executor, ros_context):
    """Since rclpy 7.1.9 in the executor, before that in the thread that completes the future."""
    here = []
    for executor in make_executor(), SingleThreadedExecutor(context=ros_context):
        future = Future()
        threads = []

        async def wait(future=future):
            await future

        task = executor.create_task(wait)
        executor.spin_once(timeout_sec=0)
        future.add_done_callback(
            lambda _, threads=threads: threads.append(threading.get_ident()))
        completing = threading.Thread(target=future.set_result, args=(None,))
        completing.start()
        completing.join()
        for _ in range(20):
            if task.done() and threads:
                break
            executor.spin_once(timeout_sec=0.1)
        here.append(threads == [threading.get_ident()])
        executor.shutdown()
    assert here[0] == here[1]


@pytest.mark.parametrize('mine', [True, False], ids=['own', 'free'])
@pytest.mark.parametrize('generates', [False, True], ids=['await', 'for'])
def test_a_task_awaits_one_future_after_another(make_executor, mine, generates):
    """Since rclpy 7.1.9 a coroutine must not go on before the future that it awaits is done."""
    executor = make_executor()
    futures = [executor.create_future() if mine else Future() for _ in range(20)]
    got = []

    async def one_by_one():
        for future in futures:
            yield await future

    async def inner(future):
        got.append(await future)

    async def outer():
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
    # where rclpy's own executors keep tasks that are to go on, which nothing would take out here
    assert not getattr(executor, '_ready_tasks', ())

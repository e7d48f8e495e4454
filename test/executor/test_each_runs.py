# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Of many callbacks none is lost and none runs twice, whatever starts them."""

from builtin_interfaces.msg import Time
import pytest
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import Spinning, wait_for
from .pulse import Pulse

MANY = 60
"""More than twice twenty: every twentieth that is lost shows."""


def of_tasks(executor, node, call):
    for number in range(MANY):
        executor.create_task(call, number)


def of_coroutines(executor, node, call):
    waiting = []

    async def work(number):
        waiting.append(number)
        call(await futures[number])

    futures = [Future(executor=executor) for _ in range(MANY)]
    for number in range(MANY):
        executor.create_task(work, number)
    wait_for(lambda: len(waiting) >= MANY, 6.0)
    for number, future in enumerate(futures):
        future.set_result(number)


def of_subscriptions(executor, node, call):
    node.create_subscription(Header, '/topic', lambda m: call(m.stamp.sec), MANY)
    publisher = node.create_publisher(Header, '/topic', MANY)
    assert wait_for(lambda: publisher.get_subscription_count() == 1)
    for number in range(MANY):
        publisher.publish(Header(stamp=Time(sec=number)))


def of_services(executor, node, call):
    numbers = iter(range(MANY))

    def answer(request, response):
        call(next(numbers))
        return response

    node.create_service(Trigger, '/ask', answer)
    client = node.create_client(Trigger, '/ask')
    assert client.wait_for_service(5.0)
    for _ in range(MANY):  # one after the other, since of those that wait the queue keeps ten
        future = client.call_async(Trigger.Request())
        assert wait_for(future.done, 6.0)


def of_guards(executor, node, call):
    one_by_one(lambda ran: node.create_guard_condition(ran).trigger, call)


def of_waitables(executor, node, call):
    def make(ran):
        async def execute(data):
            ran()
        pulse = Pulse(node, node.default_callback_group)
        pulse.execute = execute
        node.add_waitable(pulse)
        return pulse.guard.trigger
    one_by_one(make, call)


def one_by_one(make, call):
    """Trigger what ``make`` makes of a callback, and again when that has run."""
    done = []

    def ran():
        call(len(done))
        done.append(1)

    trigger = make(ran)
    for number in range(1, MANY + 1):
        trigger()
        assert wait_for(lambda n=number: len(done) == n, 6.0)


@pytest.mark.parametrize('start', [
    of_tasks, of_coroutines, of_subscriptions, of_services, of_guards, of_waitables])
def test_each_of_many_runs_once(make_executor, make_node, spinning, start):
    node = make_node()
    executor = make_executor(nodes=[node])
    calls = []
    with spinning(executor) as spun:
        start(executor, node, calls.append)
        wait_for(lambda: len(calls) >= MANY, 6.0)
    assert sorted(calls) == list(range(MANY))
    assert spun.error is None


def test_each_time_that_a_timer_is_due_counts(make_executor, make_node):
    """Where this machine is busy it skips periods, and says so."""
    node, calls = make_node(), []
    timer = node.create_timer(0.005, lambda: calls.append(1))
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(calls) >= MANY)
        timer.cancel()
    counts = executor.statistics()['callbacks']['/node: <lambda> (timer 5ms)']
    assert counts['ready'] - counts['waiting'] == counts['ran'] == len(calls)

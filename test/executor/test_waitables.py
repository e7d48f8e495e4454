# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Actions, QoS events, guard conditions, waitables of a user's own, and timers that have info."""

import os
import threading
import time

from mddag_executor.executor import compat
from mddag_executor.executor.waitables import EventsSource
import pytest
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler, PublisherEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from test_msgs.action import Fibonacci

from .conftest import is_idle, Spinning, wait_for

SUCCEEDED, CANCELED = 4, 5


class Counting:
    """An action that counts up to its order, in a node of its own; and a client for it."""

    def __init__(self, server_node, client_node, **kwargs):
        self.group = ReentrantCallbackGroup()
        self.server = ActionServer(
            server_node, Fibonacci, 'count', self._execute, callback_group=self.group,
            cancel_callback=lambda request: CancelResponse.ACCEPT,
            feedback_pub_qos_profile=QoSProfile(depth=100), **kwargs)
        self.client = ActionClient(
            client_node, Fibonacci, 'count', callback_group=self.group,
            feedback_sub_qos_profile=QoSProfile(depth=100))

    def _execute(self, goal):
        feedback = Fibonacci.Feedback()
        for number in range(goal.request.order):
            feedback.sequence.append(number)
            goal.publish_feedback(feedback)
        if goal.request.order == 0:
            wait_for(lambda: goal.is_cancel_requested)
            goal.canceled()
        else:
            goal.succeed()
        return Fibonacci.Result(sequence=feedback.sequence)

    async def ask(self, order, cancels=False):
        """Return status, result and lengths of the feedback of a goal."""
        lengths = []
        goal = await self.client.send_goal_async(
            Fibonacci.Goal(order=order),
            feedback_callback=lambda m: lengths.append(len(m.feedback.sequence)))
        assert goal.accepted
        if cancels:
            await goal.cancel_goal_async()
        answer = await goal.get_result_async()
        return answer.status, list(answer.result.sequence), lengths

    def destroy(self):
        self.server.destroy()
        self.client.destroy()


@pytest.mark.parametrize('apart', [False, True])
def test_many_goals_at_once(make_executor, make_node, apart):
    """Client and server in one executor, or each in one of its own."""
    nodes = [make_node('server'), make_node('client')]
    counting = Counting(*nodes)
    executors = [make_executor(), make_executor()] if apart else [make_executor()] * 2
    for executor, node in zip(executors, nodes):
        executor.add_node(node)
    with Spinning(executors[1]) as spinning:
        other = Spinning(executors[0])
        if apart:
            other.__enter__()
        try:
            assert counting.client.wait_for_server(15.0)
            tasks = [executors[1].create_task(counting.ask(order)) for order in range(1, 9)]
            tasks += [executors[1].create_task(counting.ask(0, True)) for _ in range(2)]
            assert wait_for(lambda: all(task.done() for task in tasks))
            assert wait_for(lambda: all(map(is_idle, executors)))
        finally:
            if apart:
                other.__exit__()
    assert spinning.error is None
    for order, task in enumerate(tasks[:8], 1):
        status, result, lengths = task.result()
        assert (status, result) == (SUCCEEDED, [*range(order)])
        assert sorted(lengths) == [*range(1, order + 1)]
    assert [task.result()[0] for task in tasks[8:]] == [CANCELED] * 2
    counting.destroy()


@pytest.mark.parametrize('stepwise', [False, True])
def test_a_goal_expires_when_its_time_is_over(make_executor, make_node, stepwise):
    """The timer is within the server; nothing else happens meanwhile."""
    node = make_node()
    counting = Counting(node, node, result_timeout=0.2)
    executor = make_executor(nodes=[node])

    def known():
        return len(counting.server._goal_handles)

    for _ in range(2):
        task = executor.create_task(counting.ask(2))
        executor.spin_until_future_complete(task, 15.0)
        assert task.result()[0] == SUCCEEDED and known() == 1
        if stepwise:
            end = time.monotonic() + 15.0
            while known() and time.monotonic() < end:
                executor.spin_once(0.05)
        else:
            with spun(executor):
                assert wait_for(lambda: known() == 0)
        assert known() == 0
    counting.destroy()


class spun:
    """Spin in a thread while entered, without shutting the executor down."""

    def __init__(self, executor):
        self._future = executor.create_future()
        self._thread = threading.Thread(
            target=executor.spin_until_future_complete, args=(self._future, 30.0))

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *_):
        self._future.set_result(None)
        self._thread.join(30.0)
        assert not self._thread.is_alive()


# --- QoS events ----------------------------------------------------------------------------------


def test_events_keep_their_listener_when_another_one_is_destroyed_meanwhile(
        make_executor, make_node, monkeypatch):
    """No thread waits for them in a wait set, which would disturb the next listener."""
    node, victims, waiting = make_node(), [], set()
    subscriptions = [node.create_subscription(Header, f'/t{i}', print, 10) for i in range(20)]
    executor = make_executor(nodes=[node])
    listen, add = EventsSource.listen, EventHandler.add_to_wait_set

    def destroy_before(self):
        while victims:
            node.destroy_subscription(victims.pop())
        listen(self)

    def note(self, wait_set):
        waiting.add(threading.current_thread().name)
        add(self, wait_set)

    monkeypatch.setattr(EventsSource, 'listen', destroy_before)
    monkeypatch.setattr(EventHandler, 'add_to_wait_set', note)
    with Spinning(executor) as spinning:
        for number in range(10):
            assert wait_for(lambda: is_idle(executor))
            victims.append(subscriptions.pop())
            subscriptions.insert(0, node.create_subscription(Header, f'/n{number}', print, 10))
            assert wait_for(lambda: not victims)
    assert spinning.error is None
    assert waiting and 'mddag-wait-set' not in waiting


def test_the_middleware_writes_to_no_file_after_the_executor_has_ended(
        make_executor, make_node, tmp_path):
    """Not even if the event of another subscription has just been destroyed."""
    node, source, noticed = make_node(), make_node('source'), []
    subscriptions = [node.create_subscription(Header, f'/t{i}', print, 10) for i in range(20)]
    executor = make_executor(nodes=[node])
    executor.spin_once(0.0)
    subscriptions[0].event_handlers[0].destroy()
    executor.shutdown()
    files = [(tmp_path / f'{number}').open('w+b', buffering=0) for number in range(200)]
    sensor = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    for number in range(1, 20):
        source.create_publisher(Header, f'/t{number}', sensor, event_callbacks=(
            PublisherEventCallbacks(incompatible_qos=noticed.append)))
    with Spinning(make_executor(nodes=[source])):
        assert wait_for(lambda: len(noticed) == 19)
    sizes = []
    for file in files:
        with file:
            sizes.append(os.fstat(file.fileno()).st_size)
    assert sizes == [0] * 200


@pytest.mark.skipif(compat.TimerInfo is None, reason='this rclpy has no TimerInfo')
def test_a_timer_gives_its_info_to_who_asks_for_it(make_executor, make_node):
    node, seen, plain = make_node(), [], []

    def tick(call):
        seen.append(call)

    tick.__annotations__['call'] = compat.TimerInfo
    node.create_timer(0.02, tick)
    node.create_timer(0.02, lambda: plain.append(1))
    executor = make_executor(nodes=[node])
    with Spinning(executor) as spinning:
        assert wait_for(lambda: len(seen) >= 10 and len(plain) >= 10)
    assert spinning.error is None
    for call in seen:
        assert call.expected_call_time <= call.actual_call_time
        assert call.expected_call_time.clock_type == node.get_clock().clock_type
    steps = {(b.expected_call_time - a.expected_call_time).nanoseconds
             for a, b in zip(seen, seen[1:])}
    assert all(step % 20_000_000 == 0 for step in steps)

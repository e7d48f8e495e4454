# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callback groups of a user's own class are asked, as rclpy's executors do."""

import threading

import pytest
from rclpy.callback_groups import CallbackGroup
from rclpy.task import Future
from std_msgs.msg import Int32

from .conftest import Spinning, wait_for


class Tokens(CallbackGroup):
    """Lets so many callbacks run as it has tokens, and notes what it is asked and told."""

    def __init__(self, tokens=0):
        super().__init__()
        self.lock = threading.Lock()
        self.tokens = tokens
        self.asked = self.running = self.most = self.begun = self.ended = 0

    def can_execute(self, entity):
        with self.lock:
            self.asked += 1
            return self.tokens > 0

    def beginning_execution(self, entity):
        with self.lock:
            if self.tokens == 0:
                return False
            self.tokens -= 1
            self.begun += 1
            self.running += 1
            self.most = max(self.most, self.running)
            return True

    def ending_execution(self, entity):
        with self.lock:
            self.ended += 1
            self.running -= 1

    def give(self, tokens=1):
        with self.lock:
            self.tokens += tokens


class AtMost(Tokens):
    """Gives back the token of what ends: at most so many run at once."""

    def ending_execution(self, entity):
        super().ending_execution(entity)
        self.give()


@pytest.fixture
def node(make_node):
    return make_node('gated')


def test_a_timer_runs_as_often_as_its_group_lets_it(make_executor, node):
    """The throttled example of ros2/examples: another callback gives the tokens."""
    group, ran, ticks = Tokens(3), [], []
    node.create_timer(0.001, lambda: ran.append(len(ticks)), callback_group=group)

    def tick():
        ticks.append(1)
        if len(ticks) % 10 == 0:
            group.give()

    node.create_timer(0.004, tick)
    executor = make_executor(nodes=[node])
    with Spinning(executor) as spinning:
        assert wait_for(lambda: len(ticks) > 60)
    assert spinning.error is None
    assert 3 < len(ran) <= 3 + len(ticks) // 10
    assert group.begun == group.ended == len(ran) and group.asked > len(ran)
    (gated,) = [counts for name, counts in executor.statistics()['callbacks'].items()
                if name.endswith('(timer 1ms)')]
    assert gated['ran'] == len(ran) and gated['dropped'] == 0 < gated['skipped']


def test_messages_that_wait_are_as_many_as_the_qos_says_and_keep_their_order(make_executor, node):
    group, got = Tokens(), []
    node.create_subscription(
        Int32, '/gated', lambda m: got.append(m.data), 3, callback_group=group)
    publisher = node.create_publisher(Int32, '/gated', 50)
    executor = make_executor(nodes=[node])

    def count(what):
        return int(sum(c[what] for name, c in executor.statistics()['callbacks'].items()
                       if name.startswith('/gated: ')))

    with Spinning(executor):
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        for i in range(10):
            publisher.publish(Int32(data=i))
            assert wait_for(lambda i=i: count('ready') > i)
        assert wait_for(lambda: count('dropped') == 7)
        group.give(50)
        assert wait_for(lambda: len(got) == 3)
    assert got == [7, 8, 9]


def test_a_coroutine_ends_when_it_has_run_to_its_end(make_executor, node):
    group, future, steps = AtMost(1), Future(), []

    async def callback(message):
        steps.append(('begins', message.data))
        await future
        steps.append(('ends', message.data))

    node.create_subscription(Int32, '/awaits', callback, 5, callback_group=group)
    publisher = node.create_publisher(Int32, '/awaits', 5)
    executor = make_executor(nodes=[node])
    with Spinning(executor) as spinning:
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        publisher.publish(Int32(data=1))
        assert wait_for(lambda: len(steps) == 1)
        publisher.publish(Int32(data=2))
        asked = group.asked
        assert wait_for(lambda: group.asked > asked + 1)
        assert steps == [('begins', 1)] and group.ended == 0
        future.set_result(None)
        assert wait_for(lambda: len(steps) == 4 and group.ended == 2)
    assert spinning.error is None
    assert steps == [('begins', 1), ('ends', 1), ('begins', 2), ('ends', 2)]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callback groups of a user's own class are asked, as rclpy's executors do."""

from __future__ import annotations

from pathlib import Path
import threading
from typing import Any

from mddag_executor.executor import current_job
from mddag_executor.replay import replay
from mddag_executor.trace import read_events
from msg_graph import loads
import pytest
from rclpy.callback_groups import CallbackGroup
from rclpy.task import Future
from std_msgs.msg import Int32

from .conftest import Spinning, wait_for


class Tokens(CallbackGroup):
    """Lets so many callbacks run as it has tokens, and notes what it is asked and told."""

    def __init__(self, tokens: int = 0) -> None:
        super().__init__()
        self.lock = threading.Lock()
        self.tokens = tokens
        self.asked = self.running = self.most = self.begun = self.ended = 0

    def can_execute(self, entity: Any) -> bool:
        with self.lock:
            self.asked += 1
            return self.tokens > 0

    def beginning_execution(self, entity: Any) -> bool:
        with self.lock:
            if self.tokens == 0:
                return False
            self.tokens -= 1
            self.begun += 1
            self.running += 1
            self.most = max(self.most, self.running)
            return True

    def ending_execution(self, entity: Any) -> None:
        with self.lock:
            self.ended += 1
            self.running -= 1

    def give(self, tokens: int = 1) -> None:
        with self.lock:
            self.tokens += tokens


class AtMost(Tokens):
    """Gives back the token of what ends: at most so many run at once."""

    def ending_execution(self, entity: Any) -> None:
        super().ending_execution(entity)
        self.give()


@pytest.fixture
def node(make_node):
    return make_node('gated')


def test_a_timer_runs_as_often_as_its_group_lets_it(make_executor, node):
    """The throttled example of ros2/examples: another callback gives the tokens."""
    group, ran, ticks = Tokens(3), [], []
    node.create_timer(0.001, lambda: ran.append(len(ticks)), callback_group=group)

    def tick() -> None:
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

    def count(what: str) -> int:
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

    async def callback(message: Int32) -> None:
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


def test_a_declared_callback_completes_its_jobs_when_its_group_lets_it(
        make_executor, make_node, tmp_path: Path) -> None:
    group, trace = Tokens(), tmp_path / 'run.mcap'
    source, sink = make_node('source'), make_node('sink')
    publisher = source.create_publisher(Int32, '/a', 100)
    jobs: list[Any] = []
    ran: list[tuple[int, int]] = []

    def tick() -> None:
        jobs.append(current_job())
        publisher.publish(Int32(data=jobs[-1].job))

    def last(message: Int32) -> None:
        ran.append((current_job().job, message.data))

    timer = source.create_timer(0.01, tick, autostart=False)
    sink.create_subscription(Int32, '/a', last, 100, callback_group=group)
    executor = make_executor(loads("""
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 10ms, publishes: [/a], dag: chain, max_active_jobs: 100}]
  - node: /sink
    callbacks: [{name: last, subscription: /a, deadline: 60s}]
"""), trace=trace)
    executor.add_node(source)
    executor.add_node(sink)
    with Spinning(executor) as spinning:
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        timer.reset()
        executor.wake()
        assert wait_for(lambda: len(jobs) >= 10)
        timer.cancel()
        group.give(3)
        assert wait_for(lambda: len(ran) == 3)
        assert wait_for(lambda: executor.statistics()['queue'] == len(jobs) - 3)
        group.give(100)
        assert wait_for(lambda: len(ran) == len(jobs))
    assert spinning.error is None
    assert sorted(ran) == [(job.job, job.job) for job in jobs]
    completed = executor.statistics()['dags']['chain']['sinks']['/sink:last']['completed']
    assert completed == len(jobs) == group.ended
    recorded = replay(trace)
    assert recorded.warnings == []
    assert recorded.result()['dags']['chain']['sinks']['/sink:last']['completed'] == len(jobs)
    assert ['reentrant'] == [
        event['group_type_name'] for event in read_events(trace)
        if event['_name'] == 'ros2_caret:add_callback_group'
        and event['callback_group_addr'] == id(group)]

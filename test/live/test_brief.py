# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that always end at once run in the intake's thread, and never stop it."""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from typing import Any

from mddag_executor.live import entity, pool
import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import Spinning, wait_for

TIMES = entity.BRIEF_RUNS + 8
INTAKE = 'mddag-intake-events'


@pytest.fixture(autouse=True)
def busiest_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a callback count as brief, and be trusted again soon, where the machine stalls, too."""
    monkeypatch.setattr(entity, 'BRIEF_NS', 20_000_000)
    monkeypatch.setattr(pool, 'BRIEF_NS', 20_000_000)
    monkeypatch.setattr(entity, 'MOST_DEBT', 64)


class Ears:
    """A node on the executor that hears what one beside it publishes, on ``/a`` and ``/b``."""

    def __init__(self, make_executor: Any, make_node: Any) -> None:
        # Not on the executor: its messages come through the intake.
        mouth = make_node('mouth')
        self.node = make_node('ears')
        self.threads: dict[str, list[str]] = {'/a': [], '/b': []}
        self.body: Callable[[], None] = lambda: None
        self.publishers = {topic: mouth.create_publisher(Header, topic, 100)
                           for topic in self.threads}
        for topic in self.threads:
            self.node.create_subscription(
                Header, topic, lambda _, topic=topic: self._hear(topic), 100,
                callback_group=MutuallyExclusiveCallbackGroup())
        self.executor = make_executor(intake='events', num_workers=3)
        self.executor.add_node(self.node)

    def _hear(self, topic: str) -> None:
        self.threads[topic].append(threading.current_thread().name)
        if topic == '/a':
            self.body()

    def say(self, topic: str) -> None:
        heard = len(self.threads[topic])
        self.publishers[topic].publish(Header())
        assert wait_for(lambda: len(self.threads[topic]) > heard)

    def warm_up(self) -> None:
        for _ in range(TIMES):
            self.say('/a')
        # A stall of the machine puts it off.
        assert wait_for(lambda: self.say('/a') or self.threads['/a'][-1] == INTAKE, 30)


@pytest.fixture
def ears(make_executor: Any, make_node: Any) -> Ears:
    return Ears(make_executor, make_node)


def test_it_runs_where_it_is_taken_once_it_has_always_been_brief(ears: Ears) -> None:
    with Spinning(ears.executor):
        for _ in range(entity.BRIEF_RUNS // 2):
            ears.say('/a')
        assert INTAKE not in ears.threads['/a']
        ears.warm_up()


def test_others_are_heard_while_it_does_not_end(ears: Ears) -> None:
    with Spinning(ears.executor):
        ears.warm_up()
        goes_on = threading.Event()
        ears.body = lambda: goes_on.wait(20.0)
        ears.say('/a')
        for _ in range(20):
            ears.say('/b')
        goes_on.set()
        ears.body = lambda: None
        for _ in range(20):
            ears.say('/a')
        assert set(ears.threads['/a'][-20:]) != {INTAKE}  # not trusted for some time


def test_it_may_call_a_service_of_its_own_executor(ears: Ears) -> None:
    server = MutuallyExclusiveCallbackGroup()
    ears.node.create_service(
        Trigger, '/serve', lambda request, response: response, callback_group=server)
    client = ears.node.create_client(Trigger, '/serve', callback_group=server)
    answers: list[Any] = []
    with Spinning(ears.executor):
        assert client.wait_for_service(10.0)
        ears.warm_up()
        ears.body = lambda: answers.append(client.call(Trigger.Request(), timeout_sec=20.0))
        ears.say('/a')
        assert wait_for(lambda: bool(answers), 25)
    assert answers[0] is not None


def test_what_it_raises_comes_out_of_the_spin(ears: Ears) -> None:
    def fail() -> None:
        raise ValueError('no')

    with Spinning(ears.executor) as spinning:
        ears.warm_up()
        ears.body = fail
        ears.publishers['/a'].publish(Header())
        assert wait_for(lambda: spinning.error is not None)
    assert isinstance(spinning.error, ValueError)


def test_shutdown_waits_for_it(ears: Ears) -> None:
    ended: list[bool] = []

    def go_on() -> None:
        time.sleep(0.3)
        ended.append(True)

    with Spinning(ears.executor):
        ears.warm_up()
        ears.body = go_on
        ears.say('/a')
        assert ears.executor.shutdown()
        assert ended


def test_a_spin_ends_though_it_does_not(ears: Ears) -> None:
    goes_on = threading.Event()
    with Spinning(ears.executor) as spinning:
        ears.warm_up()
        ears.body = lambda: goes_on.wait(60.0)
        ears.say('/a')
        assert not ears.executor.shutdown(0.1)
        spinning.join()
        goes_on.set()


@pytest.mark.parametrize('what', ['subscription', 'node', 'executor', 'context'])
def test_it_may_end_what_it_runs_on(
        what: str, make_executor: Any, make_node: Any, ros_context: Any) -> None:
    ears = Ears(make_executor, make_node)
    ended = threading.Event()

    def end() -> None:
        if what == 'subscription':
            for subscription in list(ears.node.subscriptions):
                ears.node.destroy_subscription(subscription)
        elif what == 'node':
            ears.node.destroy_node()
        elif what == 'executor':
            ears.executor.shutdown()
        else:
            ros_context.shutdown()
        ended.set()

    with Spinning(ears.executor) as spinning:
        ears.warm_up()
        ears.body = end
        ears.publishers['/a'].publish(Header())
        assert ended.wait(20.0)
        if what == 'subscription':
            assert wait_for(lambda: ears.executor.statistics()['idle_workers'] == 3)
        elif what in ('executor', 'context'):
            spinning.join()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that compute in Python pause for more urgent ones, where Python can do that."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import sys
import threading
import time
from typing import Any

import msg_graph
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import Spinning, wait_for

MONITORING: Any = getattr(sys, 'monitoring', None)
GRAPH = """
mddag: 1
nodes:
  - node: /node
    callbacks:
      - {name: urgent, subscription: /urgent, dag: urgent, period: 10ms, deadline: 10ms,
         holds_interpreter: true}
      - {name: long, subscription: /long, dag: long, period: 10s, deadline: 10s,
         holds_interpreter: true}
"""
LONG_S = 60.0

needs_monitoring = pytest.mark.skipif(
    MONITORING is None, reason='sys.monitoring came with Python 3.12')


class Two:
    """A long callback, and an urgent one that runs when the long one says so."""

    def __init__(
        self, executor: Any, node: Any, long: Callable[[], Any], urgent: Callable[[], Any],
    ) -> None:
        group = ReentrantCallbackGroup()
        self.done: list[str] = []
        self.executor = executor

        async def run_long(message: Any) -> None:
            try:
                result = long()
                if result is not None:
                    await result
            finally:
                self.done.append('long')

        def run_urgent(message: Any) -> None:
            urgent()
            self.done.append('urgent')

        node.create_subscription(Header, '/long', run_long, 10, callback_group=group)
        node.create_subscription(Header, '/urgent', run_urgent, 10, callback_group=group)
        self._long = node.create_publisher(Header, '/long', 10)
        self._urgent = node.create_publisher(Header, '/urgent', 10)
        executor.add_node(node)

    def run(self, begun: Callable[[], Any]) -> list[str]:
        """Return what ended, in order: the urgent one is to run when the long one has begun."""
        with Spinning(self.executor):
            self._long.publish(Header())
            assert wait_for(begun, LONG_S)
            self._urgent.publish(Header())
            assert wait_for(lambda: len(self.done) == 2, LONG_S)
        return self.done


class Counter:
    """Counts until it is told to stop; ``is_still`` computes until it has not counted lately."""

    def __init__(self) -> None:
        self.n = 0
        self.stop = False
        self.stood_still = False

    def count(self) -> None:
        end = time.monotonic() + LONG_S
        while not self.stop and time.monotonic() < end:
            self.n += 1

    def is_still(self) -> None:
        """Compute until the count stands still while this thread computes for 20 ms, or so."""
        end = time.monotonic() + LONG_S / 4
        while not self.stood_still and time.monotonic() < end:
            before, until = self.n, time.thread_time_ns() + 20_000_000
            while time.thread_time_ns() < until:
                pass
            self.stood_still = self.n == before
        self.stop = True


def preempting(make_executor: Any) -> Any:
    executor = make_executor(msg_graph.loads(GRAPH, 'g.yaml'), preempt=True)
    assert executor.statistics()['preemption'] == {'reason_off': None, 'pauses': 0}
    return executor


@needs_monitoring
def test_the_long_one_pauses_while_the_urgent_one_computes(make_executor, make_node):
    counter = Counter()
    executor = preempting(make_executor)
    two = Two(executor, make_node(), counter.count, counter.is_still)
    assert two.run(lambda: counter.n > 0) == ['urgent', 'long']
    assert counter.stood_still
    assert executor.statistics()['preemption']['pauses'] >= 1


@needs_monitoring
def test_code_is_not_slowed_down_any_more_once_the_long_one_pauses(make_executor, make_node):
    counter, events = Counter(), []

    def urgent() -> None:
        counter.is_still()
        events.append([MONITORING.get_local_events(tool, Counter.count.__code__)
                       for tool in range(6) if MONITORING.get_tool(tool) == 'mddag_executor'])

    two = Two(preempting(make_executor), make_node(), counter.count, urgent)
    assert two.run(lambda: counter.n > 0) == ['urgent', 'long']
    assert counter.stood_still and events == [[0]]


def numbers(counter: Counter) -> Iterator[int]:
    while not counter.stop:
        counter.n += 1
        yield counter.n


def in_a_generator(counter: Counter) -> None:
    for _ in numbers(counter):
        pass


async def in_a_coroutine(counter: Counter) -> None:
    counter.count()


def in_what_raises(counter: Counter) -> None:
    while not counter.stop:
        try:
            counter.n += 1
            raise ValueError(counter.n)
        except ValueError:
            pass


def in_c(counter: Counter) -> None:
    while not counter.stop:
        counter.n += 1
        sorted(range(20_000), key=str)


@needs_monitoring
@pytest.mark.parametrize('body', [in_a_generator, in_a_coroutine, in_what_raises, in_c])
def test_whatever_it_executes_it_pauses_and_goes_on(make_executor, make_node, body):
    counter = Counter()
    two = Two(
        preempting(make_executor), make_node(), lambda: body(counter), counter.is_still)
    assert two.run(lambda: counter.n > 0) == ['urgent', 'long']
    assert counter.stood_still


@needs_monitoring
def test_a_lock_of_the_paused_one_keeps_nobody_for_long(make_executor, make_node):
    lock, counter, got = threading.Lock(), Counter(), []

    def long() -> None:
        with lock:
            until = time.thread_time_ns() + 300_000_000
            while time.thread_time_ns() < until:
                counter.n += 1

    def urgent() -> None:
        until = time.thread_time_ns() + 3_000_000
        while time.thread_time_ns() < until:  # the long one pauses by now
            pass
        with lock:
            got.append(True)

    two = Two(preempting(make_executor), make_node(), long, urgent)
    assert sorted(two.run(lambda: counter.n > 0)) == ['long', 'urgent']
    assert got == [True]


@needs_monitoring
def test_others_may_monitor_the_same_code(make_executor, make_node):
    counter, seen = Counter(), []
    line = MONITORING.events.LINE
    code = Counter.count.__code__
    MONITORING.use_tool_id(MONITORING.COVERAGE_ID, 'test')
    try:
        MONITORING.register_callback(
            MONITORING.COVERAGE_ID, line, lambda code, number: seen.append(number))
        MONITORING.set_local_events(MONITORING.COVERAGE_ID, code, line)
        two = Two(preempting(make_executor), make_node(), counter.count, counter.is_still)
        assert two.run(lambda: counter.n > 0) == ['urgent', 'long']
        assert counter.stood_still
        assert len(seen) > counter.n
        assert MONITORING.get_local_events(MONITORING.COVERAGE_ID, code) == line
    finally:
        MONITORING.set_local_events(MONITORING.COVERAGE_ID, code, 0)
        MONITORING.register_callback(MONITORING.COVERAGE_ID, line, None)
        MONITORING.free_tool_id(MONITORING.COVERAGE_ID)


@needs_monitoring
def test_it_says_that_it_is_off_where_others_use_all_identifiers(make_executor, make_node):
    for tool in (3, 4):
        MONITORING.use_tool_id(tool, 'test')
    try:
        executor = make_executor(preempt=True)
        assert executor.statistics()['preemption'] == {
            'reason_off': 'others use all identifiers of sys.monitoring', 'pauses': 0}
        executor.shutdown()
    finally:
        for tool in (3, 4):
            MONITORING.free_tool_id(tool)


@needs_monitoring
def test_nothing_of_it_is_left_when_the_executor_ends(make_executor, make_node):
    counter = Counter()
    executor = preempting(make_executor)
    assert 'mddag_executor' in [MONITORING.get_tool(tool) for tool in range(6)]
    two = Two(executor, make_node(), counter.count, counter.is_still)
    two.run(lambda: counter.n > 0)
    assert 'mddag_executor' not in [MONITORING.get_tool(tool) for tool in range(6)]


@pytest.mark.skipif(MONITORING is not None, reason='this Python has sys.monitoring')
def test_older_versions_of_python_say_that_it_is_off(make_executor):
    executor = make_executor(preempt=True)
    assert executor.statistics()['preemption'] == {
        'reason_off': 'it takes Python 3.12 or newer', 'pauses': 0}


def test_unless_asked_for_it_is_off(make_executor):
    assert make_executor().statistics()['preemption'] is None

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Timers whose due time changes while the executor waits, and what is due before it spins."""

import threading
import time

from builtin_interfaces.msg import Time as TimeMessage
from msg_graph import loads
import pytest
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Header

from .conftest import is_idle, Spinning, wait_for

MS = 1_000_000
STAMPED = """
mddag: 1
nodes:
  - node: /node
    callbacks:
      - name: heard
        subscription: /topic
        period: 10ms
        release_from: {}
        execution_time: 1us
        deadline: 1s
"""


def waits_for_no_timer(executor):
    """Tell whether the executor knows of all timers, and none is to become due."""
    with executor._pool.lock:
        return executor._pool.is_current and not executor._pool.timers.next_due()


def test_a_timer_that_was_cancelled_runs_when_it_is_reset(make_executor, make_node, spinning):
    node, ran = make_node(), []
    timer = node.create_timer(0.01, lambda: ran.append(1), autostart=False)
    executor = make_executor(nodes=[node])
    with spinning(executor):
        for _ in range(5):
            assert wait_for(lambda: waits_for_no_timer(executor))
            count = len(ran)
            timer.reset()
            assert wait_for(lambda n=count: len(ran) >= n + 2)
            timer.cancel()


def test_a_timer_that_is_reset_before_it_is_due_never_runs_and_costs_no_memory(
        make_executor, make_node):
    """A watchdog."""
    node, barked, resets = make_node(), [], []
    watchdog = node.create_timer(60.0, lambda: barked.append(1))

    def feed():
        for _ in range(20):
            watchdog.reset()
        resets.append(1)

    node.create_timer(0.001, feed)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(resets) >= 50)
        assert len(executor._pool.timers._heap) < 50
    assert not barked


@pytest.mark.parametrize('sleeps', [False, True], ids=['timer', 'rate'])
def test_a_timer_that_left_while_its_arrival_was_handled_is_not_asked_again(
        make_executor, make_node, sleeps):
    """Else two executors would advance it, and one of them would drop what is due."""
    node = make_node()
    kept = node.create_rate(1.0) if sleeps else node.create_timer(1.0, print)
    executor, other = make_executor(nodes=[node]), make_executor()
    executor._upkeep.refresh()
    place = executor._at_once if sleeps else executor._pool
    (source,) = place.timers._timers.values()
    arrived = place.loop.sources(place.loop.wait(0))[0]
    assert source in arrived and place.timers.next_due()
    other.add_node(node)
    for each in arrived:
        each.collect()
    assert not place.timers.next_due()
    del kept


@pytest.mark.parametrize(
    'kind', [ClockType.STEADY_TIME, ClockType.SYSTEM_TIME, ClockType.ROS_TIME])
def test_timers_of_each_clock_run(make_executor, make_node, kind):
    node, ran = make_node(), []
    node.create_timer(0.01, lambda: ran.append(1), clock=Clock(clock_type=kind))
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(ran) >= 5)


# --- simulated time ------------------------------------------------------------------------------


class Simulation:
    """A node with simulated time, and a publisher of that time."""

    def __init__(self, make_node):
        self.node = make_node(
            'simulated', parameter_overrides=[Parameter('use_sim_time', value=True)])
        self._publisher = make_node('clock').create_publisher(
            ClockMessage, '/clock', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))

    def matched(self):
        return wait_for(lambda: self._publisher.get_subscription_count() == 1)

    def set_clock(self, now):
        """Publish the time until the node has it."""
        message = ClockMessage(clock=TimeMessage(sec=now // 10**9, nanosec=now % 10**9))
        clock = self.node.get_clock()
        return any(
            self._publisher.publish(message)
            or wait_for(lambda: clock.now().nanoseconds == now, 0.1) for _ in range(20))


class Simulated(Simulation):
    """Simulated time, with an executor and a timer that notes its clock's time."""

    def __init__(self, make_executor, make_node, start=100 * 10**9):
        super().__init__(make_node)
        self.now = start
        self.ran = []
        self.executor = make_executor()
        self.executor.add_node(self.node)

    def timer(self, period_s, **kwargs):
        clock = self.node.get_clock()
        return self.node.create_timer(
            period_s, lambda: self.ran.append(clock.now().nanoseconds), **kwargs)

    def step(self, ns):
        self.now += ns
        assert self.set_clock(self.now)

    def is_idle(self):
        """Tell whether all that has to do with the present time is done."""
        quiet = threading.Event()
        self.executor.create_task(quiet.set)
        return quiet.wait(15.0) and wait_for(
            lambda: self.executor._pool.is_current and is_idle(self.executor))

    def until(self, done):
        assert wait_for(done), self.ran


def test_a_timer_runs_by_simulated_time_and_by_nothing_else(make_executor, make_node):
    simulated = Simulated(make_executor, make_node)
    with Spinning(simulated.executor):
        assert simulated.matched()
        simulated.step(0)
        simulated.timer(1.0)
        assert simulated.is_idle()
        start = simulated.now
        for second in range(1, 6):
            simulated.step(999 * MS)
            assert simulated.is_idle() and len(simulated.ran) == second - 1
            simulated.step(1 * MS)
            simulated.until(lambda n=second: len(simulated.ran) == n)
    assert simulated.ran == [start + second * 10**9 for second in range(1, 6)]


def test_a_node_may_turn_to_simulated_time_and_back(make_executor, make_node):
    from rclpy.parameter import Parameter
    simulated = Simulated(make_executor, make_node)
    node = simulated.node
    with Spinning(simulated.executor):
        assert simulated.matched()
        simulated.step(0)
        simulated.timer(0.01)
        assert simulated.is_idle() and not simulated.ran
        node.set_parameters([Parameter('use_sim_time', value=False)])
        simulated.until(lambda: len(simulated.ran) >= 3)
        node.set_parameters([Parameter('use_sim_time', value=True)])
        assert simulated.matched()
        simulated.step(3600 * 10**9)
        assert simulated.is_idle()
        count = len(simulated.ran)
        simulated.step(20 * MS)
        simulated.until(lambda: len(simulated.ran) > count)


GRAPH = """
mddag: 1
nodes:
  - node: /node
    callbacks:
      - name: tick
        timer: 10ms
        publishes: [/topic]
        execution_time: 1us
      - name: heard
        subscription: /topic
        execution_time: 1us
        deadline: 10s
"""


def test_periods_before_the_spin_are_no_jobs_and_no_misses(make_executor, make_node):
    node, ran = make_node(), []
    publisher = node.create_publisher(Header, '/topic', 10)
    node.create_subscription(Header, '/topic', lambda m: None, 10)

    def tick():
        ran.append(1)
        publisher.publish(Header())

    node.create_timer(0.01, tick)
    executor = make_executor(loads(GRAPH), nodes=[node])
    releases = []
    executor._engine.verdicts.on_release = lambda dag, release: releases.append(release)
    time.sleep(0.3)
    begin = executor._trace_clock.now()
    with Spinning(executor):
        assert wait_for(lambda: len(ran) > 5)
    assert min(releases) >= begin
    assert executor.statistics()['callbacks']['/node:tick']['skipped'] < 25


@pytest.mark.parametrize('stamp', ['source_timestamp', 'header_stamp'])
def test_a_message_from_before_the_spin_is_released_when_it_begins(
        make_executor, make_node, stamp):
    node, got = make_node(), []
    publisher = node.create_publisher(Header, '/topic', 10)
    node.create_subscription(Header, '/topic', got.append, 10)
    assert wait_for(publisher.get_subscription_count)
    executor = make_executor(loads(STAMPED.format(stamp)), nodes=[node])
    releases = []
    executor._engine.verdicts.on_release = lambda dag, release: releases.append(release)
    publisher.publish(Header(stamp=node.get_clock().now().to_msg()))
    time.sleep(0.2)
    begin = executor._trace_clock.now()
    with Spinning(executor):
        assert wait_for(lambda: got)
    assert len(releases) == 1 and releases[0] >= begin


@pytest.mark.parametrize('stamp', ['source_timestamp', 'header_stamp'])
def test_a_pause_while_a_message_is_taken_does_not_move_its_release(
        make_executor, make_node, stamp):
    node, got = make_node(), []
    publisher = node.create_publisher(Header, '/topic', 10)
    subscription = node.create_subscription(
        Header, '/topic', lambda message, info: got.append(info['source_timestamp']), 10)
    assert wait_for(publisher.get_subscription_count)
    executor = make_executor(loads(STAMPED.format(stamp)), nodes=[node])
    releases = []
    executor._engine.verdicts.on_release = lambda dag, release: releases.append(release)
    with Spinning(executor):
        assert wait_for(lambda: executor._pool.is_current)
        source = executor._upkeep._sources[executor._registry.by_id[id(subscription)]]
        take = source._take
        source._take = lambda: (take(), time.sleep(0.1))[0]
        time.sleep(0.2)  # no release is before the spin
        sent = node.get_clock().now()
        publisher.publish(Header(stamp=sent.to_msg()))
        assert wait_for(lambda: got)
    expected = got[0] if stamp == 'source_timestamp' else sent.nanoseconds
    assert len(releases) == 1
    assert abs(releases[0] - executor._trace_clock.of_system(expected)) < MS

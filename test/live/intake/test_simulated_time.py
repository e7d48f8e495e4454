# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Timers of the intakes under simulated time, against real rclpy."""

from __future__ import annotations

from collections.abc import Iterator
import time

from builtin_interfaces.msg import Time as TimeMessage
from mddag_executor.live.intake.waitset import WaitSetIntake
import pytest
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage

from .helpers import (
    look_after,
    make_node,
    matched,
    MS,
    nothing,
    on_grid,
    Recorder,
    start,
    wait_for,
)


class Simulation:
    """A node with simulated time, the intake that looks after it, and its clock."""

    def __init__(self, context: Context, recorder: Recorder) -> None:
        self.recorder = recorder
        self.node = make_node(
            context, start_parameter_services=False, enable_rosout=False,
            parameter_overrides=[Parameter('use_sim_time', value=True)])
        self._other = make_node(context, start_parameter_services=False, enable_rosout=False)
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._publisher = self._other.create_publisher(ClockMessage, '/clock', qos)
        recorder.react['message'] = lambda subscription, message, _: subscription.callback(message)
        self.intake = WaitSetIntake(context, recorder)
        start(self.intake, self.node)
        assert matched(self._publisher)
        self.set_clock(1000 * MS)

    def set_clock(self, now: int) -> None:
        """Set the clock and wait until the node has it."""
        message = ClockMessage(clock=TimeMessage(sec=now // 10**9, nanosec=now % 10**9))
        clock = self.node.get_clock()
        for _ in range(100):
            self._publisher.publish(message)
            if wait_for(lambda: clock.now().nanoseconds == now, 0.1):
                return
        raise AssertionError('the clock does not come through')

    def run(self, start: int, steps: int, step: int = 10 * MS) -> int:
        """Advance the clock step by step, 1 ms of real time each; return the time then."""
        for k in range(1, steps + 1):
            self.set_clock(start + k * step)
            time.sleep(0.001)
        return start + steps * step

    def fired(self) -> int:
        """Return how often timers fired, once no more comes."""
        time.sleep(0.05)
        return len(self.recorder.timers)

    def close(self) -> None:
        self.intake.stop()
        self._other.destroy_node()
        self.node.destroy_node()


@pytest.fixture
def simulation(ros_context: Context, recorder: Recorder) -> Iterator[Simulation]:
    made = Simulation(ros_context, recorder)
    yield made
    made.close()
    assert not recorder.errors


def test_simulated_time_drives_timers(simulation: Simulation) -> None:
    timer = simulation.node.create_timer(0.050, nothing)
    look_after(simulation.intake, simulation.node)
    time.sleep(0.2)
    assert simulation.fired() == 0  # paused
    start = time.monotonic_ns()
    now = simulation.run(1000 * MS, 50)
    assert simulation.fired() == 10
    dues = simulation.recorder.dues(timer)
    assert start < dues[0] and dues[-1] < time.monotonic_ns() and dues == sorted(dues)
    time.sleep(0.2)
    assert simulation.fired() == 10  # paused again
    before = time.monotonic_ns()
    simulation.set_clock(now + 1000 * MS)
    assert simulation.fired() == 11  # one call for all that was missed
    assert simulation.recorder.dues(timer)[-1] >= before  # when it was noticed


def test_simulated_time_that_jumps_back_does_not_stall_timers(simulation: Simulation) -> None:
    """It is asked for in rclpy#1490 and rclcpp#2535."""
    simulation.node.create_timer(0.050, nothing)
    look_after(simulation.intake, simulation.node)
    simulation.run(1000 * MS, 20)
    count = simulation.fired()
    assert count == 4
    simulation.set_clock(100 * MS)
    assert simulation.fired() == count
    simulation.run(100 * MS, 50)
    assert simulation.fired() - count in (9, 10)


def test_a_timer_follows_its_clock_into_simulated_time_and_back(
    simulation: Simulation
) -> None:
    node, recorder = simulation.node, simulation.recorder
    timer = node.create_timer(0.020, nothing)
    look_after(simulation.intake, node)
    time.sleep(0.1)
    assert not recorder.timers
    node.set_parameters([Parameter('use_sim_time', value=False)])
    look_after(simulation.intake, node)
    assert wait_for(lambda: len(recorder.timers) >= 10)
    assert on_grid(recorder.dues(timer)[-8:], 20 * MS)
    node.set_parameters([Parameter('use_sim_time', value=True)])
    look_after(simulation.intake, node)
    time.sleep(0.05)
    count = len(recorder.timers)
    time.sleep(0.2)
    assert len(recorder.timers) == count

# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Snapshots, timers and the wait set intake, against real rclpy."""

from __future__ import annotations

from collections.abc import Iterator
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from mddag_executor.live.entities import snapshot
from mddag_executor.live.waitset import WaitSetIntake
import pytest
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String

from .intakes import cpu_ns, intake_threads, make_node, matched, Recorder, text, topic, wait_for

MS = 1_000_000


@pytest.fixture
def node(ros_context: Context) -> Iterator[Node]:
    made = make_node(ros_context, start_parameter_services=False, enable_rosout=False)
    yield made
    made.destroy_node()


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def intake(ros_context: Context, recorder: Recorder) -> Iterator[WaitSetIntake]:
    """Give an intake of timers only, which is what EventsIntake has for them."""
    made = WaitSetIntake(ros_context, recorder, kinds={'timer'})
    yield made
    made.stop()
    assert not recorder.errors


def nothing() -> None:
    pass


def on_grid(dues: list[int], period: int) -> bool:
    """Return whether due times are points of one exact phase grid, and never go back."""
    steps = [b - a for a, b in zip(dues, dues[1:])]
    return all(step > 0 and step % period == 0 for step in steps)


# --- snapshots -----------------------------------------------------------------------------------


def test_a_snapshot_has_every_entity_and_its_node(ros_context: Context) -> None:
    a, b = make_node(ros_context), make_node(ros_context)
    timer = a.create_timer(1.0, nothing)
    guard = b.create_guard_condition(nothing)
    subscription = b.create_subscription(String, topic(), lambda _: None, 10)
    seen = snapshot([a, b])
    assert seen.timers == [timer] and seen.guards == [guard]
    assert subscription in seen.subscriptions
    assert seen.node_of(timer) is a and seen.node_of(guard) is b
    assert set(seen.services) == {*a.services, *b.services}
    assert set(seen.events) == {*a.waitables, *b.waitables} and seen.events
    assert not seen.waitables and seen.nodes == [a, b]
    with pytest.raises(KeyError):
        seen.node_of(object())


def test_a_snapshot_is_the_same_while_nothing_changes(ros_context: Context) -> None:
    a, b = make_node(ros_context), make_node(ros_context)
    first = snapshot([a, b])
    assert snapshot([a, b], first) is first
    assert snapshot([b, a], first) is first  # executors keep their nodes in a set
    timer = a.create_timer(1.0, nothing)
    second = snapshot([a, b], first)
    assert second is not first and second.timers == [timer]
    b.create_timer(1.0, nothing)
    a.destroy_timer(timer)  # as many as before
    third = snapshot([a, b], second)
    assert third is not second and third.timers != second.timers
    assert snapshot([a], third) is not third
    assert snapshot([], first).timers == []


def test_a_snapshot_takes_what_is_accepted(node: Node) -> None:
    timer, other = node.create_timer(1.0, nothing), node.create_timer(2.0, nothing)
    assert snapshot([node], accept=lambda entity: entity is not other).timers == [timer]


def test_comparing_a_thousand_entities_is_cheap(ros_context: Context) -> None:
    nodes = [make_node(ros_context) for _ in range(8)]
    for made in nodes:
        for _ in range(125):
            made.create_guard_condition(nothing)
    first = snapshot(nodes)
    assert len(first) > 1000
    best = min(_seconds(lambda: snapshot(nodes, first)) for _ in range(5))
    assert best < 0.002  # about 0.1 ms


def _seconds(function: Any) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


# --- timers: the phase grid ----------------------------------------------------------------------


@pytest.mark.parametrize('clock_type', [None, ClockType.STEADY_TIME, ClockType.SYSTEM_TIME])
def test_due_times_form_a_grid_although_the_receiver_stalls(
    intake: WaitSetIntake, node: Node, recorder: Recorder, clock_type: ClockType | None
) -> None:
    clock = None if clock_type is None else Clock(clock_type=clock_type)
    timer = node.create_timer(0.010, nothing, clock=clock)
    stalls = []

    def stall(_: Any, due: int) -> None:
        if len(recorder.timers) in (50, 100):
            time.sleep(0.035)
            stalls.append(due)

    recorder.react['timer'] = stall
    intake.update([node])
    intake.start()
    assert wait_for(lambda: len(recorder.timers) >= 150)
    dues = recorder.dues(timer)
    steps = [b - a for a, b in zip(dues, dues[1:])]
    # The grid may be anchored anew only for the clocks' drift: then a step is off by the
    # tolerance and a bit. Nearly all are exact.
    exact = sum(step % (10 * MS) == 0 for step in steps)
    assert exact >= len(steps) - 3
    assert all(min(step % (10 * MS), -step % (10 * MS)) < 100_000 for step in steps)
    for due in stalls:
        # The stall began up to a millisecond late, so it ended 35 to 40 ms after this due time;
        # what became due first meanwhile comes next, and the others of that time never.
        after = [d for d in dues if d > due][:2]
        assert round((after[0] - due) / MS) == 10
        assert 40 <= round((after[1] - due) / MS) <= 60
    assert all(due <= time.monotonic_ns() for due in dues)


def test_due_times_are_those_of_rcl(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.020, nothing)
    intake.update([node])
    intake.start()
    assert wait_for(lambda: len(recorder.timers) >= 5)
    before = time.monotonic_ns()
    expected = before + timer.time_until_next_call()
    after = time.monotonic_ns()
    count = len(recorder.timers)
    assert wait_for(lambda: len(recorder.timers) > count)
    next_due = next(due for due in recorder.dues(timer) if due > expected - 10 * MS)
    assert -30_000 <= next_due - expected <= after - before + 30_000


def test_timers_are_handed_over_soon_after_they_are_due(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    late = []
    recorder.react['timer'] = lambda _, due: late.append(time.monotonic_ns() - due)
    for k in range(11):
        node.create_timer(0.010 + 0.001 * k, nothing)
    intake.update([node])
    intake.start()
    time.sleep(1.0)
    assert len(late) > 500
    late.sort()
    assert late[0] >= -1000  # never early, but for the measured phase
    assert late[len(late) // 2] < 1.5 * MS


def test_many_timers_wake_their_thread_for_those_due_only(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.010, nothing)
    intake.update([node])
    intake.start()
    time.sleep(0.2)
    few = _cpu_for(intake_threads(), 0.5)
    for _ in range(300):
        node.create_timer(100.0, nothing)
    intake.update([node])
    time.sleep(0.2)
    many = _cpu_for(intake_threads(), 0.5)
    assert len(recorder.dues(timer)) > 80
    assert many < 4 * few + 10 * MS


def _cpu_for(threads: list[threading.Thread], seconds: float) -> int:
    start = cpu_ns(threads)
    time.sleep(seconds)
    return cpu_ns(threads) - start


# --- timers: changes -----------------------------------------------------------------------------


def test_a_cancelled_timer_does_not_fire_until_it_is_reset(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.030, nothing)
    intake.update([node])
    intake.start()
    assert wait_for(lambda: len(recorder.timers) >= 3)
    timer.cancel()
    time.sleep(0.05)
    count = len(recorder.timers)
    time.sleep(0.2)
    assert len(recorder.timers) == count
    before = time.monotonic_ns()
    timer.reset()
    after = time.monotonic_ns()
    assert wait_for(lambda: len(recorder.timers) > count)
    seen = time.monotonic_ns()
    due = recorder.timers[count][1]
    assert before + 30 * MS - 50_000 <= due <= after + 30 * MS + 50_000
    assert seen - due < 20 * MS  # nobody told the intake, and it is in time all the same


def test_a_timer_that_is_reset_again_and_again_does_not_fire(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.050, nothing)
    intake.update([node])
    intake.start()
    for _ in range(30):
        timer.reset()
        time.sleep(0.010)
    assert not recorder.timers
    assert wait_for(lambda: recorder.timers)


def test_a_reset_moves_the_grid(intake: WaitSetIntake, node: Node, recorder: Recorder) -> None:
    timer = node.create_timer(0.020, nothing)
    intake.update([node])
    intake.start()
    assert wait_for(lambda: len(recorder.timers) >= 4)
    time.sleep(0.007)
    timer.reset()
    reset = time.monotonic_ns()
    assert wait_for(lambda: recorder.timers[-1][1] > reset + 60 * MS)
    after = [due for due in recorder.dues(timer) if due > reset]
    assert abs(after[0] - reset - 20 * MS) < MS
    assert on_grid(after, 20 * MS)


@pytest.mark.parametrize('period_ms', [5, 7, 20])
def test_a_changed_period_holds_from_the_next_call_on(
    intake: WaitSetIntake, node: Node, recorder: Recorder, period_ms: int
) -> None:
    timer = node.create_timer(0.010, nothing)
    intake.update([node])
    intake.start()
    assert wait_for(lambda: len(recorder.timers) >= 5)
    timer.timer_period_ns = period_ms * MS
    changed = time.monotonic_ns()
    assert wait_for(lambda: recorder.timers[-1][1] > changed + 200 * MS)
    after = [due for due in recorder.dues(timer) if due > changed + 10 * MS]
    steps = [b - a for a, b in zip(after, after[1:])]
    assert on_grid(after, period_ms * MS)
    assert steps.count(period_ms * MS) > 0.7 * len(steps)  # not skipping, this machine willing
    assert len(steps) > 150 / period_ms * 0.7


def test_a_shortened_period_and_reset_are_noticed(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(30.0, nothing)
    intake.update([node])
    intake.start()
    time.sleep(0.05)
    timer.timer_period_ns = 10 * MS
    timer.reset()
    assert wait_for(lambda: recorder.timers, 0.3)


def test_a_timer_without_autostart_fires_once_it_is_reset(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.020, nothing, autostart=False)
    intake.update([node])
    intake.start()
    time.sleep(0.1)
    assert not recorder.timers
    timer.reset()
    assert wait_for(lambda: len(recorder.timers) >= 3)
    assert on_grid(recorder.dues(timer), 20 * MS)


def test_a_timer_without_period_fires_often_but_not_all_the_time(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    node.create_timer(0.0, nothing)
    intake.update([node])
    intake.start()
    time.sleep(0.5)
    assert 100 < len(recorder.timers) <= 501


def test_destroyed_timers_do_not_fire_and_new_ones_do(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    old = node.create_timer(0.010, nothing)
    intake.update([node])
    intake.start()
    assert wait_for(lambda: len(recorder.timers) >= 3)
    node.destroy_timer(old)  # the intake is not told
    time.sleep(0.02)
    count = len(recorder.timers)
    time.sleep(0.1)
    assert len(recorder.timers) == count
    new = node.create_timer(0.010, nothing)
    intake.update([node])
    assert wait_for(lambda: len(recorder.dues(new)) >= 3)
    assert len(recorder.dues(old)) == count


def test_the_grid_survives_other_timers_coming_and_going(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.010, nothing)
    intake.update([node])
    intake.start()
    for _ in range(50):
        other = node.create_timer(0.003, nothing)
        intake.update([node])
        time.sleep(0.010)
        node.destroy_timer(other)
        intake.update([node])
    assert len(recorder.dues(timer)) >= 30
    assert on_grid(recorder.dues(timer), 10 * MS)


def test_a_receiver_that_raises_does_not_end_the_timers(
    ros_context: Context, node: Node, recorder: Recorder
) -> None:
    def fail(*_: Any) -> None:
        raise ValueError('on purpose')

    recorder.react['timer'] = fail
    node.create_timer(0.010, nothing)
    intake = WaitSetIntake(ros_context, recorder, kinds={'timer'})
    intake.update([node])
    intake.start()
    try:
        assert wait_for(lambda: len(recorder.errors) >= 5)
    finally:
        intake.stop()
    assert {str(error) for error in recorder.errors} == {'on purpose'}


# --- timers: simulated time ----------------------------------------------------------------------


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
        self.intake.update([self.node])
        self.intake.start()
        assert matched(self._publisher)
        self.set(1000 * MS)

    def set(self, now: int) -> None:
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
            self.set(start + k * step)
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
    simulation.intake.update([simulation.node])
    time.sleep(0.2)
    assert simulation.fired() == 0  # paused
    start = time.monotonic_ns()
    now = simulation.run(1000 * MS, 50)
    assert simulation.fired() == 10
    dues = simulation.recorder.dues(timer)
    assert start < dues[0] and dues[-1] < time.monotonic_ns() and dues == sorted(dues)
    time.sleep(0.2)
    assert simulation.fired() == 10  # paused again
    simulation.set(now + 1000 * MS)
    assert simulation.fired() == 11  # one call for all that was missed


def test_simulated_time_that_jumps_back_does_not_stall_timers(simulation: Simulation) -> None:
    simulation.node.create_timer(0.050, nothing)
    simulation.intake.update([simulation.node])
    simulation.run(1000 * MS, 20)
    count = simulation.fired()
    assert count == 4
    simulation.set(100 * MS)
    assert simulation.fired() == count
    simulation.run(100 * MS, 50)
    assert simulation.fired() - count in (9, 10)


def test_a_timer_follows_its_clock_into_simulated_time_and_back(
    simulation: Simulation
) -> None:
    node, recorder = simulation.node, simulation.recorder
    timer = node.create_timer(0.020, nothing)
    simulation.intake.update([node])
    time.sleep(0.1)
    assert not recorder.timers
    node.set_parameters([Parameter('use_sim_time', value=False)])
    simulation.intake.update([node])
    assert wait_for(lambda: len(recorder.timers) >= 10)
    assert on_grid(recorder.dues(timer)[-8:], 20 * MS)
    node.set_parameters([Parameter('use_sim_time', value=True)])
    simulation.intake.update([node])
    time.sleep(0.05)
    count = len(recorder.timers)
    time.sleep(0.2)
    assert len(recorder.timers) == count


# --- poll ----------------------------------------------------------------------------------------


@pytest.fixture
def inline(ros_context: Context, recorder: Recorder) -> WaitSetIntake:
    return WaitSetIntake(ros_context, recorder)


def test_poll_returns_after_its_time_and_not_before(inline: WaitSetIntake, node: Node) -> None:
    inline.update([node])
    for timeout, least, most in ((0.0, 0.0, 0.1), (0.1, 0.1, 0.3)):
        start = time.monotonic()
        assert inline.poll(timeout) == 0
        assert least <= time.monotonic() - start < most


def test_poll_hands_over_what_is_ready(
    inline: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, lambda _: None, 10)
    publisher = node.create_publisher(String, name, 10)
    guard = node.create_guard_condition(nothing)
    timer = node.create_timer(0.010, nothing)
    timer.cancel()
    inline.update([node])
    assert matched(publisher)
    for k in range(3):
        publisher.publish(text(str(k)))
    assert wait_for(lambda: (inline.poll(0.0), len(recorder.messages) == 3)[1])
    assert recorder.texts(subscription) == ['0', '1', '2']
    guard.trigger()
    assert inline.poll(1.0) == 1 and recorder.guards == [guard]
    timer.reset()
    start = time.monotonic_ns()
    assert inline.poll(None) == 1
    assert abs(recorder.dues(timer)[0] - start - 10 * MS) < MS
    assert time.monotonic_ns() - start >= 9 * MS


def test_poll_ends_early_when_a_guard_condition_or_wake_says_so(
    ros_context: Context, node: Node, recorder: Recorder
) -> None:
    guard = GuardCondition(None, None, ros_context)
    inline = WaitSetIntake(ros_context, recorder, (guard,))
    inline.update([node])
    for ring in (guard.trigger, inline.wake):
        thread = threading.Timer(0.05, ring)
        thread.start()
        start = time.monotonic()
        assert inline.poll(5.0) == 0
        assert 0.04 < time.monotonic() - start < 1.0
        thread.join()
    assert not recorder.guards  # it is nobody's entity


def test_poll_holds_entities_no_longer_than_it_lasts(
    inline: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, lambda _: None, 10)
    inline.update([node])
    inline.poll(0.0)
    assert node.count_subscribers(name) == 1
    node.destroy_subscription(subscription)
    assert wait_for(lambda: node.count_subscribers(name) == 0)
    inline.poll(0.0)  # which has not been told
    assert not recorder.errors


def test_poll_and_start_exclude_each_other(inline: WaitSetIntake, node: Node) -> None:
    inline.update([node])
    inline.start()
    with pytest.raises(RuntimeError, match='thread of its own'):
        inline.poll(0.0)
    with pytest.raises(RuntimeError, match='runs already'):
        inline.start()
    inline.stop()
    assert inline.poll(0.0) == 0


def test_unknown_kinds_are_refused(ros_context: Context, recorder: Recorder) -> None:
    with pytest.raises(ValueError, match='timers'):
        WaitSetIntake(ros_context, recorder, kinds={'timers'})


# --- cost ----------------------------------------------------------------------------------------


def test_one_take_empties_a_queue_up_to_its_depth(
    inline: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, lambda _: None, 4)
    publisher = node.create_publisher(String, name, 20)
    inline.update([node])
    assert matched(publisher)
    for k in range(10):
        publisher.publish(text(str(k)))
    time.sleep(0.2)
    assert inline.poll(1.0) == 4
    assert recorder.texts(subscription) == ['6', '7', '8', '9']  # as the QoS says


def test_idle_timers_cost_little(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    for k in range(11):
        node.create_timer(1.0 + k, nothing)
    intake.update([node])
    intake.start()
    time.sleep(0.1)
    assert _cpu_for(intake_threads(), 0.5) < 50 * MS  # about 0.5 ms


def test_a_timer_wake_up_costs_little(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    for _ in range(11):
        node.create_timer(0.010, nothing)
    intake.update([node])
    intake.start()
    time.sleep(0.2)
    count = len(recorder.timers)
    cpu = _cpu_for(intake_threads(), 1.0)
    fired = len(recorder.timers) - count
    assert fired > 800
    assert cpu / fired < 100_000  # about 14 us, most of it the operating system's

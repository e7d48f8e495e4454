# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Timers of the intakes: due times and changes; against real rclpy."""

from __future__ import annotations

import threading
import time
from typing import Any

from mddag_executor.live.intake.timers import TimerQueue
from mddag_executor.live.intake.waitset import WaitSetIntake
import pytest
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.node import Node

from .helpers import (
    cpu_ns,
    intake_threads,
    look_after,
    MS,
    nothing,
    on_grid,
    Recorder,
    start,
    wait_for,
)


@pytest.fixture
def node(bare_node: Node) -> Node:
    return bare_node


@pytest.fixture
def intake(timer_intake: WaitSetIntake) -> WaitSetIntake:
    return timer_intake


def test_timers_that_come_due_meanwhile_are_of_the_same_round(
    node: Node, recorder: Recorder
) -> None:
    timers = [node.create_timer(0.010, nothing) for _ in range(2)]
    queue = TimerQueue(recorder, nothing)
    for _ in range(1000):  # until the two resets were not interrupted
        for timer in timers:
            timer.reset()
        queue.update(timers)
        first = queue.next_look() or 0
        time.sleep(0.0105)
        queue.fire(first)  # to this clock only the first one is due
        if recorder.rounds[-1] == 2 and recorder.timers[-1][1] > first:
            break
    assert recorder.rounds[-1] == 2


# --- the phase grid ------------------------------------------------------------------------------


@pytest.mark.parametrize('clock_type', [None, ClockType.STEADY_TIME, ClockType.SYSTEM_TIME])
def test_due_times_form_a_grid_although_the_receiver_stalls(
    intake: WaitSetIntake, node: Node, recorder: Recorder, clock_type: ClockType | None
) -> None:
    clock = None if clock_type is None else Clock(clock_type=clock_type)
    timer = node.create_timer(0.010, nothing, clock=clock)
    stalls = []

    def stall(_: Any, due: int) -> None:
        if len(recorder.timers) in (50, 100):
            begin = time.monotonic_ns()
            time.sleep(0.035)
            stalls.append((due, begin, time.monotonic_ns()))

    recorder.react['timer'] = stall
    start(intake, node)
    assert wait_for(lambda: len(recorder.timers) >= 150)
    dues = recorder.dues(timer)
    steps = [b - a for a, b in zip(dues, dues[1:])]
    # The grid may be anchored anew only for the clocks' drift: then a step is off by the
    # tolerance and a bit. Nearly all are exact.
    exact = sum(step % (10 * MS) == 0 for step in steps)
    assert exact >= len(steps) - 3
    assert all(min(step % (10 * MS), -step % (10 * MS)) < 100_000 for step in steps)
    for due, begin, end in stalls:
        # What became due first meanwhile comes next, and the others of that time never.
        after = [d for d in dues if d > due][:2]
        assert after[0] <= begin + 11 * MS
        assert after[1] >= end - MS
    assert all(due <= time.monotonic_ns() for due in dues)


def test_due_times_are_those_of_rcl(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.020, nothing)
    start(intake, node)
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
    start(intake, node)
    assert wait_for(lambda: len(late) > 500)
    late.sort()
    assert late[0] >= -1000  # never early, but for the measured phase
    assert late[len(late) // 10] < 1.5 * MS  # where the machine is not busy


def test_many_timers_wake_their_thread_for_those_due_only(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.010, nothing)
    start(intake, node)
    time.sleep(0.2)
    few = _cpu_for(intake_threads(), 0.5)
    for _ in range(300):
        node.create_timer(100.0, nothing)
    look_after(intake, node)
    time.sleep(0.2)
    many = _cpu_for(intake_threads(), 0.5)
    assert len(recorder.dues(timer)) > 80
    assert many < 4 * few + 45 * MS  # all of them at each wake-up: 150 ms at least


def _cpu_for(threads: list[threading.Thread], seconds: float) -> int:
    start = cpu_ns(threads)
    time.sleep(seconds)
    used: int = cpu_ns(threads) - start
    return used


# --- changes -------------------------------------------------------------------------------------


def test_a_cancelled_timer_does_not_fire_until_it_is_reset(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.030, nothing)
    start(intake, node)
    assert wait_for(lambda: len(recorder.timers) >= 3)
    late = []
    for _ in range(5):
        timer.cancel()
        time.sleep(0.05)
        count = len(recorder.timers)
        time.sleep(0.1)
        assert len(recorder.timers) == count
        before = time.monotonic_ns()
        timer.reset()
        after = time.monotonic_ns()
        assert wait_for(lambda count=count: len(recorder.timers) > count)
        due = recorder.timers[count][1]
        late.append(time.monotonic_ns() - due)
        assert before + 30 * MS - 50_000 <= due <= after + 30 * MS + 50_000
    assert sorted(late)[2] < 60 * MS  # nobody told the intake, and it is in time all the same


def test_a_timer_cancelled_for_a_moment_is_in_time_again(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.030, nothing)
    start(intake, node)
    late = []
    for _ in range(7):
        count = len(recorder.timers)
        assert wait_for(lambda count=count: len(recorder.timers) > count)
        timer.cancel()
        time.sleep(0.035)  # it was due, and has been found to be cancelled
        timer.reset()
        due = time.monotonic_ns() + 30 * MS
        count = len(recorder.timers)
        assert wait_for(lambda count=count: len(recorder.timers) > count)
        late.append(time.monotonic_ns() - due)
    assert sorted(late)[3] < 15 * MS


def test_a_timer_that_is_reset_again_and_again_does_not_fire(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.050, nothing)
    start(intake, node)
    for _ in range(30):
        timer.reset()
        time.sleep(0.010)
    assert not recorder.timers
    assert wait_for(lambda: recorder.timers)


def test_a_reset_moves_the_grid(intake: WaitSetIntake, node: Node, recorder: Recorder) -> None:
    timer = node.create_timer(0.020, nothing)
    start(intake, node)
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
    start(intake, node)
    assert wait_for(lambda: len(recorder.timers) >= 5)
    timer.timer_period_ns = period_ms * MS
    changed = time.monotonic_ns()
    assert wait_for(lambda: recorder.timers[-1][1] > changed + 200 * MS)
    after = [due for due in recorder.dues(timer) if due > changed + 10 * MS]
    steps = [b - a for a, b in zip(after, after[1:])]
    assert on_grid(after, period_ms * MS)
    assert min(steps) == period_ms * MS  # a busy machine skips some


def test_a_shortened_period_and_reset_are_noticed(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(30.0, nothing)
    start(intake, node)
    time.sleep(0.05)
    timer.timer_period_ns = 10 * MS
    timer.reset()
    assert wait_for(lambda: recorder.timers)


def test_a_timer_without_autostart_fires_once_it_is_reset(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.020, nothing, autostart=False)
    start(intake, node)
    time.sleep(0.1)
    assert not recorder.timers
    timer.reset()
    assert wait_for(lambda: len(recorder.timers) >= 3)
    assert on_grid(recorder.dues(timer), 20 * MS)


def test_a_timer_without_period_fires_often_but_not_all_the_time(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    node.create_timer(0.0, nothing)
    start(intake, node)
    time.sleep(0.5)
    assert 100 < len(recorder.timers) <= 501


def test_destroyed_timers_do_not_fire_and_new_ones_do(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    old = node.create_timer(0.010, nothing)
    start(intake, node)
    assert wait_for(lambda: len(recorder.timers) >= 3)
    node.destroy_timer(old)  # the intake is not told
    time.sleep(0.02)
    count = len(recorder.timers)
    time.sleep(0.1)
    assert len(recorder.timers) == count
    new = node.create_timer(0.010, nothing)
    look_after(intake, node)
    assert wait_for(lambda: len(recorder.dues(new)) >= 3)
    assert len(recorder.dues(old)) == count


def test_a_destroyed_timer_that_somebody_still_holds_does_not_fire(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.010, nothing)
    start(intake, node)
    assert wait_for(lambda: len(recorder.timers) >= 3)
    with timer.handle:
        node.destroy_timer(timer)
        time.sleep(0.020)
        count = len(recorder.timers)
        time.sleep(0.100)
        assert len(recorder.timers) == count


def test_the_grid_survives_other_timers_coming_and_going(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    timer = node.create_timer(0.010, nothing)
    start(intake, node)
    for _ in range(50):
        other = node.create_timer(0.003, nothing)
        look_after(intake, node)
        time.sleep(0.010)
        node.destroy_timer(other)
        look_after(intake, node)
    assert len(recorder.dues(timer)) >= 30
    assert on_grid(recorder.dues(timer), 10 * MS)


def test_a_receiver_that_raises_does_not_end_the_timers(
    ros_context: Context, node: Node, recorder: Recorder
) -> None:
    def fail(*_: Any) -> None:
        raise ValueError('on purpose')

    recorder.react['timer'] = fail
    node.create_timer(0.010, nothing)
    intake = WaitSetIntake(ros_context, recorder, kinds={'timers'})
    start(intake, node)
    try:
        assert wait_for(lambda: len(recorder.errors) >= 5)
    finally:
        intake.stop()
    assert {str(error) for error in recorder.errors} == {'on purpose'}


# --- cost ----------------------------------------------------------------------------------------


def test_idle_timers_cost_little(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    for k in range(11):
        node.create_timer(1.0 + k, nothing)
    start(intake, node)
    time.sleep(0.1)
    assert _cpu_for(intake_threads(), 0.5) < 50 * MS  # about 0.5 ms


def test_a_timer_wake_up_costs_little(
    intake: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    for _ in range(11):
        node.create_timer(0.010, nothing)
    start(intake, node)
    time.sleep(0.2)
    count = len(recorder.timers)
    cpu = _cpu_for(intake_threads(), 1.0)
    fired = len(recorder.timers) - count
    assert fired > 100  # 1100 where the machine is not busy
    assert cpu / fired < 100_000  # about 14 us, most of it the operating system's

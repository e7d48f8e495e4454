# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Warnings about timers that cannot keep their rate (rclpy#1126)."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

from mddag_executor.live.rates import AGAIN_S, LOOK_S, RateWatch
from msg_graph import loads

from .conftest import Spinning, wait_for


class Timer:
    """A timer as far as the watch looks at it."""

    def __init__(self) -> None:
        self.node = '/node'
        self.rclpy = SimpleNamespace(timer_period_ns=10_000_000)
        self.skipped = self.ran = self.busy_ns = 0
        self.gate: Any = None

    def run(self, ran: int, skipped: int) -> None:
        self.ran += ran
        self.skipped += skipped
        self.busy_ns += ran * 25_000_000


def make_watch(*timers: Any) -> tuple[RateWatch, list[str], list[float]]:
    warnings: list[str] = []
    now = [100.0]
    registry: Any = SimpleNamespace(timers=lambda: list(timers))
    return RateWatch(registry, warnings.append, lambda: now[0]), warnings, now


def test_the_first_warning_comes_at_once_and_has_the_figures():
    timer = Timer()
    watch, warnings, now = make_watch(timer, Timer())
    watch.look()
    timer.run(ran=10, skipped=15)
    now[0] += LOOK_S
    watch.look()
    assert warnings == [
        'the timer of /node with a period of 10 ms cannot keep its rate: 15 of 25 periods were '
        'skipped within 0.5 s, its callback takes 25 ms']


def test_further_warnings_are_throttled_and_have_what_came_since():
    timer = Timer()
    watch, warnings, now = make_watch(timer)
    watch.look()
    times = []
    for _ in range(int(100 / LOOK_S)):
        timer.run(ran=1, skipped=1)
        now[0] += LOOK_S
        watch.look()
        if len(warnings) > len(times):
            times.append(now[0])
    assert [round(b - a) for a, b in zip(times, times[1:])] == [AGAIN_S, 2 * AGAIN_S, 4 * AGAIN_S]
    assert '20 of 40 periods' in warnings[1] and 'within 10.0 s' in warnings[1]


def test_a_timer_that_keeps_its_rate_is_not_warned_of():
    timer = Timer()
    watch, warnings, now = make_watch(timer)
    for _ in range(10):
        timer.run(ran=50, skipped=0)
        now[0] += LOOK_S
        watch.look()
    assert warnings == []


def test_a_timer_that_its_callback_group_slows_down_is_not_warned_of():
    timer = Timer()
    timer.gate = object()
    watch, warnings, now = make_watch(timer)
    watch.look()
    timer.run(ran=10, skipped=15)
    now[0] += LOOK_S
    watch.look()
    assert warnings == []


def test_a_period_skipped_now_and_then_is_no_reason_to_warn():
    timer = Timer()
    watch, warnings, now = make_watch(timer)
    for i in range(200):
        timer.run(ran=50, skipped=i % 10 == 0)
        now[0] += LOOK_S
        watch.look()
    assert warnings == []
    timer.run(ran=50, skipped=100)
    now[0] += LOOK_S
    watch.look()
    assert len(warnings) == 1


def test_it_looks_no_more_often_than_it_should():
    looks = []
    registry: Any = SimpleNamespace(timers=lambda: looks.append(1) or [])
    now = [0.0]
    watch = RateWatch(registry, clock=lambda: now[0])
    for _ in range(10):
        watch.look()
    assert len(looks) == 1


def test_an_executor_warns_once_of_a_slow_timer_and_counts_what_it_skips(
        make_executor, make_node, capfd):
    node = make_node('slow')
    starts: list[float] = []

    def body() -> None:
        starts.append(time.monotonic())
        time.sleep(0.035)

    node.create_timer(0.01, body)
    executor = make_executor()
    executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: len(starts) >= 40)
    text = capfd.readouterr().err
    assert text.count('cannot keep its rate') == 1
    assert 'the timer of /slow with a period of 10 ms' in text
    counts = executor.statistics()['callbacks']['/slow: body (timer 10ms)']
    # one runs, one waits: of each 35 ms there are one or two periods that nothing comes of
    assert counts['skipped'] + counts['ran'] + counts['waiting'] > 2 * counts['ran']


def test_periods_that_pass_while_nobody_looks_are_counted_and_their_jobs_are_late(
        make_executor, make_node):
    """As after a suspended machine: the timer goes on in phase, without a burst."""
    graph = loads("""
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 10ms, dag: alone, deadline: 5ms}]
""")
    node = make_node('source')
    runs: list[float] = []
    node.create_timer(0.01, lambda: runs.append(time.monotonic()))
    executor = make_executor(graph, num_workers=1)
    executor.add_node(node)
    begin = time.monotonic()
    executor.spin_once(1.0)
    time.sleep(0.1)
    executor.spin_once(1.0)
    executor.spin_once(0.0)
    periods = (time.monotonic() - begin) / 0.01
    assert executor.shutdown(5.0)
    assert 2 <= len(runs) <= 3
    statistics = executor.statistics()
    skipped = statistics['callbacks']['/source:tick']['skipped']
    assert 8 <= skipped <= periods
    dag = statistics['dags']['alone']
    assert dag['jobs'] == skipped + statistics['callbacks']['/source:tick']['ready']
    assert dag['ends']['expired'] >= skipped


def test_a_timer_that_gets_its_declared_period_later_is_the_declared_one(
    make_executor: Any, make_node: Any
) -> None:
    executor = make_executor(loads(
        'mddag: 1\nnodes: [{node: /node, callbacks: '
        '[{name: tick, timer: 20ms, dag: tick, deadline: 20ms}]}]'))
    node = make_node('node')
    executor.add_node(node)
    timer = node.create_timer(0.05, lambda: None)
    with Spinning(executor):
        assert wait_for(lambda: executor.statistics()['callbacks'].get(
            '/node: <lambda> (timer 50ms)', {}).get('ran', 0) >= 2)
        timer.timer_period_ns = 20_000_000
        assert wait_for(lambda: executor.statistics()['dags']['tick']['jobs'] >= 2)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots of entities, and polling a wait set, against real rclpy."""

from __future__ import annotations

import threading
import time
from typing import Any

from mddag_executor.live.intake.entities import snapshot
from mddag_executor.live.intake.waitset import WaitSetIntake
import pytest
from rclpy.context import Context
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from std_msgs.msg import String

from .helpers import (
    look_after,
    make_node,
    matched,
    MS,
    nothing,
    Recorder,
    text,
    topic,
    wait_for,
)


@pytest.fixture
def node(bare_node: Node) -> Node:
    return bare_node


@pytest.fixture
def intake(timer_intake: WaitSetIntake) -> WaitSetIntake:
    return timer_intake


# --- snapshots -----------------------------------------------------------------------------------


def test_a_snapshot_has_every_entity_and_its_node(ros_context: Context) -> None:
    a, b = make_node(ros_context), make_node(ros_context)
    timer = a.create_timer(1.0, nothing)
    guard = b.create_guard_condition(nothing)
    subscription = b.create_subscription(String, topic(), lambda _: None, 10)
    seen = snapshot([a, b])
    assert seen.timers == [timer] and seen.guards == [guard]
    assert subscription in seen.subscriptions
    assert set(seen.services) == {*a.services, *b.services}
    assert set(seen.logged_events) == {*a.waitables, *b.waitables} and not seen.events
    assert not seen.waitables and seen.nodes == [a, b]


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


def test_a_snapshot_has_what_follows_something_that_is_destroyed_meanwhile(
    ros_context: Context,
) -> None:
    class Busy(Node):

        @property
        def guards(self) -> Any:
            for guard in super().guards:
                yield guard
                self.destroy_guard_condition(first)  # as another thread would do it

    node = Busy('busy', context=ros_context)
    first, second = (node.create_guard_condition(nothing) for _ in range(2))
    assert snapshot([node]).guards == [second]
    node.destroy_node()


def test_comparing_a_thousand_entities_is_cheap(ros_context: Context) -> None:
    nodes = [make_node(ros_context) for _ in range(8)]
    for made in nodes:
        for _ in range(125):
            made.create_guard_condition(nothing)
    first = snapshot(nodes)
    assert len(first.guards) >= 1000
    best = min(_seconds(lambda: snapshot(nodes, first)) for _ in range(5))
    assert best < 0.002  # about 0.1 ms


def _seconds(function: Any) -> float:
    start = time.thread_time()
    function()
    return time.thread_time() - start


# --- poll ----------------------------------------------------------------------------------------


@pytest.fixture
def inline(ros_context: Context, recorder: Recorder) -> WaitSetIntake:
    return WaitSetIntake(ros_context, recorder)


def test_poll_returns_after_its_time_and_not_before(inline: WaitSetIntake, node: Node) -> None:
    look_after(inline, node)
    assert inline.poll(0.0) == 0
    start = time.monotonic()
    assert inline.poll(0.1) == 0
    assert time.monotonic() - start >= 0.1


def test_poll_hands_over_what_is_ready(
    inline: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, lambda _: None, 10)
    publisher = node.create_publisher(String, name, 10)
    guard = node.create_guard_condition(nothing)
    timer = node.create_timer(0.010, nothing)
    timer.cancel()
    look_after(inline, node)
    assert matched(publisher)
    for k in range(3):
        publisher.publish(text(str(k)))
    assert wait_for(lambda: (inline.poll(0.0), len(recorder.messages) == 3)[1])
    assert recorder.texts(subscription) == ['0', '1', '2']
    guard.trigger()
    assert inline.poll(1.0) == 1 and recorder.guards == [guard]
    before = time.monotonic_ns()
    timer.reset()
    after = time.monotonic_ns()
    assert inline.poll(None) == 1
    assert before <= recorder.dues(timer)[0] - 10 * MS <= after
    assert time.monotonic_ns() >= recorder.dues(timer)[0]


def test_poll_ends_early_when_a_guard_condition_or_wake_says_so(
    ros_context: Context, node: Node, recorder: Recorder
) -> None:
    guard = GuardCondition(None, None, ros_context)
    inline = WaitSetIntake(ros_context, recorder, (guard,))
    look_after(inline, node)
    for ring in (guard.trigger, inline.wake):
        thread = threading.Timer(0.05, ring)
        thread.start()
        start = time.monotonic()
        assert inline.poll(60.0) == 0
        assert time.monotonic() - start < 30.0
        thread.join()
    assert not recorder.guards  # it is nobody's entity


def test_poll_holds_entities_no_longer_than_it_lasts(
    inline: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, lambda _: None, 10)
    look_after(inline, node)
    inline.poll(0.0)
    assert node.count_subscribers(name) == 1
    node.destroy_subscription(subscription)
    assert wait_for(lambda: node.count_subscribers(name) == 0)
    inline.poll(0.0)  # which has not been told
    assert not recorder.errors


# --- cost ----------------------------------------------------------------------------------------


def test_one_take_empties_a_queue_up_to_its_depth(
    inline: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, lambda _: None, 4)
    publisher = node.create_publisher(String, name, 20)
    look_after(inline, node)
    assert matched(publisher)
    for k in range(10):
        publisher.publish(text(str(k)))
    time.sleep(0.2)
    assert inline.poll(1.0) == 4
    assert recorder.texts(subscription) == ['6', '7', '8', '9']  # as the QoS says


def test_a_topic_that_never_rests_does_not_keep_a_poll_for_itself(
    inline: WaitSetIntake, node: Node, recorder: Recorder
) -> None:
    name = topic()
    node.create_subscription(String, name, lambda _: None, 4)
    publisher = node.create_publisher(String, name, 20)

    def answer(*_: Any) -> None:
        publisher.publish(text(''))
        time.sleep(0.010)

    recorder.react['message'] = answer
    look_after(inline, node)
    assert matched(publisher)
    publisher.publish(text(''))
    assert 1 <= inline.poll(1.0) <= 4

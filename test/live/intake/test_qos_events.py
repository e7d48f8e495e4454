# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""QoS events through all intakes, against real rclpy."""

from __future__ import annotations

import time
from typing import Any

from mddag_executor.live.intake.events import EventsIntake
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from std_msgs.msg import String

from .helpers import (
    cpu_ns,
    intake_threads,
    matched,
    MS,
    nothing,
    Recorder,
    start,
    text,
    topic,
    wait_for,
)

# --- QoS events ----------------------------------------------------------------------------------


def _events(recorder: Recorder) -> list[str]:
    return [w.event_type.name.split('RCL_')[1] for w, _ in recorder.waitables]


def test_qos_events_come_once(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    qos = QoSProfile(
        depth=10, deadline=Duration(nanoseconds=100 * MS),
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(nanoseconds=300 * MS))
    node.create_subscription(
        String, name, nothing, qos, event_callbacks=SubscriptionEventCallbacks(
            deadline=nothing, liveliness=nothing, matched=nothing))
    start(intake, node)
    publisher = other.create_publisher(String, name, qos)
    assert matched(publisher)
    publisher.publish(text(''))
    want = {'SUBSCRIPTION_REQUESTED_DEADLINE_MISSED', 'SUBSCRIPTION_LIVELINESS_CHANGED',
            'SUBSCRIPTION_MATCHED'}
    assert wait_for(lambda: want <= set(_events(recorder)))
    assert all(data is not None for _, data in recorder.waitables)
    first = next(
        d for w, d in recorder.waitables if 'MATCHED' in w.event_type.name)
    assert first.current_count == 1 and first.current_count_change == 1
    count = len([d for w, d in recorder.waitables if 'MATCHED' in w.event_type.name])
    assert count == 1
    other.destroy_publisher(publisher)
    assert wait_for(lambda: [
        d.current_count for w, d in recorder.waitables
        if 'MATCHED' in w.event_type.name] == [1, 0])
    assert not recorder.errors


def test_incompatible_qos_is_noticed_on_both_sides(
    intake: Any, node: Node, recorder: Recorder
) -> None:
    name = topic()
    node.create_subscription(String, name, nothing, QoSProfile(
        depth=1, reliability=ReliabilityPolicy.RELIABLE))
    start(intake, node)
    node.create_publisher(
        String, name, QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
        event_callbacks=PublisherEventCallbacks(incompatible_qos=nothing))
    intake.update([node])
    assert wait_for(lambda: set(_events(recorder)) == {
        'SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS', 'PUBLISHER_OFFERED_INCOMPATIBLE_QOS'})
    time.sleep(0.2)
    assert len(recorder.waitables) == 2


def test_messages_do_not_wake_whoever_waits_for_qos_events(
    ros_context: Context, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    node.create_subscription(String, name, nothing, 10)
    publisher = other.create_publisher(String, name, 10)
    intake = EventsIntake(ros_context, recorder)
    start(intake, node)
    try:
        assert matched(publisher)
        threads = [t for t in intake_threads() if t.name.endswith('waitables')]
        assert threads
        before = cpu_ns(threads)
        for _ in range(200):
            publisher.publish(text(''))
            time.sleep(0.001)
        assert wait_for(lambda: len(recorder.messages) == 200)
        assert cpu_ns(threads) - before < 5 * MS
    finally:
        intake.stop()

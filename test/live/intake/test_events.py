# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""All intakes on every kind of entity, and that they do the same, against real rclpy."""

from __future__ import annotations

import random
import time
from typing import Any

import pytest
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
)
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

from .helpers import (
    INTAKES,
    make_intake,
    make_node,
    matched,
    MS,
    nothing,
    Pulse,
    Recorder,
    start,
    text,
    topic,
    wait_for,
)

# --- every kind ----------------------------------------------------------------------------------


def test_messages_come_with_their_info(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, nothing, 10)
    publisher = other.create_publisher(String, name, 10)
    start(intake, node)
    assert matched(publisher)
    before = time.time_ns()
    for k in range(5):
        publisher.publish(text(str(k)))
    assert wait_for(lambda: len(recorder.messages) == 5)
    assert recorder.texts(subscription) == ['0', '1', '2', '3', '4']
    for got, message, info in recorder.messages:
        assert got is subscription and isinstance(message, String)
        assert before - MS < info['source_timestamp'] < time.time_ns()
        assert info['received_timestamp'] > 0
    assert not recorder.errors


def test_raw_subscriptions_get_bytes(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    node.create_subscription(String, name, nothing, 10, raw=True)
    publisher = other.create_publisher(String, name, 10)
    start(intake, node)
    assert matched(publisher)
    publisher.publish(text('raw'))
    assert wait_for(lambda: recorder.messages)
    assert recorder.messages[0][1] == serialize_message(text('raw'))


@pytest.mark.parametrize('history', [HistoryPolicy.KEEP_ALL, HistoryPolicy.KEEP_LAST])
def test_messages_from_before_the_start_are_not_lost(
    intake: Any, node: Node, other: Node, recorder: Recorder, history: HistoryPolicy
) -> None:
    name = topic()
    qos = QoSProfile(
        depth=10, history=history, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = other.create_publisher(String, name, qos)
    for k in range(5):
        publisher.publish(text(str(k)))
    subscription = node.create_subscription(String, name, nothing, qos)
    assert matched(publisher)
    time.sleep(0.1)
    start(intake, node)
    assert wait_for(lambda: len(recorder.messages) == 5)
    publisher.publish(text('5'))
    assert wait_for(lambda: len(recorder.messages) == 6)
    assert recorder.texts(subscription) == ['0', '1', '2', '3', '4', '5']


def test_waitables_are_taken_right_after_they_are_ready(
    intake: Any, node: Node, recorder: Recorder
) -> None:
    pulses = [Pulse(node, node.default_callback_group) for _ in range(2)]
    for pulse in pulses:
        node.add_waitable(pulse)
    start(intake, node)
    time.sleep(0.05)
    for k in range(3):
        pulses[1].guard.trigger()
        assert wait_for(lambda k=k: len(recorder.waitables) == k + 1)
    assert [w for w, _ in recorder.waitables] == [pulses[1]] * 3
    assert [data for _, data in recorder.waitables] == [2, 4, 6]
    assert pulses[1].order == ['ready', 'take'] * 3 and not pulses[0].order
    for pulse in pulses:
        pulse.guard.destroy()


# --- the same from all ---------------------------------------------------------------------------


def test_all_intakes_hand_over_the_same(ros_context: Context, other: Node) -> None:
    """Send one load to a node of each intake, and compare what comes out."""
    names = [topic() for _ in range(4)]
    parts = []
    futures: list[list[Any]] = [[] for _ in INTAKES]
    for kind in INTAKES:
        node, recorder = make_node(ros_context), Recorder()
        recorder.react['request'] = lambda _, request, respond: respond(
            SetBool.Response(success=request.data))
        subscriptions = [
            node.create_subscription(String, name, nothing, depth, raw=depth == 5)
            for name, depth in zip(names, (100, 50, 5, 1))]
        service = node.create_service(SetBool, f'{names[0]}_{kind}', nothing)
        client = node.create_client(SetBool, f'{names[0]}_{kind}')
        timer = node.create_timer(0.020, nothing)
        intake = make_intake(kind, ros_context, recorder)
        parts.append((intake, recorder, node, subscriptions, service, client, timer))
    publishers = [other.create_publisher(String, name, 100) for name in names]
    for part in parts:
        start(part[0], part[2])
    try:
        for publisher in publishers:
            assert matched(publisher, len(INTAKES))
        for part in parts:
            assert part[5].wait_for_service(5.0)
        draw = random.Random(3)
        for k in range(200):
            draw.choice(publishers).publish(text(str(k)))
            if k % 20 == 0:
                for part, asked in zip(parts, futures):
                    asked.append(part[5].call_async(SetBool.Request(data=k % 40 == 0)))
            # The queue of one of them has room for one message.
            assert wait_for(lambda: all(len(part[1].messages) > k for part in parts))  # noqa: B023
        assert wait_for(lambda: all(future.done() for asked in futures for future in asked))
        summaries = []
        for (_, recorder, _, subscriptions, _, _, timer), asked in zip(parts, futures):
            messages = [
                [(m if isinstance(m, bytes) else m.data, info['source_timestamp'])
                 for s, m, info in recorder.messages if s is subscription]
                for subscription in subscriptions]
            dues = recorder.dues(timer)
            assert all((b - a) % (20 * MS) == 0 for a, b in zip(dues, dues[1:]))
            assert not recorder.errors
            summaries.append((
                messages, [r.data for _, r in recorder.requests],
                [future.result().success for future in asked]))
        assert sum(map(len, summaries[0][0])) == 200 and len(summaries[0][2]) == 10
        assert summaries[0] == summaries[1] == summaries[2]
    finally:
        for part in parts:
            part[0].stop()
            part[2].destroy_node()

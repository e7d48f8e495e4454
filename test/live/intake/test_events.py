# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""All intakes on every kind of entity, and that they do the same, against real rclpy."""

from __future__ import annotations

import random
import threading
import time
from typing import Any

from mddag_executor.live.intake.events import EventsIntake
import pytest
from rclpy.action.client import ActionClient
from rclpy.action.server import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
)
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

from .helpers import (
    FakeExecutor,
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


def test_it_is_available() -> None:
    assert EventsIntake.available()


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


def test_services_and_clients(intake: Any, node: Node, recorder: Recorder) -> None:
    name = topic()
    service = node.create_service(SetBool, name, nothing)
    client = node.create_client(SetBool, name)
    start(intake, node)
    assert client.wait_for_service(5.0)

    recorder.react['request'] = lambda _, request, respond: respond(
        SetBool.Response(success=not request.data))
    for _ in range(5):  # five at once: a service keeps no more than ten
        futures = [client.call_async(SetBool.Request(data=bool(k % 2))) for k in range(5)]
        assert wait_for(lambda futures=futures: all(future.done() for future in futures))
        assert [f.result().success for f in futures] == [True, False, True, False, True]
    assert {id(s) for s, _ in recorder.requests} == {id(service)}
    assert not recorder.errors


def test_guard_conditions(intake: Any, node: Node, recorder: Recorder) -> None:
    guards = [node.create_guard_condition(nothing) for _ in range(3)]
    start(intake, node)
    time.sleep(0.05)
    for guard in guards:
        guard.trigger()
        assert wait_for(lambda guard=guard: guard in recorder.guards)
    time.sleep(0.05)
    assert recorder.guards == guards


def test_timers_of_both_kinds_of_threads(intake: Any, node: Node, recorder: Recorder) -> None:
    timer = node.create_timer(0.010, nothing)
    node.create_guard_condition(nothing)
    start(intake, node)
    assert wait_for(lambda: len(recorder.timers) >= 30)
    dues = recorder.dues(timer)
    assert all((b - a) % (10 * MS) == 0 for a, b in zip(dues, dues[1:]))


def test_parameter_services(intake: Any, node: Node, other: Node, recorder: Recorder) -> None:
    node.declare_parameter('size', 3)
    client = AsyncParameterClient(other, node.get_name())
    recorder.react['request'] = lambda service, request, respond: respond(
        service.callback(request, service.srv_type.Response()))
    start(intake, node, other)
    assert client.wait_for_services(5.0)
    future = client.get_parameters(['size'])
    assert wait_for(future.done)
    assert future.result().values[0].integer_value == 3
    future = client.list_parameters()
    assert wait_for(future.done)
    assert 'size' in future.result().result.names


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


def _run_waitables_in_order(executor: FakeExecutor, recorder: Recorder) -> None:
    """Execute what waitables have taken, each one's in order, and answer nothing else."""
    locks: dict[int, threading.Lock] = {}

    def execute(waitable: Any, function: Any, data: Any) -> None:
        with locks.setdefault(id(waitable), threading.Lock()):
            executor.run(function, data)

    recorder.react['waitable'] = execute


def test_actions(intake: Any, ros_context: Context, recorder: Recorder) -> None:
    node = make_node(ros_context)
    executor = FakeExecutor(intake)
    node.executor = executor
    _run_waitables_in_order(executor, recorder)
    name = topic()
    feedback: list[tuple[int, int]] = []
    wait_for_cancel = threading.Event()

    def run(goal: Any) -> Fibonacci.Result:
        for k in range(goal.request.order):
            goal.publish_feedback(Fibonacci.Feedback(sequence=[goal.request.order, k]))
        if goal.request.order == 7:
            assert wait_for_cancel.wait(5.0) and wait_for(lambda: goal.is_cancel_requested)
            goal.canceled()
            return Fibonacci.Result()
        goal.succeed()
        return Fibonacci.Result(sequence=[goal.request.order] * 2)

    group = ReentrantCallbackGroup()
    server = ActionServer(
        node, Fibonacci, name, run, callback_group=group,
        cancel_callback=lambda _: CancelResponse.ACCEPT,
        feedback_pub_qos_profile=QoSProfile(depth=20))
    client = ActionClient(
        node, Fibonacci, name, callback_group=group,
        feedback_sub_qos_profile=QoSProfile(depth=20))
    intake.start()
    try:
        assert wait_for(client.server_is_ready)
        goals = [
            client.send_goal_async(
                Fibonacci.Goal(order=order),
                feedback_callback=lambda m: feedback.append(tuple(m.feedback.sequence)))
            for order in (1, 2, 3, 7)]
        assert wait_for(lambda: all(goal.done() for goal in goals))
        assert all(goal.result().accepted for goal in goals)
        results = [goal.result().get_result_async() for goal in goals]
        assert wait_for(lambda: all(result.done() for result in results[:3]))
        assert [list(r.result().result.sequence) for r in results[:3]] == [[1, 1], [2, 2], [3, 3]]
        assert not results[3].done()
        cancel = goals[3].result().cancel_goal_async()
        wait_for_cancel.set()
        assert wait_for(lambda: cancel.done() and results[3].done())
        assert len(cancel.result().goals_canceling) == 1
        assert wait_for(lambda: len(feedback) == 13)
        for order in (1, 2, 3, 7):
            assert [k for o, k in feedback if o == order] == list(range(order))
        assert not executor.errors and not recorder.errors
    finally:
        client.destroy()
        server.destroy()
        intake.stop()
        node.destroy_node()


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

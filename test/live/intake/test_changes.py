# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Intakes while entities come and go, start, stop and end, against real rclpy."""

from __future__ import annotations

import random
import threading
import time
from typing import Any

from mddag_executor.live.intake.entities import snapshot
from mddag_executor.live.intake.events import EventsIntake
from mddag_executor.live.intake.waitset import WaitSetIntake
import pytest
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool

from .helpers import (
    cpu_ns,
    intake_threads,
    INTAKES,
    look_after,
    make_intake,
    make_node,
    matched,
    MS,
    nothing,
    Recorder,
    start,
    text,
    THREADED,
    topic,
    wait_for,
)

# --- coming and going ----------------------------------------------------------------------------


def test_entities_come_and_go_while_it_runs(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    start(intake)
    for k in range(5):
        name = topic()
        publisher = other.create_publisher(String, name, 10)
        subscription = node.create_subscription(String, name, nothing, 10)
        look_after(intake, node)
        assert matched(publisher)
        publisher.publish(text(str(k)))
        assert wait_for(lambda s=subscription, k=k: recorder.texts(s) == [str(k)])
        node.destroy_subscription(subscription)
        look_after(intake, node)
        assert wait_for(lambda name=name: node.count_subscribers(name) == 0)
        publisher.publish(text('late'))
    look_after(intake)
    time.sleep(0.05)
    assert len(recorder.messages) == 5 and not recorder.errors


def test_nothing_is_handed_over_for_what_was_removed(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, nothing, 10)
    publisher = other.create_publisher(String, name, 10)
    stop = threading.Event()

    def flood() -> None:
        while not stop.is_set():
            publisher.publish(text(''))
            time.sleep(0.0002)

    start(intake, node)
    assert matched(publisher)
    flooding = threading.Thread(target=flood)
    flooding.start()
    try:
        assert wait_for(lambda: len(recorder.messages) > 50)
        look_after(intake)
        time.sleep(0.1)
        count = len(recorder.messages)
        time.sleep(0.1)
        assert len(recorder.messages) == count
        look_after(intake, node)
        assert wait_for(lambda: len(recorder.messages) > count + 50)
        node.destroy_subscription(subscription)
        look_after(intake, node)
        time.sleep(0.1)
        count = len(recorder.messages)
        time.sleep(0.1)
        assert len(recorder.messages) == count
    finally:
        stop.set()
        flooding.join()
    assert not recorder.errors


def test_all_is_destroyed_before_it_is_looked_at(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    for _ in range(3):
        node.create_subscription(String, name, nothing, 10)
    entities = snapshot([node])
    assert entities.logged_events
    node.destroy_node()
    start(intake)
    intake.update(entities)
    time.sleep(0.2)
    assert not recorder.errors
    other.create_subscription(String, name, nothing, 10)
    publisher = other.create_publisher(String, name, 10)
    look_after(intake, other)
    assert matched(publisher)
    publisher.publish(text('goes on'))
    assert wait_for(lambda: recorder.messages)
    assert not recorder.errors


@pytest.mark.parametrize('kind', INTAKES)
def test_a_storm_of_destruction(kind: str, ros_context: Context, recorder: Recorder) -> None:
    """Create and destroy everything at random while messages and requests pour in."""
    intake = make_intake(kind, ros_context, recorder)
    source = make_node(ros_context, start_parameter_services=False, enable_rosout=False)
    names = [topic() for _ in range(3)]
    publishers = [source.create_publisher(String, name, 10) for name in names]
    clients = [source.create_client(SetBool, name) for name in names]
    stop = threading.Event()
    responses: list[Any] = []

    def pour() -> None:
        while not stop.is_set():
            for publisher in publishers:
                publisher.publish(text('x'))
            for client in clients:
                client.call_async(SetBool.Request()).add_done_callback(responses.append)
            time.sleep(0.0005)

    def answer(_: Any, request: Any, respond: Any) -> None:
        try:
            respond(SetBool.Response())
        except InvalidHandle:
            pass

    recorder.react['request'] = answer
    draw = random.Random(7)
    nodes: list[Node] = []
    start(intake, source)
    pouring = threading.Thread(target=pour)
    pouring.start()
    made = 0
    try:
        end = time.monotonic() + 3.0
        while time.monotonic() < end:
            if len(nodes) < 2:
                nodes.append(make_node(
                    ros_context, start_parameter_services=False, enable_rosout=False))
            node = draw.choice(nodes)
            for name in names:
                node.create_subscription(String, name, nothing, 10)
                node.create_service(SetBool, name, nothing)
                node.create_client(SetBool, name)
                made += 3
            node.create_timer(0.001, nothing)
            node.create_guard_condition(nothing).trigger()
            if draw.random() < 0.5:
                look_after(intake, source, *nodes)
            if draw.random() < 0.5:
                time.sleep(draw.random() * 0.005)
            pairs: list[tuple[list[Any], Any]] = [
                (list(node.subscriptions), node.destroy_subscription),
                (list(node.services), node.destroy_service),
                (list(node.clients), node.destroy_client),
                (list(node.timers), node.destroy_timer),
                (list(node.guards), node.destroy_guard_condition),
            ]
            for some, destroy in pairs:
                for entity in draw.sample(some, min(3, len(some))):
                    destroy(entity)
            if draw.random() < 0.1:
                nodes.remove(node)
                node.destroy_node()
            if draw.random() < 0.7:
                look_after(intake, source, *nodes)
            if draw.random() < 0.05:
                intake.stop()
                intake = make_intake(kind, ros_context, recorder)
                start(intake, source, *nodes)
    finally:
        stop.set()
        pouring.join()
        intake.stop()
        for node in (source, *nodes):
            node.destroy_node()
    assert made > 100
    assert recorder.messages and recorder.requests and responses
    assert recorder.timers and recorder.guards
    # A destroyed entity is no error; a response may come for a request of a former client.
    assert not recorder.errors


@pytest.mark.parametrize('kind', INTAKES)
def test_one_intake_after_the_other_loses_nothing(
    kind: str, ros_context: Context, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, nothing, 200)
    publisher = other.create_publisher(String, name, 200)
    assert matched(publisher)
    sent = 0
    for _ in range(5):
        intake = make_intake(kind, ros_context, recorder)
        start(intake, node)
        for _ in range(20):
            publisher.publish(text(str(sent)))
            sent += 1
        intake.stop()
        assert not intake_threads()
        for _ in range(3):
            publisher.publish(text(str(sent)))
            sent += 1
        time.sleep(0.01)
    intake = make_intake(kind, ros_context, recorder)
    start(intake, node)
    assert wait_for(lambda: len(recorder.messages) == sent)
    # Nothing lags behind: the next one comes as soon as it is sent.
    publisher.publish(text(str(sent)))
    assert wait_for(lambda: len(recorder.messages) == sent + 1)
    intake.stop()
    assert recorder.texts(subscription) == [str(k) for k in range(sent + 1)]


@pytest.mark.parametrize('kind', THREADED)
def test_stopping_is_prompt_and_allowed_in_any_state(
    kind: str, ros_context: Context, node: Node, recorder: Recorder
) -> None:
    node.create_timer(100.0, nothing)
    intake = make_intake(kind, ros_context, recorder)
    intake.stop()
    start(intake, node)
    begin = time.monotonic()
    intake.stop()
    assert time.monotonic() - begin < 20  # the timer's period is 100 s
    intake.stop()
    assert not intake_threads()


@pytest.mark.parametrize('kind', THREADED)
def test_a_receiver_may_stop_the_intake(
    kind: str, ros_context: Context, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    node.create_subscription(String, name, nothing, 10)
    publisher = other.create_publisher(String, name, 10)
    intake = make_intake(kind, ros_context, recorder)
    recorder.react['message'] = lambda *_: intake.stop()
    start(intake, node)
    assert matched(publisher)
    publisher.publish(text('first'))
    assert wait_for(lambda: recorder.messages and not intake_threads())
    assert not recorder.errors


@pytest.mark.parametrize('kind', THREADED)
def test_it_ends_with_its_context(
    kind: str, ros_context: Context, recorder: Recorder
) -> None:
    node = make_node(ros_context)
    node.create_timer(100.0, nothing)
    node.create_guard_condition(nothing)
    intake = make_intake(kind, ros_context, recorder)
    start(intake, node)
    time.sleep(0.05)
    ros_context.shutdown()
    assert wait_for(lambda: not intake_threads())
    intake.stop()
    node.destroy_node()
    assert not recorder.errors


@pytest.mark.parametrize('kind', THREADED)
def test_it_ends_with_a_context_that_ends_after_the_wake_up(
    kind: str, ros_context: Context, recorder: Recorder
) -> None:
    """As signals do it: everybody is woken, and then, without a word, the context ends."""
    node = make_node(ros_context)
    guard = GuardCondition(None, None, ros_context)
    ended = threading.Event()
    intake = {'events': EventsIntake, 'waitset': WaitSetIntake}[kind](
        ros_context, recorder, (guard,), on_shutdown=ended.set)
    start(intake, node)
    time.sleep(0.05)
    guard.trigger()
    if kind == 'events':
        intake.wake()
    time.sleep(0.03)
    assert not ended.is_set()
    ros_context.handle.shutdown()
    assert ended.wait(10.0)
    assert wait_for(lambda: not intake_threads(), 10.0)
    intake.stop()
    node.destroy_node()
    assert not recorder.errors


def test_a_poll_ends_with_a_context_that_ends_after_the_wake_up(
    ros_context: Context, recorder: Recorder
) -> None:
    guard = GuardCondition(None, None, ros_context)
    inline = WaitSetIntake(ros_context, recorder, (guard,))
    guard.trigger()
    assert inline.poll(None) == 0
    threading.Timer(0.03, ros_context.handle.shutdown).start()
    assert inline.poll(None) == 0
    assert not ros_context.ok()
    assert inline.poll(None) == 0


# --- cost ----------------------------------------------------------------------------------------


@pytest.mark.parametrize('kind', THREADED)
def test_idle_subscriptions_cost_nothing(
    kind: str, ros_context: Context, node: Node, recorder: Recorder
) -> None:
    for _ in range(100):
        node.create_subscription(String, topic(), nothing, 10)
    intake = make_intake(kind, ros_context, recorder)
    start(intake, node)
    try:
        time.sleep(0.3)
        threads = intake_threads()
        before = cpu_ns(threads)
        time.sleep(1.0)
        assert cpu_ns(threads) - before < 100 * MS  # none, and about 5 ms
    finally:
        intake.stop()


@pytest.mark.parametrize('kind', THREADED)
def test_updates_of_many_entities_in_a_row_are_put_together(
    kind: str, ros_context: Context, node: Node, recorder: Recorder
) -> None:
    intake = make_intake(kind, ros_context, recorder)
    start(intake, node)
    try:
        threads = intake_threads()
        before = cpu_ns(threads)
        name = topic()
        for _ in range(200):
            node.create_subscription(String, name, nothing, 10)
            look_after(intake, node)
        publisher = node.create_publisher(String, name, 10)
        assert matched(publisher, 200)
        publisher.publish(text(''))
        assert wait_for(lambda: len(recorder.messages) == 200)
        assert cpu_ns(threads) - before < 2000 * MS
    finally:
        intake.stop()


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

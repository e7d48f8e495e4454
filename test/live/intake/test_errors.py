# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Intakes when a take or a receiver fails, and when rclpy does, against real rclpy."""

from __future__ import annotations

import time
from typing import Any

from mddag_executor.live.intake import sources
from mddag_executor.live.intake.events import EventsIntake
from mddag_executor.live.intake.waitset import WaitSetIntake
import pytest
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool

from .helpers import (
    intake_threads,
    look_after,
    matched,
    nothing,
    Pulse,
    Recorder,
    start,
    text,
    topic,
    wait_for,
)

# --- errors --------------------------------------------------------------------------------------


class _Failing(type):
    """The class of a message type's metaclass: every fourth conversion from C fails."""

    conversions = 0

    @property
    def _CONVERT_TO_PY(cls) -> Any:
        _Failing.conversions += 1
        if _Failing.conversions % 4 == 2:
            raise ValueError('on purpose')
        return type(String)._CONVERT_TO_PY


def test_a_message_that_can_not_be_taken_is_an_error_and_no_end(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    meta = _Failing('Meta', (type(String),), {})
    name = topic()
    subscription = node.create_subscription(String, name, nothing, 10)
    subscription.msg_type = meta('OddString', (String,), {'__slots__': ()})
    publisher = other.create_publisher(String, name, 10)
    _Failing.conversions = 0
    start(intake, node)
    assert matched(publisher)
    for k in range(1, 13):
        publisher.publish(text(str(k)))
        if k % 4 == 0:
            assert wait_for(lambda k=k: len(recorder.messages) == 3 * k // 4)
    assert [str(error) for error in recorder.errors] == ['on purpose'] * 3
    assert recorder.texts(subscription) == [str(k) for k in range(1, 13) if k % 4 != 2]


def test_a_receiver_that_raises_is_an_error_and_no_end(
    intake: Any, node: Node, recorder: Recorder
) -> None:
    name = topic()
    node.create_subscription(String, name, nothing, 10)
    publisher = node.create_publisher(String, name, 10)
    node.create_service(SetBool, name, nothing)
    client = node.create_client(SetBool, name)
    guard = node.create_guard_condition(nothing)

    def fail(*_: Any) -> None:
        raise ValueError('on purpose')

    recorder.react.update(message=fail, request=fail, guard=fail)
    start(intake, node)
    assert matched(publisher) and client.wait_for_service(5.0)
    for k in range(1, 4):
        publisher.publish(text(''))
        client.call_async(SetBool.Request())
        guard.trigger()
        kinds = recorder.messages, recorder.requests, recorder.guards
        wait_for(lambda k=k, kinds=kinds: all(len(each) == k for each in kinds))
        assert [len(each) for each in kinds] == [k] * 3
    assert wait_for(lambda: len(recorder.errors) == 9)
    assert {str(error) for error in recorder.errors} == {'on purpose'}


def test_a_take_that_always_fails_does_not_take_a_whole_cpu(
    ros_context: Context, node: Node, recorder: Recorder
) -> None:
    class Broken(Pulse):

        def take_data(self) -> int:
            self.guard.trigger()
            raise ValueError('on purpose')

    broken = Broken(node, node.default_callback_group)
    node.add_waitable(broken)
    intake = WaitSetIntake(ros_context, recorder)
    start(intake, node)
    broken.guard.trigger()
    time.sleep(1.0)
    intake.stop()
    broken.guard.destroy()
    assert 4 <= len(recorder.errors) < 100


def test_what_is_destroyed_while_it_is_added_does_no_harm(
    ros_context: Context, node: Node, other: Node, recorder: Recorder,
    monkeypatch: pytest.MonkeyPatch
) -> None:
    name = topic()
    subscriptions = [node.create_subscription(String, name, nothing, 10) for _ in range(5)]
    kept, doomed = subscriptions[0], [subscriptions[2]]
    publisher = other.create_publisher(String, name, 10)

    class Unlucky(sources.SubscriptionSource):
        """Lose the entity after its handle was entered, and before it is added."""

        def take(self) -> int:
            count = super().take()
            if doomed and self.entity is doomed[0]:
                node.destroy_subscription(doomed.pop())
            return count

    monkeypatch.setitem(sources.SOURCES, 'subscriptions', Unlucky)
    intake = EventsIntake(ros_context, recorder)
    start(intake, node)
    try:
        assert wait_for(lambda: not doomed)
        look_after(intake, node)  # as the executor does; its QoS events are held until then
        assert wait_for(lambda: publisher.get_subscription_count() == 4)
        for k in range(3):
            publisher.publish(text(str(k)))
        assert wait_for(lambda: len(recorder.messages) == 12)
        assert recorder.texts(kept) == ['0', '1', '2']
        late = node.create_subscription(String, name, nothing, 10)
        look_after(intake, node)
        assert matched(publisher, 5)
        publisher.publish(text('3'))
        assert wait_for(lambda: recorder.texts(late) == ['3'])
        assert wait_for(lambda: recorder.texts(kept) == ['0', '1', '2', '3'])
        assert [t.name for t in intake_threads() if t.name == 'mddag-intake-events']
    finally:
        intake.stop()
    assert not recorder.errors


def test_a_wait_set_takes_over_from_a_native_executor_that_fails(
    ros_context: Context, node: Node, other: Node, recorder: Recorder,
    monkeypatch: pytest.MonkeyPatch
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, nothing, 10)
    publisher = other.create_publisher(String, name, 10)

    class Bad(sources.SubscriptionSource):
        """What makes the native executor fail in the middle of adding."""

        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            self.handle = ros_context.handle
            sources.SOURCES['subscriptions'] = sources.SubscriptionSource

    monkeypatch.setitem(sources.SOURCES, 'subscriptions', Bad)
    intake = EventsIntake(ros_context, recorder)
    start(intake, node)
    try:
        assert wait_for(lambda: recorder.errors)
        assert matched(publisher)
        publisher.publish(text('still'))
        assert wait_for(lambda: recorder.texts(subscription) == ['still'])
        assert len(recorder.errors) == 1
    finally:
        intake.stop()

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

"""Both intakes on every kind of entity, under storms and signals, against real rclpy."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from mddag_executor.live import native as native_module
from mddag_executor.live.events import EventsIntake
from mddag_executor.live.waitset import WaitSetIntake
import pytest
from rclpy.action.client import ActionClient
from rclpy.action.server import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.serialization import serialize_message
from rclpy.waitable import NumberOfEntities, Waitable
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

from .intakes import (
    cpu_ns,
    FakeExecutor,
    intake_threads,
    INTAKES,
    make_intake,
    make_node,
    matched,
    Recorder,
    text,
    topic,
    wait_for,
)

MS = 1_000_000
THREADED = ('events', 'waitset')


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture(params=INTAKES)
def intake(request: pytest.FixtureRequest, ros_context: Context, recorder: Recorder
           ) -> Iterator[Any]:
    made = make_intake(request.param, ros_context, recorder)
    yield made
    made.stop()


@pytest.fixture
def node(ros_context: Context) -> Iterator[Node]:
    made = make_node(ros_context)
    yield made
    made.destroy_node()


@pytest.fixture
def other(ros_context: Context) -> Iterator[Node]:
    """Give a node that no intake looks after."""
    made = make_node(ros_context)
    yield made
    made.destroy_node()


def nothing(*_: Any) -> None:
    pass


def start(intake: Any, *nodes: Node) -> None:
    intake.update(nodes)
    intake.start()


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

    def answer(service: Any, request: Any, header: Any) -> None:
        service.send_response(SetBool.Response(success=not request.data), header)

    def complete(client: Any, sequence: int, header: Any, response: Any) -> None:
        assert header is None or header.request_id.sequence_number == sequence
        client.get_pending_request(sequence).set_result(response)

    recorder.react.update(request=answer, response=complete)
    for _ in range(5):  # five at once: a service keeps no more than ten
        futures = [client.call_async(SetBool.Request(data=bool(k % 2))) for k in range(5)]
        assert wait_for(lambda futures=futures: all(future.done() for future in futures))
        assert [f.result().success for f in futures] == [True, False, True, False, True]
    assert {id(s) for s, _, _ in recorder.requests} == {id(service)}
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
    recorder.react['request'] = lambda service, request, header: service.send_response(
        service.callback(request, service.srv_type.Response()), header)
    recorder.react['response'] = lambda client, sequence, header, response: (
        client.get_pending_request(sequence).set_result(response))
    start(intake, node, other)
    assert client.wait_for_services(5.0)
    future = client.get_parameters(['size'])
    assert wait_for(future.done)
    assert future.result().values[0].integer_value == 3
    future = client.list_parameters()
    assert wait_for(future.done)
    assert 'size' in future.result().result.names


class Pulse(Waitable):
    """A waitable of one's own, made of a guard condition."""

    def __init__(self, node: Node, group: Any) -> None:
        super().__init__(group)
        self.guard = node.create_guard_condition(nothing)
        node._guards.remove(self.guard)
        self._index: int | None = None
        self.order: list[str] = []

    def __enter__(self) -> None:
        self.guard.handle.__enter__()

    def __exit__(self, *_: Any) -> None:
        self.guard.handle.__exit__(None, None, None)

    def is_ready(self, wait_set: Any) -> bool:
        ready = bool(wait_set.is_ready('guard_condition', self._index))
        if ready:
            self.order.append('ready')
        return ready

    def take_data(self) -> int:
        self.order.append('take')
        return len(self.order)

    async def execute(self, taken_data: int) -> None:
        pass

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        self._index = wait_set.add_guard_condition(self.guard.handle)


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

    def execute(waitable: Any, data: Any) -> None:
        with locks.setdefault(id(waitable), threading.Lock()):
            executor.run(waitable.execute, data)

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
        threads = [t for t in intake_threads() if t.name.endswith('qos')]
        assert threads
        before = cpu_ns(threads)
        for _ in range(200):
            publisher.publish(text(''))
            time.sleep(0.001)
        assert wait_for(lambda: len(recorder.messages) == 200)
        assert cpu_ns(threads) - before < 5 * MS
    finally:
        intake.stop()


# --- coming and going ----------------------------------------------------------------------------


def test_entities_come_and_go_while_it_runs(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    start(intake)
    for k in range(5):
        name = topic()
        publisher = other.create_publisher(String, name, 10)
        subscription = node.create_subscription(String, name, nothing, 10)
        intake.update([node])
        assert matched(publisher)
        publisher.publish(text(str(k)))
        assert wait_for(lambda s=subscription, k=k: recorder.texts(s) == [str(k)])
        node.destroy_subscription(subscription)
        intake.update([node])
        assert wait_for(lambda name=name: node.count_subscribers(name) == 0)
        publisher.publish(text('late'))
    intake.update([])
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
        intake.update([])
        time.sleep(0.1)
        count = len(recorder.messages)
        time.sleep(0.1)
        assert len(recorder.messages) == count
        intake.update([node])
        assert wait_for(lambda: len(recorder.messages) > count + 50)
        node.destroy_subscription(subscription)
        intake.update([node])
        time.sleep(0.1)
        count = len(recorder.messages)
        time.sleep(0.1)
        assert len(recorder.messages) == count
    finally:
        stop.set()
        flooding.join()
    assert not recorder.errors


def test_a_storm_of_destruction(intake: Any, ros_context: Context, recorder: Recorder) -> None:
    """Create and destroy everything at random while messages and requests pour in."""
    source = make_node(ros_context, start_parameter_services=False, enable_rosout=False)
    names = [topic() for _ in range(3)]
    publishers = [source.create_publisher(String, name, 10) for name in names]
    clients = [source.create_client(SetBool, name) for name in names]
    stop = threading.Event()

    def pour() -> None:
        while not stop.is_set():
            for publisher in publishers:
                publisher.publish(text('x'))
            for client in clients:
                client.call_async(SetBool.Request())
            time.sleep(0.0005)

    def answer(service: Any, request: Any, header: Any) -> None:
        try:
            service.send_response(SetBool.Response(), header)
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
        end = time.monotonic() + 4.0
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
                intake.update([source, *nodes])
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
                intake.update([source, *nodes])
            if draw.random() < 0.05:
                intake.stop()
                intake.start()
    finally:
        stop.set()
        pouring.join()
        intake.stop()
        for node in (source, *nodes):
            node.destroy_node()
    assert made > 100
    assert recorder.messages and recorder.requests and recorder.responses
    assert recorder.timers and recorder.guards
    # A destroyed entity is no error; a response may come for a request of a former client.
    assert not recorder.errors


def test_it_stops_and_starts_again(
    intake: Any, node: Node, other: Node, recorder: Recorder
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, nothing, 200)
    publisher = other.create_publisher(String, name, 200)
    intake.update([node])
    assert matched(publisher)
    sent = 0
    for _ in range(5):
        intake.start()
        assert intake_threads() or type(intake).__name__ == 'PollingIntake'
        for _ in range(20):
            publisher.publish(text(str(sent)))
            sent += 1
        intake.stop()
        assert not intake_threads()
        for _ in range(3):
            publisher.publish(text(str(sent)))
            sent += 1
        time.sleep(0.01)
    intake.start()
    assert wait_for(lambda: len(recorder.messages) == sent)
    # Nothing lags behind: the next one comes as soon as it is sent.
    publisher.publish(text(str(sent)))
    assert wait_for(lambda: len(recorder.messages) == sent + 1)
    assert recorder.texts(subscription) == [str(k) for k in range(sent + 1)]


@pytest.mark.parametrize('kind', THREADED)
def test_stopping_is_prompt_and_allowed_in_any_state(
    kind: str, ros_context: Context, node: Node, recorder: Recorder
) -> None:
    node.create_timer(100.0, nothing)
    intake = make_intake(kind, ros_context, recorder)
    intake.stop()
    start(intake, node)
    with pytest.raises(RuntimeError, match='runs already'):
        intake.start()
    begin = time.monotonic()
    intake.stop()
    assert time.monotonic() - begin < 0.5
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
    intake.start()
    publisher.publish(text('second'))
    assert wait_for(lambda: len(recorder.messages) == 2 and not intake_threads())
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
    assert wait_for(lambda: not intake_threads(), 2.0)
    intake.stop()
    node.destroy_node()
    assert not recorder.errors


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
        assert wait_for(lambda k=k: (
            len(recorder.messages), len(recorder.requests), len(recorder.guards)) == (k, k, k))
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


def test_a_wait_set_takes_over_from_a_native_executor_that_fails(
    ros_context: Context, node: Node, other: Node, recorder: Recorder,
    monkeypatch: pytest.MonkeyPatch
) -> None:
    name = topic()
    subscription = node.create_subscription(String, name, nothing, 10)
    publisher = other.create_publisher(String, name, 10)

    class Bad(native_module.SubscriptionStandIn):
        """What makes the native executor fail in the middle of adding."""

        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            self.let_go()
            self.handle = ros_context.handle
            self.handle.__enter__()

    monkeypatch.setitem(native_module._STAND_INS, 'subscriptions', Bad)
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
            intake.update([node])
        publisher = node.create_publisher(String, name, 10)
        assert matched(publisher, 200)
        publisher.publish(text(''))
        assert wait_for(lambda: len(recorder.messages) == 200)
        assert cpu_ns(threads) - before < 2000 * MS
    finally:
        intake.stop()


# --- the same from all ---------------------------------------------------------------------------


def test_all_intakes_hand_over_the_same(ros_context: Context, other: Node) -> None:
    """Send one load to a node of each intake, and compare what comes out."""
    names = [topic() for _ in range(4)]
    parts = []
    for kind in INTAKES:
        node, recorder = make_node(ros_context), Recorder()
        recorder.react['request'] = lambda service, request, header: service.send_response(
            SetBool.Response(success=request.data), header)
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
                for part in parts:
                    part[5].call_async(SetBool.Request(data=k % 40 == 0))
            time.sleep(0.005)
        time.sleep(0.3)
        summaries = []
        for _, recorder, _, subscriptions, _, _, timer in parts:
            messages = [
                [(m if isinstance(m, bytes) else m.data, info['source_timestamp'])
                 for s, m, info in recorder.messages if s is subscription]
                for subscription in subscriptions]
            dues = recorder.dues(timer)
            assert all((b - a) % (20 * MS) == 0 for a, b in zip(dues, dues[1:]))
            assert not recorder.errors
            summaries.append((
                messages, [r.data for _, r, _ in recorder.requests],
                [(sequence, r.success) for _, sequence, _, r in recorder.responses]))
        assert sum(map(len, summaries[0][0])) == 200 and len(summaries[0][2]) == 10
        assert summaries[0] == summaries[1] == summaries[2]
    finally:
        for part in parts:
            part[0].stop()
            part[2].destroy_node()


# --- signals -------------------------------------------------------------------------------------

PROGRAM = """
import signal, sys, threading, time
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerGuardCondition
from mddag_executor.live.events import EventsIntake
from mddag_executor.live.waitset import WaitSetIntake

class Receiver:
    def __getattr__(self, name):
        return lambda *_: None

kind = sys.argv[1]
rclpy.init()
context = rclpy.get_default_context()
node = Node('node')
node.create_timer(0.05, lambda: None)
handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
if kind == 'single':
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    print('ready', flush=True)
    try:
        while rclpy.ok():
            executor.spin_once()
        print('context ended', flush=True)
    except KeyboardInterrupt:
        print('KeyboardInterrupt', flush=True)
    except rclpy.executors.ExternalShutdownException:
        print('context ended', flush=True)
    sys.exit(3)
done = threading.Event()
guard = SignalHandlerGuardCondition(context)
intake = {'events': EventsIntake, 'waitset': WaitSetIntake}[kind](
    context, Receiver(), (guard,), on_shutdown=done.set)
intake.update([node])
intake.start()
time.sleep(0.1)
assert handlers == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))
print('ready', flush=True)
try:
    done.wait()
    print('context ended', flush=True)
except KeyboardInterrupt:
    print('KeyboardInterrupt', flush=True)
start = time.monotonic()
intake.stop()
assert time.monotonic() - start < 0.5
assert not [t for t in threading.enumerate() if t.name.startswith('mddag')]
sys.exit(3)
"""


def _signalled(tmp_path: Path, kind: str, number: signal.Signals) -> tuple[int, str, str]:
    program = tmp_path / 'program.py'
    program.write_text(PROGRAM)
    root = Path(__file__).resolve().parents[2]
    path = os.pathsep.join([str(root), *filter(None, [os.environ.get('PYTHONPATH')])])
    with subprocess.Popen(
        [sys.executable, str(program), kind], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, 'PYTHONPATH': path},
    ) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == 'ready\n', process.communicate()[1]
            time.sleep(0.2)
            begin = time.monotonic()
            process.send_signal(number)
            out, err = process.communicate(timeout=5.0)
            assert time.monotonic() - begin < 2.0
        finally:
            process.kill()
    return process.returncode, out, err


@pytest.mark.parametrize('kind', THREADED)
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_do_what_they_do_with_rclpys_executors(
    tmp_path: Path, kind: str, number: signal.Signals
) -> None:
    result = _signalled(tmp_path, kind, number)
    assert result == _signalled(tmp_path, 'single', number)
    assert result[0] == 3


@pytest.mark.parametrize('kind', THREADED)
def test_a_process_that_forgets_to_stop_ends_all_the_same(tmp_path: Path, kind: str) -> None:
    program = tmp_path / 'program.py'
    program.write_text(PROGRAM.split('done.wait()')[0] + 'sys.exit(4)\nfinally:\n    pass\n')
    root = Path(__file__).resolve().parents[2]
    ended = subprocess.run(
        [sys.executable, str(program), kind], capture_output=True, text=True, timeout=20.0,
        env={**os.environ, 'PYTHONPATH': str(root)}, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (4, 'ready\n', '')

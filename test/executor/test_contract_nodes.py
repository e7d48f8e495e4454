# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What rclpy's executors promise: lifecycle nodes, QoS events, parameters, what callbacks make."""

import threading
import time

from mddag_executor.executor import waitables
import pytest
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from .conftest import Spinning, wait_for

# --- kinds of nodes and events -------------------------------------------------------------------


def test_a_lifecycle_node_goes_through_its_transitions(make_executor, make_node, ros_context):
    """By its services, called by a callback of another node of the same executor."""
    lifecycle = pytest.importorskip('rclpy.lifecycle', reason='lifecycle_msgs is not installed')
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState, GetState
    seen = []

    class Managed(lifecycle.LifecycleNode):

        def on_configure(self, state):
            self.publisher = self.create_lifecycle_publisher(Header, '/managed', 10)
            self.timer = self.create_timer(0.005, lambda: self.publisher.publish(Header()))
            seen.append('configure')
            return super().on_configure(state)

        def on_activate(self, state):
            seen.append('activate')
            return super().on_activate(state)

        def on_deactivate(self, state):
            seen.append('deactivate')
            return super().on_deactivate(state)

        def on_cleanup(self, state):
            self.destroy_timer(self.timer)
            self.destroy_publisher(self.publisher)
            seen.append('cleanup')
            return lifecycle.TransitionCallbackReturn.SUCCESS

    managed = Managed('managed', context=ros_context, enable_rosout=False)
    other = make_node('manager')
    change = other.create_client(ChangeState, '/managed/change_state')
    state = other.create_client(GetState, '/managed/get_state')
    heard = []
    other.create_subscription(Header, '/managed', heard.append, 10)
    executor = make_executor(nodes=[managed, other])

    async def go(transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert (await change.call_async(request)).success
        return (await state.call_async(GetState.Request())).current_state.label

    def now_in(transition):
        task = executor.create_task(go(transition))
        assert wait_for(task.done)
        return task.result()

    with Spinning(executor) as spinning:
        assert change.wait_for_service(5.0) and state.wait_for_service(5.0)
        assert now_in(Transition.TRANSITION_CONFIGURE) == 'inactive'
        time.sleep(0.05)
        assert heard == []
        assert now_in(Transition.TRANSITION_ACTIVATE) == 'active'
        assert wait_for(lambda: len(heard) >= 3)
        assert now_in(Transition.TRANSITION_DEACTIVATE) == 'inactive'
        assert now_in(Transition.TRANSITION_CLEANUP) == 'unconfigured'
    assert spinning.error is None
    assert seen == ['configure', 'activate', 'deactivate', 'cleanup']
    managed.destroy_node()


def test_qos_events_reach_their_callbacks(make_executor, make_node):
    """Deadline missed and liveliness lost, on both sides, in a worker."""
    node = make_node()
    got = {
        'requested': [], 'offered': [], 'changed': [], 'lost': []}
    qos = QoSProfile(
        depth=10, deadline=Duration(seconds=0.1), liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(seconds=0.2))
    node.create_subscription(
        Header, '/topic', lambda m: None, qos, event_callbacks=SubscriptionEventCallbacks(
            deadline=got['requested'].append, liveliness=got['changed'].append))
    publisher = node.create_publisher(
        Header, '/topic', qos, event_callbacks=PublisherEventCallbacks(
            deadline=got['offered'].append, liveliness=got['lost'].append))
    executor = make_executor(nodes=[node])
    with Spinning(executor) as spinning:
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        publisher.publish(Header())
        assert wait_for(lambda: all(got.values())), got
        assert wait_for(lambda: got['changed'][-1].not_alive_count == 1)
        assert wait_for(
            lambda: publisher.assert_liveliness() or got['changed'][-1].alive_count == 1)
    assert spinning.error is None
    assert got['lost'][0].total_count >= 1 and got['requested'][0].total_count >= 1


def test_parameters_through_another_node_of_the_same_executor(make_executor, make_node):
    node, other = make_node('server', start_parameter_services=True), make_node('asker')
    node.declare_parameter('speed', 3)
    node.declare_parameter('name', 'first')
    told = []
    node.add_post_set_parameters_callback(lambda given: told.extend(p.name for p in given))
    client = AsyncParameterClient(other, 'server', callback_group=ReentrantCallbackGroup())
    executor = make_executor(nodes=[node, other])

    async def ask():
        given = await client.set_parameters([Parameter('speed', value=5)])
        names = await client.list_parameters([], 10)
        values = await client.get_parameters(['speed', 'name'])
        types = await client.describe_parameters(['name'])
        return given.results, names.result.names, values.values, types.descriptors

    with Spinning(executor) as spinning:
        assert client.wait_for_services(5.0)
        task = executor.create_task(ask)
        assert wait_for(task.done)
    assert spinning.error is None
    results, names, values, descriptors = task.result()
    assert results[0].successful and told == ['speed']
    assert {'speed', 'name'} <= set(names)
    assert values[0].integer_value == 5 and values[1].string_value == 'first'
    assert descriptors[0].name == 'name'
    assert node.get_parameter('speed').value == 5


# --- what callbacks make and destroy -------------------------------------------------------------


def test_entities_that_a_callback_makes_run(make_executor, make_node):
    """Entities of each kind, made in a worker, and a node."""
    node = make_node()
    ran = {name: [] for name in (
        'timer', 'message', 'request', 'response', 'guard', 'result', 'node')}
    executor = make_executor(nodes=[node])
    kept = []
    group = ReentrantCallbackGroup()

    def answer(request, response):
        ran['request'].append(1)
        return response

    def execute(goal):
        goal.succeed()
        return Fibonacci.Result()

    async def use(publisher, client, actions):
        while not (publisher.get_subscription_count() and client.service_is_ready()
                   and actions.server_is_ready()):
            await pause()
        publisher.publish(Header())
        ran['response'].append(await client.call_async(Trigger.Request()))
        goal = await actions.send_goal_async(Fibonacci.Goal())
        ran['result'].append(await goal.get_result_async())

    async def pause():
        future = Future(executor=executor)
        timer = node.create_timer(0.005, lambda: future.set_result(None), group)
        await future
        node.destroy_timer(timer)

    def make():
        first.cancel()
        node.create_timer(0.005, lambda: ran['timer'].append(1), group)
        node.create_subscription(Header, '/made', ran['message'].append, 10)
        node.create_service(Trigger, '/made', answer)
        guard = node.create_guard_condition(lambda: ran['guard'].append(1))
        kept.extend([
            ActionServer(node, Fibonacci, '/made_action', execute, callback_group=group),
            ActionClient(node, Fibonacci, '/made_action', callback_group=group)])
        executor.create_task(use(
            node.create_publisher(Header, '/made', 10), node.create_client(Trigger, '/made'),
            kept[-1]))
        guard.trigger()
        new = make_node('made')
        new.create_timer(0.005, lambda: ran['node'].append(1))
        executor.add_node(new)

    first = node.create_timer(0.005, make)
    with Spinning(executor) as spinning:
        assert wait_for(lambda: all(ran.values()), 10.0), (ran, spinning.error)
    assert spinning.error is None
    for made in kept:
        made.destroy()


def test_a_cancelled_goal_request_does_not_block_its_callback_group(
        make_executor, make_node, monkeypatch):
    monkeypatch.setattr(waitables, 'SENDER_CHECKS', 10 ** 9)  # the response is unknown for ever
    node, ticks = make_node(), []
    answered, cancelled = threading.Event(), threading.Event()

    def accept(_):
        cancelled.wait(15.0)
        answered.set()
        return GoalResponse.ACCEPT

    server = ActionServer(
        node, Fibonacci, '/cancelled', lambda goal: Fibonacci.Result(), goal_callback=accept,
        callback_group=ReentrantCallbackGroup())
    client = ActionClient(node, Fibonacci, '/cancelled')
    node.create_timer(0.002, lambda: ticks.append(1))
    executor = make_executor(nodes=[node])
    with Spinning(executor) as spinning:
        assert client.wait_for_server(15.0)
        client.send_goal_async(Fibonacci.Goal()).cancel()
        cancelled.set()
        assert answered.wait(15.0)
        for _ in range(50):  # the response comes meanwhile
            count = len(ticks)
            assert wait_for(lambda count=count: len(ticks) > count)
    assert spinning.error is None
    server.destroy()
    client.destroy()


def test_a_callback_may_destroy_what_it_belongs_to(make_executor, make_node):
    """A timer itself, a subscription itself, and in the end the node they are of (rclpy#1206)."""
    executor = make_executor()
    with Spinning(executor) as spinning:
        for _ in range(10):
            node = make_node()
            calls = []

            def heard(_, node=node, calls=calls):
                calls.append('message')
                node.destroy_subscription(next(iter(node.subscriptions)))
                node.create_timer(0.001, lambda: calls.append('node') or node.destroy_node())

            publisher = node.create_publisher(Header, '/topic', 10)
            node.create_subscription(Header, '/topic', heard, 10)

            def tick(node=node, calls=calls, publisher=publisher):
                calls.append('timer')
                if publisher.get_subscription_count():
                    node.destroy_timer(next(iter(node.timers)))
                    publisher.publish(Header())

            node.create_timer(0.001, tick)
            executor.add_node(node)
            assert wait_for(lambda some=calls: 'node' in some), calls
            assert calls.count('message') == calls.count('node') == 1
    assert spinning.error is None

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What rclpy promises of executors: contexts, several executors, forks, kinds of nodes."""

import multiprocessing
import os
import signal
import sys
import threading
import time

from mddag_executor.executor import waitables
import pytest
import rclpy
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from .conftest import is_idle, matched, patience, Spinning, wait_for

DEPTH = 1000


def counting(node, period=0.005):
    """Give a node a timer; return what grows with its calls."""
    calls = []
    node.create_timer(period, lambda: calls.append(threading.get_native_id()))
    return calls


def goes_on(calls, count=3):
    before = len(calls)
    return wait_for(lambda: len(calls) >= before + count)


def test_rclpy_s_functions_spin_the_global_executor(
        make_executor, make_node, ros_context, monkeypatch):
    executor = make_executor()
    monkeypatch.setattr(rclpy, '__executor', executor)
    node, group = make_node(), ReentrantCallbackGroup()
    calls = counting(node)
    for count in range(1, 4):
        rclpy.spin_once(node, timeout_sec=5.0)
        assert calls == [threading.get_native_id()] * count
        assert executor.get_nodes() == []
    node.destroy_timer(next(iter(node.timers)))
    begin = time.monotonic()
    rclpy.spin_once(node, timeout_sec=0.05)
    rclpy.spin_until_future_complete(node, Future(), timeout_sec=0.05)
    assert time.monotonic() - begin >= 0.1

    node.create_service(Trigger, '/ask', lambda request, response: response)
    client = node.create_client(Trigger, '/ask')
    assert client.wait_for_service(60.0)
    answer = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, answer, timeout_sec=patience(5.0))
    assert answer.done() and executor.get_nodes() == []

    together, met = threading.Barrier(3), []

    def meet():  # on all workers, as with ``executor.spin()``
        if not met:
            met.append(together.wait(5.0))
            rclpy.try_shutdown(context=ros_context)

    for _ in range(3):
        node.create_timer(0.01, meet, group)
    rclpy.spin(node)
    assert met and executor.get_nodes() == []


# --- several at once -----------------------------------------------------------------------------


def test_several_contexts_in_one_process(make_executor, make_node, ros_context):
    """One is shut down, the other goes on; what signals do is not touched."""
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    other = Context()
    rclpy.init(context=other)
    second = make_executor(context=other)
    far = Node('far', context=other, start_parameter_services=False, enable_rosout=False)
    near = make_node('near')
    of_far, of_near = counting(far), counting(near)
    first = make_executor(nodes=[near])
    second.add_node(far)
    heard = []
    near.create_subscription(Header, '/across', heard.append, 10)
    publisher = far.create_publisher(Header, '/across', 10)
    with Spinning(first):
        with Spinning(second, raises=ExternalShutdownException) as ended:
            assert goes_on(of_far) and goes_on(of_near)
            assert wait_for(lambda: publisher.publish(Header()) or heard)
            rclpy.shutdown(context=other)
            ended.join()
        assert ros_context.ok() and goes_on(of_near)
    assert handlers == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))


def test_one_of_rclpys_executors_in_the_same_process(make_executor, make_node, ros_context):
    """
    They pass a number to each other, a thousand times.

    rclpy's MultiThreadedExecutor needs 150 ms for each, whatever the other executor is.
    """
    here, there, got = make_node('here'), make_node('there'), []
    to_there = here.create_publisher(Header, '/to_there', DEPTH)
    to_here = there.create_publisher(Header, '/to_here', DEPTH)

    def back(message):
        got.append(message.stamp.sec)
        message.stamp.sec += 1
        to_there.publish(message)

    here.create_subscription(Header, '/to_here', back, DEPTH)
    there.create_subscription(Header, '/to_there', to_here.publish, DEPTH)
    executor = make_executor(nodes=[here])
    other = SingleThreadedExecutor(context=ros_context)
    other.add_node(there)
    matched(to_there, to_here)
    with Spinning(executor), Spinning(other):
        to_there.publish(Header())
        assert wait_for(lambda: len(got) >= DEPTH, 30.0), got[-1:]
    assert got == list(range(len(got)))


def test_a_node_moves_between_executors_that_spin(make_executor, make_node):
    """Nothing that was published is heard twice, and what is published after the move is heard."""
    node, source, heard = make_node(), make_node('source'), []
    node.create_subscription(Header, '/a', lambda m: heard.append(m.stamp.sec), DEPTH)
    ticks = counting(node, 0.001)
    publisher = source.create_publisher(Header, '/a', DEPTH)
    executors = [make_executor(num_workers=2) for _ in range(2)]
    matched(publisher)
    message = Header()
    with Spinning(executors[0]), Spinning(executors[1]):
        for number in range(40):
            to = executors[number % 2]
            to.add_node(node)  # which removes it from the other one
            assert node.executor is to
            message.stamp.sec = number
            publisher.publish(message)
            assert goes_on(ticks, 1) and wait_for(lambda n=number: n in heard), number
    assert heard == list(range(40))


# --- fork ----------------------------------------------------------------------------------------


def wait_until_told(connection):
    connection.send('here')
    connection.recv()
    raise SystemExit(3)


@pytest.mark.filterwarnings('ignore:.*use of fork')
def test_a_forked_process_disturbs_nothing_and_ends(make_executor, make_node):
    """From a callback and from elsewhere, as ``multiprocessing`` does it."""
    fork = multiprocessing.get_context('fork')
    node, heard = make_node(), []
    ticks = counting(node)
    publisher = node.create_publisher(Header, '/a', DEPTH)
    node.create_subscription(
        Header, '/a', lambda m: heard.append(m.stamp.sec), DEPTH,
        callback_group=ReentrantCallbackGroup())
    executor = make_executor(num_workers=3, nodes=[node])
    matched(publisher)

    pipes = [fork.Pipe() for _ in range(2)]
    children = [fork.Process(target=wait_until_told, args=(theirs,)) for _, theirs in pipes]
    with Spinning(executor):
        task = executor.create_task(children[0].start)
        assert wait_for(task.done)
        children[1].start()
        assert [mine.recv() for mine, _ in pipes] == ['here'] * 2
        message = Header()
        for number in range(50):  # while there is a child that has all the descriptors
            message.stamp.sec = number
            publisher.publish(message)
        assert goes_on(ticks, 10) and wait_for(lambda: len(heard) == 50)
        for mine, _ in pipes:
            mine.send('go')
        for child in children:
            child.join(15.0)
    assert [child.exitcode for child in children] == [3, 3]
    assert sorted(heard) == list(range(50))
    assert is_idle(executor)
    for connection in (each for pipe in pipes for each in pipe):
        connection.close()


@pytest.mark.filterwarnings('ignore:.*use of fork')
def test_a_forked_copy_ends_with_the_callback_that_forked_it(make_executor, make_node, capfd):
    """It would take the events of its parent, and run the nodes a second time."""
    ends = {'return': lambda: None, 'exit': lambda: sys.exit(5), 'raise': lambda: 1 // 0}
    statuses = {}

    def forks(name):
        child = os.fork()
        if child == 0:
            ends[name]()
            return
        statuses[name] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    node = make_node('forking')
    ticks = counting(node)
    executor = make_executor(num_workers=2, nodes=[node])
    task = executor.create_task(forks, 'return')
    executor.spin_until_future_complete(task, timeout_sec=patience(15.0))  # in this thread
    assert statuses.pop('return') == 1
    with Spinning(executor):
        for name in ends:
            task = executor.create_task(forks, name)
            assert wait_for(task.done)
        assert goes_on(ticks, 5)
    assert statuses == {'exit': 5, 'raise': 1, 'return': 1}
    said = capfd.readouterr().err
    assert said.count('forked this process and returned in the copy') == 2, said
    assert 'ZeroDivisionError' in said


# --- kinds of nodes and events -------------------------------------------------------------------


def test_a_lifecycle_node_and_its_parameters(make_executor, make_node, ros_context):
    """By its services, called by coroutines of the same executor."""
    lifecycle = pytest.importorskip('rclpy.lifecycle', reason='lifecycle_msgs is not installed')
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    class Managed(lifecycle.LifecycleNode):

        def on_configure(self, state):
            publisher = self.create_lifecycle_publisher(Header, '/managed', 10)
            self.create_timer(0.005, lambda: publisher.publish(Header()))
            return super().on_configure(state)

    managed = Managed('managed', context=ros_context, enable_rosout=False)
    managed.declare_parameter('speed', 3)
    other, heard, told = make_node('manager'), [], []
    managed.add_post_set_parameters_callback(lambda given: told.extend(p.name for p in given))
    client = other.create_client(ChangeState, '/managed/change_state')
    parameters = AsyncParameterClient(other, 'managed', callback_group=ReentrantCallbackGroup())
    other.create_subscription(Header, '/managed', heard.append, 10)
    executor = make_executor(nodes=[managed, other])

    async def change(transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert (await client.call_async(request)).success

    async def set_speed():
        given = await parameters.set_parameters([Parameter('speed', value=5)])
        names = await parameters.list_parameters([], 10)
        values = await parameters.get_parameters(['speed'])
        return given.results[0].successful, 'speed' in names.result.names, values.values

    def result(function, *args):
        task = executor.create_task(function, *args)
        assert wait_for(task.done)
        return task.result()

    with Spinning(executor):
        assert client.wait_for_service(60.0) and parameters.wait_for_services(60.0)
        result(change, Transition.TRANSITION_CONFIGURE)
        time.sleep(0.05)
        assert heard == []
        result(change, Transition.TRANSITION_ACTIVATE)
        assert wait_for(lambda: len(heard) >= 3)
        result(change, Transition.TRANSITION_DEACTIVATE)
        was_set, is_listed, values = result(set_speed)
    assert was_set and is_listed and told == ['speed']
    assert values[0].integer_value == managed.get_parameter('speed').value == 5
    managed.destroy_node()


def test_qos_events_reach_their_callbacks(make_executor, make_node):
    """Deadline missed and liveliness lost, on both sides, in a worker."""
    node = make_node()
    got = {'requested': [], 'offered': [], 'changed': [], 'lost': []}
    qos = QoSProfile(
        depth=10, deadline=Duration(seconds=0.1), liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(seconds=0.2))
    node.create_subscription(
        Header, '/topic', lambda m: None, qos, event_callbacks=SubscriptionEventCallbacks(
            deadline=got['requested'].append, liveliness=got['changed'].append))
    publisher = node.create_publisher(
        Header, '/topic', qos, event_callbacks=PublisherEventCallbacks(
            deadline=got['offered'].append, liveliness=got['lost'].append))
    with Spinning(make_executor(nodes=[node])):
        matched(publisher)
        publisher.publish(Header())
        assert wait_for(lambda: all(got.values())), got
        assert wait_for(lambda: got['changed'][-1].not_alive_count == 1)
        assert wait_for(
            lambda: publisher.assert_liveliness() or got['changed'][-1].alive_count == 1)
    assert got['lost'][0].total_count >= 1 and got['requested'][0].total_count >= 1


# --- what callbacks make and destroy -------------------------------------------------------------


def test_entities_that_a_callback_makes_run(make_executor, make_node):
    """Entities of each kind, made in a worker, and a node."""
    node, group, ran, kept = make_node(), ReentrantCallbackGroup(), set(), []
    executor = make_executor(nodes=[node])

    def answer(request, response):
        ran.add('request')
        return response

    def execute(goal):
        goal.succeed()
        return Fibonacci.Result()

    async def use(publisher, client, actions):
        publisher.publish(Header())
        await client.call_async(Trigger.Request())
        goal = await actions.send_goal_async(Fibonacci.Goal())
        await goal.get_result_async()
        ran.add('result')

    def make():
        first.cancel()
        new = make_node('made')
        executor.add_node(new)
        new.create_timer(0.005, lambda: ran.add('timer'), group)
        new.create_subscription(Header, '/made', lambda m: ran.add('message'), 10)
        new.create_service(Trigger, '/made', answer)
        node.create_guard_condition(lambda: ran.add('guard')).trigger()
        kept.extend([
            ActionServer(new, Fibonacci, '/made_action', execute, callback_group=group),
            ActionClient(new, Fibonacci, '/made_action', callback_group=group)])
        publisher, client = new.create_publisher(Header, '/made', 10), new.create_client(
            Trigger, '/made')
        matched(publisher)
        assert client.wait_for_service(60.0) and kept[1].wait_for_server(60.0)
        executor.create_task(use(publisher, client, kept[1]))

    first = node.create_timer(0.005, make)
    with Spinning(executor):
        assert wait_for(
            lambda: ran == {'timer', 'message', 'request', 'guard', 'result'}, 10.0), ran
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
    with Spinning(executor):
        assert client.wait_for_server(60.0)
        client.send_goal_async(Fibonacci.Goal()).cancel()
        cancelled.set()
        assert answered.wait(15.0)
        for _ in range(50):  # the response comes meanwhile
            count = len(ticks)
            assert wait_for(lambda count=count: len(ticks) > count)
    server.destroy()
    client.destroy()


def test_a_callback_may_destroy_what_it_belongs_to(make_executor, make_node):
    """A timer itself, a subscription itself, and in the end the node they are of (rclpy#1206)."""
    executor = make_executor()
    with Spinning(executor):
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

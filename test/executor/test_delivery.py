# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Messages between callbacks of one process: taken by who publishes, and none is lost."""

from concurrent.futures import ThreadPoolExecutor
import itertools
import subprocess
import sys
import threading
import time

from mddag_executor.executor import compat, current_job
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import is_idle, matched, patience, Spinning, wait_for
from .declared import graph


def test_the_publishing_thread_takes(make_executor, make_node):
    """
    So it is known when ``publish`` returns, though all workers are busy.

    A message from before the subscription comes first.
    """
    node, got, begun, go_on = make_node(), [], threading.Event(), threading.Event()
    qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(Header, '/a', qos)
    publisher.publish(Header(frame_id='early'))
    node.create_subscription(Header, '/a', lambda m: got.append(m.frame_id), qos)
    executor = make_executor(num_workers=1, nodes=[node])
    matched(publisher)
    publisher.publish(Header(frame_id='before'))
    with Spinning(executor):
        assert wait_for(lambda: got == ['early', 'before'])
        executor.create_task(lambda: (begun.set(), go_on.wait(15.0)))
        assert begun.wait(15.0)
        queues = []
        for number in range(3):
            publisher.publish(Header(frame_id=str(number)))
            queues.append(executor.statistics()['queue'])
        go_on.set()
        assert wait_for(lambda: len(got) == 5)
    assert queues == [1, 2, 3]
    publisher.publish(Header(frame_id='after'))
    assert got == ['early', 'before', '0', '1', '2']


def test_messages_after_a_failed_take_run_in_the_next_spin(make_executor, make_node, monkeypatch):
    """They arrived together, and no later message announces them."""
    node, got, errors = make_node(), [], [InvalidHandle('once')]
    take_with = compat.message_taker

    def message_taker(subscription):
        take = take_with(subscription)

        def fail_once():
            if errors:
                raise errors.pop()
            return take()
        return fail_once
    monkeypatch.setattr(compat, 'message_taker', message_taker)
    publisher = node.create_publisher(Header, '/a', 10)
    node.create_subscription(Header, '/a', lambda m: got.append(m.frame_id), 10)
    matched(publisher)
    for number in range(3):
        publisher.publish(Header(frame_id=str(number)))
    executor = make_executor(num_workers=1, nodes=[node])
    with pytest.raises(InvalidHandle, match='once'):
        for _ in range(10):
            executor.spin_once(0.2)
    for _ in range(10):
        executor.spin_once(0.2)
    assert got == ['0', '1', '2']


def test_a_publication_that_fails_leaves_no_subscription_deaf(make_executor, make_node):
    """While a thread publishes, no other one waits for messages on the topic."""
    node, got = make_node(), []
    publisher = node.create_publisher(Header, '/a', 10)
    node.create_subscription(Header, '/a', got.append, 10)
    executor = make_executor(num_workers=1, nodes=[node])
    with Spinning(executor):
        matched(publisher)
        for count in range(1, 4):
            assert wait_for(lambda: is_idle(executor))
            with pytest.raises(TypeError):
                publisher.publish('no message')
            with publisher.handle:
                publisher.handle.publish(Header())  # as a publisher of another process
            assert wait_for(lambda n=count: len(got) == n)


FOREIGN = """
import time, rclpy
from std_msgs.msg import Header
rclpy.init()
node = rclpy.create_node('foreign')
publisher = node.create_publisher(Header, '/a', 5000)
while not publisher.get_subscription_count():
    time.sleep(0.01)
for number in range(2000):
    publisher.publish(Header(frame_id=f'foreign:{number}'))
    time.sleep(0.0001)
publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=10))
rclpy.shutdown()
"""


def test_messages_of_this_process_and_of_another_one_come_all_and_in_order(
        make_executor, make_node):
    """
    Also while other publishers come and go; and those of the other process belong to no job.

    Many of them lie in the window of a publication here, and have other numbers.
    """
    node, plain, other, got, declared = *map(make_node, ('here', 'plain', 'other')), [], []
    publisher = node.create_publisher(Header, '/a', 5000)
    count = itertools.count()
    timer = node.create_timer(
        0.002, lambda: publisher.publish(Header(frame_id=f'here:{next(count)}')), autostart=False)
    node.create_subscription(
        Header, '/a', lambda m: declared.append((m.frame_id[:4], current_job() is None)), 5000)
    plain.create_subscription(Header, '/a', lambda m: got.append(m.frame_id), 5000)
    # On a busy machine there are too many foreign ones: they have time, and no job ends before.
    executor = make_executor(loads(graph(here="""
        name: tick, timer: 2ms, publishes: [/a]
        name: hear, subscription: /a, deadline: 60s""")), num_workers=2, nodes=[node, plain],
        default_deadline='60s', max_active_jobs=5000)
    with Spinning(executor):
        matched(publisher, count=2)
        with subprocess.Popen([sys.executable, '-c', FOREIGN]) as foreign:
            assert wait_for(lambda: 'foreign:200' in got)  # after that, its numbers are larger
            publisher.publish(Header(frame_id='main:0'))    # before any callback has
            timer.reset()
            executor.wake()
            for number in itertools.count(1):
                if 'foreign:1500' in got:
                    break
                brief = other.create_publisher(Header, '/a', 10)
                time.sleep(0.015)
                publisher.publish(Header(frame_id=f'main:{number}'))  # not in a callback
                other.destroy_publisher(brief)
                time.sleep(0.015)
            timer.cancel()  # only the other one publishes: no thread here receives for it then
        assert foreign.returncode == 0
        counts = {'here': next(count), 'main': number, 'foreign': 2000}
        assert wait_for(lambda: len(got) == len(declared) == sum(counts.values())), len(got)
    for name, sent in counts.items():
        assert numbers(got, name) == list(range(sent))
    assert {*declared} == {('fore', True), ('main', True), ('here', False)}


def test_the_first_message_of_a_callback_has_a_job_though_others_were_sent_before(
        make_executor, make_node):
    """By its publisher, outside of callbacks; only its number says which of two messages it is."""
    node, jobs = make_node('here'), []
    publisher, other = (node.create_publisher(Header, '/a', 10) for _ in range(2))

    def tick():
        other.handle.publish(Header(frame_id='other'))  # as a publisher of another process
        publisher.publish(Header(frame_id='here'))
        timer.cancel()

    timer = node.create_timer(0.01, tick, autostart=False)
    node.create_subscription(
        Header, '/a', lambda m: jobs.append((m.frame_id, current_job() is not None)), 10)
    executor = make_executor(loads(graph(here="""
        name: tick, timer: 10ms, publishes: [/a]
        name: hear, subscription: /a, deadline: 60s""")), nodes=[node], default_deadline='60s')
    with Spinning(executor):
        matched(publisher, other)
        publisher.publish(Header(frame_id='main'))
        assert wait_for(lambda: jobs)
        timer.reset()
        executor.wake()
        assert wait_for(lambda: len(jobs) == 3)
    assert sorted(jobs) == [('here', True), ('main', False), ('other', False)]


def numbers(got, name):
    return [int(text.split(':')[1]) for text in got if text.startswith(f'{name}:')]


def test_several_threads_publish_and_each_ones_order_is_kept(make_executor, make_node):
    """At the same time: each takes in what it publishes."""
    node, got = make_node(), []
    node.create_subscription(Header, '/a', lambda m: got.append(m.frame_id), 5000)
    publishers = [node.create_publisher(Header, '/a', 5000) for _ in range(4)]

    def publish(name):
        for number in range(200):
            publishers[name].publish(Header(frame_id=f'{name}:{number}'))

    with Spinning(make_executor(nodes=[node])), ThreadPoolExecutor() as pool:
        matched(*publishers)
        list(pool.map(publish, range(4)))
        assert wait_for(lambda: len(got) >= 800), len(got)
    for name in range(4):
        assert numbers(got, name) == list(range(200))


@pytest.mark.parametrize('waits', ['always', 'seldom'])
def test_work_does_not_wait_for_a_callback_that_goes_on_after_publishing(
        make_executor, make_node, waits):
    """It waits until its message has been heard: no other thread would start that callback."""
    node, group, heard, waited = make_node(), ReentrantCallbackGroup(), threading.Event(), []
    publisher = node.create_publisher(Header, '/one', 10)
    calls = iter(range(10 ** 6))

    def tick():
        heard.clear()
        publisher.publish(Header())
        if len(waited) < 10 and (waits == 'always' or next(calls) % 10 == 9):
            waited.append(heard.wait(15.0))

    node.create_timer(0.005, tick)
    node.create_subscription(Header, '/one', lambda m: heard.set(), 10, callback_group=group)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(waited) >= 10, 40.0)
    assert all(waited)


def test_a_publishing_callback_wakes_the_workers_of_another_executor(make_executor, make_node):
    """It ends soon, but it runs callbacks of its own executor only."""
    nodes, got = [make_node('first'), make_node('second')], [[], []]
    for node, heard in zip(nodes, got):
        node.create_subscription(
            Header, '/a', lambda m, heard=heard: heard.append(m.frame_id), 100)
    first, second = (make_executor(nodes=[node]) for node in nodes)
    publisher = nodes[0].create_publisher(Header, '/a', 100)
    waited = []

    def publish():
        before = len(got[1])
        publisher.publish(Header())
        waited.append(wait_for(lambda: len(got[1]) > before or len(waited) >= 5))

    with Spinning(first), Spinning(second):
        matched(publisher, count=2)
        nodes[0].create_timer(0.001, publish)
        assert wait_for(lambda: len(waited) >= 5, 60.0)
    assert all(waited)


def test_each_client_of_a_service_gets_its_own_response(ros_context, make_executor, make_node):
    """All clients of a service hear all responses; one's own may come after another one's."""
    server, node = SingleThreadedExecutor(context=ros_context), make_node('asks')
    serving = make_node('serves')
    serving.create_service(Trigger, 'served', lambda request, response: response)
    server.add_node(serving)
    executor = make_executor()
    clients = [node.create_client(Trigger, 'served') for _ in range(3)]
    assert all(client.wait_for_service(30.0) for client in clients)
    executor.add_node(node)
    executor.spin_once(0.0)
    for _ in range(3):
        futures = [client.call_async(Trigger.Request()) for client in reversed(clients)]
        for _ in futures:
            server.spin_once(5.0)
        for future in futures:
            executor.spin_until_future_complete(future, patience(5.0))
        assert all(future.done() for future in futures)
    server.shutdown()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The executor against real rclpy: each kind of callback, tasks, groups, queues, arguments."""

import threading
import time

from builtin_interfaces.msg import Time
from mddag_executor import MultiDeadlineExecutor
from mddag_executor.errors import MddagError
import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import Spinning, wait_for


def publish_when_matched(publisher, message, count=1):
    assert wait_for(lambda: publisher.get_subscription_count() > 0)
    for _ in range(count):
        publisher.publish(message)


def test_subscriptions_of_each_kind(make_executor, make_node):
    node = make_node()
    got = {'plain': [], 'info': [], 'raw': [], 'async': []}

    async def coroutine(message):
        got['async'].append(message.frame_id)

    node.create_subscription(Header, '/plain', lambda m: got['plain'].append(m.frame_id), 10)
    node.create_subscription(Header, '/info', lambda m, i: got['info'].append((m, i)), 10)
    node.create_subscription(Header, '/raw', got['raw'].append, 10, raw=True)
    node.create_subscription(Header, '/async', coroutine, 10)
    publishers = {name: node.create_publisher(Header, f'/{name}', 10) for name in got}
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        for publisher in publishers.values():
            publish_when_matched(publisher, Header(frame_id='x'))
        assert wait_for(lambda: all(got.values())), got
    assert got['plain'] == got['async'] == ['x']
    message, info = got['info'][0]
    assert message.frame_id == 'x' and info['source_timestamp'] > 0
    assert deserialize_message(got['raw'][0], Header).frame_id == 'x'


def test_service_and_client_from_a_coroutine(make_executor, make_node):
    node, answers = make_node(), []

    async def answer(request, response):
        response.success, response.message = True, 'yes'
        return response

    node.create_service(Trigger, '/ask', answer)
    client = node.create_client(Trigger, '/ask')
    group = MutuallyExclusiveCallbackGroup()  # a coroutine keeps its group while it waits

    async def ask():
        answers.append((await client.call_async(Trigger.Request())).message)

    timer = node.create_timer(0.01, ask, group)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(answers) >= 3)
        timer.cancel()
    assert set(answers) == {'yes'}


def test_a_callback_that_waits_may_lend_its_worker(make_executor, make_node):
    node, event, seen = make_node(), threading.Event(), []

    def wait():
        waiting.cancel()
        with executor.lend():
            seen.append(event.wait(15.0))

    waiting = node.create_timer(0.01, wait, ReentrantCallbackGroup())
    node.create_timer(0.02, event.set, ReentrantCallbackGroup())
    executor = make_executor(num_workers=1, nodes=[node])
    with executor.lend():  # elsewhere it does nothing
        pass
    with Spinning(executor):
        assert wait_for(lambda: bool(seen), 30.0)
    assert seen == [True]


def test_synchronous_calls_from_all_workers_at_once(make_executor, make_node):
    """A worker that waits lends its place: rclpy#1211 and #1398 hang here."""
    node = make_node()
    group, answers, together = ReentrantCallbackGroup(), [], threading.Barrier(7)
    node.create_service(
        Trigger, '/ask', lambda request, response: response, callback_group=group)
    client = node.create_client(Trigger, '/ask', callback_group=group)

    def ask():
        together.wait(5.0)
        answers.append(client.call(Trigger.Request(), timeout_sec=5.0))

    executor = make_executor(nodes=[node])
    assert client.wait_for_service(5.0)
    with Spinning(executor) as spinning:
        for _ in range(7):
            executor.create_task(ask)
        assert wait_for(lambda: len(answers) == 7)
    assert spinning.error is None
    assert None not in answers
    assert executor.statistics()['lent'] == 7


def test_tasks_functions_coroutines_and_futures_across_them(make_executor):
    executor = make_executor()
    future = Future(executor=executor)
    order = []

    async def waits():
        order.append('waits')
        value = await future
        order.append('has it')
        return f'{value}!'

    waiting = executor.create_task(waits)
    plain = executor.create_task(lambda a, b: a + b, 1, b=2)
    with Spinning(executor):
        assert wait_for(plain.done) and plain.result() == 3
        assert wait_for(lambda: order == ['waits']) and not waiting.done()
        future.set_result('value')
        assert wait_for(waiting.done)
    assert waiting.result() == 'value!' and order == ['waits', 'has it']


def test_tasks_and_nodes_wake_an_idle_executor(make_executor, make_node):
    executor = make_executor()
    calls = []
    with Spinning(executor):
        time.sleep(0.2)
        assert wait_for(executor.create_task(lambda: None).done)
        time.sleep(0.2)
        node = make_node()
        node.create_timer(0.001, lambda: calls.append(1))
        assert executor.add_node(node)
        assert not executor.add_node(node)
        assert wait_for(lambda: calls)
        assert executor.get_nodes() == [node]
        executor.remove_node(node)
        assert executor.get_nodes() == []
        assert wait_for(lambda: stays(calls))


def stays(calls):
    before = len(calls)
    time.sleep(0.05)
    return len(calls) == before


def test_a_node_destroyed_while_it_spins_and_one_made_instead(make_executor, make_node):
    executor = make_executor()
    total = 0
    with Spinning(executor) as spinning:
        for _ in range(8):
            calls = []
            node = make_node()
            node.create_timer(0.001, lambda some=calls: some.append(1))
            executor.add_node(node)
            assert wait_for(lambda some=calls: len(some) >= 3)
            node.destroy_node()
            assert wait_for(lambda some=calls: stays(some))
            total += len(calls)
    assert spinning.error is None
    counts = executor.statistics()['callbacks']
    assert counts['/node: <lambda> (timer 1ms)']['ran'] == total
    assert len(executor._registry._retired) <= 1


def test_mutually_exclusive_group_is_kept(make_executor, make_node):
    node = make_node()
    group, running, most, ran = MutuallyExclusiveCallbackGroup(), [0], [0], []
    lock = threading.Lock()

    def exclusive(message):
        with lock:
            running[0] += 1
            most[0] = max(most[0], running[0])
        time.sleep(0.005)
        with lock:
            running[0] -= 1
        ran.append(message)

    for _ in range(6):
        node.create_subscription(Header, '/topic', exclusive, 10, callback_group=group)
    publisher = node.create_publisher(Header, '/topic', 10)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: publisher.get_subscription_count() == 6)
        for _ in range(3):
            publisher.publish(Header())
        assert wait_for(lambda: len(ran) == 18)
    assert most[0] == 1


def test_queue_depth_is_kept_and_drops_are_counted(make_executor, make_node):
    """A bounded queue, the policy is that of its QoS: the oldest goes (rclcpp#3213)."""
    node, got, gate = make_node(), [], threading.Event()
    group = MutuallyExclusiveCallbackGroup()

    def slow(message):
        got.append(message.stamp.sec)
        gate.wait(5.0)

    node.create_subscription(Header, '/topic', slow, 3, callback_group=group)
    publisher = node.create_publisher(Header, '/topic', 100)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        publish_when_matched(publisher, Header(stamp=Time(sec=0)))
        assert wait_for(lambda: got == [0])
        for second in range(1, 11):
            publisher.publish(Header(stamp=Time(sec=second)))
            time.sleep(0.01)
        gate.set()
        assert wait_for(lambda: len(got) >= 4)
        assert stays(got)
    assert got == [0, 8, 9, 10]
    assert sum(executor.statistics()['dropped'].values()) == 7


@pytest.mark.parametrize('kwargs, says', [
    ({'num_workers': 0}, 'give an integer from 1 to'),
    ({'policy': 'nonsense'}, 'choose one of'),
    ({'worker_policy': 'SCHED_NONSENSE'}, 'give one of'),
    ({'worker_priority': 5}, 'give worker_policy'),
    ({'worker_cpus': {4096}}, 'choose from'),
    ({'trace': '/nowhere/at/all.mcap'}, '/nowhere/at/all.mcap'),
])
def test_bad_arguments_say_what_to_do(ros_context, kwargs, says):
    with pytest.raises(MddagError, match=says):
        MultiDeadlineExecutor(context=ros_context, **kwargs)

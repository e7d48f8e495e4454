# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is bounded: descriptors, threads, what waits in Python, and what an idle executor does."""

import threading

from mddag_executor.executor.bounds import MOST
from mddag_executor.executor.sources import SERVICE_DEPTH
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import HistoryPolicy, QoSProfile
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ..conftest import run_program
from .conftest import is_idle, Spinning, wait_for

# --- descriptors ---------------------------------------------------------------------------------

MANY = """
import os, resource, threading, time
import rclpy
from std_msgs.msg import Header
from mddag_executor import MultiDeadlineExecutor

rclpy.init()
node = rclpy.create_node('node', start_parameter_services=False, enable_rosout=False)
other = rclpy.create_node('other', start_parameter_services=False, enable_rosout=False)
heard = [[] for _ in range(300)]
ticks = [0] * 30
def tick(number):
    ticks[number] += 1
for number in range(30):
    node.create_timer(0.01, lambda number=number: tick(number))
for number in range(300):
    node.create_subscription(
        Header, f'/t{number % 10}', lambda m, to=heard[number]: to.append(m.frame_id), 100)
publishers = [other.create_publisher(Header, f'/t{number}', 100) for number in range(10)]
assert len(os.listdir('/proc/self/fd')) < 128
resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))
executor = MultiDeadlineExecutor()
executor.add_node(node)
thread = threading.Thread(target=executor.spin, daemon=True)
thread.start()
def until(done):
    end = time.monotonic() + 20
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)
until(lambda: all(publisher.get_subscription_count() == 30 for publisher in publishers))
for number in range(20):
    for publisher in publishers:
        publisher.publish(Header(frame_id=str(number)))
until(lambda: all(len(each) >= 20 for each in heard) and all(ticks))
# some go, and others come in their place
for subscription in list(node.subscriptions)[:150]:
    node.destroy_subscription(subscription)
late = []
node.create_subscription(Header, '/t0', lambda m: late.append(m.frame_id), 100)
until(lambda: publishers[0].get_subscription_count() == 16)
publishers[0].publish(Header(frame_id='late'))
until(lambda: late)
print(all(each[:20] == [str(n) for n in range(20)] for each in heard), all(ticks), late)
executor.shutdown()
thread.join()
rclpy.shutdown()
"""


def test_many_subscriptions_share_few_descriptors():
    """300 of them, and no more than 256 files."""
    assert run_program(MANY)[0] == "True True ['late']\n"


# --- what waits ----------------------------------------------------------------------------------


def waiting(executor):
    return executor.statistics()['queue']


def test_few_requests_wait_in_python_and_none_is_lost(make_executor, make_node):
    node, go_on, answered = make_node(), threading.Event(), []
    most = []
    executor = make_executor(num_workers=2)

    def answer(request, response):
        go_on.wait(15.0)
        most.append(sum(
            each['waiting'] for each in executor.statistics()['callbacks'].values()
            if each['kind'] == 'service'))
        response.message = str(len(most))
        return response

    qos = QoSProfile(depth=100)
    node.create_service(Trigger, '/ask', answer, qos_profile=qos)
    client = node.create_client(Trigger, '/ask', qos_profile=qos)
    executor.add_node(node)
    assert client.wait_for_service(15.0)
    with Spinning(executor):
        for _ in range(60):
            client.call_async(Trigger.Request()).add_done_callback(
                lambda future: answered.append(future.result().message))
        # one runs, and no more are taken than wait
        assert wait_for(lambda: waiting(executor) == SERVICE_DEPTH)
        go_on.set()
        assert wait_for(lambda: len(answered) == 60, 10.0), len(answered)
        assert wait_for(lambda: is_idle(executor))
    assert sorted(map(int, answered)) == list(range(1, 61))
    assert 0 < max(most) <= SERVICE_DEPTH


@pytest.mark.parametrize('from_here', [True, False])
def test_few_messages_of_keep_all_wait_in_python_and_none_is_lost(
        make_executor, make_node, monkeypatch, from_here):
    if not from_here:  # as from another process: a worker takes them
        monkeypatch.setattr(
            'mddag_executor.executor.publishing.replace_delivery', lambda *args: None)
    node, go_on = make_node(), threading.Event()
    got = []
    most = []
    executor = make_executor(num_workers=1)

    def hear(message):
        go_on.wait(15.0)
        most.append(waiting(executor))
        got.append(message.stamp.sec)

    qos = QoSProfile(history=HistoryPolicy.KEEP_ALL)
    node.create_subscription(Header, '/all', hear, qos)
    publisher = node.create_publisher(Header, '/all', qos)
    executor.add_node(node)
    message = Header()
    with Spinning(executor):
        assert wait_for(lambda: publisher.get_subscription_count() == 1)
        for number in range(300):
            message.stamp.sec = number
            publisher.publish(message)
        if from_here:
            assert wait_for(lambda: waiting(executor) in (MOST, MOST - 1))
        go_on.set()
        assert wait_for(lambda: len(got) == 300), len(got)
    assert got == list(range(300))
    assert max(most) <= MOST
    assert executor.statistics()['dropped'] == {}


# --- threads -------------------------------------------------------------------------------------


def worker_threads():
    return sum(thread.name.startswith('mddag-worker') for thread in threading.enumerate())


def test_blocked_calls_take_a_bounded_number_of_threads(make_executor, make_node):
    """The rest waits for a worker, and all are answered in the end."""
    workers, answers = 2, []
    node, other = make_node(), make_node('other')
    other.create_service(
        Trigger, '/ask', lambda request, response: response,
        callback_group=ReentrantCallbackGroup(), qos_profile=QoSProfile(depth=200))
    client = node.create_client(Trigger, '/ask', qos_profile=QoSProfile(depth=200))
    asking, answering = make_executor(num_workers=workers), make_executor(num_workers=2)
    asking.add_node(node)
    answering.add_node(other)
    assert client.wait_for_service(15.0)
    count = MOST + 30
    most = MOST + workers

    def ask():
        answers.append(client.call(Trigger.Request(), 20.0))

    with Spinning(asking):
        tasks = [asking.create_task(ask) for _ in range(count)]
        assert wait_for(lambda: asking.statistics()['lent'] == MOST, 30.0)
        assert wait_for(lambda: not asking.statistics()['idle_workers'])
        assert worker_threads() <= most
        with Spinning(answering):
            assert wait_for(lambda: all(task.done() for task in tasks), 10.0)
        assert None not in answers and len(answers) == count
        assert worker_threads() <= most
        assert wait_for(lambda: is_idle(asking))
        # and the next ones find their threads
        again = asking.create_task(lambda: 'fine')
        assert wait_for(again.done)
    assert wait_for(lambda: worker_threads() == 0)


# --- an idle executor ----------------------------------------------------------------------------

IDLE = """
import resource, threading, time
import rclpy
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from mddag_executor import MultiDeadlineExecutor
from msg_graph import loads

rclpy.init()
node = rclpy.create_node('node')
ran = []
group = rclpy.callback_groups.ReentrantCallbackGroup()
timer = node.create_timer(0.005, lambda: ran.append(publisher.publish(Header())))
node.create_subscription(Header, '/a', lambda message: ran.append(1), 10, callback_group=group)
node.create_timer(3600.0, print)
node.create_service(Trigger, '/ask', lambda request, response: response)
client = node.create_client(Trigger, '/ask')
publisher = node.create_publisher(Header, '/a', 10)
executor = MultiDeadlineExecutor(loads('''
mddag: 1
nodes:
  - node: /node
    callbacks:
      - {name: tick, timer: 5ms, publishes: [/a]}
      - {name: hear, subscription: /a, deadline: 1s}
'''))
executor.add_node(node)


def waits():
    return resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw


def measure():
    while len(ran) < 20:
        time.sleep(0.01)
    timer.cancel()
    found = []
    # discovery and the machine's other programs may disturb: one quiet second is enough
    while not found or found[-1] >= 20 and len(found) < 12:
        before = waits()
        time.sleep(1.0)
        found.append(waits() - before)
    print(found[-1] < 20 or found)


def end():
    executor.shutdown()

if WAY == 'spin_once':
    thread = threading.Thread(target=lambda: (measure(), end()))
    thread.start()
    while not executor._is_shutdown:
        executor.spin_once()
    thread.join()
else:
    thread = threading.Thread(target=executor.spin)
    thread.start()
    measure()
    end()
    thread.join()
rclpy.shutdown()
"""


@pytest.mark.parametrize('way', ['spin', 'spin_once'])
def test_nothing_wakes_in_an_idle_executor(way):
    """No thread polls: in a second the whole process, with the middleware, waits seldom."""
    assert run_program(IDLE.replace('WAY', repr(way)))[0] == 'True\n'

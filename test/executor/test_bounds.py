# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What is bounded: descriptors, threads, what waits in Python, and what an idle executor does."""

from functools import partial
import resource
import threading

from builtin_interfaces.msg import Time
from mddag_executor.executor import lending
from mddag_executor.executor.bounds import MOST
from mddag_executor.executor.loop import MOST_DESCRIPTORS, raise_limit
from mddag_executor.executor.sources import SERVICE_DEPTH
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import HistoryPolicy, QoSProfile
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ..conftest import run_program
from .conftest import is_idle, matched, Spinning, wait_for
from .declared import graph

# --- descriptors ---------------------------------------------------------------------------------


@pytest.fixture
def few_files():
    """Let this process open no more than 256 files."""
    raise_limit()  # once for the process
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.usefixtures('few_files')
def test_many_subscriptions_share_few_descriptors(make_executor, make_node):
    """300 of them, and 30 timers; some go, and others come in their place."""
    node, other = make_node(), make_node('other')
    heard, ticks, late = [[] for _ in range(300)], set(), []
    for number in range(30):
        node.create_timer(0.01, partial(ticks.add, number))
    for number, to in enumerate(heard):
        node.create_subscription(
            Header, f'/t{number % 10}', lambda m, to=to: to.append(m.stamp.sec), 100)
    publishers = [other.create_publisher(Header, f'/t{number}', 100) for number in range(10)]
    with Spinning(make_executor(nodes=[node])):
        matched(*publishers, count=30)
        for number in range(20):
            for publisher in publishers:
                publisher.publish(Header(stamp=Time(sec=number)))
        assert wait_for(lambda: all(len(each) == 20 for each in heard) and len(ticks) == 30)
        for subscription in [*node.subscriptions][:150]:
            node.destroy_subscription(subscription)
        node.create_subscription(Header, '/t0', late.append, 100)
        matched(publishers[0], count=16)
        publishers[0].publish(Header())
        assert wait_for(lambda: late)
    assert all(each[:20] == [*range(20)] for each in heard)


@pytest.mark.usefixtures('few_files')
def test_the_soft_limit_of_open_files_is_raised_once(make_executor):
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    make_executor()
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (256, hard)  # as set after the first
    raise_limit.cache_clear()
    make_executor()
    most = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (most, hard)


# --- what waits ----------------------------------------------------------------------------------


@pytest.mark.parametrize('kind', ['requests', 'messages', 'messages from elsewhere'])
def test_few_wait_in_python_and_none_is_lost(make_executor, make_node, monkeypatch, kind):
    """Also of KEEP_ALL; what comes from another process is taken by a worker."""
    if kind == 'messages from elsewhere':
        monkeypatch.setattr(
            'mddag_executor.executor.publishing.replace_delivery', lambda *args: None)
    node, go_on, got, most = make_node(), threading.Event(), [], []
    executor = make_executor(num_workers=1, nodes=[node])

    def waiting():
        return sum(each['waiting'] for each in executor.statistics()['callbacks'].values()
                   if each['kind'] in ('service', 'subscription'))

    def hear(message):
        go_on.wait(15.0)
        most.append(waiting())
        got.append(message.stamp.sec)

    def answer(request, response):
        hear(Header(stamp=Time(sec=len(got))))
        return response

    with Spinning(executor):
        if kind == 'requests':
            count, bound, qos = 60, SERVICE_DEPTH, QoSProfile(depth=100)
            node.create_service(Trigger, '/ask', answer, qos_profile=qos)
            client = node.create_client(Trigger, '/ask', qos_profile=qos)
            assert client.wait_for_service(60.0)
            futures = [client.call_async(Trigger.Request()) for _ in range(count)]
        else:
            count, bound, futures = 300, MOST, []
            qos = QoSProfile(history=HistoryPolicy.KEEP_ALL)
            node.create_subscription(Header, '/all', hear, qos)
            publisher = node.create_publisher(Header, '/all', qos)
            matched(publisher)
            for number in range(count):
                publisher.publish(Header(stamp=Time(sec=number)))
        if kind != 'messages from elsewhere':  # one runs, and no more are taken than may wait
            assert wait_for(lambda: waiting() in (bound, bound - 1))
        go_on.set()
        assert wait_for(lambda: len(got) == count and all(each.done() for each in futures))
        assert wait_for(lambda: is_idle(executor))
    assert got == list(range(count))
    assert 0 < max(most) <= bound
    assert executor.statistics()['dropped'] == {}


# --- threads -------------------------------------------------------------------------------------


def worker_threads():
    return sum(thread.name.startswith('mddag-worker') for thread in threading.enumerate())


@pytest.mark.parametrize('n_workers', [1, 2])
def test_a_call_for_which_no_thread_can_be_made(
        make_executor, make_node, monkeypatch, capfd, n_workers):
    """The other workers answer; without any, it raises what a thread raises."""
    node = make_node()
    node.create_service(
        Trigger, '/ask', lambda request, response: response,
        callback_group=ReentrantCallbackGroup())
    client = node.create_client(Trigger, '/ask', callback_group=ReentrantCallbackGroup())
    executor = make_executor(num_workers=n_workers, nodes=[node])

    def limited(thread):
        raise RuntimeError("can't start new thread")

    def ask():
        with monkeypatch.context() as limit:
            limit.setattr(threading.Thread, 'start', limited)
            try:
                return client.call(Trigger.Request(), 60.0)
            except RuntimeError as error:
                return error

    with Spinning(executor):
        assert client.wait_for_service(60.0)
        for _ in range(2):
            task = executor.create_task(ask)
            assert wait_for(task.done)
            assert isinstance(
                task.result(), RuntimeError if n_workers == 1 else Trigger.Response)
        task = executor.create_task(client.call, Trigger.Request(), 60.0)
        assert wait_for(task.done) and isinstance(task.result(), Trigger.Response)
        assert wait_for(lambda: executor.statistics()['idle_workers'] == n_workers)
    assert capfd.readouterr().err.count("can't start new thread: while callbacks wait in "
                                        'Client.call, fewer than 2 others run') == n_workers - 1


def test_blocked_calls_take_a_bounded_number_of_threads(make_executor, make_node):
    """The rest waits for a worker, and all are answered in the end."""
    answers, count, most = [], MOST + 30, MOST + 2
    node, other = make_node(), make_node('other')
    other.create_service(
        Trigger, '/ask', lambda request, response: response,
        callback_group=ReentrantCallbackGroup(), qos_profile=QoSProfile(depth=200))
    client = node.create_client(Trigger, '/ask', qos_profile=QoSProfile(depth=200))
    asking, answering = (make_executor(num_workers=2, nodes=[each]) for each in (node, other))
    assert client.wait_for_service(60.0)

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


def test_the_end_waits_for_no_blocked_call_though_it_has_kept_its_worker(
        make_executor, monkeypatch):
    """No thread would handle its answer any more."""
    monkeypatch.setattr(lending, 'MOST', 1)
    executor, begun, go_on = make_executor(num_workers=2), [], threading.Event()

    def waits():
        with executor.lend():
            begun.append(1)
            go_on.wait(60.0)

    try:
        with Spinning(executor):
            for _ in range(2):
                executor.create_task(waits)
            assert wait_for(lambda: len(begun) == 2)
            assert executor.statistics()['lent'] == 1
            assert executor.shutdown(20.0)
    finally:
        go_on.set()
    assert wait_for(lambda: worker_threads() == 0)


# --- an idle executor ----------------------------------------------------------------------------

IDLE = """
import resource, sys, threading, time
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
executor = MultiDeadlineExecutor(loads(sys.argv[2]))
executor.add_node(node)


def measure():
    while len(ran) < 20:
        time.sleep(0.01)
    timer.cancel()
    found = []
    # discovery and the machine's other programs may disturb: one quiet second is enough
    while not found or found[-1] >= 20 and len(found) < 12:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw
        time.sleep(1.0)
        found.append(resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw - before)
    print(found[-1] < 20 or found)
    executor.shutdown()

thread = threading.Thread(target=measure)
thread.start()
if sys.argv[1] == 'spin':
    executor.spin()
while not executor._is_shutdown:
    executor.spin_once()
thread.join()
rclpy.shutdown()
"""
IDLE_GRAPH = graph(
    node="""
        name: tick, timer: 5ms, publishes: [/a]
        name: hear, subscription: /a, deadline: 1s""")


@pytest.mark.parametrize('way', ['spin', 'spin_once'])
def test_nothing_wakes_in_an_idle_executor(way):
    """No thread polls: in a second the whole process, with the middleware, waits seldom."""
    assert run_program(IDLE, way, IDLE_GRAPH)[0] == 'True\n'

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes and entities come and go: nothing of them is kept, and what stays loses nothing."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
import gc
import os
import random
import threading
import time
from types import SimpleNamespace
import weakref

from mddag_executor.core.state import State
from mddag_executor.executor import publishing, waitables
from mddag_executor.executor.registry import OTHERS
from mddag_executor.executor.transfers import Transfer, transfer_of
from msg_graph import loads
import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import is_idle, matched, Spinning, wait_for
from .declared import graph
from .inside import engine_of, pool_of, registry_of

# --- while others run ----------------------------------------------------------------------------

RELIABLE = QoSProfile(depth=1000)
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def nothing(*_):
    pass


def answer(_, response):
    return response


def new_entity(node, draw):
    """Make an entity of any kind; return what destroys it."""
    group = draw.choice([None, ReentrantCallbackGroup(), MutuallyExclusiveCallbackGroup()])
    kind, topic = draw.randrange(6), f'/topic{draw.randrange(6)}'
    qos = draw.choice([RELIABLE, SENSOR])
    if kind == 0:
        publisher = node.create_publisher(
            Header, topic, qos,
            event_callbacks=PublisherEventCallbacks(matched=nothing, incompatible_qos=nothing))
        publisher.publish(Header())
        return lambda: node.destroy_publisher(publisher)
    if kind == 1:
        timer = node.create_timer(draw.choice([0.001, 0.01]), nothing, callback_group=group)
        return lambda: node.destroy_timer(timer)
    if kind == 2:
        service = node.create_service(Trigger, f'{topic}/ask', answer, callback_group=group)
        return lambda: node.destroy_service(service)
    if kind == 3:
        guard = node.create_guard_condition(nothing, callback_group=group)
        guard.trigger()
        return lambda: node.destroy_guard_condition(guard)
    subscription = node.create_subscription(
        Header, topic, nothing, qos, callback_group=group,
        event_callbacks=SubscriptionEventCallbacks(matched=nothing, incompatible_qos=nothing))
    return lambda: node.destroy_subscription(subscription)


def churn(node, executors, moving, seed):
    """Make and destroy entities of a node, and move it between executors, for a while."""
    draw, present, end = random.Random(seed), [], time.monotonic() + 3.0
    while time.monotonic() < end:
        if len(present) < 12 and draw.random() < 0.6:
            present.append(new_entity(node, draw))
        elif present:
            present.pop(draw.randrange(len(present)))()
        if draw.random() < 0.05:
            executor = draw.choice(executors)
            with moving:  # else rclpy's add_node may wait for another one, for ever
                executor.add_node(node)
            executor.create_task(nothing)
            executor.statistics()
            executor.wake()
        time.sleep(draw.choice([0.0, 0.0, 0.001, 0.01]))


def test_what_stays_loses_nothing(make_executor, make_node):
    """Entities of all kinds come and go in several threads, and nodes move."""
    executors = [make_executor(num_workers=7), make_executor(num_workers=2)]
    stable = [make_node('here'), make_node('there')]
    heard, answers, asked = [[], []], [], 0
    publishers, clients = [], []
    for number, node in enumerate(stable):
        node.create_subscription(
            Header, f'/stable{number}', lambda m, h=heard[number]: h.append(m.stamp.sec), RELIABLE)
        node.create_service(Trigger, f'/stable{number}/ask', answer)
        other = stable[1 - number]
        publishers.append(other.create_publisher(Header, f'/stable{number}', RELIABLE))
        clients.append(other.create_client(Trigger, f'/stable{number}/ask'))
        executors[number].add_node(node)
    others, moving = [make_node(f'churn{number}') for number in range(4)], threading.Lock()
    matched(*publishers)
    assert wait_for(lambda: all(each.service_is_ready() for each in clients))
    message = Header()
    with ThreadPoolExecutor() as pool, Spinning(executors[0]), Spinning(executors[1]):
        churns = [pool.submit(churn, node, executors, moving, i) for i, node in enumerate(others)]
        while not all(each.done() for each in churns):
            for publisher in publishers:
                publisher.publish(message)
            message.stamp.sec += 1
            if message.stamp.sec % 10 == 0:
                for client in clients:
                    client.call_async(Trigger.Request()).add_done_callback(answers.append)
                    asked += 1
            time.sleep(0.005)
        assert wait_for(lambda: len(heard[0]) == len(heard[1]) == message.stamp.sec)
        assert wait_for(lambda: len(answers) == asked)
    assert [each.result() for each in churns] == [None] * 4
    assert heard == [list(range(message.stamp.sec))] * 2


# --- what is kept --------------------------------------------------------------------------------

GRAPH = graph(
    source='name: tick, timer: 10ms, publishes: [/chatter], dag: chain',
    sink='name: heard, subscription: /chatter, deadline: 50ms')
CYCLES = 15
# What is kept of the last ones: publications and response times, a few in a worker's frame.
SETTLED = 5


@pytest.mark.parametrize('to_group', [False, True])
def test_an_execution_that_waits_runs_when_its_node_moves_to_an_open_group(
        make_executor, make_node, to_group):
    node, ran = make_node(), []
    guard = node.create_guard_condition(lambda: ran.append(1))
    executor = make_executor(nodes=[node])
    closed, opened = executor.new_outer_group(), executor.new_outer_group()
    opened.open(1)
    executor.put(node, closed)
    with Spinning(executor):
        guard.trigger()
        assert wait_for(lambda: executor.statistics()['queue'] == 1)
        executor.put(node, opened if to_group else None)
        assert wait_for(lambda: ran)


def test_a_refresh_does_not_put_off_the_look_at_a_callback_that_takes_longer_than_usual(
        make_executor, make_node):
    """Another thread soon runs what the callback has posted: it may wait for that."""
    node = make_node(parameter_overrides=[  # nothing comes from outside, so no other look is due
        Parameter('start_type_description_service', value=False)])
    victims = [node.create_guard_condition(nothing) for _ in range(3)]
    ran, waited = [], []

    def callback():
        if len(ran) % 20 == 19:
            is_done = threading.Event()
            executor.create_task(is_done.set)
            node.destroy_guard_condition(victims.pop())
            waited.append(is_done.wait(15.0))
        ran.append(1)

    guard = node.create_guard_condition(callback)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        for count in range(1, 61):
            guard.trigger()
            assert wait_for(lambda count=count: len(ran) == count, 30.0)
    assert waited == [True] * 3


class Brief:
    """Two nodes for a while: a declared chain, and everything else that a node can have."""

    def __init__(self, executor, context, made):
        self.executor = executor
        source, sink = self.nodes = [  # not by the fixture, which keeps its nodes
            Node(name, context=context, enable_rosout=False, start_parameter_services=False)
            for name in ('source', 'sink')]
        self.heard = []
        publisher = self._publisher = source.create_publisher(Header, 'chatter', 10)
        group = MutuallyExclusiveCallbackGroup()
        entities = [
            publisher, group, source.create_timer(0.01, self._tick),
            sink.create_subscription(Header, 'chatter', self._hear, 10, callback_group=group),
            sink.create_service(Trigger, 'ask', answer), sink.create_client(Trigger, 'ask'),
            sink.create_guard_condition(nothing)]
        made += [weakref.ref(thing) for thing in (self, *self.nodes, *entities)]
        for node in self.nodes:
            executor.add_node(node)
        thread = threading.Thread(target=self._tick)    # of the program's own
        thread.start()
        thread.join()

    def _tick(self):
        with suppress(InvalidHandle):  # destroyed while it runs
            self._publisher.publish(Header())

    def _hear(self, message):
        self.heard.append(message)

    def end(self):
        for node in self.nodes:
            node.destroy_node()
            self.executor.remove_node(node)


# A busy machine has more stops, which are bounded, and slots, which are used again: an invariant.
VARIES, OF_SLOTS = ('Deadlines.', 'Stops.'), ('x_', 'job_')


def sizes(executor):
    """Return the sizes of what the executor, and all that it consists of, has."""
    found, seen, todo = Counter(), set(), [executor]
    state = engine_of(executor).scheduler.state     # others also refer to its columns
    of_slots = {id(getattr(state, name)) for name in State._fields if name.startswith(OF_SLOTS)}
    while todo:
        owner = todo.pop()
        if id(owner) in seen or not type(owner).__module__.startswith('mddag_executor.'):
            continue
        seen.add(id(owner))
        for name in (*getattr(owner, '__dict__', ()), *getattr(owner, '__slots__', ())):
            value = getattr(owner, name)
            todo.append(value)
            name = f'{type(owner).__name__}.{name}'
            if (hasattr(value, '__len__') and not isinstance(value, str)
                    and id(value) not in of_slots and not name.startswith(VARIES)):
                found[name] += len(value)
    return found + Counter({
        'deliveries': sum(map(len, publishing._deliveries.values())),
        'events': len(waitables._known), 'descriptors': len(os.listdir('/proc/self/fd'))})


def test_nodes_that_come_and_go_leave_nothing_behind(make_executor, ros_context):
    executor = make_executor(loads(GRAPH))
    made, heard = [], []

    def cycle(times):
        for _ in range(times):
            brief = Brief(executor, ros_context, made)
            assert wait_for(lambda brief=brief: brief.heard), spinning.error
            brief.end()
            heard.append(brief.heard)
            del brief
            gc.collect()  # else it depends on how busy the interpreter is

    def nothing_left():
        gc.collect()
        return len(registry_of(executor).by_id) == 0 and not registry_of(executor)._retired

    with Spinning(executor) as spinning:
        cycle(SETTLED)
        assert wait_for(nothing_left)
        before = sizes(executor)
        assert len(before) > 30
        cycle(CYCLES)
        assert wait_for(nothing_left)

        def grown():
            return {name: (before[name], size) for name, size in sizes(executor).items()
                    if size - before[name] >= CYCLES // 2}
        assert wait_for(lambda: not grown()), grown()

        def left():
            gc.collect()
            return [thing() for thing in made[:-10 * SETTLED] if thing() is not None]
        assert wait_for(lambda: not left()), left()
    ran = executor.statistics()['callbacks']['/sink:heard']['ran']
    assert ran == sum(map(len, heard))


def test_names_of_destroyed_callbacks_are_kept_up_to_a_bound(
        make_executor, make_node, monkeypatch):
    """A helper node with a random name, for instance, that each request makes."""
    monkeypatch.setattr('mddag_executor.executor.registry.REMEMBERED', 2)
    executor, ran = make_executor(), []
    for number in (*range(5), 0):
        node = make_node(f'helper_{number}')
        before = ran.count(number)
        timer = node.create_timer(0.001, lambda number=number: ran.append(number))
        executor.add_node(node)
        assert wait_for(
            lambda n=number, m=before: executor.spin_once(1.0) or ran.count(n) > m)
        node.destroy_timer(timer)
        executor.remove_node(node)
        executor.spin_once(0)
    counts = executor.statistics()['callbacks']
    assert sum(each['ran'] for each in counts.values()) == len(ran) >= 5
    assert len(counts) == 3 and counts[OTHERS]['ran'] >= 3
    # the name of the first one is among those that are kept
    assert ran.count(0) in [each['ran'] for name, each in counts.items() if '/helper_0' in name]


def test_a_node_is_forgotten_when_its_last_callback_ends(make_executor, make_node):
    """Though nothing else happens then."""
    executor, node, begun = make_executor(num_workers=2), make_node(), threading.Event()
    go_on = threading.Event()
    node.create_guard_condition(lambda: (begun.set(), go_on.wait(30.0))).trigger()
    executor.add_node(node)
    registry = registry_of(executor)
    with Spinning(executor):
        assert begun.wait(15.0)
        executor.remove_node(node)
        assert wait_for(lambda: registry._retired)
        assert wait_for(lambda: pool_of(executor).is_current)
        go_on.set()
        assert wait_for(lambda: not registry._retired)


def test_nodes_that_are_removed_and_come_back_without_a_spin_leave_no_descriptors(
        make_executor, make_node):
    """Also if several are, one after the other: each listens once again."""
    nodes, ran = [make_node(name) for name in 'ab'], []
    for node in nodes:
        node.create_timer(0.001, lambda node=node: ran.append(node))
        node.create_subscription(Header, '/a', print, 10)
    executor, sizes = make_executor(nodes=nodes), []
    for _ in range(6):
        ran.clear()
        assert wait_for(lambda: executor.spin_once(1.0) or len({*ran}) == 2)
        sizes.append(len(os.listdir('/proc/self/fd')))
        for change in (executor.remove_node, executor.add_node):
            for node in nodes:
                change(node)
    assert sizes[-1] == sizes[1]


def test_a_destroyed_node_is_freed_without_the_collector(make_executor, ros_context):
    """Else it waits with all its handles: with many objects around that may take hours."""
    executor = make_executor()
    gc.collect()
    gc.disable()
    try:
        with Spinning(executor):
            node = Node('brief', context=ros_context, enable_rosout=False,
                        start_parameter_services=False)
            publisher = node.create_publisher(Header, 'chatter', 10)
            subscription = node.create_subscription(Header, 'chatter', nothing, 10)
            things = [publisher, subscription, *publisher.event_handlers,
                      *subscription.event_handlers, node.create_timer(100.0, print)]
            n_things = len(things) - 1  # publishers are not kept
            executor.add_node(node)
            assert wait_for(lambda: len(registry_of(executor).by_id) >= n_things
                            and pool_of(executor).is_current)
            left = [weakref.ref(thing) for thing in (node, *things)]
            assert len(left) > 6
            node.destroy_node()
            executor.remove_node(node)
            del node, publisher, subscription, things
            assert wait_for(lambda: all(thing() is None for thing in left)), [
                thing() for thing in left if thing() is not None]
    finally:
        gc.enable()


# --- nodes that move -----------------------------------------------------------------------------

class Moving:
    """A node with all kinds of arrivals, some of which an executor has collected but not run."""

    def __init__(self, make_node):
        self.heard, self.node, other = [], make_node('moving'), make_node('other')
        self.node.create_subscription(
            Header, '/moved', lambda m: self.heard.append(m.stamp.sec), 10)
        self.node.create_service(Trigger, '/moved/ask', answer)
        self.guard = self.node.create_guard_condition(lambda: self.heard.append(-1))
        self.publisher = other.create_publisher(Header, '/moved', 10)
        self.client = other.create_client(Trigger, '/moved/ask')
        self.other, self.answers = other, []
        matched(self.publisher)
        assert wait_for(self.client.service_is_ready)

    def send(self):
        for number in range(3):
            message = Header()
            message.stamp.sec = number
            self.publisher.publish(message)
        self.client.call_async(Trigger.Request()).add_done_callback(self.answers.append)
        self.guard.trigger()

    def has_all(self):
        return sorted(self.heard) == [-1, 0, 1, 2] and len(self.answers) == 1


def waiting(executor):
    return sum(each['waiting'] for each in executor.statistics()['callbacks'].values())


class Owner:
    """What listens to an object."""

    def __init__(self, give_up):
        self.give_up = give_up


def test_only_another_executor_requests_what_waits():
    """One that begins to listen again keeps it."""
    given_up, transfer = [], Transfer()
    first, second = (Owner(given_up.append) for _ in range(2))
    for owner, expected in ((first, []), (first, []), (second, ['timer'])):
        transfer.claim(owner, 'timer')
        assert given_up == expected


@pytest.mark.parametrize('shuts_down', [False, True])
def test_what_waits_moves_with_its_node(make_executor, make_node, shuts_down):
    """With executors of rclpy, messages wait in the middleware until their callbacks run."""
    moving = Moving(make_node)
    has_begun, go_on = threading.Event(), threading.Event()

    def wait():
        has_begun.set()
        go_on.wait(30.0)

    guard = moving.node.create_guard_condition(wait)  # in the callback group of all others
    before = make_executor(num_workers=2, nodes=[moving.node])
    after = make_executor(nodes=[moving.other])
    with Spinning(after):
        with Spinning(before):
            guard.trigger()
            assert has_begun.wait(15.0)
            moving.send()
            assert wait_for(lambda: waiting(before) == 5)
            if shuts_down:
                before.shutdown(0.0)
            after.add_node(moving.node)
            go_on.set()
            assert wait_for(moving.has_all)
            assert wait_for(lambda: is_idle(after))
    assert moving.has_all() and [each for each in moving.heard if each >= 0] == [0, 1, 2]


def test_an_executor_that_has_ended_leaves_what_another_one_has_left(make_executor, make_node):
    node = make_node()
    subscription = node.create_subscription(Header, '/a', print, 10)
    executor = make_executor(nodes=[node])
    executor.spin_once(0)
    executor.abandon_callbacks()    # its run has ended, and it still has its nodes
    transfer_of(subscription).leave([
        SimpleNamespace(function=print, args=(number,), then=None) for number in range(3)])
    assert executor.unmatched() == []   # brings its entities up to date
    assert [each.args for each in transfer_of(subscription).left] == [(0,), (1,), (2,)]


def test_a_sync_lacks_what_it_had_until_it_has_all_again(make_executor, make_node):
    node = make_node()
    executor = make_executor(loads(graph(node="""
        name: a, timer: 1s, publishes: [/a, /b]
        name: sync, sync: [/a, /b], deadline: 1s""")), nodes=[node])
    bindings, verdicts = registry_of(executor).bindings, engine_of(executor).verdicts

    def make(topic):
        return node.create_subscription(Header, topic, print, 10)

    subscriptions = [make('/a'), make('/b')]
    executor.spin_once(0)
    assert not verdicts.gone and not bindings.gone()
    for subscription in subscriptions:
        node.destroy_subscription(subscription)
        executor.spin_once(0)
        if subscription is subscriptions[0]:
            first = bindings.gone()
            assert [*first] == [*verdicts.gone] == ['/node:sync']
    assert bindings.gone() == first     # since it has lacked any
    make('/a')
    executor.spin_once(0)
    assert '/node:sync' in verdicts.gone and bindings.gone().keys() == first.keys()
    assert bindings.gone() != first
    make('/b')
    executor.spin_once(0)
    assert not verdicts.gone and not bindings.gone()


@pytest.mark.parametrize('then', ['moves', 'comes_back', 'shuts_down'])
def test_what_a_spin_once_has_not_run_moves_with_its_node(make_executor, make_node, then):
    moving = Moving(make_node)
    before, after = make_executor(nodes=[moving.node]), make_executor(nodes=[moving.other])
    with Spinning(after):
        before.spin_once(timeout_sec=0.0)
        moving.send()
        assert wait_for(lambda: before.spin_once(timeout_sec=0.1) or waiting(before) > 1)
        if then == 'shuts_down':
            before.shutdown()
        else:
            before.remove_node(moving.node)
        if then == 'comes_back':
            before.add_node(moving.node)
            assert wait_for(lambda: before.spin_once(timeout_sec=0.01) or moving.has_all())
        else:
            after.add_node(moving.node)
            assert wait_for(moving.has_all)
            assert wait_for(lambda: is_idle(after))
    assert moving.has_all() and [each for each in moving.heard if each >= 0] == [0, 1, 2]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Actions, QoS events, guard conditions, waitables of a user's own, and timers with info."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
import os
import sys
import threading
import time
from types import SimpleNamespace

from mddag_executor.executor import compat
from mddag_executor.executor.listeners import ListenerError
from mddag_executor.executor.waitables import EventsSource, WaitableSource
from mddag_executor.executor.work import Work
import pytest
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler, PublisherEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rclpy.time import Time
from rclpy.waitable import NumberOfEntities, Waitable
from std_msgs.msg import Header
from test_msgs.action import Fibonacci

from .conftest import is_idle, patience, Pulse, Spinning, wait_for
from .inside import pool_of

SUCCEEDED, CANCELED = 4, 5
QOS = QoSProfile(depth=100)


class Counting:
    """An action that counts up to its order, in a node of its own; and a client for it."""

    def __init__(self, server_node, client_node, **kwargs):
        group = ReentrantCallbackGroup()
        self.server = ActionServer(
            server_node, Fibonacci, 'count', self._execute, callback_group=group,
            cancel_callback=lambda request: CancelResponse.ACCEPT,
            feedback_pub_qos_profile=QOS, **kwargs)
        self.client = ActionClient(client_node, Fibonacci, 'count', callback_group=group,
                                   feedback_sub_qos_profile=QOS)

    def _execute(self, goal):
        feedback = Fibonacci.Feedback()
        for number in range(goal.request.order):
            feedback.sequence.append(number)
            goal.publish_feedback(feedback)
        if goal.request.order == 0:
            wait_for(lambda: goal.is_cancel_requested)
            goal.canceled()
        else:
            goal.succeed()
        return Fibonacci.Result(sequence=feedback.sequence)

    async def ask(self, order):
        """Return status, result and lengths of the feedback of a goal; cancel one of order 0."""
        lengths = []
        goal = await self.client.send_goal_async(
            Fibonacci.Goal(order=order),
            feedback_callback=lambda m: lengths.append(len(m.feedback.sequence)))
        assert goal.accepted
        if order == 0:
            await goal.cancel_goal_async()
        answer = await goal.get_result_async()
        return answer.status, list(answer.result.sequence), sorted(lengths)

    def destroy(self):
        self.server.destroy()
        self.client.destroy()


@pytest.mark.parametrize('apart', [False, True])
def test_many_goals_at_once(make_executor, make_node, apart):
    """Client and server in one executor, or each in one of its own."""
    nodes = [make_node('server'), make_node('client')]
    counting = Counting(*nodes)
    executors = [make_executor(), make_executor()]
    for executor, node in zip(executors if apart else executors[1:] * 2, nodes):
        executor.add_node(node)
    with Spinning(executors[1]), Spinning(executors[0]):
        assert counting.client.wait_for_server(15.0)
        tasks = [executors[1].create_task(counting.ask(order)) for order in (*range(1, 9), 0, 0)]
        assert wait_for(lambda: all(task.done() for task in tasks))
        assert wait_for(lambda: all(map(is_idle, executors)))
    for order, task in enumerate(tasks[:8], 1):
        assert task.result() == (SUCCEEDED, [*range(order)], [*range(1, order + 1)])
    assert [task.result()[0] for task in tasks[8:]] == [CANCELED] * 2
    counting.destroy()


def test_the_server_of_many_goals_is_asked_once_when_the_first_one_expires(
        make_executor, make_node):
    node = make_node()
    counting = Counting(node, node, result_timeout=300.0)
    executor = make_executor(nodes=[node])
    for _ in range(10):
        task = executor.create_task(counting.ask(2))
        executor.spin_until_future_complete(task, patience(15.0))
        assert task.result()[0] == SUCCEEDED
    assert pool_of(executor).agenda._appointments <= 3
    counting.destroy()


def test_a_response_that_comes_while_its_goal_is_being_sent(make_executor, make_node):
    """In rclpy 9.1.2, the client makes the future once more after the request has been sent."""
    class Slow(dict):
        def __setitem__(self, key, value):
            time.sleep(0.1)
            super().__setitem__(key, value)

    nodes = [make_node('server'), make_node('client')]
    counting = Counting(*nodes)
    counting.client._feedback_callbacks = Slow()
    executor = make_executor(nodes=nodes)
    with Spinning(executor):
        assert counting.client.wait_for_server(15.0)
        task = executor.create_task(counting.ask(1))
        assert wait_for(task.done)
    assert task.result()[:2] == (SUCCEEDED, [0])
    counting.destroy()


@pytest.mark.parametrize('stepwise', [False, True])
def test_a_goal_expires_when_its_time_is_over(make_executor, make_node, stepwise):
    """The timer is within the server; nothing else happens meanwhile."""
    node = make_node()
    counting = Counting(node, node, result_timeout=0.2)
    executor = make_executor(nodes=[node])
    for _ in range(2):
        task = executor.create_task(counting.ask(2))
        executor.spin_until_future_complete(task, patience(15.0))
        assert task.result()[0] == SUCCEEDED and len(counting.server._goal_handles) == 1
        if stepwise:
            assert wait_for(
                lambda: executor.spin_once(0.05) or not counting.server._goal_handles)
        else:
            end = executor.create_future()
            thread = threading.Thread(
                target=executor.spin_until_future_complete, args=(end, 30.0))
            thread.start()
            assert wait_for(lambda: not counting.server._goal_handles)
            end.set_result(None)
            thread.join(30.0)
    counting.destroy()


@pytest.mark.parametrize('stepwise', [False, True])
def test_a_goal_expires_when_simulated_time_is_over(make_executor, make_node, stepwise):
    """It is not over while the clock of the node stands."""
    node = make_node()
    clock = node.get_clock()
    counting = Counting(node, node, result_timeout=800.0)
    executor = make_executor(nodes=[node])
    clock._set_ros_time_is_active(True)

    def set_clock(seconds):
        clock.set_ros_time_override(
            Time(nanoseconds=int(seconds * 1e9), clock_type=clock.clock_type))

    def goals(seconds, expected):
        """Set the clock; return whether this many goals are left then."""
        set_clock(seconds)
        return wait_for(lambda: stepwise and executor.spin_once(0.01) or (
            len(counting.server._goal_handles) == expected))

    with nullcontext() if stepwise else Spinning(executor):
        for begin in (1000.0, 2000.0):
            set_clock(begin)
            task = executor.create_task(counting.ask(2))
            assert wait_for(
                lambda done=task.done: stepwise and executor.spin_once(0.01) or done())
            assert task.result()[0] == SUCCEEDED
            assert goals(begin + 799.0, 1)
            assert goals(begin + 801.0, 0)
    counting.destroy()


# --- QoS events ----------------------------------------------------------------------------------


def test_events_keep_their_listener_when_another_one_is_destroyed_meanwhile(
        make_executor, make_node, monkeypatch):
    """No thread waits for them in a wait set, which would disturb the next listener."""
    node, victims, waiting = make_node(), [], set()
    subscriptions = [node.create_subscription(Header, f'/t{i}', print, 10) for i in range(20)]
    executor = make_executor(nodes=[node])
    listen, add = EventsSource.listen, EventHandler.add_to_wait_set

    def destroy_before(self, before=None):
        while victims:
            node.destroy_subscription(victims.pop())
        listen(self, before)

    def note(self, wait_set):
        waiting.add(threading.current_thread().name)
        add(self, wait_set)

    monkeypatch.setattr(EventsSource, 'listen', destroy_before)
    monkeypatch.setattr(EventHandler, 'add_to_wait_set', note)
    with Spinning(executor):
        for number in range(10):
            assert wait_for(lambda: is_idle(executor))
            victims.append(subscriptions.pop())
            subscriptions.insert(0, node.create_subscription(Header, f'/n{number}', print, 10))
            assert wait_for(lambda: not victims)
    assert waiting and 'mddag-wait-set' not in waiting


def test_an_event_keeps_its_change_when_others_are_created(make_executor, make_node):
    """Setting a listener again would forget by how much the counts have changed."""
    node, other, seen = make_node(), make_node('other'), []
    publisher = node.create_publisher(
        Header, '/topic', 10, event_callbacks=PublisherEventCallbacks(
            matched=lambda info: seen.append((info.current_count, info.current_count_change))))
    executor = make_executor(nodes=[node])
    executor.spin_once(0.0)
    for number in (1, 2, 3):
        other.create_subscription(Header, '/topic', print, 10)
        assert wait_for(lambda: publisher.get_subscription_count() == number)  # noqa: B023
        node.create_subscription(Header, f'/n{number}', print, 10)
        end = time.monotonic() + 15
        while len(seen) < number and time.monotonic() < end:
            executor.spin_once(0.1)
    assert seen == [(1, 1), (2, 1), (3, 1)]


def test_an_event_is_taken_that_was_announced_before_another_was_destroyed(
        make_executor, make_node, monkeypatch):
    """Its thread had not asked for it yet when the shared source was made again."""
    node, other, seen, held = make_node(), make_node('other'), [], []
    node.create_publisher(Header, '/topic', 10, event_callbacks=PublisherEventCallbacks(
        matched=lambda info: seen.append(info.current_count_change)))
    another = node.create_subscription(Header, '/another', print, 10)
    executor = make_executor(nodes=[node])
    executor.spin_once(0.0)

    def spin_until(done):
        end = time.monotonic() + 15
        while not done() and time.monotonic() < end:
            executor.spin_once(0.1)
        return done()

    with monkeypatch.context() as patch:
        patch.setattr(EventsSource, 'collect', lambda self: held.append(self._ask))
        other.create_subscription(Header, '/topic', print, 10)
        assert spin_until(lambda: held)
    node.destroy_subscription(another)
    executor.spin_once(0.1)
    for ask in held:
        ask()
    assert spin_until(lambda: seen) and seen == [1]


def test_the_middleware_writes_to_no_file_after_the_executor_has_ended(
        make_executor, make_node, tmp_path):
    """Not even if the event of another subscription has just been destroyed."""
    node, source, noticed = make_node(), make_node('source'), []
    subscriptions = [node.create_subscription(Header, f'/t{i}', print, 10) for i in range(20)]
    executor = make_executor(nodes=[node])
    executor.spin_once(0.0)
    subscriptions[0].event_handlers[0].destroy()
    executor.shutdown()
    files = [(tmp_path / f'{number}').open('w+b', buffering=0) for number in range(200)]
    sensor = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    for number in range(1, 20):
        source.create_publisher(Header, f'/t{number}', sensor, event_callbacks=(
            PublisherEventCallbacks(incompatible_qos=noticed.append)))
    with Spinning(make_executor(nodes=[source])):
        assert wait_for(lambda: len(noticed) == 19)
    sizes = []
    for file in files:
        with file:
            sizes.append(os.fstat(file.fileno()).st_size)
    assert sizes == [0] * 200


# --- guard conditions and waitables of a user's own ----------------------------------------------

class Seen(Pulse):
    """It notes which threads ask it."""

    def __init__(self, node):
        super().__init__(node, ReentrantCallbackGroup())
        self.ran, self.asked_by = 0, set()

    def is_ready(self, wait_set):
        self.asked_by.add(threading.current_thread().name)
        return super().is_ready(wait_set)

    async def execute(self, taken_data):
        self.ran += 1


@pytest.mark.parametrize('listens', [True, False], ids=['listener', 'thread'])
def test_what_is_triggered_runs(make_executor, make_node, spinning, monkeypatch, listens):
    """By a listener, or by the thread that waits if there is none; no matter who triggers it."""
    node, ran = make_node(), []
    guard = node.create_guard_condition(lambda: ran.append(1))
    seen = Seen(node)
    node.add_waitable(seen)
    guard.trigger()  # nothing listens yet
    seen.guard.trigger()
    if not listens:
        def listen(self, before=None):
            raise ListenerError('the middleware has none')
        monkeypatch.setattr(WaitableSource, 'listen', listen)

    def both_run(by_handle):
        before = len(ran), seen.ran
        for each in guard, seen.guard:
            (each.handle.trigger_guard_condition if by_handle else each.trigger)()
        assert wait_for(lambda: len(ran) > before[0] and seen.ran > before[1])

    with spinning(make_executor(nodes=[node])):
        assert wait_for(lambda: ran and seen.ran)
        both_run(False)
        both_run(True)
        other = node.create_guard_condition(lambda: ran.append(2))
        other.trigger()
        assert wait_for(lambda: 2 in ran)
        node.destroy_guard_condition(other)
        both_run(False)
    assert ('mddag-wait-set' in seen.asked_by) is not listens


def test_a_wake_up_that_a_busy_thread_has_received_is_not_waited_for(make_executor, make_node):
    """A thread that looks for events after a callback also takes the event of the bell."""
    node, ran = make_node(), []

    def compute():  # too long for the thread to go on without looking
        end = time.monotonic() + 0.002
        while time.monotonic() < end:
            pass
        ran.append(1)

    guards = [node.create_guard_condition(compute) for _ in range(2)]
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        for _ in range(5):
            before = len(ran)
            for guard in guards:
                guard.trigger()
            assert wait_for(lambda before=before: len(ran) > before)
            assert wait_for(lambda: is_idle(executor))
            assert wait_for(executor.create_task(lambda: None).done)


class Bare(Waitable):
    """A waitable without any entity: it is ready when it says so."""

    def __init__(self):
        super().__init__(ReentrantCallbackGroup())
        self.ready, self.ran = False, 0

    def __enter__(self):
        pass

    def __exit__(self, *_):
        pass

    def is_ready(self, wait_set):
        return self.ready

    def take_data(self):
        self.ready = False

    async def execute(self, taken_data):
        self.ran += 1

    def get_num_entities(self):
        return NumberOfEntities()

    def add_to_wait_set(self, wait_set):
        pass


def test_a_waitable_without_entities_is_asked_when_the_executor_is_woken(
        make_executor, make_node, spinning):
    node, bare = make_node(), Bare()
    node.add_waitable(bare)
    executor = make_executor(nodes=[node])
    with spinning(executor):
        for _ in range(3):
            assert wait_for(lambda: is_idle(executor))
            bare.ready = True
            executor.wake()
            assert wait_for(lambda: not bare.ready)
        assert wait_for(lambda: bare.ran == 3)


# --- timers --------------------------------------------------------------------------------------


@pytest.mark.skipif(compat.TimerInfo is None, reason='this rclpy has no TimerInfo')
def test_a_timer_gives_its_info_to_who_asks_for_it(make_executor, make_node):
    node, seen, plain = make_node(), [], []

    def tick(call):
        seen.append((call.expected_call_time, call.actual_call_time))

    tick.__annotations__['call'] = compat.TimerInfo
    node.create_timer(0.02, tick)
    node.create_timer(0.02, lambda: plain.append(1))
    with Spinning(make_executor(nodes=[node])):
        assert wait_for(lambda: len(seen) >= 10 and len(plain) >= 10)
    for expected, actual in seen:
        assert expected <= actual and expected.clock_type == node.get_clock().clock_type
        assert (expected - seen[0][0]).nanoseconds % 20_000_000 == 0


def test_no_event_is_taken_for_another_while_events_come_and_go(make_executor, make_node):
    """An event notes in itself its place in a wait set: two sources must not mix them up."""
    stays, changes, matched, wrong = make_node('stays'), make_node('changes'), [], []
    callbacks = PublisherEventCallbacks(
        matched=matched.append, incompatible_qos=wrong.append, liveliness=wrong.append,
        deadline=wrong.append)
    for number in range(12):
        stays.create_publisher(Header, f'/seen{number}', 1, event_callbacks=callbacks)
    interval, ends = sys.getswitchinterval(), time.monotonic() + 2.5

    def churn(number):
        while time.monotonic() < ends or (  # a busy machine needs longer
                len(matched) <= 10 and time.monotonic() < ends + patience(20)):
            publisher = changes.create_publisher(
                Header, f'/other{number}', 1,
                event_callbacks=PublisherEventCallbacks(matched=lambda event: None))
            subscription = changes.create_subscription(
                Header, f'/seen{number}', lambda message: None, 1)
            time.sleep(0.002)
            changes.destroy_publisher(publisher)
            changes.destroy_subscription(subscription)

    sys.setswitchinterval(1e-5)
    try:
        with Spinning(make_executor(nodes=[stays, changes])), ThreadPoolExecutor() as pool:
            list(pool.map(churn, range(3)))
    finally:
        sys.setswitchinterval(interval)
    assert len(matched) > 10 and wrong == []


class Broken(Waitable):
    """A waitable that contains no entity, and raises whenever it is asked."""

    def __init__(self):
        super().__init__(ReentrantCallbackGroup())

    def __enter__(self):    # Kilted's Waitable has none
        pass

    def __exit__(self, *error):
        pass

    def is_ready(self, wait_set):
        raise ValueError('no device')

    def get_num_entities(self):
        return NumberOfEntities(0, 0, 0, 0, 0, 0)

    def add_to_wait_set(self, wait_set):
        pass


def test_a_waitable_that_fails_again_and_again_is_raised_by_each_spin_once(
        make_executor, make_node):
    node, broken = make_node(), Broken()
    node.add_waitable(broken)
    executor = make_executor(nodes=[node])
    for _ in range(3):
        with pytest.raises(ValueError, match='no device'):
            executor.spin_until_future_complete(Future(), patience(30.0))
        time.sleep(0.1)     # it is asked meanwhile
    node.remove_waitable(broken)
    with suppress(ValueError):
        executor.spin_until_future_complete(Future(), 0.1)
    executor.spin_until_future_complete(Future(), 0.1)


def test_a_response_is_posted_once_when_its_request_has_been_noted(monkeypatch):
    """What was found with it does not wait."""
    posted, calls, behind = [], [], ['response']
    monkeypatch.setattr(
        compat, 'sender_is_behind', lambda waitable, data: data in behind)
    pool = SimpleNamespace(post=posted.extend, call_at=lambda at, call: calls.append(call))
    source = WaitableSource.__new__(WaitableSource)
    source._pool = pool
    entity = SimpleNamespace(rclpy_object=None, depth=0)
    response, other = (Work(entity, print, (data,)) for data in ('response', 'other'))
    source._post_noted([response, other])
    assert posted == [other]
    calls.pop()()
    assert posted == [other]
    behind.clear()
    calls.pop()()
    assert posted == [other, response] and not calls

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The executor against real rclpy: each kind of callback, groups, queues, arguments."""

from functools import partial
import threading
import time

from builtin_interfaces.msg import Time
from mddag_executor.executor import threads
from mddag_executor.executor.bounds import SHORT_CALLBACK_NS
from mddag_executor.executor.tasks import TaskEntity
from mddag_executor.executor.threads import WorkerThread
from mddag_executor.executor.work import current, Work
import pytest
from rclpy.callback_groups import (
    CallbackGroup,
    MutuallyExclusiveCallbackGroup,
    ReentrantCallbackGroup,
)
from rclpy.executors import MultiThreadedExecutor
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from rclpy.timer import Rate
from std_msgs.msg import Header, Int32
from std_srvs.srv import Trigger

from .conftest import is_idle, matched, patience, Pulse, Spinning, wait_for
from .inside import functions_of_tasks, pool_of, registry_of

MS = 1_000_000


def test_subscriptions_of_each_kind(make_executor, make_node):
    node = make_node()
    got = {'plain': [], 'info': [], 'raw': [], 'async': []}

    async def coroutine(message):
        got['async'].append(message.frame_id)

    node.create_subscription(Header, '/plain', lambda m: got['plain'].append(m.frame_id), 10)
    node.create_subscription(Header, '/info', lambda m, i: got['info'].append((m, i)), 10)
    node.create_subscription(Header, '/raw', got['raw'].append, 10, raw=True)
    node.create_subscription(Header, '/async', coroutine, 10)
    publishers = [node.create_publisher(Header, f'/{name}', 10) for name in got]
    with Spinning(make_executor(nodes=[node])):
        matched(*publishers)
        for publisher in publishers:
            publisher.publish(Header(frame_id='x'))
        assert wait_for(lambda: all(got.values())), got
    assert got['plain'] == got['async'] == ['x']
    message, info = got['info'][0]
    assert message.frame_id == 'x' and info['source_timestamp'] > 0
    assert deserialize_message(got['raw'][0], Header).frame_id == 'x'


# --- each of many runs once ----------------------------------------------------------------------

MANY = 60
"""More than twice twenty: every twentieth that is lost shows."""


def of_tasks(executor, node, call):
    one_by_one(lambda ran: partial(executor.create_task, ran), call)


def of_coroutines(executor, node, call):
    waiting = []

    async def work(number):
        waiting.append(number)
        call(await futures[number])

    futures = [Future(executor=executor) for _ in range(MANY)]
    for number in range(MANY):
        executor.create_task(work, number)
    wait_for(lambda: len(waiting) >= MANY, 6.0)
    for number, future in enumerate(futures):
        future.set_result(number)


def of_subscriptions(executor, node, call):
    node.create_subscription(Header, '/topic', lambda m: call(m.stamp.sec), MANY)
    publisher = node.create_publisher(Header, '/topic', MANY)
    matched(publisher)
    for number in range(MANY):
        publisher.publish(Header(stamp=Time(sec=number)))


def of_services(executor, node, call):
    numbers = iter(range(MANY))

    def answer(request, response):
        call(next(numbers))
        return response

    node.create_service(Trigger, '/ask', answer)
    client = node.create_client(Trigger, '/ask')
    assert client.wait_for_service(60.0)
    for _ in range(MANY):  # one after the other, since of those that wait the queue keeps ten
        assert wait_for(client.call_async(Trigger.Request()).done, 6.0)


def of_guards(executor, node, call):
    one_by_one(lambda ran: node.create_guard_condition(ran).trigger, call)


def of_waitables(executor, node, call):
    def make(ran):
        class Empty(Pulse):
            async def execute(self, taken_data):
                assert taken_data is None
                ran()

        pulse = Empty(node, node.default_callback_group)
        node.add_waitable(pulse)
        return pulse.guard.trigger
    one_by_one(make, call)


def one_by_one(make, call):
    """Trigger what ``make`` makes of a callback, and again when that has run."""
    done = []

    def ran():
        call(len(done))
        done.append(1)

    trigger = make(ran)
    for number in range(1, MANY + 1):
        trigger()
        assert wait_for(lambda n=number: len(done) == n, 6.0)


NAMES = {
    of_subscriptions: '/node: <lambda> (subscription /topic)',
    of_services: '/node: answer (service /ask)', of_guards: '/node: ran (guard condition)',
    of_waitables: '/node: Empty (waitable)'}


@pytest.mark.parametrize('start', [of_tasks, of_coroutines, *NAMES])
def test_each_of_many_runs_once(make_executor, make_node, spinning, start):
    node = make_node()
    executor = make_executor(nodes=[node])
    calls = []
    with spinning(executor):
        start(executor, node, calls.append)
        wait_for(lambda: len(calls) >= MANY, 6.0)
    assert sorted(calls) == list(range(MANY))
    if start in NAMES:
        assert executor.statistics()['callbacks'][NAMES[start]]['ran'] == MANY


def test_each_time_that_a_timer_is_due_counts(make_executor, make_node):
    """Where this machine is busy it skips periods, and says so."""
    node, calls = make_node(), []
    timer = node.create_timer(0.005, lambda: calls.append(1))
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(calls) >= MANY)
        timer.cancel()
    counts = executor.statistics()['callbacks']['/node: <lambda> (timer 5ms)']
    assert counts['ready'] - counts['waiting'] == counts['ran'] == len(calls)


# --- workers, nodes ------------------------------------------------------------------------------


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


def test_a_rate_that_is_found_before_it_has_its_callback_ends_a_sleep(make_executor, make_node):
    """``create_rate`` sets it after it has notified the executor; the only worker sleeps then."""
    node, slept, ran = make_node(), [], []
    timer = node.create_timer(0.01, None, node._rate_group)
    late = node.create_timer(0.01, None, ReentrantCallbackGroup())
    executor = make_executor(num_workers=1, nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: pool_of(executor).is_current)
        rate = Rate(timer, context=node.context)
        task = executor.create_task(lambda: [slept.append(rate.sleep()) for _ in range(3)])
        assert wait_for(task.done)
        # a callback of the user's does not run in the thread that handles Rates
        late.callback = lambda: ran.append(current.running)
        assert wait_for(lambda: len(ran) >= 3)
        assert all(running is not None for running in ran)
    assert len(slept) == 3
    assert executor.statistics()['callbacks']['/node: Rate (timer 10ms)']['ran'] >= 3


def test_one_slow_execution_does_not_make_a_callback_long(make_executor, monkeypatch):
    """Each execution counts the same; short ones are measured seldom."""
    pool, now, takes = pool_of(make_executor()), [10**12], [10_000]
    monkeypatch.setattr(threads, 'monotonic_ns', lambda: now[0])
    entity = TaskEntity()
    thread = WorkerThread(pool, None)

    def run():
        now[0] += takes[0]

    def execute():
        thread.work = Work(entity, run)
        thread.execute()
        entity.ran += 1

    for _ in range(100):
        execute()
    assert entity.wall_ns <= SHORT_CALLBACK_NS
    takes[0] = 50 * MS
    execute()
    assert entity.wall_ns > SHORT_CALLBACK_NS
    takes[0], before = 10_000, entity.ran
    while entity.wall_ns > SHORT_CALLBACK_NS:
        execute()
    assert entity.ran - before < 30
    for _ in range(3):  # it has become long
        takes[0] = 10 * MS
        execute()
    assert entity.wall_ns > SHORT_CALLBACK_NS


def test_a_response_makes_no_task(make_executor, make_node):
    """The client forgets its request without a worker."""
    node = make_node()
    node.create_service(Trigger, '/ask', lambda request, response: response)
    client = node.create_client(Trigger, '/ask')
    executor = make_executor(nodes=[node])
    assert client.wait_for_service(60.0)
    future = client.call_async(Trigger.Request())
    executor.spin_until_future_complete(future, patience(10.0))
    assert future.done() and not client._pending_requests
    cancelled = client.call_async(Trigger.Request())
    cancelled.cancel()
    assert not client._pending_requests
    assert not functions_of_tasks(executor)


def test_tasks_nodes_and_entities_wake_an_idle_executor(make_executor, make_node, spinning):
    executor, node, calls = make_executor(), make_node(), [[], []]
    with spinning(executor):
        time.sleep(0.2)
        assert wait_for(executor.create_task(lambda: None).done)
        for ran in calls:  # of a new node, then of one that is there
            time.sleep(0.1)
            node.create_timer(0.001, lambda ran=ran: ran.append(1))
            assert executor.add_node(node) == (ran is calls[0])
            assert wait_for(lambda ran=ran: ran)
        assert executor.get_nodes() == [node]
        executor.remove_node(node)
        assert executor.get_nodes() == []
        assert wait_for(lambda: stays(calls[0]))


def stays(calls):
    before = len(calls)
    time.sleep(0.05)
    return len(calls) == before


# --- groups --------------------------------------------------------------------------------------


def test_mutually_exclusive_group_is_kept(make_executor, make_node):
    node, group, ran = make_node(), MutuallyExclusiveCallbackGroup(), []
    lock = threading.Lock()

    def exclusive(message):
        assert lock.acquire(blocking=False)
        time.sleep(0.005)
        ran.append(message)
        lock.release()

    for _ in range(6):
        node.create_subscription(Header, '/topic', exclusive, 10, callback_group=group)
    publisher = node.create_publisher(Header, '/topic', 10)
    with Spinning(make_executor(nodes=[node])):
        matched(publisher, count=6)
        for _ in range(3):
            publisher.publish(Header())
        assert wait_for(lambda: len(ran) == 18)


class Moved:
    """
    A node with a timer whose group lets one callback run, in whichever executor.

    :ivar begun: how many have begun; ``most`` ran at once.
    """

    def __init__(self, node, group=None):
        self.node = node
        self.begun, self.running, self.most = 0, 0, 0
        self.leave = threading.Event()
        self._lock = threading.Lock()
        node.create_timer(0.01, self.tick, group)

    def tick(self):
        with self._lock:
            self.begun += 1
            self.running += 1
            self.most = max(self.most, self.running)
        assert self.leave.wait(15.0)
        with self._lock:
            self.running -= 1


@pytest.mark.parametrize('kind', ['own', 'rclpy'])
def test_a_mutually_exclusive_group_is_kept_though_its_node_moves(
        make_executor, make_node, ros_context, kind):
    """Its callback runs in one executor, ours or rclpy's, and the next one in another."""
    first = make_executor() if kind == 'own' else MultiThreadedExecutor(2, context=ros_context)
    second, moved = make_executor(), Moved(make_node())
    with Spinning(first), Spinning(second):
        first.add_node(moved.node)
        assert wait_for(lambda: moved.begun == 1)
        first.remove_node(moved.node)
        second.add_node(moved.node)
        assert wait_for(lambda: second.statistics()['queue'] or moved.begun > 1)
        moved.leave.set()
        assert wait_for(lambda: moved.begun > 3)
    assert moved.most == 1


def test_a_mutually_exclusive_group_is_kept_though_two_executors_run_it(make_executor, make_node):
    group = MutuallyExclusiveCallbackGroup()
    moved = Moved(make_node(), group)
    other = make_node('other')
    other.create_timer(0.01, moved.tick, group)
    executors = [make_executor(nodes=[node]) for node in (moved.node, other)]
    with Spinning(executors[0]), Spinning(executors[1]):
        assert wait_for(lambda: any(each.statistics()['queue'] for each in executors))
        moved.leave.set()
        assert wait_for(lambda: moved.begun > 10)
    assert moved.most == 1


def test_a_group_is_free_when_an_executor_ends_before_its_coroutine(make_executor, make_node):
    """It never goes on, so another executor may run the others of its group."""
    node, begun = make_node(), []
    future = Future()

    async def wait():
        begun.append(1)
        await future

    timer = node.create_timer(0.01, wait)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: begun)
    timer.cancel()
    executor.remove_node(node)
    moved = Moved(node, timer.callback_group)
    moved.leave.set()
    with Spinning(make_executor(nodes=[node])):
        assert wait_for(lambda: moved.begun > 1)


class Tokens(CallbackGroup):
    """A user's own group, which lets a callback run for each token, and notes the calls."""

    def __init__(self, tokens=0, are_given_back=False):
        super().__init__()
        self.lock = threading.Lock()
        self.tokens = tokens
        self.are_given_back = are_given_back
        self.asked = self.begun = self.ended = 0

    def can_execute(self, entity):
        with self.lock:
            self.asked += 1
            return self.tokens > 0

    def beginning_execution(self, entity):
        with self.lock:
            if self.tokens == 0:
                return False
            self.tokens -= 1
            self.begun += 1
            return True

    def ending_execution(self, entity):
        with self.lock:
            self.ended += 1
            self.tokens += self.are_given_back

    def give(self, tokens=1):
        with self.lock:
            self.tokens += tokens


def test_a_timer_runs_as_often_as_its_group_lets_it(make_executor, make_node):
    """The throttled example of ros2/examples: another callback gives the tokens."""
    node, group, ran, ticks = make_node(), Tokens(3), [], []
    node.create_timer(0.001, lambda: ran.append(len(ticks)), callback_group=group)

    def tick():
        ticks.append(1)
        if len(ticks) % 10 == 0:
            group.give()

    node.create_timer(0.004, tick)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(ticks) > 60)
    assert 3 < len(ran) <= 3 + len(ticks) // 10
    assert group.begun == group.ended == len(ran) and group.asked > len(ran)
    (gated,) = [counts for name, counts in executor.statistics()['callbacks'].items()
                if name.endswith('(timer 1ms)')]
    assert gated['ran'] == len(ran) and gated['dropped'] == 0 < gated['skipped']


def test_a_group_that_has_refused_often_is_asked_again_once_at_a_time(make_executor, make_node):
    """Not once for each time that it has refused: each would lead to a further one."""
    node, group, calls = make_node(), Tokens(), []
    node.create_timer(0.001, lambda: None, callback_group=group)
    executor = make_executor(num_workers=1, nodes=[node])
    agenda = pool_of(executor).agenda
    with Spinning(executor):
        assert wait_for(lambda: group.asked)
        tasks = [executor.create_task(lambda: calls.append(agenda._appointments))
                 for _ in range(100)]
        assert wait_for(lambda: all(task.done() for task in tasks))
    assert len(calls) == 100 and max(calls) <= 5


def test_messages_that_a_group_keeps_waiting_are_as_many_as_the_qos_says(make_executor, make_node):
    """
    The oldest go, and are counted (rclcpp#3213).

    And a coroutine has ended when it has run to its end.
    """
    node, group, future, steps = make_node(), Tokens(are_given_back=True), Future(), []

    async def callback(message):
        steps.append(('begins', message.data))
        await future
        steps.append(('ends', message.data))

    node.create_subscription(Int32, '/gated', callback, 3, callback_group=group)
    publisher = node.create_publisher(Int32, '/gated', 50)
    executor = make_executor(nodes=[node])

    def count(what):
        return sum(counts[what] for name, counts in executor.statistics()['callbacks'].items()
                   if name.startswith('/node: '))

    with Spinning(executor):
        matched(publisher)
        for number in range(10):
            publisher.publish(Int32(data=number))
            assert wait_for(lambda n=number: count('ready') > n)
        assert wait_for(lambda: count('dropped') == 7)
        group.give()
        assert wait_for(lambda: steps)
        asked = group.asked
        assert wait_for(lambda: group.asked > asked + 1)
        assert steps == [('begins', 7)] and group.ended == 0
        future.set_result(None)
        assert wait_for(lambda: group.ended == 3)
    assert steps == [(what, number) for number in (7, 8, 9) for what in ('begins', 'ends')]


class Deciding(Tokens):
    """A group that does something before it refuses for the first time."""

    def __init__(self, meanwhile):
        super().__init__()
        self._meanwhile = meanwhile

    def can_execute(self, entity):
        meanwhile, self._meanwhile = self._meanwhile, lambda: None
        meanwhile()
        return super().can_execute(entity)


def test_messages_that_come_while_a_group_decides_replace_the_refused_one(
        make_executor, make_node):
    node, got = make_node(), []
    group = Deciding(lambda: [publisher.publish(Int32(data=number)) for number in (2, 3)])
    node.create_subscription(
        Int32, '/gated', lambda message: got.append(message.data), 2, callback_group=group)
    publisher = node.create_publisher(Int32, '/gated', 10)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        matched(publisher)
        publisher.publish(Int32(data=1))
        assert wait_for(lambda: executor.statistics()['queue'] == 2)
        group.give(3)
        assert wait_for(lambda: len(got) == 2 and is_idle(executor))
    assert got == [2, 3] and sum(executor.statistics()['dropped'].values()) == 1


def test_a_timer_that_is_due_again_while_its_group_decides_runs_twice(make_executor, make_node):
    """The time that the group has refused is not dropped for the new one."""
    node, ran = make_node(), []
    group = Deciding(lambda: wait_for(lambda: executor.statistics()['queue']))
    node.create_timer(0.005, lambda: ran.append(1), callback_group=group)
    executor = make_executor(num_workers=2, nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: group.asked)
        group.give(2)
        assert wait_for(lambda: len(ran) == 2)
        assert executor.statistics()['dropped'] == {}


def test_what_is_destroyed_while_its_group_decides_waits_no_longer(make_executor, make_node):
    node = make_node()
    group = Deciding(lambda: (
        node.destroy_guard_condition(guard), wait_for(lambda: guard not in [
            each.rclpy_object for each in registry_of(executor).by_id.values()])))
    guard = node.create_guard_condition(lambda: None, group)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        guard.trigger()
        assert wait_for(lambda: group.asked and is_idle(executor))
    assert sum(executor.statistics()['dropped'].values()) == 1

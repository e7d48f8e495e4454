# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What publishes for a callback: threads, tasks, later pieces of coroutines, other callbacks.

It belongs to the execution if that has not ended; else a line says so: see ``starters``.
"""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
import inspect
from multiprocessing.pool import ThreadPool
import threading

from mddag_executor import replay
from mddag_executor.executor import current_job
from mddag_executor.executor.watch import Watch
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import is_idle, matched, Spinning, wait_for
from .declared import graph
from .inside import engine_of

GRAPH = graph(
    detector='name: detect, subscription: /image, period: 20ms, sporadic: true, '
             'may_publish: [/alarm], dag: main',
    brake='name: stop, subscription: /alarm, deadline: 60s')
ALWAYS = GRAPH.replace('may_publish', 'publishes').replace('60s', '1ms')
IMAGES = 6


class Detector:
    """
    A node that publishes an alarm for every second image, and one that gets it.

    :param publish: how it does so: a function or coroutine function, which gets this object and
        the message.
    :ivar may_go_on: to be set when the execution has ended.
    """

    def __init__(self, make_executor, make_node, publish, text=GRAPH, node=None, **more):
        self.task_set, self._publish = loads(text), publish
        self.node, brake = node or make_node('detector'), make_node('brake')
        self.group = ReentrantCallbackGroup()
        run = self._await if inspect.iscoroutinefunction(publish) else self._call
        self.node.create_subscription(Header, '/image', run, 10, callback_group=self.group)
        self.publisher = self.node.create_publisher(Header, '/alarm', 10)
        brake.create_subscription(Header, '/alarm', self._stop, 10)
        self.images = make_node('camera').create_publisher(Header, '/image', 10)
        self.executor = make_executor(
            self.task_set, num_workers=4, nodes=[self.node, brake], **more)
        self.watch = Watch(self.executor, self.task_set)
        self.ended, self.stopped, self.kept, self.messages = [], [], [], []
        self.threads = [threading.Thread(target=lambda: self.alarm(self.messages[-1]))
                        for _ in range(IMAGES)]
        self.may_go_on = threading.Event()
        self.pool = ThreadPoolExecutor(1)

    def alarm(self, message):
        self.publisher.publish(message)

    def alarm_later(self, message):
        assert self.may_go_on.wait(60.0)
        self.alarm(message)

    def _call(self, message):
        if int(message.frame_id) % 2:
            self._publish(self, message)
        self.ended.append(message)

    async def _await(self, message):
        if int(message.frame_id) % 2:
            await self._publish(self, message)
        self.ended.append(message)

    def _stop(self, message):
        job = current_job()
        self.stopped.append((int(message.frame_id), None if job is None else job.job))

    def sink(self):
        return self.executor.statistics()['dags']['main']['sinks']['/brake:stop']

    def run(self, n_stopped=IMAGES // 2):
        """Run it with some images; return what differs from the declaration."""
        with ThreadPool(2) as self.thread_pool, Spinning(self.executor):
            matched(self.images, self.publisher)
            for number in range(IMAGES):
                self._run_once(number, min(n_stopped, (number + 1) // 2))
            assert wait_for(lambda: is_idle(self.executor))
        self.pool.shutdown()
        self.thread_pool.join()
        return self.watch.drift(self.executor.statistics())

    def _run_once(self, number, n_stopped):
        self.may_go_on.clear()
        self.images.publish(Header(frame_id=str(number)))
        assert wait_for(lambda: self.n_ran() == number + 1)
        self.may_go_on.set()
        assert wait_for(lambda: len(self.stopped) >= n_stopped)

    def n_ran(self):
        return self.executor.statistics()['callbacks'].get('/detector:detect', {'ran': 0})['ran']


def counts(dags):
    """Return how many results of the brake were in time, not due, and missed."""
    sink = dags['main']['sinks']['/brake:stop']
    return (sink['completed'] - sink['late'], sink.get('not_due', 0),
            sink['late'] + sink['expired'] + sink['failed'])


# --- in time: the callback waits for it ----------------------------------------------------------

async def in_a_later_piece(each, message):
    future = Future(executor=each.executor)
    each.executor.create_task(future.set_result, None)
    await future
    each.alarm(message)


async def after_a_sleep_of_asyncio(each, message):
    await asyncio.sleep(0.001)
    each.alarm(message)


async def run_in_executor(each, message):
    await asyncio.get_running_loop().run_in_executor(None, each.alarm, message)


async def to_thread(each, message):
    await asyncio.to_thread(each.alarm, message)


async def a_task_of_asyncio(each, message):
    async def publish():
        await asyncio.sleep(0.001)
        each.alarm(message)
    await asyncio.gather(publish(), asyncio.create_task(asyncio.sleep(0)))


async def a_thread_of_a_task_of_asyncio(each, message):
    await asyncio.create_task(run_in_executor(each, message))


async def a_task(each, message):
    await each.executor.create_task(each.alarm, message)


async def a_task_of_a_task(each, message):
    async def publish():
        await asyncio.sleep(0)
        await each.executor.create_task(each.alarm, message)
    await each.executor.create_task(publish)


async def a_done_callback_of_a_future(each, message):
    future, done = Future(executor=each.executor), Future(executor=each.executor)

    def publish(_):
        each.alarm(message)
        done.set_result(None)
    future.add_done_callback(publish)
    future.set_result(None)
    await done


def a_thread(each, message):
    thread = threading.Thread(target=each.alarm, args=(message,))
    thread.start()
    thread.join()


def a_thread_of_a_thread(each, message):
    thread = threading.Thread(target=a_thread, args=(each, message))
    thread.start()
    thread.join()


def a_thread_that_was_made_before(each, message):
    thread = each.threads.pop()
    each.messages.append(message)
    thread.start()
    thread.join()


def a_timer_of_threading(each, message):
    timer = threading.Timer(0.001, each.alarm, (message,))
    timer.start()
    timer.join()


def a_pool_of_threads(each, message):
    each.pool.submit(each.alarm, message).result()


def a_map_over_threads(each, message):
    with ThreadPoolExecutor(2) as pool:
        for _ in pool.map(lambda publish: publish and each.alarm(message), [False, True, False]):
            pass


def a_pool_of_multiprocessing(each, message):
    each.thread_pool.apply(each.alarm, (message,))


def parts(message):
    """Return what functions of pools get in two calls, one of which publishes."""
    return [(None,), (message,)]


def in_parts(method, is_starmap=False):
    """Return a callback that publishes by a method of a pool that gets an iterable."""
    def publish(each, message):
        def alarm(part):
            if not is_starmap:
                part, = part
            if part is not None:
                each.alarm(part)

        found = getattr(each.thread_pool, method)(alarm, parts(message))
        if hasattr(found, 'get'):
            found = found.get(60.0)
        assert [*found] == [None, None]
    publish.__name__ = f'a_{method}_of_multiprocessing'
    return publish


def a_loop_over_a_generator(each, message):
    for made in (Header(frame_id=message.frame_id) for _ in range(1)):
        each.alarm(made)


IN_TIME = [
    in_a_later_piece, after_a_sleep_of_asyncio, run_in_executor, to_thread, a_task_of_asyncio,
    a_thread_of_a_task_of_asyncio, a_task, a_task_of_a_task, a_done_callback_of_a_future, a_thread,
    a_thread_of_a_thread, a_thread_that_was_made_before, a_timer_of_threading, a_pool_of_threads,
    a_map_over_threads, a_pool_of_multiprocessing, *map(
        in_parts, ('map', 'map_async', 'imap', 'imap_unordered')),
    in_parts('starmap', True), in_parts('starmap_async', True), a_loop_over_a_generator]


@pytest.mark.parametrize('publish', IN_TIME)
def test_what_a_callback_waits_for_publishes_for_it(make_executor, make_node, tmp_path, publish):
    """Live and in the replay; nothing differs from the declaration."""
    path = tmp_path / 'run.mcap'
    each = Detector(make_executor, make_node, publish, trace=str(path))
    assert each.run() == []
    statistics = each.executor.statistics()
    assert counts(statistics['dags']) == (IMAGES // 2, IMAGES // 2, 0)
    assert statistics['callbacks']['/brake:stop']['unattributed'] == 0
    assert each.stopped == [(number, number) for number in range(1, IMAGES, 2)]
    recorded = replay(path)
    assert counts(recorded.result()['dags']) == (IMAGES // 2, IMAGES // 2, 0)
    assert recorded.drift() == []


# --- too late, or not for it ---------------------------------------------------------------------

def a_thread_that_goes_on(each, message):
    threading.Thread(target=each.alarm_later, args=(message,)).start()


def a_pool_that_goes_on(each, message):
    each.pool.submit(each.alarm_later, message)


def a_pool_of_multiprocessing_that_goes_on(each, message):
    each.thread_pool.apply_async(each.alarm_later, (message,))


async def a_task_of_asyncio_that_goes_on(each, message):
    async def publish():
        await asyncio.to_thread(each.may_go_on.wait, 60.0)
        each.alarm(message)
    each.kept.append(asyncio.create_task(publish()))


def a_task_that_goes_on(each, message):
    each.executor.create_task(each.alarm_later, message)


def a_response(each, message):
    def on_response(_):
        each.alarm_later(message)
    each.client.call_async(Trigger.Request()).add_done_callback(on_response)


def a_service(each, message):
    each.kept.append(message)
    each.client.call_async(Trigger.Request())


def a_timer_of_the_node(each, message):
    def publish():
        timer.destroy()
        each.alarm_later(message)
    timer = each.node.create_timer(0.001, publish, callback_group=each.group)


TOO_LATE = {
    a_thread_that_goes_on: 'threads of its own', a_pool_that_goes_on: 'threads of its own',
    a_pool_of_multiprocessing_that_goes_on: 'threads of its own',
    a_task_of_asyncio_that_goes_on: 'threads of its own',
    a_task_that_goes_on: 'alarm_later', a_response: 'on_response',
    a_service: 'service /answer', a_timer_of_the_node: '/detector: publish (timer 1ms)'}


def serving(each, publish):
    """Let the node have a service with a client; return the executor's service callback."""
    def answer(request, response):
        if publish is a_service:
            each.alarm_later(each.kept.pop())
        return response
    each.node.create_service(Trigger, '/answer', answer, callback_group=each.group)
    each.client = each.node.create_client(Trigger, '/answer', callback_group=each.group)


@pytest.mark.parametrize('publish', TOO_LATE)
def test_what_is_published_otherwise_belongs_to_no_job_and_is_named(
        make_executor, make_node, tmp_path, publish, capfd):
    """The results are not due; the log, the run and its replay say where messages came from."""
    path = tmp_path / 'run.mcap'
    each = Detector(make_executor, make_node, publish, trace=str(path))
    serving(each, publish)
    found, = each.run()
    statistics = each.executor.statistics()
    assert counts(statistics['dags']) == (0, IMAGES, 0)
    assert statistics['callbacks']['/brake:stop']['unattributed'] == IMAGES // 2
    recorded = replay(path)
    assert counts(recorded.result()['dags']) == (0, IMAGES, 0)
    for drift in (found, *recorded.drift()):
        assert (drift.kind, drift.callback, drift.topic, drift.observed) == (
            'published outside', '/detector:detect', '/alarm', IMAGES // 2)
        assert TOO_LATE[publish] in drift.text and 'are not due' in drift.text
    assert len(recorded.drift()) == 1
    err = capfd.readouterr().err
    assert '/detector published 1 message on /alarm in ' in err
    assert err.count('/detector published ') == 1


def test_a_message_that_is_being_published_when_the_execution_ends_is_due(
        make_executor, make_node, monkeypatch):
    """The thread that publishes it was just interrupted."""
    begins = threading.Semaphore(0)

    def publish(each, message):
        threading.Thread(target=each.alarm, args=(message,)).start()
        assert begins.acquire(timeout=60.0)

    each = Detector(make_executor, make_node, publish)
    attribution = engine_of(each.executor).attribution
    send = attribution.publish

    def send_later(*args):
        begins.release()
        assert each.may_go_on.wait(60.0)
        return send(*args)

    monkeypatch.setattr(attribution, 'publish', send_later)
    assert each.run() == []
    assert counts(each.executor.statistics()['dags']) == (IMAGES // 2, IMAGES // 2, 0)


def test_results_that_are_due_are_missed_which_is_no_warning(
        make_executor, make_node, capfd):
    """The line says so, and the table has the misses."""
    each = Detector(make_executor, make_node, a_thread_that_goes_on, ALWAYS)
    found, = each.run()
    assert 'are missed' in found.text
    statistics = each.executor.statistics()
    sink = statistics['dags']['main']['sinks']['/brake:stop']
    assert statistics['deadline_missed'] and 'not_due' not in sink
    assert 'published' not in capfd.readouterr().err


def test_what_starts_nothing_or_is_of_another_node_is_not_named(make_executor, make_node):
    def publish(each, message):
        each.alarm(message)
        for publisher in each.kept:
            thread = threading.Thread(target=publisher.publish, args=(message,))
            thread.start()

    each = Detector(make_executor, make_node, publish, GRAPH.replace(
        'may_publish: [/alarm]', 'may_publish: [/alarm, /info]'))
    each.kept = [each.node.create_publisher(Header, '/info', 10),
                 make_node('foreign').create_publisher(Header, '/alarm', 10)]
    assert each.run(n_stopped=IMAGES) == []


def test_two_alarms_of_one_execution_make_one_result(make_executor, make_node):
    def publish(each, message):
        each.alarm(message)
        each.alarm(message)

    each = Detector(make_executor, make_node, publish)
    assert each.run(n_stopped=IMAGES) == []
    assert counts(each.executor.statistics()['dags']) == (IMAGES // 2, IMAGES // 2, 0)


@pytest.mark.parametrize('is_active', [True, False])
def test_a_lifecycle_node_publishes_only_while_it_is_active(
        make_executor, make_node, ros_context, is_active):
    node = LifecycleNode('detector', context=ros_context, enable_communication_interface=False)
    each = Detector(
        make_executor, make_node, lambda each, message: each.alarm(message), node=node)
    each.publisher = node.create_lifecycle_publisher(Header, '/alarm', 10)
    node.trigger_configure()
    if is_active:
        node.trigger_activate()
    n = IMAGES // 2 if is_active else 0
    assert each.run(n_stopped=n) == []
    assert counts(each.executor.statistics()['dags']) == (n, IMAGES - n, 0)
    node.destroy_node()


def belongs_to_no_job(each, schedule):
    """Run a detector while another thread lets its threads publish: results are not due."""
    thread = threading.Thread(target=schedule)
    thread.start()
    found, = each.run()
    thread.join()
    assert 'threads of its own' in found.text
    assert counts(each.executor.statistics()['dags']) == (0, IMAGES, 0)


@pytest.mark.parametrize(('make', 'use'), [
    (lambda each: each.pool, lambda pool, run, *args: pool.submit(run, *args).result()),
    (lambda each: ThreadPool(1), lambda pool, run, *args: pool.apply(run, args)),
], ids=['futures', 'multiprocessing'])
def test_a_pool_s_thread_works_for_no_execution_that_has_only_made_it(
        make_executor, make_node, make, use):
    """Others submit functions as well, while the execution still runs."""
    has_made, has_published = threading.Semaphore(0), threading.Semaphore(0)
    pools, to_end = [], ExitStack()

    def publish(each, message):
        if not pools:
            pools.append(to_end.enter_context(make(each)))
        use(pools[0], int)
        each.kept.append(message)
        has_made.release()
        assert has_published.acquire(timeout=60.0)

    def submit():
        for _ in range(IMAGES // 2):
            assert has_made.acquire(timeout=60.0)
            use(pools[0], each.alarm, each.kept.pop())
            has_published.release()

    each = Detector(make_executor, make_node, publish)
    with to_end:
        belongs_to_no_job(each, submit)


def test_a_thread_of_asyncio_works_for_no_execution_that_has_only_started_it(
        make_executor, make_node):
    """Others schedule functions as well, while the execution still runs."""
    has_made, has_published = threading.Semaphore(0), threading.Semaphore(0)

    async def publish(each, message):
        await asyncio.sleep(0.001)
        each.kept.append((asyncio.get_running_loop(), message))
        has_made.release()
        assert await asyncio.to_thread(has_published.acquire, timeout=60.0)

    def schedule():
        for _ in range(IMAGES // 2):
            assert has_made.acquire(timeout=60.0)
            loop, message = each.kept.pop()
            loop.call_soon_threadsafe(each.alarm, message)
            loop.call_soon_threadsafe(has_published.release)

    each = Detector(make_executor, make_node, publish)
    belongs_to_no_job(each, schedule)


def observed(watch, executor):
    """Return how many messages the line about messages from outside counts; None: no line."""
    return next((each.observed for each in watch.drift(executor.statistics())
                 if each.kind == 'published outside'), None)


def test_a_task_of_another_executor_publishes_for_no_job_there(make_executor, make_node):
    """Its jobs are others, though the callback that has started the task waits for it."""
    node = make_node('detector')
    publisher = node.create_publisher(Header, '/alarm', 10)
    other = make_executor(loads(GRAPH), nodes=[node])
    watch = Watch(other, loads(GRAPH))

    def publish(each, message):
        task = other.create_task(publisher.publish, message)
        assert wait_for(task.done)

    each = Detector(make_executor, make_node, publish)
    with Spinning(other):
        each.run()
        assert observed(watch, other) == IMAGES // 2
    assert counts(each.executor.statistics()['dags']) == (0, IMAGES, 0)


def test_a_declared_callback_that_runs_for_no_job_is_not_named(make_executor, make_node):
    """It publishes what it is declared to."""
    task_set, heard = loads(GRAPH.replace(
        'deadline: 60s', 'publishes: [/braked]') + graph(
            lamp='name: show, subscription: /braked, deadline: 60s').partition('nodes:\n')[2]), []
    brake, lamp = make_node('brake'), make_node('lamp')
    publisher = brake.create_publisher(Header, '/braked', 10)
    brake.create_subscription(Header, '/alarm', publisher.publish, 10)
    lamp.create_subscription(Header, '/braked', heard.append, 10)
    foreign = make_node('foreign').create_publisher(Header, '/alarm', 10)
    executor = make_executor(task_set, nodes=[brake, lamp])
    watch = Watch(executor, task_set)
    with Spinning(executor):
        matched(foreign, publisher)
        foreign.publish(Header())
        assert wait_for(lambda: heard)
    assert executor.statistics()['callbacks']['/brake:stop']['unattributed'] == 1
    assert observed(watch, executor) is None


def test_messages_before_the_run_are_counted_and_no_warning(make_executor, make_node, capfd):
    """A watch that begins again does not count those of before."""
    each = Detector(make_executor, make_node, Detector.alarm)
    each.alarm(Header(frame_id='0'))
    assert observed(each.watch, each.executor) == 1
    each.watch.restart()
    assert observed(each.watch, each.executor) is None
    for publisher in (each.publisher, each.node.create_publisher(Header, '/alarm', 10)):
        publisher.publish(Header(frame_id='0'))
    assert observed(each.watch, each.executor) == 2
    assert 'published' not in capfd.readouterr().err


def test_messages_are_counted_from_the_first_one_though_the_node_is_added_later(
        make_executor, make_node):
    each = Detector(make_executor, make_node, Detector.alarm)
    later = make_executor(each.task_set)
    watch = Watch(later, each.task_set)
    for _ in range(3):
        each.alarm(Header(frame_id='0'))
    assert observed(watch, later) is None
    each.executor.remove_node(each.node)
    later.add_node(each.node)
    each.alarm(Header(frame_id='0'))
    assert observed(watch, later) == 4

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that await asyncio: in each way of spinning, cancelled, at the end, at random."""

import asyncio
from collections import Counter
import itertools
import os
import random
import signal
import subprocess
import sys
import threading
import time

from mddag_executor import MultiDeadlineExecutor, open_recording, replay
from mddag_executor.analysis.drift import drift_of
from mddag_executor.executor import current_job
from mddag_executor.executor.asyncio_loop import Turnstile
from msg_graph import loads
import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import patience, Spinning, wait_for
from .declared import graph
from .inside import engine_of, pool_of

needs_timeout = pytest.mark.skipif(
    sys.version_info < (3, 11), reason='asyncio.timeout is new in Python 3.11')


def spin(executor, done):
    """Spin on the pool until a future is done."""
    executor.spin_until_future_complete(done, patience(15))


def spin_once(executor, done):
    """Step until a future is done; the coroutines use the executor's own loop."""
    end = time.monotonic() + patience(15)
    while not done.done() and time.monotonic() < end:
        executor.spin_once(0.1)


def step_in_loop(executor, done):
    """Step in a program's own loop until a future is done."""
    async def main():
        end = time.monotonic() + patience(15)
        while not done.done() and time.monotonic() < end:
            executor.spin_once(0)
            await asyncio.sleep(0.001)
    asyncio.run(main())


def spin_async(executor, done):
    """Spin in a program's own loop until a future is done."""
    async def main():
        spinning = asyncio.ensure_future(executor.spin_async())
        over = asyncio.get_running_loop().create_future()
        done.add_done_callback(lambda _: over.set_result(None))
        await asyncio.wait_for(over, patience(15))
        spinning.cancel()
        with pytest.raises(asyncio.CancelledError):
            await spinning
    asyncio.run(main())


@pytest.fixture(params=[spin, spin_once, step_in_loop, spin_async])
def until_done(request):
    """Give the ways of spinning until a future is done."""
    return request.param


def test_what_asyncio_offers_works_in_callbacks(make_executor, make_node, until_done):
    """Timers, subscriptions, services and tasks; futures of rclpy and of asyncio side by side."""
    node, found, done = make_node(), [], Future()
    group = ReentrantCallbackGroup()
    client = node.create_client(Trigger, 'asked', callback_group=group)
    queues, ticks = [], itertools.count()

    async def serve(_, response):
        await asyncio.sleep(0.001)
        response.message = 'served'
        return response

    async def ask():
        return (await client.call_async(Trigger.Request())).message

    async def hear(message):
        if not queues:
            queues.append(asyncio.Queue())
        await queues[0].put(message.frame_id)

    async def tick():
        timer.cancel()
        if next(ticks) > 0:
            return  # on a busy machine, two had begun before one could cancel the timer
        publisher.publish(Header(frame_id='sent'))
        assert await asyncio.sleep(0.001, 'slept') == 'slept'
        found.append(await asyncio.wait_for(client.call_async(Trigger.Request()), 10))
        found.append(await asyncio.gather(
            asyncio.sleep(0.002, 1), ask(), client.call_async(Trigger.Request()),
            asyncio.to_thread(threading.get_ident)))
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(Future(), 0.001)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(asyncio.Event().wait(), 0.001)
        while not queues:
            await asyncio.sleep(0)
        found.append(await queues[0].get())
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        found.append(await reader.read())
        writer.close()
        made = executor.create_task(asyncio.sleep(0, 'a task'))
        found.append(await made)
        done.set_result(None)

    async def answer(reader, writer):
        writer.write(b'over a socket')
        writer.close()

    async def start_server():
        nonlocal server
        server = await asyncio.start_server(answer, '127.0.0.1', 0)
        timer.reset()
        executor.wake()

    server = None
    node.create_service(Trigger, 'asked', serve, callback_group=group)
    publisher = node.create_publisher(Header, '/sent', 10)
    node.create_subscription(Header, '/sent', hear, 10, callback_group=group)
    timer = node.create_timer(0.001, tick, callback_group=group, autostart=False)
    executor = make_executor(nodes=[node])
    executor.create_task(start_server)
    until_done(executor, done)
    assert done.done()
    first, several, heard, read, made = found
    assert first.message == 'served'
    assert several[:2] == [1, 'served'] and several[2].message == 'served'
    assert several[3] != threading.get_ident()
    assert (heard, read, made) == ('sent', b'over a socket', 'a task')


@needs_timeout
def test_the_coroutine_of_a_callback_is_the_current_task(make_executor, until_done):
    found, done = [], Future()

    async def fail():
        await asyncio.sleep(0.001)
        raise ValueError('of a child')

    async def ask():
        assert asyncio.current_task().get_coro().__name__ == 'ask'  # before anything else
        assert asyncio.current_task().get_loop() is asyncio.get_running_loop()
        for never in (Future(), asyncio.get_running_loop().create_future()):
            try:
                async with asyncio.timeout(0.001):
                    await never
            except TimeoutError:
                found.append('timeout')
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(fail())
                group.create_task(asyncio.sleep(100))
                await Future()
        except ExceptionGroup as several:  # noqa: F821
            found.append(str(several.exceptions[0]))
        assert not asyncio.current_task().cancelling()
        await asyncio.sleep(0.001)
        done.set_result(None)

    executor = make_executor()
    executor.create_task(ask)
    until_done(executor, done)
    assert found == ['timeout', 'timeout', 'of a child']


def test_a_cancelled_callback_ends_without_an_error(make_executor, make_node, until_done):
    """A task of rclpy is cancelled then; a callback that was not cancelled fails."""
    done, node, ticked = Future(), make_node(), []

    async def cancel_itself():
        asyncio.current_task().cancel()
        await Future()

    async def tick():
        timer.cancel()
        ticked.append(True)
        await cancel_itself()

    async def check():
        while not (cancelled.cancelled() and ticked):
            await asyncio.sleep(0.001)
        done.set_result(None)

    async def raise_it():
        raise asyncio.CancelledError

    timer = node.create_timer(0.001, tick)
    executor = make_executor(nodes=[node])
    cancelled = executor.create_task(cancel_itself)
    executor.create_task(check)
    until_done(executor, done)
    assert cancelled.cancelled() and not cancelled.done()

    timer.callback = raise_it
    timer.reset()
    with pytest.raises(asyncio.CancelledError):
        executor.spin_until_future_complete(Future(), patience(10))


def test_groups_and_jobs_are_kept_while_a_callback_sleeps(make_executor, make_node, tmp_path):
    """It keeps its mutually exclusive group, and continues for its job; a recording agrees."""
    node, jobs, running, overlaps = make_node('n'), [], set(), []
    publisher = node.create_publisher(Header, '/a', 10)

    async def sleep(name):
        overlaps.extend(running)
        running.add(name)
        await asyncio.sleep(0.003)
        running.remove(name)

    async def hear(_):
        before = current_job()
        await sleep('hear')
        jobs.append((before[1], current_job()[1]))

    node.create_timer(0.01, lambda: publisher.publish(Header()),
                      callback_group=MutuallyExclusiveCallbackGroup())
    node.create_timer(0.015, lambda: sleep('other'))
    node.create_subscription(Header, '/a', hear, 10)
    text = graph(n="""
        name: tick, timer: 10ms, publishes: [/a]
        name: hear, subscription: /a, deadline: 10s""")
    trace = str(tmp_path / 'run.mcap')
    with Spinning(make_executor(loads(text), nodes=[node], trace=trace)):
        assert wait_for(lambda: len(jobs) > 20)
    outcome = replay(trace)
    parts, = outcome.chains.breakdown().values()
    assert parts['mean']['suspended_ns'] > 3_000_000 and not drift_of(outcome.recording)
    assert not overlaps
    assert all(a == b for a, b in jobs) and [a for a, _ in jobs] == sorted({a for a, _ in jobs})


def test_many_coroutines_sleep_at_once(make_executor):
    executor, threads = make_executor(num_workers=2), set()
    done, left = Future(), 1000

    async def sleep():
        nonlocal left
        await asyncio.sleep(0.02)
        threads.add(threading.get_ident())
        await asyncio.sleep(0)
        left -= 1  # no other step runs between the two: they are joined
        if not left:
            done.set_result(None)

    for _ in range(1000):
        executor.create_task(sleep)
    spin(executor, done)
    assert done.done() and len(threads) <= 2


def test_steps_run_one_at_a_time_once_a_coroutine_has_used_asyncio(make_executor):
    """Also those that call nothing of the loop: two that await one future at once would fail."""
    executor, running, together, done = make_executor(num_workers=3), [], [], []

    async def compute():
        for _ in range(5):
            running.append(1)
            time.sleep(0.002)
            together.append(len(running))
            running.pop()
            future = Future()
            threading.Timer(0.001, future.set_result, (None,)).start()
            await future
        done.append(1)

    with Spinning(executor):
        used = executor.create_task(asyncio.sleep, 0.001)
        assert wait_for(used.done)
        for _ in range(6):
            executor.create_task(compute)
        assert wait_for(lambda: len(done) == 6)
    assert {*together} == {1}


class Model:
    """
    Coroutines that await futures of both kinds in a random order; how far each has to be.

    :ivar steps: of each coroutine, how many of its waits are over.
    """

    def __init__(self, executor, seed):
        self.random = random.Random(seed)
        self.executor = executor
        self.loop = None
        self.futures = []
        self.done = set()
        self.programs = []
        self.steps = []

    async def make(self, coroutines, futures):
        """Make the futures in the loop, and start the coroutines."""
        self.loop = asyncio.get_running_loop()
        self.futures = [self.random.choice((Future, self.loop.create_future))()
                        for _ in range(futures)]
        for number in range(coroutines):
            self.programs.append([
                self.random.sample(range(futures), self.random.choice((1, 1, 1, 2)))
                for _ in range(self.random.randint(1, 6))])
            self.steps.append(0)
            start = self.random.choice((self.executor.create_task, self.loop.create_task))
            start(self.run(number))

    async def run(self, number):
        """Await the futures of a coroutine, one after the other or two at once."""
        for several in self.programs[number]:
            if len(several) == 1:
                assert await self.futures[several[0]] == several[0]
            else:
                assert await asyncio.gather(*(self.futures[i] for i in several)) == several
            assert self.done.issuperset(several)
            self.steps[number] += 1

    def complete(self):
        """Complete one or more futures, from this thread."""
        left = sorted({*range(len(self.futures))} - self.done)
        for i in self.random.sample(left, min(len(left), self.random.choice((1, 1, 2, 5)))):
            self.done.add(i)
            if isinstance(self.futures[i], Future):
                self.futures[i].set_result(i)
            else:
                self.loop.call_soon_threadsafe(self.futures[i].set_result, i)

    def expected(self):
        """Return how many waits of each coroutine have to be over."""
        return [next((n for n, several in enumerate(program)
                      if not self.done.issuperset(several)), len(program))
                for program in self.programs]


def test_random_orders_of_both_kinds_of_futures(make_executor):
    """`MDDAG_THOROUGH=20` tries more than 10,000 waits."""
    waits, times = 0, int(os.environ.get('MDDAG_THOROUGH', '1'))
    executor = make_executor(num_workers=3)
    with Spinning(executor):
        for seed in range(4 * times):
            model = Model(executor, seed)
            made = executor.create_task(model.make, 50, 12)
            assert wait_for(made.done)
            while len(model.done) < 12:
                model.complete()
                assert wait_for(lambda: model.steps == model.expected()), seed  # noqa: B023
            waits += sum(model.steps)
    assert waits > 500 * times


def test_coroutines_that_await_asyncio_at_the_end_are_cancelled(ros_context, make_node, capfd):
    ended = Counter()

    async def sleep():
        try:
            await asyncio.sleep(100)
        finally:
            ended['callback'] += 1

    async def child():
        try:
            await asyncio.sleep(100)
        finally:
            ended['task'] += 1

    async def start():
        children.append(asyncio.get_running_loop().create_task(child()))
        await asyncio.sleep(0.001)

    node, children = make_node(), []
    node.create_timer(0.001, sleep)
    executor = MultiDeadlineExecutor(context=ros_context)
    executor.add_node(node)
    with Spinning(executor):
        started = executor.create_task(start)
        assert wait_for(lambda: started.done() and 'sleep' in str(begun(executor)))
    assert ended == {'callback': 1, 'task': 1} and children[0].cancelled()
    said = capfd.readouterr().err
    assert '/node: sleep (timer 1ms): its coroutine' in said and '.sleep has not ended' in said
    assert 'the asyncio task' in said and '.child has not ended' in said
    assert not any(t.name == 'mddag-asyncio' for t in threading.enumerate())


def begun(executor):
    """Return the names of the coroutines that are suspended."""
    with pool_of(executor).lock:
        return [str(work.coroutine.get_coro()) for work in engine_of(executor).begun()]


def test_a_coroutine_may_fail_when_it_is_cancelled_at_the_end(ros_context, make_node, capfd):
    """The others are cancelled as well, and the run is judged."""
    ended = []

    async def fail():
        timers[0].cancel()
        try:
            await asyncio.sleep(100)
        finally:
            raise ValueError('too late')

    async def await_a_task():
        timers[1].cancel()
        try:
            await asyncio.create_task(asyncio.sleep(100))
        except asyncio.CancelledError:
            ended.append('cancelled')
            raise

    node = make_node()
    # each once: on a busy machine a timer fires again before its callback cancels it
    timers = [node.create_timer(0.01, callback, callback_group=MutuallyExclusiveCallbackGroup())
              for callback in (fail, await_a_task)]
    executor = MultiDeadlineExecutor(context=ros_context)
    executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: len(begun(executor)) == 2)
        time.sleep(0.01)
    assert ended == ['cancelled']
    assert 'when it was cancelled, raised ValueError: too late' in capfd.readouterr().err
    assert not any(t.name == 'mddag-asyncio' for t in threading.enumerate())


def test_a_future_that_stays_keeps_no_callbacks_of_waits_that_are_over(make_executor):
    stays, done, kept = Future(), Future(), []

    async def wait():
        is_over = asyncio.Event()
        for _ in range(5):
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(asyncio.shield(wrapped(is_over)), 0.001)
            with pytest.raises(asyncio.CancelledError):
                asyncio.get_running_loop().call_later(0.001, asyncio.current_task().cancel)
                await stays
        kept.append(len(stays._callbacks))
        is_over.set()
        done.set_result(None)

    async def wrapped(is_over):
        await is_over.wait()

    executor = make_executor()
    executor.create_task(wait)
    spin(executor, done)
    assert kept == [0]


def test_the_turnstile_outlives_an_interrupt_and_a_finalizer(make_executor):
    """An interrupted thread gives its turn up; a finalizer under the engine's lock waits not."""
    turnstile = Turnstile()
    turnstile.acquire()
    main = threading.main_thread().ident
    interrupt = threading.Timer(0.05, signal.pthread_kill, (main, signal.SIGINT))
    interrupt.start()
    with pytest.raises(KeyboardInterrupt):
        turnstile.acquire()
    turnstile.release()
    turnstile.acquire()

    executor, is_held, ends = make_executor(), threading.Event(), threading.Event()
    loop = pool_of(executor).loops().loop()

    def hold():
        loop.own()
        is_held.set()
        ends.wait(15)
        loop.let_others(None)

    holder = threading.Thread(target=hold)
    holder.start()
    assert is_held.wait(15)
    with pool_of(executor).lock:  # where garbage may be collected
        loop.call_soon(int)
    ends.set()
    holder.join()


def test_without_coroutines_there_is_no_loop():
    code = ('import rclpy, sys\n'
            'from mddag_executor import MultiDeadlineExecutor\n'
            'rclpy.init()\n'
            'node = rclpy.create_node("n")\n'
            'executor = MultiDeadlineExecutor()\n'
            'executor.add_node(node)\n'
            'executor.spin_once(0.1)\n'
            'executor.shutdown()\n'
            'assert "asyncio" not in sys.modules\n')
    subprocess.run([sys.executable, '-c', code], check=True, timeout=60)


def test_a_task_of_a_program_s_own_loop_awaits_futures_of_rclpy(make_executor, make_node):
    """The futures are of a service and of a task. A wait does not poll, and leaves no callback."""
    node = make_node()
    node.create_service(Trigger, 'asked', lambda _, response: response)
    client = node.create_client(Trigger, 'asked')
    executor = make_executor(nodes=[node])

    async def fail():
        raise ValueError('of a task')

    async def main():
        spinning = asyncio.ensure_future(executor.spin_async())
        response = await asyncio.wait_for(client.call_async(Trigger.Request()), patience(15))
        assert isinstance(response, Trigger.Response)
        with pytest.raises(ValueError, match='of a task'):
            await executor.create_task(fail)
        loop, never, turns = asyncio.get_running_loop(), Future(), itertools.count()
        turn = loop._run_once
        loop._run_once = lambda: (next(turns), turn())
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(never, 0.3)
        assert next(turns) < 50
        assert not never._callbacks
        spinning.cancel()
        with pytest.raises(asyncio.CancelledError):
            await spinning

    asyncio.run(main())


def test_spin_async_ends_as_spin_does(make_executor, ros_context):
    executor = make_executor()

    async def fail():
        await asyncio.sleep(0.001)
        raise ValueError('in a task')

    async def main():
        executor.create_task(fail)
        with pytest.raises(ValueError, match='in a task'):
            await executor.spin_async()
        spinning = asyncio.ensure_future(executor.spin_async())
        await asyncio.sleep(0.01)
        with pytest.raises(RuntimeError, match='already spinning'):
            executor.spin_once(0)
        threading.Timer(0.01, ros_context.shutdown).start()
        with pytest.raises(ExternalShutdownException):
            await asyncio.wait_for(spinning, 10)

    asyncio.run(main())


def test_spin_async_is_no_time_without_a_spin(make_executor, make_node, tmp_path):
    path, node, ran = tmp_path / 'run.mcap', make_node(), []
    node.create_timer(0.005, lambda: ran.append(1))
    executor = make_executor(nodes=[node], trace=path)
    assert wait_for(lambda: executor.spin_once(0.1) or ran)

    async def main():
        spinning = asyncio.ensure_future(executor.spin_async())
        while len(ran) < 5:
            await asyncio.sleep(0.001)
        spinning.cancel()
        with pytest.raises(asyncio.CancelledError):
            await spinning

    asyncio.run(asyncio.wait_for(main(), patience(15)))
    time.sleep(0.002)
    executor.shutdown()
    recording = open_recording(path)
    gaps = recording.spin_gaps[recording.spin_gaps['program'] == -1]
    starts = recording.executions['start']
    assert len(gaps) and len(starts) >= 5
    assert not [(gap, start) for gap in gaps for start in starts
                if gap['start'] < start < gap['end']]


def test_a_callback_of_asyncio_that_does_not_end_is_abandoned(
        ros_context, make_node, monkeypatch, capfd):
    """So are the coroutines of its loop; the executor ends."""
    for module in ('asyncio_loop', 'coroutines'):
        monkeypatch.setattr(f'mddag_executor.executor.{module}.CLOSE_S', 0.1)
    blocks, let_go = threading.Event(), threading.Event()

    def block():
        blocks.set()
        let_go.wait(60.0)

    async def sleep():
        timer.cancel()
        asyncio.get_running_loop().call_soon(block)
        await asyncio.sleep(100)

    node = make_node()
    timer = node.create_timer(0.01, sleep)
    executor = MultiDeadlineExecutor(context=ros_context)
    executor.add_node(node)
    try:
        with Spinning(executor):
            assert wait_for(lambda: blocks.is_set() and begun(executor))
        assert 'a callback of asyncio has not ended: it is abandoned' in capfd.readouterr().err
    finally:
        let_go.set()
    assert wait_for(lambda: not any(t.name == 'mddag-asyncio' for t in threading.enumerate()))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Tasks, coroutines and futures: orders that rclpy's own tests rely on, with seven workers."""

import inspect
import threading
import time

from mddag_executor import open_recording
from msg_graph import loads
import pytest
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future, Task
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from .conftest import matched, patience, Spinning, wait_for
from .declared import graph
from .inside import pool_of

# --- like rclpy's executor -----------------------------------------------------------------------


def test_tasks_created_before_spin_run_in_rclpys_order(make_executor, ros_context):
    orders = []
    for executor in make_executor(), SingleThreadedExecutor(context=ros_context):
        order = []
        orders.append(order)
        for name in 'abc':
            executor.create_task(order.append, name)
        for count in range(1, 4):
            executor.spin_once(timeout_sec=0)
            assert len(order) == count
        executor.shutdown()
    assert orders[0] == orders[1] and sorted(orders[0]) == ['a', 'b', 'c']


def test_other_callbacks_of_an_awaited_future_run_where_rclpy_runs_them(
        make_executor, ros_context):
    """Since rclpy 7.1.9 in the executor, before that in the thread that completes the future."""
    here = []
    for executor in make_executor(), SingleThreadedExecutor(context=ros_context):
        future = Future()
        threads = []

        async def wait(future=future):
            await future

        task = executor.create_task(wait)
        executor.spin_once(timeout_sec=0)
        future.add_done_callback(
            lambda _, threads=threads: threads.append(threading.get_ident()))
        completing = threading.Thread(target=future.set_result, args=(None,))
        completing.start()
        completing.join()
        for _ in range(20):
            if task.done() and threads:
                break
            executor.spin_once(timeout_sec=0.1)
        here.append(threads == [threading.get_ident()])
        executor.shutdown()
    assert here[0] == here[1]


# --- with the rclpy that is installed, and as since 7.1.9 ----------------------------------------

# There a future that is awaited hands itself to the task, which goes on by itself when it is done;
# and a coroutine that continues before gets an error.
IS_NEWER = hasattr(Task, '_add_resume_callback')


@pytest.fixture(params=['installed'] + ['newer'] * (not IS_NEWER))
def each_rclpy(request, monkeypatch):
    """Let futures and tasks do what they do now, and what they do since rclpy 7.1.9."""
    if request.param == 'installed':
        return
    call_function = Task.__call__

    def wait(self):
        if self._pending():
            yield self
        if self._pending():
            raise RuntimeError('it goes on before the future that it awaits is done')
        return self.result()

    def call(self):
        if not inspect.iscoroutine(self._handler):
            call_function(self)
        elif self._pending():
            step(self)

    def step(task):
        try:
            yielded = task._handler.send(None)
        except StopIteration as stop:
            task.set_result(stop.value)
        except Exception as error:
            task.set_exception(error)
        else:
            if yielded is None:
                task._executor()._call_task_in_next_spin(task)
            else:
                task._add_resume_callback(yielded, task._executor())

    def resume(self, future, executor):
        future.add_done_callback(lambda _: self())

    monkeypatch.setattr(Future, '__await__', wait)
    monkeypatch.setattr(Task, '__call__', call)
    monkeypatch.setattr(Task, '_add_resume_callback', resume, raising=False)


@pytest.mark.usefixtures('each_rclpy')
def test_a_coroutine_goes_on_in_the_step_after_its_future_is_done(make_executor):
    executor = make_executor()
    future = Future(executor=executor)

    async def wait(word, end):
        return word + await future + end

    task = executor.create_task(wait, 'it ', end='!')
    executor.spin_once(timeout_sec=0)
    assert not task.done()
    future.set_result('is done')
    executor.spin_once(timeout_sec=1)
    assert task.done() and task.result() == 'it is done!'


@pytest.mark.usefixtures('each_rclpy')
def test_a_task_awaits_one_future_after_another(make_executor):
    """The executor's or free ones, in coroutines or in a generator: none goes on before."""
    executor = make_executor()

    async def one_by_one(futures):
        for future in futures:
            yield await future

    async def inner(future, got):
        got.append(await future)

    async def outer(futures, generates):
        got = []
        if generates:
            async for value in one_by_one(futures):
                got.append(value)
        else:
            for future in futures:
                await inner(future, got)
        return got

    tasks, ways = [], []
    for make in executor.create_future, Future:
        for generates in False, True:
            ways.append([make() for _ in range(20)])
            tasks.append(executor.create_task(outer, ways[-1], generates))
    with Spinning(executor):
        for number, futures in enumerate(zip(*ways)):
            time.sleep(0.003)
            for future in futures:
                future.set_result(number)
        assert wait_for(lambda: all(task.done() for task in tasks))
    assert [task.result() for task in tasks] == [[*range(20)]] * 4
    # where rclpy's own executors keep tasks that are to go on, which nothing would take out here
    assert not getattr(executor, '_ready_tasks', ())


class Turn:
    """What a coroutine may await as well: nothing that says when it is ready."""

    def __await__(self):
        yield


@pytest.mark.usefixtures('each_rclpy')
@pytest.mark.parametrize('stepwise', [False, True])
def test_a_coroutine_that_awaits_something_unknown_is_asked_again(make_executor, stepwise):
    executor, turns = make_executor(), []

    async def work():
        for turn in range(5):
            await Turn()
            turns.append(turn)
        return 'done'

    task = executor.create_task(work)
    if stepwise:
        for step in range(6):
            executor.spin_once(0.1)
            assert turns == [*range(step)]
    else:
        executor.spin_until_future_complete(task, 3.0)
    assert task.done() and task.result() == 'done' and turns == [0, 1, 2, 3, 4]


def test_the_callback_group_of_a_coroutine_that_never_goes_on_is_free_again(
        make_executor, make_node):
    """The node may run in another executor then."""
    node, begun, ran, future = make_node(), [], [], Future()

    async def waits():
        begun.append(1)
        await future

    guard = node.create_guard_condition(waits)
    guard.trigger()
    with Spinning(make_executor(nodes=[node])):
        assert wait_for(lambda: begun)
    other = node.create_guard_condition(lambda: ran.append(1))
    other.trigger()
    with Spinning(make_executor(nodes=[node])):
        assert wait_for(lambda: ran)


def test_a_coroutine_that_only_asks_again_and_again_takes_little_of_the_cpu(make_executor):
    """It rests for a microsecond more each time."""
    executor, turns = make_executor(), []

    async def work():
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            await Turn()
            turns.append(1)

    with Spinning(executor):
        assert wait_for(executor.create_task(work).done)
    # this many microseconds have passed, whatever else the machine has done
    assert len(turns) * (len(turns) - 1) // 2 <= 500_000


def test_a_coroutine_that_has_awaited_something_rests_briefly_again(make_executor, monkeypatch):
    executor, rests, done = make_executor(), [], Future()
    kind = type(pool_of(executor))
    call_at = kind.call_at

    def note(pool, at, function):
        rests.append(at - time.monotonic_ns())
        call_at(pool, at, function)

    monkeypatch.setattr(kind, 'call_at', note)

    async def work():
        for _ in range(300):
            await Turn()
        executor.create_task(done.set_result, None)
        await done
        await Turn()

    with Spinning(executor):
        assert wait_for(executor.create_task(work).done)
    assert len(rests) == 301 and rests[-1] <= 1_000


def fails():
    raise KeyError('handled')


async def fails_later():
    fails()


@pytest.mark.usefixtures('each_rclpy')
def test_an_exception_that_is_handled_does_not_end_the_executor(make_executor):
    """Whether the task fails before its maker awaits it or after (rclpy#1215, #1098)."""
    executor = make_executor()

    async def handle(kind, late):
        handled = 0
        for _ in range(10):
            task = executor.create_task(kind)
            if late:
                assert wait_for(task.done)
            try:
                await task
            except KeyError:
                handled += 1
        return handled

    def look(kind):  # with rclpy's example, in a function
        task = executor.create_task(kind)
        assert wait_for(task.done)
        with pytest.raises(KeyError, match='handled'):
            task.result()
        return 10

    tasks = [executor.create_task(look, kind) for kind in (fails, fails_later)] + [
        executor.create_task(handle, kind, late)
        for kind in (fails, fails_later) for late in (False, True)]
    with Spinning(executor):
        assert wait_for(lambda: all(task.done() for task in tasks))
        time.sleep(0.15)  # exceptions are checked every 100 ms
    assert [task.result() for task in tasks] == [10] * 6


@pytest.mark.usefixtures('each_rclpy')
@pytest.mark.parametrize('steps', [False, True])
def test_a_spin_that_waits_for_a_task_raises_its_exception(make_executor, steps):
    """Once, even if the maker of the task still runs; a later spin is not disturbed by it."""
    executor = make_executor()
    goes_on, made = Future(executor=executor), []

    def spin(future):
        if not steps:
            executor.spin_until_future_complete(future, patience(5.0))
        while steps and not future.done():
            executor.spin_once_until_future_complete(future, 5.0)

    async def fails_when_it_goes_on():
        await goes_on
        fails()

    async def make():
        made.append(executor.create_task(fails))
        await goes_on

    for kind in (fails, fails_later):
        with pytest.raises(KeyError, match='handled'):
            spin(executor.create_task(kind))
    maker = executor.create_task(make)
    executor.spin_once(0.0)
    with pytest.raises(KeyError, match='handled'):
        spin(made[0])
    task = executor.create_task(fails_when_it_goes_on)
    for _ in range(3):  # without the task's end, a spin leaves nothing behind
        executor.spin_until_future_complete(task, 0.001)
        executor.spin_once_until_future_complete(task, 0.001)
    assert len(goes_on._callbacks) == 2 and len(task._callbacks) == 1  # the coroutines' own
    executor.create_task(goes_on.set_result, None)
    with pytest.raises(KeyError, match='handled'):
        spin(task)
    assert maker.done()
    spin(executor.create_task(lambda: time.sleep(0.06)))  # exceptions are checked in that time


@pytest.mark.usefixtures('each_rclpy')
@pytest.mark.parametrize('declared, order', [(False, 'bba'), (True, 'bab')])
def test_a_coroutine_that_goes_on_counts_from_then_unless_it_belongs_to_a_job(
        make_executor, make_node, declared, order):
    """One that began long ago does not go before everything that was ready before it."""
    future, begun, ran = Future(), [], []

    async def wait(_):
        begun.append('a')
        await future
        ran.append('a')

    node = make_node()
    node.create_subscription(Header, '/a', wait, 10)
    publisher = make_node('other').create_publisher(Header, '/a', 10)
    text = graph(node='name: a, subscription: /a, period: 1s, deadline: 60s')
    executor = make_executor(
        loads(text) if declared else None, default_deadline='120s', nodes=[node])
    matched(publisher)
    publisher.publish(Header())
    while not begun:
        executor.spin_once(1.0)
    for _ in range(2):
        executor.create_task(ran.append, 'b')
    executor.spin_once(0)
    future.set_result(None)
    for _ in range(2):
        executor.spin_once(0)
    assert ''.join(ran) == order


@pytest.mark.usefixtures('each_rclpy')
def test_coroutines_ask_and_answer(make_executor, make_node):
    node, answers = make_node(), []

    async def answer(request, response):
        response.message = await executor.create_task(lambda a, b: a + b, 'y', b='es')
        return response

    async def ask():
        answers.append((await client.call_async(Trigger.Request())).message)

    node.create_service(Trigger, '/ask', answer)
    client = node.create_client(Trigger, '/ask')
    # a coroutine keeps its group while it waits
    timer = node.create_timer(0.01, ask, MutuallyExclusiveCallbackGroup())
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(answers) >= 3)
        timer.cancel()
    assert set(answers) == {'yes'}


def test_a_recording_names_tasks_after_their_functions(make_executor, make_node, tmp_path):
    """Those of goals belong to the node of the action server."""
    node, path = make_node('arm'), tmp_path / 'run.mcap'
    executor = make_executor(num_workers=2, nodes=[node], trace=path)

    def reach(goal):
        goal.succeed()
        return Fibonacci.Result()

    async def plan():
        pass

    server = ActionServer(node, Fibonacci, 'reach', reach)
    client = ActionClient(node, Fibonacci, 'reach')
    with Spinning(executor):
        assert client.wait_for_server(15.0)
        goal = client.send_goal_async(Fibonacci.Goal())
        assert wait_for(goal.done)
        result = goal.result().get_result_async()
        tasks = [executor.create_task(each) for each in (plan, plan(), list)]
        assert wait_for(lambda: result.done() and all(each.done() for each in tasks))
    server.destroy()
    client.destroy()
    executor.shutdown()
    recording = open_recording(path)
    names = {recording.callback_name(each)
             for each in recording.executions['callback'].tolist()}
    assert names > {'/arm: reach (task)', 'plan (task)', 'list (task)'}
    assert 'callback (task)' not in names

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Each thing that is used of rclpy beyond its interface, on the rclpy that is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import gc
import os
import threading
import time
from typing import Any
import weakref

from mddag_executor.executor import compat, listeners, waitsets
from mddag_executor.executor.compat import alive
from mddag_executor.executor.waitables import is_qos_event
import pytest
import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from rclpy.wait_for_message import wait_for_message
from rclpy.waitable import NumberOfEntities, Waitable
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

from .conftest import Spinning, wait_for


@pytest.fixture
def pair(make_node):
    """Give a client and a service that have found one another."""
    node = make_node()
    client = node.create_client(SetBool, 'asked')
    service = node.create_service(SetBool, 'asked', lambda request, response: response)
    assert client.wait_for_service(15.0)
    return client, service


def until_there(take):
    """Return what is taken, once it is there."""
    taken: list[Any] = []

    def look() -> bool:
        taken.append(take())
        return taken[-1] is not None and None not in taken[-1]

    assert wait_for(look)
    return taken[-1]


# --- taking --------------------------------------------------------------------------------------


@pytest.mark.parametrize('raw', [False, True])
def test_a_message_is_taken_with_its_info(make_node, raw):
    node = make_node()
    subscription = node.create_subscription(String, 'said', lambda message: None, 10, raw=raw)
    publisher = node.create_publisher(String, 'said', 10)
    take = compat.message_taker(subscription)
    assert take() is None
    assert wait_for(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data='this'))
    message, info = until_there(take)
    assert isinstance(message, bytes) if raw else message.data == 'this'
    assert 0 < info['source_timestamp'] <= time.time_ns()


def test_a_request_and_its_response_are_taken(pair):
    client, service = pair
    take_request, take_response = compat.request_taker(service), compat.response_taker(client)
    assert take_request()[1] is None and take_response()[0] is None
    future = client.call_async(SetBool.Request(data=True))
    request, header = until_there(take_request)
    assert request.data
    service.send_response(SetBool.Response(message='so'), header)
    header, response = until_there(take_response)
    number = header.request_id.sequence_number
    compat.complete_request(client, number, response, None)
    assert future.result().message == 'so'
    compat.complete_request(client, number, response, None)  # nobody waits any more


def test_whether_a_callback_takes_the_info_is_known(make_node):
    node = make_node()
    plain = node.create_subscription(String, 'said', lambda message: None, 10)
    both = node.create_subscription(String, 'said', lambda message, info: None, 10)
    assert compat.callback_type(plain) is not compat.WITH_INFO
    assert compat.callback_type(both) is compat.WITH_INFO


# --- timers --------------------------------------------------------------------------------------


def test_a_timer_is_asked_and_called(make_node):
    node = make_node()
    timer = node.create_timer(3600.0, print)
    until, call, period = compat.timer_functions(timer)
    assert period() == 3600 * 10**9
    assert 3590 * 10**9 < until() <= 3600 * 10**9
    timer.timer_period_ns = 1_000_000
    timer.reset()
    assert wait_for(lambda: until() <= 0)
    called = call()
    assert until() > -1_000_000
    assert (called is None) == (compat.TimerInfo is None)


@pytest.mark.skipif(compat.TimerInfo is None, reason='this rclpy has no TimerInfo')
def test_a_timer_gives_its_info_to_who_asks_for_it(make_executor, make_node):
    node, seen, plain = make_node(), [], []

    def tick(call) -> None:
        seen.append(call)

    tick.__annotations__['call'] = compat.TimerInfo
    node.create_timer(0.02, tick)
    node.create_timer(0.02, lambda: plain.append(1))
    executor = make_executor(nodes=[node])
    with Spinning(executor) as spinning:
        assert wait_for(lambda: len(seen) >= 10 and len(plain) >= 10)
    assert spinning.error is None
    for call in seen:
        assert call.expected_call_time <= call.actual_call_time
        assert call.expected_call_time.clock_type == node.get_clock().clock_type
    steps = {(b.expected_call_time - a.expected_call_time).nanoseconds
             for a, b in zip(seen, seen[1:])}
    assert all(step % 20_000_000 == 0 for step in steps)


def test_a_rates_timer_is_known(make_node):
    node = make_node()
    rate = node.create_rate(10.0)
    timer, = node.timers
    assert compat.ends_sleep(timer.callback)
    assert not compat.ends_sleep(print)
    node.destroy_rate(rate)


# --- futures and tasks ---------------------------------------------------------------------------


class Answering:
    """An executor as far as futures need one."""

    def __init__(self) -> None:
        self.tasks: list[Any] = []

    def create_task(self, *task: Any) -> None:
        self.tasks.append(task)


class Always(Waitable):
    """A waitable that its executor finds ready each time, and whose take gives nothing."""

    def __init__(self, node: Any) -> None:
        super().__init__(node.default_callback_group)
        self.guard = node.create_guard_condition(None)
        self.got: list[Any] = []

    def __enter__(self) -> None:
        self.guard.handle.__enter__()

    def __exit__(self, *_: Any) -> None:
        self.guard.handle.__exit__(None, None, None)

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities()

    def add_to_wait_set(self, wait_set: Any) -> None:
        pass

    def is_ready(self, wait_set: Any) -> bool:
        return len(self.got) < 3

    def take_data(self) -> None:
        return None

    async def execute(self, taken_data: Any) -> None:
        self.got.append(taken_data)


def test_what_ends_a_blocking_call_is_known(pair, monkeypatch):
    client, _ = pair
    added: list[Any] = []

    class Asked(Future):

        def add_done_callback(self, callback: Any) -> None:
            added.append(callback)
            super().add_done_callback(callback)

    future = Asked()
    monkeypatch.setattr(client, 'call_async', lambda request: future)
    got: list[Any] = []
    thread = threading.Thread(target=lambda: got.append(client.call(SetBool.Request())))
    thread.start()
    assert wait_for(lambda: added)
    future.set_result('so')
    thread.join(15.0)
    assert got == ['so'] and [compat.ends_call(each) for each in added] == [True]
    assert not compat.ends_call(print) and not compat.ends_call(lambda future: None)


def test_a_waitables_futures_run_their_callbacks_in_the_executor(make_node):
    waitable, executor, future = Always(make_node()), Answering(), Future()
    waitable.add_future(future)
    compat.attach_futures(waitable, executor)
    future.add_done_callback(print)
    future.set_result(None)
    assert executor.tasks == [(print, future)]
    assert compat.feedback_taken(waitable, {'feedback': None}, 9) == []


def test_a_waitable_that_takes_nothing_is_executed(make_executor, make_node):
    node = make_node()
    waitable = Always(node)
    node.add_waitable(waitable)
    executor = make_executor(nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: waitable.guard.trigger() or len(waitable.got) >= 3)
    assert set(waitable.got) == {None}
    node.remove_waitable(waitable)


def test_an_exception_of_a_task_is_told_once_and_not_printed(capsys):
    def fail() -> None:
        raise ValueError('on purpose')

    task = compat.BareTask(fail)
    task()
    assert str(task.unfetched()) == 'on purpose'
    compat.forget_task_frames(task.unfetched())
    assert task.unfetched().__traceback__.tb_frame.f_code is fail.__code__
    task.mark_fetched()
    assert task.unfetched() is None
    gone = weakref.ref(task)
    del task
    gc.collect()
    assert gone() is None
    assert capsys.readouterr().err == ''


def test_what_a_coroutine_waits_for_is_found():
    future: Any = Future()

    async def inner() -> None:
        await future

    async def outer() -> None:
        await inner()

    coroutine = outer()
    yielded = coroutine.send(None)
    assert (yielded if yielded is not None else compat.awaited(coroutine)) is future
    coroutine.close()

    class Odd:

        def __await__(self) -> Any:
            yield

    async def waits_for_something_else() -> None:
        await Odd()

    coroutine = waits_for_something_else()
    coroutine.send(None)
    assert compat.awaited(coroutine) is compat.NEXT_TURN
    coroutine.close()


# --- executors and nodes -------------------------------------------------------------------------


def test_the_bare_executor_knows_of_signals_and_of_its_end(ros_context):
    executor = compat.BareExecutor(context=ros_context)
    assert alive(executor.signal_guard())
    assert not executor.is_ending() and not executor.is_gone()
    executor.begin_end()
    assert executor.is_ending()
    executor.shutdown()
    assert executor.is_gone()


def test_the_end_of_a_context_is_told_before_its_nodes_are_gone():
    context = rclpy.context.Context()
    rclpy.init(context=context)
    node = rclpy.node.Node('ended', context=context)
    calls: list[bool] = []
    kept = compat.on_end(context, lambda: calls.append(alive(node)))
    context.shutdown()
    assert calls and calls[0]
    del kept
    node.destroy_node()


def test_who_is_called_by_spin_knows(ros_context, make_node):
    found = []

    class Asking(SingleThreadedExecutor):

        def spin_once(self, timeout_sec: float | None = None) -> None:
            found.append(compat.is_called_by_spin())
            self.context.try_shutdown()

    executor = Asking(context=ros_context)
    executor.spin_once()
    other = rclpy.context.Context()
    rclpy.init(context=other)
    again = Asking(context=other)
    node = rclpy.node.Node('spun', context=other)
    rclpy.spin(node, again)
    assert found == [False, True]


def test_a_node_keeps_its_executor_beside_another_one(make_node, ros_context):
    node = make_node()
    kept, runs = (SingleThreadedExecutor(context=ros_context) for _ in range(2))
    kept.add_node(node)
    with compat.executor_kept(node):
        runs.add_node(node)
    assert node.executor is kept
    assert kept.get_nodes() == runs.get_nodes() == [node]
    for executor in (kept, runs):
        executor.shutdown()


def test_the_subscription_that_keeps_time_is_known(make_node):
    node = make_node(parameter_overrides=[rclpy.parameter.Parameter('use_sim_time', value=True)])
    other = node.create_subscription(String, 'said', lambda message: None, 1)
    kept = [s for s in node.subscriptions if compat.keeps_time(s)]
    assert [s.topic_name for s in kept] == ['/clock'] and other not in kept


def test_which_waitables_are_qos_events_is_known(make_node):
    node = make_node()
    callbacks = SubscriptionEventCallbacks(deadline=print)
    node.create_subscription(
        String, 'said', lambda message: None, 1, event_callbacks=callbacks)
    events = list(node.waitables)
    assert events and all(map(is_qos_event, events))
    assert not is_qos_event(Always(node))


def test_services_of_rclpys_own_are_known(make_node):
    node = make_node(start_parameter_services=True)
    mine = node.create_service(SetBool, 'asked', lambda request, response: response)
    others = [service for service in node.services if service is not mine]
    assert others and all(map(compat.is_builtin, others)) and not compat.is_builtin(mine)


def test_a_subscription_that_waits_for_one_message_is_known(make_node):
    node, found = make_node(), []
    plain = node.create_subscription(String, 'said', lambda message: None, 10)
    publisher = node.create_publisher(String, 'said', 10)

    def look() -> None:
        if wait_for(lambda: len(list(node.subscriptions)) == 2):
            found.extend(map(compat.is_of_wait_for_message, node.subscriptions))
        publisher.publish(String())

    thread = threading.Thread(target=look)
    thread.start()
    got, _ = wait_for_message(String, node, 'said', time_to_wait=15.0)
    thread.join()
    assert got and found == [False, True]
    node.destroy_subscription(plain)


def test_names_of_services(pair):
    assert [compat.service_name(entity) for entity in pair] in (
        ['/asked', '/asked'], ['asked', 'asked'])


# --- what is behind a handle ---------------------------------------------------------------------


def is_written(fd: int) -> bool:
    try:
        return os.eventfd_read(fd) > 0
    except BlockingIOError:
        return False


@pytest.fixture
def eventfd() -> Iterator[int]:
    """Give an eventfd that nothing has been written to."""
    fd = listeners.new_eventfd()
    yield fd
    os.close(fd)


def listened(kind: str, entity: Any, fd: int, cause: Callable[[], Any]) -> None:
    """Try a listener: what it writes at once, when something happens, and when it is cleared."""
    with entity.handle:
        listeners.set_listener(kind, entity.handle.pointer, fd)
    assert is_written(fd)  # it is not known what was there before
    assert not is_written(fd)
    cause()
    assert wait_for(lambda: is_written(fd))
    with entity.handle:
        listeners.clear_listener(kind, entity.handle.pointer)
    cause()
    time.sleep(0.05)
    assert not is_written(fd)


def test_a_message_is_announced(make_node, eventfd):
    node = make_node()
    subscription = node.create_subscription(String, 'said', lambda message: None, 10)
    publisher = node.create_publisher(String, 'said', 10)
    assert wait_for(lambda: publisher.get_subscription_count() == 1)
    listened('subscription', subscription, eventfd, lambda: publisher.publish(String()))


def test_a_request_is_announced(pair, eventfd):
    client, service = pair
    listened('service', service, eventfd, lambda: client.call_async(SetBool.Request()))


def test_a_response_is_announced(pair, eventfd):
    client, service = pair
    take = compat.request_taker(service)

    def answer() -> None:
        client.call_async(SetBool.Request())
        service.send_response(SetBool.Response(), until_there(take)[1])

    listened('client', client, eventfd, answer)


def test_a_reset_of_a_timer_is_announced(make_node, eventfd):
    timer = make_node().create_timer(3600.0, print)
    listened('timer', timer, eventfd, timer.reset)


def test_when_rcl_calls_a_timer_next_is_known(make_node):
    timer = make_node().create_timer(
        3600.0, print, clock=rclpy.clock.Clock(clock_type=ClockType.STEADY_TIME))
    with timer.handle:
        next_call = listeners.NextCall(timer.handle.pointer)
        at = next_call.read()
        assert 3590 * 10**9 < at - time.monotonic_ns() <= 3600 * 10**9
        assert 3590 * 10**9 < next_call.until() <= 3600 * 10**9
        timer.cancel()
        assert next_call.read() is next_call.until() is None


def test_the_parts_of_a_waitable_are_known(make_node):
    node = make_node()
    callbacks = SubscriptionEventCallbacks(deadline=print)
    subscription = node.create_subscription(
        String, 'said', lambda message: None, 1, event_callbacks=callbacks)
    client = ActionClient(node, Fibonacci, 'count')
    server = ActionServer(node, Fibonacci, 'count', lambda goal: Fibonacci.Result())
    for waitables, kinds in (
        (subscription.event_handlers, ['event'] * len(subscription.event_handlers)),
        ([client], ['subscription', 'subscription', 'client', 'client', 'client']),
        ([server], ['timer', 'service', 'service', 'service']),
    ):
        found: list[str] = []
        waitsets.FilledSet(node.context, waitables).parts(
            lambda kind, address, found=found: found.append(kind))
        assert found == kinds
    client.destroy()
    server.destroy()

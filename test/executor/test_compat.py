# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Each thing that is used of rclpy beyond its interface, on the rclpy that is installed."""

from __future__ import annotations

import gc
import time
from typing import Any
import weakref

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor import compat
from mddag_executor.executor.compat.events_executor import events_executor_modules, is_available
from mddag_executor.executor.intake.entities import alive
import pytest
import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.task import Future
from rclpy.waitable import NumberOfEntities, Waitable
from std_msgs.msg import String
from std_srvs.srv import SetBool

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
    executor = make_executor()
    executor.add_node(node)
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
    executor = make_executor()
    executor.add_node(node)
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
    assert compat.awaited(coroutine) is compat.UNKNOWN
    coroutine.close()


# --- executors and nodes -------------------------------------------------------------------------

def test_the_bare_executor_has_guards_until_its_end(ros_context):
    executor = compat.BareExecutor(context=ros_context)
    assert len([guard.handle for guard in executor.guards()]) == 2
    assert not executor.is_ending() and not executor.is_gone()
    executor.ring()
    executor.begin_end()
    assert executor.is_ending()
    executor.shutdown()
    assert executor.is_gone()
    executor.ring()


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


def test_changes_of_a_node_are_told(make_node, monkeypatch):
    monkeypatch.setattr(rclpy.node.Node, '_wake_executor', rclpy.node.Node._wake_executor)
    calls = []
    compat.on_changes(calls.append)
    node = make_node()
    calls.clear()
    timer = node.create_timer(1.0, print)
    assert calls == [node]
    node.destroy_timer(timer)
    assert set(calls) == {node} and len(calls) >= 1


def test_the_subscription_that_keeps_time_is_known(make_node):
    node = make_node(parameter_overrides=[rclpy.parameter.Parameter('use_sim_time', value=True)])
    other = node.create_subscription(String, 'said', lambda message: None, 1)
    kept = [s for s in node.subscriptions if compat.keeps_time(s)]
    assert [s.topic_name for s in kept] == ['/clock'] and other not in kept


def test_which_qos_events_only_write_to_the_log_is_known(make_node):
    node = make_node()
    callbacks = SubscriptionEventCallbacks(deadline=print)
    node.create_subscription(
        String, 'said', lambda message: None, 1, event_callbacks=callbacks)
    logs = {w.event_type.name.rpartition('_')[2]: compat.only_logs(w) for w in node.waitables}
    assert logs.pop('MISSED') is False
    assert logs and all(logs.values())


def test_names_of_services(pair):
    assert [compat.service_name(entity) for entity in pair] in (
        ['/asked', '/asked'], ['asked', 'asked'])


def test_the_native_executor_is_there():
    assert is_available()
    assert all(hasattr(module, 'EventsExecutor') for module in events_executor_modules())


def test_without_a_native_executor_there_is_the_wait_set(monkeypatch, ros_context, make_node):
    monkeypatch.delattr(implementation, 'EventsExecutor')
    assert not is_available() and not events_executor_modules()
    node, ran = make_node(), []
    node.create_timer(0.01, lambda: ran.append(1))
    executor = MultiDeadlineExecutor(context=ros_context)
    executor.add_node(node)
    with Spinning(executor) as spinning:
        assert wait_for(lambda: ran)
    assert spinning.error is None

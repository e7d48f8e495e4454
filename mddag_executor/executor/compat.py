# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
All uses of rclpy beyond its documented interface.

No other module uses a private name of rclpy, or what is behind a handle; ``test/test_layers.py``
checks that. Each entry lists the versions in which it was seen. *7.1* is Jazzy: 7.1.5, the version
in the package index, to 7.1.11. *9.1* is Kilted: 9.1.2, the one in the package index, to 9.1.5.
Entries without a version are in both, and the executor needs them.

Adapters to rcl and rmw, which use the ``pointer`` of a handle, are separate modules:
``listeners``, ``request_ids`` and ``waitsets``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache, partial
import inspect
from operator import attrgetter
import os
import sys
import threading
import types
from typing import Any
import weakref

from mddag_executor.executor.sent_requests import ACTION, Heritage
import rclpy
import rclpy.client
from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor, MultiThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.task import Future, Task
from rclpy.time_source import TimeSource
import rclpy.timer
from rclpy.waitable import Waitable

RCLError: type[Exception] = _rclpy.RCLError
"""The error of rcl. From 7.1.8 on it is also ``rclpy.subscription.RCLError``."""

RCL_ERRORS = (InvalidHandle, RCLError)
"""Errors that rclpy raises for objects whose context has ended, among others."""


def alive(entity: Any) -> bool:
    """Return whether a node or an entity has not been destroyed."""
    try:
        with entity if isinstance(entity, Waitable) else entity.handle:
            return True
    except InvalidHandle:
        return False


# --- taking --------------------------------------------------------------------------------------

def message_taker(subscription: Any) -> Callable[[], tuple[Any, dict[str, Any]] | None]:
    """Return a function that takes a message (bytes if raw) with its info, or returns None."""
    return partial(subscription.handle.take_message, subscription.msg_type, subscription.raw)


def publisher_ids(node: Any, subscription: Any) -> frozenset[bytes] | None:
    """
    Return the ids of the publishers of a subscription's topic.

    None: they are unknown, or a content filter holds messages back (from 7.1.8 on).
    """
    try:
        if getattr(subscription, 'is_cft_enabled', False):
            return None
        with node.handle, subscription.handle:
            found = _rclpy.rclpy_get_publishers_info_by_topic(
                node.handle, subscription.topic_name, False)
    except RCL_ERRORS:
        return None
    return frozenset(bytes(each['endpoint_gid']) for each in found)


def publisher_count(subscription: Any) -> int:
    """Return the number of publishers that a subscription is matched with, -1 if unknown."""
    try:
        count: int = subscription.get_publisher_count()
    except RCL_ERRORS:
        return -1
    return count


def request_taker(service: Any) -> Callable[[], tuple[Any, Any] | None]:
    """Return a function that takes a request with its header, or returns None."""
    return _taker(service.handle.service_take_request, service.srv_type.Request)


def response_taker(client: Any) -> Callable[[], tuple[Any, Any] | None]:
    """Return a function that takes a response's header and the response, or returns None."""
    return _taker(client.handle.take_response, client.srv_type.Response)


def _taker(take: Callable[[Any], tuple[Any, Any]], kind: Any) -> Callable[
        [], tuple[Any, Any] | None]:
    def take_one() -> tuple[Any, Any] | None:
        taken = take(kind)
        return None if taken[0] is None else taken

    return take_one


callback_type: Callable[[Any], Any] = attrgetter('_callback_type')
"""Whether a subscription's callback also takes a message's info: then ``WITH_INFO``."""

WITH_INFO = Subscription.CallbackType.WithMessageInfo


# --- timers --------------------------------------------------------------------------------------

TimerInfo: Any = getattr(rclpy.timer, 'TimerInfo', None)
"""The type by which a timer's callback asks for its info. Public in 9.1; absent in 7.1."""


def timer_functions(timer: Any) -> tuple[
    Callable[[], int | None], Callable[[], dict[str, int] | None], Callable[[], int],
]:
    """
    Return functions that read the time until a timer's next call, call it, and read its period.

    Unlike the timer's own methods they do not enter its handle each time. In 9.1 a call returns
    the data of a ``TimerInfo``; in 7.1 None.
    """
    handle = timer.handle
    call = getattr(handle, 'call_timer_with_info', handle.call_timer)
    return handle.time_until_next_call, call, handle.get_timer_period


_info_parameters: weakref.WeakKeyDictionary[Any, str | None] = weakref.WeakKeyDictionary()


def with_timer_info(timer: Any, callback: Any, call: dict[str, int] | None) -> Any:
    """Return a timer's callback with the ``TimerInfo`` of a call, if it asks for that (9.1)."""
    if call is None or callback is None:
        return callback
    function = getattr(callback, '__func__', callback)
    try:
        name = _info_parameters[function]
    except KeyError:
        name = _info_parameters[function] = _info_parameter(callback)
    except TypeError:  # it supports no weak references
        name = _info_parameter(callback)
    if name is None:
        return callback
    info = TimerInfo(**call, clock_type=timer.clock.clock_type)
    return partial(callback, **{name: info})


def _info_parameter(callback: Any) -> str | None:
    try:
        parameters = inspect.signature(callback).parameters.values()
    except (TypeError, ValueError):
        return None
    return next((p.name for p in parameters if p.annotation == TimerInfo), None)


def ends_sleep(callback: Any) -> bool:
    """Return whether a timer's callback is that of a ``Rate``, which ends a thread's sleep."""
    return type(callback) is types.MethodType and callback.__func__ is threading.Event.set


# --- futures -------------------------------------------------------------------------------------

HERITAGE = '_mddag_heritage'
"""The attribute of a future with what its callbacks inherit: see ``sent_requests``."""


def complete_request(
    client: Any, number: int, response: Any, executor: Any,
    find_heritage: Callable[[], Heritage | None] = lambda: None,
) -> None:
    """
    Complete the future of a client's request; its callbacks run in an executor.

    :param find_heritage: returns what they inherit; it is called when the thread that has sent the
        request has noted that: this waits for the client's lock, with which requests are sent.
    """
    try:
        future = client.get_pending_request(number)
    except KeyError:
        find_heritage()  # the request was cancelled: nothing needs it any more
        return
    future._set_executor(executor)
    heritage = find_heritage()
    if heritage is not None:
        setattr(future, HERITAGE, heritage)
    future.set_result(response)


def heritage_of_response(args: tuple[Any, ...]) -> Heritage | None:
    """Return what a task inherits that is a done callback of a request's future; None: nothing."""
    found: Heritage | None = None
    if args and isinstance(args[0], Future):
        found = getattr(args[0], HERITAGE, None)
    return found


def attach_futures(waitable: Any, executor: Any) -> None:
    """Let the callbacks of a waitable's futures run in an executor."""
    for future in waitable._futures:
        future._set_executor(executor)


_FORGET = rclpy.client.Client.remove_pending_request.__code__
_UNBLOCK = next(
    (each for each in rclpy.client.Client.call.__code__.co_consts
     if getattr(each, 'co_name', '') == 'unblock'), None)


def is_quick(callback: Any) -> bool:
    """
    Return whether it is a done callback of rclpy itself that takes no time and never fails.

    These are the one by which ``Client.call`` stops waiting, and the one by which a client forgets
    a request that is answered or cancelled.
    """
    code = getattr(getattr(callback, '__func__', callback), '__code__', None)
    return code is _FORGET or code is not None and code is _UNBLOCK


class QuickCallback:
    """
    A future's done callback that takes no time, and never fails.

    A future passes its callbacks to its executor as tasks; this one is called at once instead.
    """

    __slots__ = ('_function',)

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function

    def __call__(self, _: Any = None) -> None:
        """Call the function."""
        self._function()


@cache
def _makes_futures_twice(code: types.CodeType) -> bool:
    """Return whether ``send_goal_async`` makes two futures for a goal's request (9.1.2)."""
    try:
        return inspect.getsource(code).count('.add_future(') > 1
    except OSError:  # there is no source
        return False


def _is_sending(client: Any, code: types.CodeType, number: int) -> bool:
    """Return whether a thread is still in ``send_goal_async`` with the request of a number."""
    for top in sys._current_frames().values():
        frame: Any = top
        while frame is not None:
            if frame.f_code is code and frame.f_locals.get('self') is client and (
                    frame.f_locals.get('sequence_number', number) == number):
                return True
            frame = frame.f_back
    return False


_NUMBERS = {
    'goal': '_goal_sequence_number_to_goal_id', 'cancel': '_pending_cancel_requests',
    'result': '_pending_result_requests'}


def sender_is_behind(waitable: Any, data: Any) -> bool:
    """
    Return whether an action client has taken a response to a request that it does not know yet.

    In 7.1.5 it sends a request before it notes its number, and discards responses that come in
    between: the future would never be done (rclpy issue 1123). From 7.1.6 on a lock prevents that.
    In 9.1.2 it makes the future of a goal's request twice, and the second one, which it returns,
    without the lock: a response in between would complete the first one.

    :param data: the data that the waitable has taken.
    """
    if type(data) is not dict:
        return False
    if hasattr(waitable, '_lock'):
        code = getattr(getattr(waitable, 'send_goal_async', None), '__code__', None)
        return 'goal' in data and code is not None and _makes_futures_twice(code) and (
            _is_sending(waitable, code, data['goal'][0]))
    return all(hasattr(waitable, numbers) for numbers in _NUMBERS.values()) and any(
        name in data and data[name][0] not in getattr(waitable, numbers)
        for name, numbers in _NUMBERS.items())


def feedback_taken(waitable: Any, data: Any, most: int) -> list[tuple[Callable[..., Any], Any]]:
    """
    Return the feedback that an action client has taken, each with its callback.

    It is removed from the taken data. A client takes one feedback at a time. Together with a
    result, all remaining feedback is taken, because another thread may handle the result and the
    client then forgets the callback. Other waitables have no feedback.

    From 7.1.6 on a client has a lock for its handle.
    """
    callbacks = getattr(waitable, '_feedback_callbacks', None)
    if callbacks is None:  # without a check of the type: rclpy.action loads much
        return []
    messages = [data['feedback']] if 'feedback' in data else []
    if 'result' in data and callbacks:
        kind = waitable._action_type.Impl.FeedbackMessage
        lock: AbstractContextManager[Any] = getattr(waitable, '_lock', nullcontext())
        with lock:
            while len(messages) < most:
                message = waitable._client_handle.take_feedback(kind)
                if message is None:
                    break
                messages.append(message)
    found = []
    for message in messages:
        callback = callbacks.get(bytes(message.goal_id.uuid))
        if callback is not None:
            data.pop('feedback', None)  # the first one
            found.append((callback, message))
    return found


# --- guard conditions ----------------------------------------------------------------------------

GUARD_HANDLE: Any = _rclpy.GuardCondition
"""The class of a guard condition's handle: its method ``trigger_guard_condition`` triggers it."""


# --- requests ------------------------------------------------------------------------------------

SERVICE_CLIENT_HANDLE: Any = _rclpy.Client
"""The class of a client's handle: its method ``send_request`` sends requests."""
CLIENT_HANDLE: Any = _rclpy.ActionClient
"""The class of an action client's handle: its methods send requests."""
SERVER_HANDLE: Any = _rclpy.ActionServer
"""That of an action server's: its methods send responses, feedback and status."""
ACTION_REQUESTS = ('goal', 'cancel', 'result')
"""The kinds of requests to an action."""


def goal_of(request: Any) -> bytes:
    """Return the id of the goal that a request to an action is about."""
    return bytes(getattr(request, 'goal_info', request).goal_id.uuid)


def receiver_of(waitable: Any) -> Any:
    """Return the key of an action's waitable as a receiver (``sent_requests``), or None."""
    client = getattr(waitable, '_client_handle', None)
    if type(client) is CLIENT_HANDLE:
        return client
    return ACTION if type(getattr(waitable, '_handle', None)) is SERVER_HANDLE else None


def clock_of(waitable: Any) -> Any:
    """Return the clock of a waitable's timers, which is that of its node; None: it has no node."""
    node = getattr(waitable, '_node', None)
    return node.get_clock() if isinstance(node, Node) else None


def exchanged(waitable: Any, data: Any) -> list[tuple[Any, ...]]:
    """
    Return which requests an action server has taken, or which responses an action client.

    They are in the data that the waitable has taken.  A request is given by its kind and goal, a
    response by the client's handle, the kind and the number of the request.
    """
    receiver = receiver_of(waitable)
    if receiver is None or type(data) is not dict:
        return []
    kinds = [kind for kind in ACTION_REQUESTS if kind in data]
    if receiver == ACTION:
        return [(kind, goal_of(data[kind][1])) for kind in kinds]
    return [(receiver, kind, data[kind][0]) for kind in kinds]


# --- requests without a middleware (reruns) ------------------------------------------------------

def new_request(client: Any, number: int) -> Future:
    """Return the future of a request with a number, as ``Client.call_async`` makes it."""
    future = Future()
    with client._lock:
        client._pending_requests[number] = future
    future.add_done_callback(client.remove_pending_request)
    return future


def action_handle(waitable: Any) -> Any:
    """Return the handle of an action client or server."""
    return waitable._client_handle if hasattr(waitable, '_client_handle') else waitable._handle


def goal_states(server: Any) -> Iterator[tuple[Any, int]]:
    """Yield the goals (``GoalInfo``) that an action server knows, with their status."""
    for goal in list(server._goal_handles.values()):
        handle = goal._goal_handle
        if handle is not None:  # not by its property: that takes a lock that may be locked here
            yield goal._goal_info, handle.get_status()


def has_result(server: Any, info: Any) -> bool:
    """Return whether an action server keeps the result of a goal (``GoalInfo``)."""
    future = server._result_futures.get(bytes(info.goal_id.uuid))
    return future is not None and future.done()


# --- tasks and coroutines ------------------------------------------------------------------------

_TASK_CODE = Task.__call__.__code__.co_filename


class BareTask(Task):
    """A task whose coroutine always yields None: the executor knows when it goes on."""

    def unfetched(self) -> BaseException | None:
        """Return the task's exception, unless it has been fetched (``exception``)."""
        error: BaseException | None = None if self._exception_fetched else self._exception
        return error

    def mark_fetched(self) -> None:
        """Mark the task's exception as handled: otherwise it is printed."""
        self._exception_fetched = True


def cancel_running(task: Any) -> None:
    """Cancel a task whose coroutine has ended with CancelledError; rclpy would not."""
    task._executing = False
    task._complete_task()
    Future.cancel(task)


def user_function(callback: Any, args: tuple[Any, ...]) -> tuple[Any, Any]:
    """
    Return what a task calls, and the object whose method it is, or None.

    An action server runs each goal in a task of its method ``_execute_goal``: then it is the
    goal's callback, of the server.
    """
    while isinstance(callback, partial):
        callback, args = callback.func, (*callback.args, *args)
    function = getattr(callback, '__func__', callback)
    owner = getattr(callback, '__self__', None)
    if getattr(function, '__qualname__', '') == 'ActionServer._execute_goal' and args:
        return user_function(args[0], ())[0], owner
    return callback, owner


def function_of_task(callback: Any, args: tuple[Any, ...]) -> object:
    """Return what a task's function has in common with others that do the same: its code."""
    callback, _ = user_function(callback, args)
    if inspect.iscoroutine(callback):
        return callback.cr_code
    function = getattr(callback, '__func__', callback)
    code: object = getattr(function, '__code__', None)
    return (type(callback), getattr(function, '__qualname__', '')) if code is None else code


def name_of_task(callback: Any, args: tuple[Any, ...]) -> tuple[str, str]:
    """Return the node of a task's function, and module and name; empty: it has none."""
    callback, owner = user_function(callback, args)
    name = getattr(callback, '__qualname__', type(callback).__qualname__)
    frame = getattr(callback, 'cr_frame', None)  # of a coroutine
    module = getattr(callback, '__module__', None) or (
        '' if frame is None else frame.f_globals.get('__name__', ''))
    node = owner if isinstance(owner, Node) else getattr(owner, '_node', None)  # of an action
    with suppress(InvalidHandle):  # it is destroyed
        if isinstance(node, Node):
            return str(node.get_fully_qualified_name()), f'{module}.{name}'
    return '', f'{module}.{name}'


def forget_task_frames(error: BaseException) -> None:
    """Remove the frames in which a task caught its exception: they refer to the task."""
    trace = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename == _TASK_CODE:
        trace.tb_frame.clear()
        trace = trace.tb_next
    error.__traceback__ = trace


HAS_NEXT_SPIN = hasattr(Executor, '_call_task_in_next_spin')
"""Whether tasks are those of 7.1.9 and later, and of 9.1.4 and later."""

NEXT_TURN = object()
"""The awaited object of a coroutine that yields None: it continues in the executor's next turn."""


def set_done(waiter: Any) -> None:
    """Complete a future of asyncio, unless it has been cancelled or completed."""
    if not waiter.done():
        waiter.set_result(None)


_SUSPENDABLE = inspect.CO_COROUTINE | inspect.CO_GENERATOR | inspect.CO_ITERABLE_COROUTINE
_DRIVERS = 'rclpy.task', 'mddag_executor.executor.coroutines'


def _asyncio_loop() -> Any:
    """
    Return the event loop whose task awaits a future of rclpy; None: no such task does.

    The first frame that is not of a coroutine is that of its driver: a task of rclpy, a coroutine
    of this executor, or otherwise the event loop that runs in this thread.
    """
    asyncio = sys.modules.get('asyncio')
    loop = None if asyncio is None else asyncio._get_running_loop()
    if loop is None:
        return None
    frame: Any = sys._getframe(2)
    while frame is not None and frame.f_code.co_flags & _SUSPENDABLE:
        frame = frame.f_back
    is_other = frame is not None and frame.f_globals.get('__name__') in _DRIVERS
    return None if is_other else loop


_await_in_rclpy: Callable[[Future], Any] = Future.__await__


def _await(future: Future) -> Any:
    """
    Wait for a future of rclpy, in a task of asyncio as well.

    There, a future of 7.1.9 and of 9.1.4 would raise RuntimeError, and an earlier one would be
    polled in each turn of the loop.
    """
    if not (future.done() or future.cancelled()):
        loop = _asyncio_loop()
        if loop is not None:
            waiter = loop.create_future()
            callback = QuickCallback(partial(loop.call_soon_threadsafe, set_done, waiter))
            future.add_done_callback(callback)
            try:
                yield from waiter
            finally:
                future.remove_done_callback(callback)
    return (yield from _await_in_rclpy(future))


Future.__await__ = _await  # type: ignore[method-assign]


def adopt_awaited(future: Any, executor: Any) -> None:
    """Let the done callbacks of an awaited future run in the executor, as from 7.1.9 on."""
    if HAS_NEXT_SPIN and isinstance(future, Future):
        reference: Any = future._executor
        if reference() is None:
            future._set_executor(executor)


def awaited(coroutine: Any) -> Any:
    """
    Return the rclpy future that a suspended coroutine waits for, or NEXT_TURN.

    From 7.1.9 and 9.1.4 on, the coroutine yields it. Before, ``Future.__await__`` is a generator
    that yields nothing. So the future is looked up at the end of the chain of awaits.
    """
    inner = coroutine
    while True:
        if type(inner) is types.CoroutineType:
            inner = inner.cr_await
        elif type(inner) is types.GeneratorType:
            if inner.gi_yieldfrom is None:
                break
            inner = inner.gi_yieldfrom
        else:
            break
    if type(inner) is types.GeneratorType and inner.gi_frame is not None:
        inner = inner.gi_frame.f_locals.get('self')
    return inner if hasattr(inner, 'add_done_callback') else NEXT_TURN


def requested_service(future: Any) -> str:
    """Return the name of the service whose response a future is; empty: it is another future."""
    # a future of asyncio has None there once it is done
    for callback in tuple(future._callbacks) if isinstance(future, Future) else ():
        client = getattr(callback, '__self__', None)
        if isinstance(client, rclpy.client.Client):
            with suppress(InvalidHandle):
                return service_name(client)
            return f'{client.srv_name}, whose client is destroyed'
    return ''


# --- executors and nodes -------------------------------------------------------------------------

def distribution() -> str:
    """Return the name of the ROS distribution: that of the environment, or else of this rclpy."""
    return os.environ.get('ROS_DISTRO') or ('jazzy' if TimerInfo is None else 'kilted')


TASKS_NEWEST_FIRST = TimerInfo is None and not HAS_NEXT_SPIN
"""Whether waiting tasks run in reverse order: in 7.1 before 7.1.9."""


def _nothing() -> None:
    """Do nothing when a context ends."""


class BareExecutor(Executor):
    """rclpy's executor without its own scheduling."""

    _sigint_gc: Any = None  # for its finalizer, if construction fails

    def __init__(self, *, context: Any = None) -> None:
        # The context keeps a WeakMethod of ``wake``. If the executor is collected first, as at
        # Python 3.11's exit, an exception is printed. See ``shutdown.call_at_shutdown``.
        self.wake = _nothing  # type: ignore[method-assign]
        super().__init__(context=context)
        del self.wake

    def signal_guard(self) -> Any:
        """Return the guard condition that a signal triggers."""
        return self._sigint_gc

    def is_gone(self) -> bool:
        """Return whether ``shutdown`` has released everything."""
        return self._guard is None

    def create_future(self) -> Future:
        """Return a future whose callbacks run in this executor (rclpy from 7.1.6 on)."""
        return Future(executor=self)

    def is_ending(self) -> bool:
        """Return whether the executor has been asked to end."""
        return bool(self._is_shutdown)

    def begin_end(self) -> None:
        """Ask the executor to end."""
        self._is_shutdown = True

    def _call_task_in_next_spin(self, task: Task) -> None:
        """Do nothing: the executor calls a task (7.1.9) again by itself."""


def joins_threads(kind: type[Any]) -> bool:
    """Return whether an executor's class joins its threads in ``shutdown``. 9.1 has the option."""
    return issubclass(kind, MultiThreadedExecutor) and 'wait_for_threads' in inspect.signature(
        MultiThreadedExecutor.shutdown).parameters


class _FirstNode:
    """The first of a context's nodes: it notices that they are being destroyed."""

    def __init__(self, call: Callable[[], None]) -> None:
        self.destroy_node = call


def on_end(context: Any, call: Callable[[], None]) -> object:
    """
    Call a function when a context is shut down, before its nodes are destroyed.

    In 9.1 a context first destroys the nodes in its list, and only then calls the functions of
    ``on_shutdown``. There, the function is called twice.

    :return: an object to keep as long as the call is wanted.
    """
    context.on_shutdown(call)
    first = _FirstNode(call)
    nodes = getattr(context, '_Context__node_weak_ref_list', None)
    if nodes is not None:
        nodes.insert(0, weakref.ref(first))
    return first


def is_called_by_spin() -> bool:
    """
    Return whether the calling method was called by ``rclpy.spin``.

    ``rclpy.spin`` runs one callback at a time, in every version.
    """
    return sys._getframe(2).f_code is rclpy.spin.__code__


@contextmanager
def executor_kept(node: Any) -> Iterator[None]:
    """Let another executor run a node when it is added to that; ``node.executor`` stays."""
    before, node._Node__executor_weakref = node._Node__executor_weakref, None
    try:
        yield
    finally:
        node._Node__executor_weakref = before


def keeps_time(subscription: Any) -> bool:
    """Return whether it is the subscription to a node's simulated time."""
    return getattr(subscription.callback, '__func__', None) is TimeSource.clock_callback


def is_of_wait_for_message(entity: Any) -> bool:
    """
    Return whether it is the temporary subscription of ``rclpy.wait_for_message``.

    That function takes the message itself, and would wait in vain if an executor had taken it.
    """
    callback = getattr(entity, 'callback', None)
    return getattr(callback, '__module__', None) == 'rclpy.wait_for_message'


def is_builtin(service: Any) -> bool:
    """Return whether it is a service that rclpy makes for each node: parameters and the like."""
    return str(getattr(service.callback, '__module__', '')).startswith('rclpy.')


def service_name(entity: Any) -> str:
    """Return the name of a service or client. 7.1.5 has no ``service_name``."""
    name: str = entity.service_name if hasattr(entity, 'service_name') else entity.srv_name
    return name

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the intake hands over becomes work for the dispatcher."""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from types import MethodType
from typing import Any

from mddag_executor.live.attribution import Origin
from mddag_executor.live.crossings import header_stamp
from mddag_executor.live.dispatcher import Dispatcher
from mddag_executor.live.entries import Entry, Work
from mddag_executor.live.pool import Pool
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry
from msg_graph import TaskSet
from rclpy.exceptions import InvalidHandle
from rclpy.subscription import Subscription

_END_OF_SLEEP = threading.Event.set
MOST_FEEDBACK = 64
"""More of it is taken in its turn."""
WITH_INFO = Subscription.CallbackType.WithMessageInfo


class Receiver:
    """
    The intake's receiver: runs in its threads, and never blocks for long.

    What callbacks may wait for comes through though they hold all workers.  So some of rclpy's
    own parts, which only take note of something, run at once, here: a client's response, which
    completes a future; while workers run, what sets a node's simulated time, and the timer of a
    ``Rate``, which ends a sleep.
    """

    def __init__(
        self, dispatcher: Dispatcher, registry: Registry, task_set: TaskSet | None,
        executor: Any, fail: Callable[[BaseException], None], recorder: Recorder | None,
        pool: Pool,
    ) -> None:
        self._dispatcher = dispatcher
        self._registry = registry
        self._release_from = [d.release_from for d in task_set.dags] if task_set else []
        self._executor = executor
        self._fail = fail
        self._recorder = recorder
        self._pool = pool

    def hold(self) -> None:
        """Take note that several things are handed over that became ready at one instant."""
        self._dispatcher.hold()

    def let_go(self) -> None:
        """Take note that all of them have been."""
        self._dispatcher.let_go()

    def on_timer(self, timer: Any, due_ns: int) -> None:
        """Take in a timer; ``due_ns`` is its nominal due time on the monotonic clock."""
        entry = self._registry[timer]
        if entry is None:
            return
        callback = timer.callback
        if type(callback) is MethodType and callback.__func__ is _END_OF_SLEEP:
            if entry.callback is None and self._pool.running:
                self._run(entry, callback)
                return
        self._dispatcher.timer_due(
            entry, Work(entry, callback, ()), due_ns + self._dispatcher.clock_offset)

    def _run(self, entry: Entry, callback: Callable[..., Any], *args: Any) -> None:
        callback(*args)
        self._dispatcher.ran_at_once(entry)

    def on_missed(self, timer: Any, due_ns: int, count: int) -> None:
        """Take in that periods were skipped since nobody was there to look at the timer."""
        entry = self._registry[timer]
        if entry is None:
            return
        try:
            period = timer.timer_period_ns
        except InvalidHandle:
            return  # destroyed meanwhile
        self._dispatcher.timer_missed(
            entry, due_ns + self._dispatcher.clock_offset, period, count)

    def on_message(self, subscription: Any, message: Any, info: dict[str, Any]) -> None:
        """Take in a message with its info."""
        entry = self._registry[subscription]
        if entry is None:
            return
        if entry.at_once and self._pool.running:
            self._run(entry, subscription.callback, message)
            return
        args = (message, info) if subscription._callback_type is WITH_INFO else (message,)
        work = Work(entry, subscription.callback, args)
        origin: Origin | None = None
        release: int | None = None
        stamp = -1
        if entry.source >= 0:
            release, stamp = self._release(entry, message, info)
        elif entry.targets:
            origin = self._dispatcher.attribution.find(
                entry.topic, info['source_timestamp'], info.get('publication_sequence_number'))
            if origin is None and entry.enters:
                stamp = header_stamp(message)
                release = self._steady(stamp)
        if self._recorder is not None:
            self._recorder.taken(entry, message, info['source_timestamp'])
        self._dispatcher.message(entry, work, origin, release, stamp)

    def _release(self, entry: Entry, message: Any, info: dict[str, Any]) -> tuple[int, int]:
        """
        Return the release of the job that a source's message starts, on the trace's clock.

        :return: the release, and the header's stamp where it comes from that, else -1.
        """
        kind = self._release_from[self._dispatcher.tables.dag_of[entry.source]]
        if kind == 'arrival':
            return self._dispatcher.now(), -1
        if kind == 'source_timestamp':
            return self._steady(info['source_timestamp']), -1
        stamp = header_stamp(message)
        if stamp < 0:  # raw, without a header, or not stamped: all that is known is its arrival
            return self._dispatcher.now(), -1
        return self._steady(stamp), stamp

    def _steady(self, stamp: int) -> int:
        """Return a system time on the trace's clock."""
        return self._dispatcher.now() - time.time_ns() + stamp

    def on_request(self, service: Any, request: Any, header: Any) -> None:
        """Take in a service request."""
        entry = self._registry[service]
        if entry is None:
            return
        work = Work(
            entry, service.callback, (request, service.srv_type.Response()),
            lambda response: service.send_response(response, header))
        if entry.source >= 0:
            self._dispatcher.message(entry, work, None, self._dispatcher.now())
        else:
            self._dispatcher.undeclared_ready(entry, work)

    def on_response(self, client: Any, sequence: int, header: Any, response: Any) -> None:
        """Pass a service's response on to the future that waits for it."""
        try:
            future = client.get_pending_request(sequence)
        except KeyError:
            return  # the request was cancelled
        future._set_executor(self._executor)
        future.set_result(response)

    def on_guard(self, guard: Any) -> None:
        """Take in a guard condition that was triggered."""
        entry = self._registry[guard]
        if entry is not None and guard.callback is not None:
            self._dispatcher.undeclared_ready(entry, Work(entry, guard.callback, ()))

    def on_waitable(self, waitable: Any, data: Any) -> None:
        """Take in what a waitable has taken."""
        entry = self._registry[waitable]
        if entry is None:
            return
        for future in waitable._futures:
            future._set_executor(self._executor)
        if hasattr(waitable, '_feedback_callbacks'):  # an action client; rclpy.action loads much
            self._feedback(entry, waitable, data)
        if data:
            self._dispatcher.undeclared_ready(entry, Work(entry, waitable.execute, (data,)))

    def _feedback(self, entry: Entry, client: Any, data: dict[str, Any]) -> None:
        """
        Hand over the feedback that an action client has taken, each with the callback it is for.

        A client forgets the callback when the goal's result has come.  It takes one feedback at a
        time, so with a result all that is there is taken, too; and another worker may have the
        result in its hands soon, so the callback is looked up now.
        """
        callbacks = client._feedback_callbacks
        messages = [data['feedback']] if 'feedback' in data else []
        if 'result' in data and callbacks:
            kind = client._action_type.Impl.FeedbackMessage
            for message in iter(lambda: client._client_handle.take_feedback(kind), None):
                messages.append(message)
                if len(messages) >= MOST_FEEDBACK:
                    break
        for message in messages:
            callback = callbacks.get(bytes(message.goal_id.uuid))
            if callback is not None:
                data.pop('feedback', None)  # the first one
                self._dispatcher.undeclared_ready(entry, Work(entry, callback, (message,)))

    def on_intake_error(self, error: BaseException) -> None:
        """Take an error of the intake: it comes out of spin."""
        self._fail(error)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The compared executors, how they are spun, and when their callbacks start.

Theory of operation
-------------------
*No executor at all* (``NoExecutor``) measures the cost of the nodes of a declaration themselves.
A thread for each timer waits until it is due and calls it.  A publishing thread takes the message
from each subscription of the topic, and runs its callback.  There is no queue, order, pool,
callback group or attribution; no data passes between threads.  The rest is what every executor
needs: waiting for timers, emulated execution, publishing, the middleware, taking messages, and
callbacks.  So the additional CPU time of an executor is its own cost.  Callbacks of one message,
and all jobs of a DAG, run one after the other, so fewer results are in time; the cost of each
callback hardly depends on that.

*Starts* of callbacks are noted in the same way under every executor: the callback of a
subscription is replaced by one that reads the clock first, which costs about 1 us.  Each start is
one tuple in a list; appending is atomic in CPython, so there is no lock.  (Timers of synthetic
nodes note their starts themselves.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
import inspect
import threading
import time
from typing import Any

from benchmarks.campaign import NONE, OURS, Spec
from mddag_executor.executor.compat import message_taker, timer_functions
from msg_graph import TaskSet
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.timer import Timer
from rclpy.utilities import ok as context_ok


def make_executor(spec: Spec, task_set: TaskSet | None) -> Executor:
    """
    Make an executor.

    :param task_set: the declared tasks, which only this executor uses.
    """
    if spec.executor == OURS:
        # Imported here: the others are measured without this executor in the process.
        from mddag_executor.executor.executor import MultiDeadlineExecutor
        return MultiDeadlineExecutor(task_set, num_workers=spec.workers, policy=spec.policy)
    if spec.executor == 'multi':
        return MultiThreadedExecutor(spec.workers)
    return {NONE: NoExecutor, 'single': SingleThreadedExecutor, 'events': EventsExecutor}[
        spec.executor]()


def spin_of(executor: Executor) -> Callable[[], None] | None:
    """Return what spins an executor, None: its ``spin``."""
    # The native EventsExecutor is not derived from rclpy's Executor.
    return None if isinstance(executor, Executor) else partial(_spin_events_executor, executor)


def _spin_events_executor(executor: Executor) -> None:
    """Spin rclpy's EventsExecutor, whose ``spin`` does not dispatch without a timeout (7.1.5)."""
    while context_ok():
        executor.spin_until_future_complete(Future(), 1000.0)


class NoExecutor(Executor):
    """Replaces an executor, in a process that ends after the measurement."""

    def spin(self) -> None:
        """Run the timers and subscriptions of the added nodes."""
        nodes = self.get_nodes()
        take_where_published([s for node in nodes for s in node.subscriptions])
        for timer in [timer for node in nodes for timer in node.timers]:
            threading.Thread(target=self._run, args=(timer,), daemon=True).start()
        while self.context.ok():
            time.sleep(0.1)

    def _run(self, timer: Timer) -> None:
        _, call, _ = timer_functions(timer)
        while self.context.ok():
            left: int | None = timer.time_until_next_call()
            if left is None:
                return  # cancelled at the end
            if left > 0:
                time.sleep(left / 1e9)
                continue
            with timer.handle:
                call()
            timer.callback()


def take_where_published(subscriptions: list[Subscription]) -> None:
    """Let every publisher of this process take from the subscriptions, and run callbacks."""
    by_topic: dict[str, list[tuple[Subscription, Any]]] = {}
    for subscription in subscriptions:
        by_topic.setdefault(subscription.topic_name, []).append(
            (subscription, message_taker(subscription)))
    send = Publisher.publish
    takers: dict[int, list[tuple[Subscription, Any]]] = {}

    def publish(self: Any, msg: Any) -> None:
        send(self, msg)
        found = takers.get(id(self))
        if found is None:
            found = takers[id(self)] = by_topic.get(self.topic_name, [])
        for subscription, take in found:
            with subscription.handle:
                taken = take()
            if taken is not None:
                subscription.callback(*taken)

    Publisher.publish = publish  # type: ignore[method-assign]


Start = tuple[int, int]
"""When a callback started, ns since the epoch, and its dispatch latency, ns."""


def _nothing(message: Any) -> None:
    pass


def noting(
    starts: list[Start], callback: Callable[[Any], None] = _nothing
) -> Callable[..., None]:
    """Return a subscription's callback that notes its start and calls another one."""
    append, time_ns = starts.append, time.time_ns

    def on_message(message: Any, info: Any = None) -> None:
        now = time_ns()
        if info is None:
            message, info = message
        append((now, now - info['source_timestamp']))
        callback(message)

    # rclpy decides by the signature whether a callback gets message and info. Its EventsExecutor
    # (7.1) then passes both in one tuple, so the second argument has a default.
    vars(on_message)['__signature__'] = inspect.Signature([
        inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY)
        for name in ('message', 'info')])
    return on_message


def within(starts: Iterable[Start], begin: int, end: int) -> list[int]:
    """Return the latencies of starts in a window (ns since the epoch), ns."""
    return [latency for at, latency in list(starts) if begin <= at <= end]

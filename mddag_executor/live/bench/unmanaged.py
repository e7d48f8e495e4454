# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
No executor at all: what the nodes of a declaration cost by themselves.

Theory of operation: a thread for each timer waits until that is due and calls it.  Whoever
publishes takes the message from each subscription of the topic, and runs its callback, in its own
thread.  There is no intake, queue, order, pool, callback group or attribution; nothing is handed
from one thread to another.  What is left is what every executor pays for: waiting for timers,
emulated execution, publishing, the middleware, taking messages, and the bodies themselves.  So the
difference to an executor's CPU time is what that executor takes.

Callbacks that one message starts run one after the other, and so do all jobs of a DAG, so less is
done in time; the cost of each callback hardly depends on that.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from mddag_executor.live.compat import message_taker, timer_functions
from rclpy.executors import Executor
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.timer import Timer


class NoExecutor(Executor):
    """Stands where an executor does; for a process that ends when it has been measured."""

    def spin(self) -> None:
        """Run the timers and subscriptions of the nodes that were added."""
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
                return  # it was cancelled, at the end
            if left > 0:
                time.sleep(left / 1e9)
                continue
            with timer.handle:
                call()
            timer.callback()


def take_where_published(subscriptions: list[Subscription]) -> None:
    """Let every publisher of this process take from these, and run their callbacks."""
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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Publishes topics at fixed rates from a separate process, and counts.

Theory of operation: the process reports that it is ready when each of its topics has a
subscription, begins to publish on the first order, and stops on the second.  Then it reports the
number of messages of each topic.  It ends when the ordering process ends.

All topics have the same period.  With a seed their phases are drawn, so messages are neither
simultaneous nor evenly spaced; otherwise all are published in a row, each period.  After a delay
of more than a period releases are skipped: a burst would lose messages because of queue depth,
which is not a fault of the measured executor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
import heapq
from multiprocessing import get_context
from multiprocessing.connection import Connection
import os
import random
import time
from typing import Any

from mddag_executor.child import ChildError
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.executor.session import MATCH_TIMEOUT_S
from mddag_executor.shared_memory import segments_removed
from mddag_executor.synthetic.workload import QOS
import rclpy
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Header


class PublisherProcess:
    """
    The publishing process, seen from the measuring process; a context manager.

    :param topics: the published topics.
    """

    def __init__(self, topics: Sequence[str], rate_hz: float, seed: int | None) -> None:
        context = get_context('spawn')
        self._orders, orders = context.Pipe()
        self._process = context.Process(
            target=_run, args=(topics, rate_hz, seed, orders), daemon=True)
        self._process.start()
        orders.close()

    def __enter__(self) -> PublisherProcess:
        return self

    def __exit__(self, *args: object) -> None:
        with segments_removed(self._process.pid or 0):
            self._process.kill()
            self._process.join()

    def wait_until_ready(self) -> None:
        """
        Wait until all its topics have a subscription.

        :raises ChildError: if the process ended instead.
        """
        self._answer()

    def begin(self) -> None:
        """Order it to publish."""
        with suppress(OSError):  # the missing answer shows the error
            self._orders.send(None)

    def finish(self) -> list[int]:
        """
        Stop it and return the number of messages of each topic.

        :raises ChildError: if the process ended before.
        """
        self.begin()
        counts: list[int] = self._answer()
        return counts

    def _answer(self) -> Any:
        try:
            return self._orders.recv()
        except (EOFError, OSError):
            raise ChildError('the publishing process ended early: check ROS_DOMAIN_ID and the '
                             'network') from None


def _run(
    topics: Sequence[str], rate_hz: float, seed: int | None, orders: Connection
) -> None:
    """Publish as ordered; the end of the ordering process also is an order."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = quiet_node('/mddag_bench_publisher')
    publishers = [node.create_publisher(Header, topic, QOS) for topic in topics]
    end = time.monotonic() + MATCH_TIMEOUT_S
    while not all(publisher.get_subscription_count() for publisher in publishers):
        if orders.poll(0.01) or time.monotonic() > end:
            os._exit(1)
    with suppress(EOFError, OSError):
        orders.send('ready')
        orders.recv()
        orders.send(publish(publishers, rate_hz, seed, orders.poll))
        orders.recv()
        orders.recv()  # the last messages may have to be sent again
    os._exit(0)


def publish(
    publishers: Sequence[Publisher], rate_hz: float, seed: int | None,
    is_to_stop: Callable[[float], bool],
) -> list[int]:
    """
    Publish on all topics until asked to stop; return the number of messages of each.

    :param is_to_stop: waits for the given seconds.
    """
    period = round(1e9 / rate_hz)
    generator = random.Random(seed)
    begin = time.monotonic_ns() + 1_000_000
    due = [(begin + (0 if seed is None else generator.randrange(period)), index)
           for index in range(len(publishers))]
    heapq.heapify(due)
    counts = [0] * len(publishers)
    message = Header()
    while True:
        at, index = due[0]
        if is_to_stop(max(0, at - time.monotonic_ns()) / 1e9):
            return counts
        publishers[index].publish(message)
        counts[index] += 1
        missed = max(0, time.monotonic_ns() - at) // period
        heapq.heapreplace(due, (at + (1 + missed) * period, index))

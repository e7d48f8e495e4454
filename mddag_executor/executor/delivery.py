# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Delivery within the process: the thread that publishes a message also takes it."""

from __future__ import annotations

from typing import Any

from mddag_executor.executor.jobs import Publication
from mddag_executor.executor.sources import SubscriptionSource
from mddag_executor.executor.work import current
from mddag_executor.executor.workers import WorkerPool


class LocalDelivery:
    """
    The subscriptions on one topic that publishing threads of this process take from.

    :param sources: their sources.
    """

    __slots__ = ('sources', '_pool', '_is_held')

    def __init__(self, sources: tuple[SubscriptionSource, ...], pool: WorkerPool) -> None:
        self.sources = sources
        self._pool = pool
        self._is_held = False

    def hold(self) -> None:
        """Pause announcements, if they would wake a thread that waits in the epoll."""
        if self._pool.polling:
            self._pool.loop.hold(self.sources)
            self._is_held = True  # set last: a thread that ends it meanwhile may be too early

    def listen_again(self, subscription: Any) -> None:
        """Announce a subscription again after the middleware has replaced its reader."""
        for source in self.sources:
            if source.entity.rclpy is subscription:
                source.listen()

    def collect_published(self, publication: Publication | None) -> None:
        """Collect arrivals announced since ``hold``, and resume announcements."""
        pool = self._pool
        running = current.running
        if running is None or running.pool is not pool:
            publication = None  # of another executor, with other jobs
        if not pool.is_inside():
            with pool.lock:
                pool.tick()
                posted = False
                for source in self.sources:
                    posted |= source.collect_published(publication)
                if posted:
                    pool.wake_for_more()
        if self._is_held:
            self._is_held = False
            pool.loop.release(self.sources)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Note when callbacks start, and how long after they could have.

Theory of operation: the callback of a subscription or timer is replaced by one that reads the
clock first.  That is the same small cost (about 1 us) under every executor.  A list takes one
tuple for each start; appending is one indivisible step in CPython, so there is no lock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
import inspect
import time
from typing import Any

from rclpy.node import Node
from rclpy.timer import Timer

Start = tuple[int, int]
"""When a callback started, ns since the epoch, and its dispatch latency, ns."""


def _nothing(message: Any) -> None:
    pass


class Starts:
    """
    What is noted about the starts of callbacks.

    ``messages`` has a ``Start`` for each message that a callback was called with.
    """

    def __init__(self) -> None:
        self.messages: list[Start] = []
        self._timers: list[tuple[list[int], deque[int]]] = []

    def noting(self, callback: Callable[[Any], None] = _nothing) -> Callable[..., None]:
        """Return a subscription's callback that notes its start and calls another one."""
        append, time_ns = self.messages.append, time.time_ns

        def on_message(message: Any, info: Any = None) -> None:
            now = time_ns()
            if info is None:
                message, info = message
            append((now, now - info['source_timestamp']))
            callback(message)

        # rclpy goes by the signature whether a callback wants message and info. Its EventsExecutor
        # (7.1) then gives both in one tuple, which is why the second argument has a default.
        vars(on_message)['__signature__'] = inspect.Signature([
            inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY)
            for name in ('message', 'info')])
        return on_message

    def watch_timer(self, timer: Timer, delays: deque[int]) -> None:
        """
        Note the starts of a timer.

        :param delays: where its callback itself appends by how much it started late, ns.
        """
        starts: list[int] = []
        append, time_ns, callback = starts.append, time.time_ns, timer.callback

        def on_timer() -> None:
            append(time_ns())
            callback()

        timer.callback = on_timer
        self._timers.append((starts, delays))

    def watch(self, nodes: Iterable[Node], delays: dict[Timer, deque[int]]) -> None:
        """Note the starts of all subscriptions and timers of nodes."""
        for node in nodes:
            for subscription in node.subscriptions:
                subscription.callback = self.noting(subscription.callback)
            for timer in node.timers:
                self.watch_timer(timer, delays[timer])

    def within(self, begin: int, end: int, timers: bool = True) -> list[int]:
        """
        Return the latencies of what started in a window, ns.

        :param begin: of the window, ns since the epoch; so is the end.
        :param timers: whether those of timers count, too.
        """
        found = [latency for at, latency in list(self.messages) if begin <= at <= end]
        for starts, delays in self._timers if timers else ():
            # One of each for every call.  Calls of one timer that overlap may come in another
            # order here than there, which can matter only at the edges of the window.
            found += [late for at, late in zip(list(starts), list(delays)) if begin <= at <= end]
        return found

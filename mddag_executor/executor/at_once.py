# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Arrivals that are handled at once: they complete something that callbacks may wait for.

Responses complete futures, ``/clock`` sets simulated time, and the timer of a ``Rate`` ends a
sleep.  All of this is short code of rclpy.  The spinning thread runs it, from a separate epoll, so
that it runs even if all workers wait for it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.jobs import Publication
from mddag_executor.executor.loop import EventLoop, Events
from mddag_executor.executor.timers import TimerQueue
from mddag_executor.executor.work import Work


class AtOnce:
    """
    The sources handled at once; all methods but ``ring`` belong to the spinning thread.

    :param lock: that of the engine.
    :param fail: receives exceptions of takes.
    """

    def __init__(
        self, engine: Engine, lock: Any, fail: Callable[[BaseException], None]
    ) -> None:
        self.loop = EventLoop(())
        self.timers = TimerQueue(self.loop.wake, lambda: None, fail)
        self.failed = fail
        self._engine = engine
        self._lock = lock
        self._has_run = False

    def ring(self) -> None:
        """End the current wait, or the next one; from any thread, also in a signal handler."""
        self.loop.wake()

    def handle(self, events: Events) -> bool:
        """Handle arrivals; return whether there were any."""
        self._has_run = False
        sources, _, expired = self.loop.sources(events)
        for source in sources:
            source.collect()
        if expired or self.timers.has_jumped:
            self.loop.timer.at = 0
            with self._lock:
                fired = list(self.timers.fire())
            for _, work, _, _ in fired:
                work.function(*work.args)
                self._ran(work.entity)
        due = self.timers.next_due()
        if due != self.loop.timer.at:
            self.loop.timer.arm(due)
        return self._has_run

    def message(
        self, entity: Entity, args: tuple[Any, ...], info: dict[str, Any],
        publication: Publication | None,
    ) -> None:
        """Handle a message of simulated time."""
        entity.rclpy.callback(*args)
        self._ran(entity)

    def request(self, work: Work) -> None:
        """Handle a request: never called, as services are not among these sources."""
        raise NotImplementedError

    def note_run(self) -> None:
        """Note that ``handle`` has done something."""
        self._has_run = True

    def _ran(self, entity: Entity) -> None:
        self.note_run()
        with self._lock:
            self._engine.ran_at_once(entity)

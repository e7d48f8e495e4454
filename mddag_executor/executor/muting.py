# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Muting: while a callback holds the GIL for long, callbacks that cannot start wake no thread.

Waking a thread costs 60 to 140 us while a callback computes.  The callbacks that could start are
known beforehand: those that do not compute, or whose relative deadline is below a bound (see
``Engine.overtaking_bound``).  Short ones compute, too: each needs the GIL to start.  The sources
of all others are switched off (``loop``), and their timers do not count for the timerfd.  Their
arrivals are collected when muting ends.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from mddag_executor.executor.entity import Entity
from mddag_executor.executor.loop import ALWAYS, urgency_of
from mddag_executor.executor.sources import SubscriptionSource

if TYPE_CHECKING:
    from mddag_executor.executor.workers import WorkerPool


class Muting:
    """
    The muted sources; all methods need the engine's lock.

    :ivar until: when to stop muting, on the trace's clock; 0: nothing is muted.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self.until = 0
        #: the entities with sources
        self.entities: Iterable[Entity] = ()
        # whether a callback has ever held the GIL for long: else nothing is worth a nested epoll
        self._has_long = False
        self._bound = 0
        self._pool = pool
        self._engine = pool.engine
        self._loop = pool.loop
        self._timers = pool.timers

    def update(self, now: int) -> None:
        """Mute sources whose callbacks cannot start while the dispatched one holds the GIL."""
        if not self._has_long:
            self._has_long = True
            for entity in list(self.entities):
                if entity.classify is not None:
                    entity.classify()
        bound, until = self._engine.overtaking_bound(now)
        if bound:
            self.until, self._bound = until, bound
            self._loop.mute(bound)
        else:
            self.end()

    def end(self) -> None:
        """End muting, and collect arrivals; timers only if callbacks may start."""
        if not self.until:
            return
        self.until = self._bound = 0
        for source in self._loop.sources(self._loop.unmute())[0]:
            source.collect()
        if self._pool.running:
            self._pool.fire_timers()

    def classify(self, source: SubscriptionSource) -> None:
        """Register a source according to its callback's GIL habit and deadline."""
        entity = source.entity
        habit = entity.habit
        if not habit.is_known:
            return
        entity.is_nested = habit.computes
        urgency = ALWAYS
        if habit.computes and self._has_long:
            urgency = urgency_of(self._engine.relative_deadline(entity))
        self._loop.move(source, urgency)

    def next_timer(self) -> int:
        """Return when the next timer that could start is due (monotonic ns); 0: never."""
        return self._timers.next_due_of(self._could_start) if self.until else (
            self._timers.next_due())

    def _could_start(self, entity: Entity) -> bool:
        habit = entity.habit
        return (not habit.computes or not habit.is_known
                or self._engine.relative_deadline(entity) < self._bound)

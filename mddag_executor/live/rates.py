# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Warnings about timers that cannot keep their rate (rclpy#1126).

Theory of operation
-------------------
A timer that becomes due while its callback still waits or runs (as often as its queue holds)
releases nothing: the period is skipped and counted, and the phase is kept, so that there are no
bursts afterwards.  Who spins looks at these counts now and then, not the intake: on the way of a
timer there is nothing more to do.  A timer that has skipped a share of ``LEAST`` of its periods
lately is warned of, at once the first time, then after ``AGAIN_S`` at the earliest and each time
twice as long, up to ``RARELY_S``.  (One that skips a period now and then, or fewer than ``FEWEST``
altogether, as when everything starts, is only counted.)
"""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any
from weakref import WeakKeyDictionary

from mddag_executor.live.entity import Entity
from mddag_executor.live.registry import Registry
from rclpy.exceptions import InvalidHandle
from rclpy.logging import get_logger

LOOK_S = 0.5
AGAIN_S, RARELY_S = 10.0, 640.0
LEAST = 0.05
FEWEST = 3


class _Known:
    """What was seen of a timer when it was looked at, or warned of, last."""

    __slots__ = ('skipped', 'ran', 'busy_ns', 'at', 'next', 'pause')

    def __init__(self, at: float) -> None:
        self.skipped = self.ran = self.busy_ns = 0
        self.at = at
        self.next = 0.0
        self.pause = AGAIN_S

    def begin(self, entity: Entity, now: float) -> None:
        """Look from here on."""
        self.skipped, self.ran, self.busy_ns, self.at = (
            entity.skipped, entity.ran, entity.busy_ns, now)


class RateWatch:
    """
    Warns of timers that cannot keep their rate.

    :param warn: takes a warning; None: it goes to the log.
    """

    def __init__(
        self, registry: Registry, warn: Callable[[str], Any] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._registry = registry
        self._warn = warn
        self._clock = clock
        self._next = self._looked = clock()
        self._known = WeakKeyDictionary[Entity, _Known]()

    def look(self) -> bool:
        """Look at all timers, unless that was done just now; return whether it was not."""
        now = self._clock()
        if now < self._next:
            return False
        since, self._looked, self._next = self._looked, now, now + LOOK_S
        before = self._known
        self._known = WeakKeyDictionary({
            entity: before.get(entity) or _Known(since) for entity in self._registry.timers()
            if entity.gate is None})  # else its callback group may want it slower
        for entity, known in self._known.items():
            if now < known.next:
                continue
            skipped, ran = entity.skipped - known.skipped, entity.ran - known.ran
            if skipped >= max(FEWEST, LEAST * (skipped + ran)):
                self._report(entity, known, now)
            elif now - known.at >= AGAIN_S and skipped + ran >= 2 * FEWEST:
                known.begin(entity, now)
        return True

    def _report(self, entity: Entity, known: _Known, now: float) -> None:
        skipped = entity.skipped - known.skipped
        ran, busy = entity.ran - known.ran, entity.busy_ns - known.busy_ns
        try:
            period = entity.rclpy.timer_period_ns
        except InvalidHandle:
            return  # destroyed meanwhile
        text = (
            f'the timer of {entity.node} with a period of {period / 1e6:g} ms cannot keep its '
            f'rate: {skipped} of {skipped + ran} periods were skipped within '
            f'{max(0.0, now - known.at):.1f} s')
        if ran > 0:
            text += f', its callback takes {busy / ran / 1e6:.3g} ms'
        (self._warn or get_logger('mddag_executor').warning)(text)
        known.begin(entity, now)
        known.next = now + known.pause
        known.pause = min(2 * known.pause, RARELY_S)

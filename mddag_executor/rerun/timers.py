# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Timers, whatever their clock, fire at their virtual due times.

Theory of operation
-------------------
What rcl knows of a timer's time is not asked for; only whether it is cancelled. A timer is due a
period after it was made or reset, and each period after that. Where a recorded run has jobs of
the timer's DAG, it is due first when the first of these was released, so that it keeps their
phase.
After a pause of the recording (see ``loop``) it keeps its phase. No timer is due any more when
the recording ends. In a recorded run timers that were made before the executor began to spin fired
once then, and so they do here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from mddag_executor.executor.compat import alive, ends_sleep, with_timer_info
from mddag_executor.executor.timers import TimerEntity, ZERO_PERIOD_NS
from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.loop import Loop, TIMER
from rclpy.exceptions import InvalidHandle
from rclpy.timer import Timer


@dataclass(eq=False, slots=True)
class _TimerState:
    """A timer: when it is due next (-1: never), and was last."""

    entity: TimerEntity
    last: int
    due: int = -1


class Timers:
    """
    The timers of a run.

    :param first_release: returns when the first job of a DAG was released in the recording.
    :param spins: before this time no timer fires, ns.
    """

    def __init__(
        self, loop: Loop, first_release: Callable[[int], int | None], spins: int
    ) -> None:
        self._loop, self._spins = loop, spins
        self._first_release = first_release
        self._known: dict[Timer, _TimerState] = {}

    def install(self, replacements: Replacements) -> None:
        """Have what nodes do with their timers count in virtual time."""
        replace = replacements.replace
        replace(Timer, 'reset', self._reset)
        replace(Timer, 'time_until_next_call', instead(self._until_next))
        replace(Timer, 'time_since_last_call', instead(self._since_last))

    def refresh(self, entities: Iterable[TimerEntity]) -> None:
        """Update which timers there are."""
        before, self._known = self._known, {}
        for entity in entities:
            known = before.get(entity.rclpy_object)
            if known is None:
                known = _TimerState(entity, self._loop.now)
                self._schedule(known, self._first_due(entity))
            known.entity = entity
            self._known[entity.rclpy_object] = known

    def _first_due(self, entity: TimerEntity) -> int:
        now, period = self._loop.now, _period(entity.rclpy_object)
        first = None
        if entity.source >= 0:
            first = self._first_release(self._loop.engine.tables.dag_of[entity.source])
        if first is None:
            return now + period
        return first if first >= now else now + (first - now) % period

    def _schedule(self, known: _TimerState, due: int) -> None:
        """Have a timer fire at a time, unless it is cancelled or destroyed."""
        known.due = -1
        with suppress(InvalidHandle):
            if not known.entity.rclpy_object.is_canceled():
                known.due = due
        if 0 <= known.due < self._loop.end:
            at = max(self._loop.after_pause(due), self._spins)
            self._loop.at(at, TIMER, self._fire, known, due)

    def _fire(self, known: _TimerState, due: int) -> None:
        timer, engine, now = known.entity.rclpy_object, self._loop.engine, self._loop.now
        if known.due != due or self._known.get(timer) is not known or not alive(timer):
            return  # it was reset meanwhile, or is gone
        period = _period(timer)
        self._schedule(known, due + ((now - due) // period + 1) * period)
        if known.due < 0:  # it was cancelled
            return
        known.last = now
        callback = timer.callback
        if callback is None:
            return
        if ends_sleep(callback):
            callback()
            self._loop.on_ended(timer)
            return
        info = {'expected_call_time': due, 'actual_call_time': now}
        engine.timer_due(
            known.entity.work(with_timer_info(timer, callback, info)), now, now)

    # --- what nodes do with them -----------------------------------------------------------------

    def _reset(self, original: Callable[[Timer], None]) -> Callable[[Timer], None]:
        def reset(timer: Timer) -> None:
            original(timer)
            known = self._known.get(timer)
            if known is not None:
                known.entity.n_resets += 1
                known.last = self._loop.now
                self._schedule(known, known.last + _period(timer))

        return reset

    def _until_next(self, timer: Timer) -> int | None:
        """Return how long it is until a timer is due; None if it is cancelled."""
        if timer.is_canceled():
            return None
        known = self._known.get(timer)
        return _period(timer) if known is None or known.due < 0 else known.due - self._loop.now

    def _since_last(self, timer: Timer) -> int:
        """Return how long ago a timer was due last, or was made."""
        known = self._known.get(timer)
        return 0 if known is None else self._loop.now - known.last


def _period(timer: Any) -> int:
    return int(timer.timer_period_ns) or ZERO_PERIOD_NS

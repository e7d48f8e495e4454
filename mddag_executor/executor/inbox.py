# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds job and release of collected messages, and passes them to the engine.

All of it happens under the engine's lock, at the time ``now``, set by the owner of the lock.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.clocks import TraceClock
from mddag_executor.executor.announcements import Announcements
from mddag_executor.executor.compat import RCL_ERRORS
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.jobs import (
    Announced,
    header_stamp,
    Origin,
    Publication,
    steady_time,
)
from mddag_executor.executor.recorder import Recorder
from mddag_executor.executor.timers import Fired
from mddag_executor.executor.work import Work


class Inbox:
    """
    Passes collected messages, requests and timers to the engine (``sources.Arrivals``).

    :param fail: receives the exception of a take.
    :ivar now: the time, on the trace's clock.
    :ivar announcements: of other processes; None: there are none.
    """

    def __init__(
        self, engine: Engine, clock: TraceClock, recorder: Recorder | None,
        fail: Callable[[BaseException], None],
    ) -> None:
        self._engine = engine
        self._clock = clock
        self._recorder = recorder
        self.failed = fail
        self.now = 0
        #: sets and returns the time
        self.tick: Callable[[], int] = clock.now
        self.announcements: Announcements | None = None

    def message(
        self, entity: Entity, args: tuple[Any, ...], info: dict[str, Any],
        publication: Publication | None,
    ) -> None:
        """Handle a message; ``publication``: the one that has just sent it, if certain."""
        if entity.is_own:
            entity.rclpy.callback(*args)
            return
        engine = self._engine
        work = Work(entity, entity.rclpy.callback, args)
        if self._recorder is not None:
            now = self.tick()  # it becomes ready right after it was taken
            self._recorder.taken(entity, args[0], info['source_timestamp'], now)
        if entity.callback is None:
            engine.ready_message(work, self.now)
            return
        if entity.awaits and self.announcements is not None and publication is None:
            self.announcements.take(work, info, self.now)
            return
        origin: Origin | Announced | None = None
        release = stamp = -1
        if entity.source >= 0:
            release, stamp = engine.jobs.release(
                engine.tables.dag_of[entity.source], args[0], info['source_timestamp'], self.now)
        elif entity.targets:
            origin = publication.origin if publication is not None else engine.jobs.find(
                entity.topic, info['source_timestamp'], info.get('publication_sequence_number'))
            if origin is None and entity.remote_publishers:
                release, stamp = self._stamp(work)
        engine.arrived(work, origin, release, stamp, self.now)

    def announced(self, work: Work, origin: Origin | Announced | None) -> None:
        """Handle a message after a possible wait for its announcement."""
        release = stamp = -1
        if isinstance(origin, Announced):
            release = origin.release + self._clock.offset_ns
        elif origin is None and work.entity.remote_publishers:
            release, stamp = self._stamp(work)
        self._engine.arrived(work, origin, release, stamp, self.now)

    def _stamp(self, work: Work) -> tuple[int, int]:
        """Return release and stamp of a message from another process."""
        stamp = header_stamp(work.args[0])
        return steady_time(stamp, self.now), stamp

    def request(self, work: Work) -> None:
        """Handle a request."""
        if work.entity.source >= 0:
            self._engine.arrived(work, None, self.now, -1, self.now)
        else:
            self._engine.ready(work, self.now)

    def timer(self, fired: Fired) -> None:
        """Handle a timer that is due, and the periods after it that were missed."""
        source, work, due, missed = fired
        due += self._clock.offset_ns
        self._engine.timer_due(work, due, self.now)
        if missed:
            try:
                period = source.period()
            except RCL_ERRORS:
                return  # it was destroyed meanwhile
            self._engine.timer_missed(source.entity, due, period, missed, self.now)

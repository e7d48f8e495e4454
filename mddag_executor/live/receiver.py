# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the intake hands over becomes work for the engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mddag_executor.live.announcements import Announcements
from mddag_executor.live.compat import ends_sleep
from mddag_executor.live.entity import Entity, WAITABLE
from mddag_executor.live.jobs import Announced, header_stamp, Origin, steady_time
from mddag_executor.live.pool import Pool
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry
from mddag_executor.live.work import Work
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle


class Receiver:
    """
    The intake's receiver: runs in its threads, and never blocks for long.

    What callbacks may wait for comes through though they hold all workers.  So some of rclpy's
    own parts, which only take note of something, run at once, here: a client's response, which
    completes a future (``intake.sources``); while workers run, what sets a node's simulated time,
    and the timer of a ``Rate``, which ends a sleep.
    """

    def __init__(
        self, pool: Pool, registry: Registry, executor: Any, fail: Callable[[BaseException], None],
        recorder: Recorder | None,
    ) -> None:
        self._pool = pool
        self._engine = pool.engine
        self._clock = pool.clock
        self._registry = registry
        self.executor = executor
        self._fail = fail
        self._recorder = recorder
        self.announcements: Announcements | None = None

    def take_in(self, arrivals: Sequence[Work]) -> None:
        """Handle what became ready at one instant."""
        if len(arrivals) == 1:
            self.take(arrivals[0])
            return
        with self._pool.batch():
            for each in arrivals:
                self.take(each)

    def take(self, work: Work) -> None:
        """Handle what became ready."""
        entity = self._registry.by_id.get(id(work.rclpy_entity))
        if entity is None:
            return
        work.entity = entity
        info = work.info
        if info is None or entity.is_own:
            self._take_other(work, entity)
            return
        if entity.at_once and self._pool.running:
            self._run(work)
            return
        if self._recorder is not None:
            self._recorder.taken(entity, work.args[0], info['source_timestamp'])
        if entity.awaits and self.announcements is not None:
            self.announcements.take(work)
            return
        engine = self._engine
        origin: Origin | Announced | None = None
        release = stamp = -1
        if entity.source >= 0:
            release, stamp = engine.jobs.release(
                engine.tables.dag_of[entity.source], work.args[0],
                info['source_timestamp'], self._clock.now())
        elif entity.targets:
            origin = engine.jobs.find(
                entity.topic, info['source_timestamp'],
                info.get('publication_sequence_number'))
            if origin is None and entity.remote_publishers:
                release, stamp = self._stamp(work)
        elif entity.callback is None and not entity.is_brief.debt and self._pool.runs_alone(work):
            return
        self._pool.report(engine.arrived, work, origin, release, stamp)

    def _take_other(self, work: Work, entity: Entity) -> None:
        """Handle what is no message, or one of the executor's own."""
        pool, engine = self._pool, self._engine
        if entity.is_own:
            work.function(*work.args)
        elif work.due is not None:
            if entity.callback is None and pool.running and ends_sleep(work.function):
                self._run(work)
            else:
                self._timer_due(work)
        elif entity.source >= 0:
            pool.report(engine.arrived, work, None, self._clock.now(), -1)
        else:
            if entity.kind == WAITABLE and isinstance(work.rclpy_entity, EventHandler):
                self._registry.note_event(work.rclpy_entity, work.args[0])
            pool.report(engine.ready, work)

    def give(self, work: Work, origin: Origin | Announced | None) -> None:
        """Hand a message over that has waited, or could have, for its announcement."""
        release = stamp = -1
        if isinstance(origin, Announced):
            release = origin.release + self._clock.offset_ns
        elif origin is None and work.entity.remote_publishers:
            release, stamp = self._stamp(work)
        self._pool.report(self._engine.arrived, work, origin, release, stamp)

    def _stamp(self, work: Work) -> tuple[int, int]:
        """Return release and stamp of a message from another process."""
        stamp = header_stamp(work.args[0])
        return steady_time(stamp, self._clock.now()), stamp

    def _run(self, work: Work) -> None:
        work.function(*work.args)
        with self._pool.lock:
            self._engine.ran_at_once(work.entity)

    def _timer_due(self, work: Work) -> None:
        """Handle a timer, and periods that were skipped since nobody was there to look at it."""
        assert work.due is not None
        due = work.due + self._clock.offset_ns
        self._pool.report(self._engine.timer_due, work, due)
        if work.missed:
            try:
                period = work.rclpy_entity.timer_period_ns
            except InvalidHandle:
                return  # destroyed meanwhile
            self._pool.report(self._engine.timer_missed, work.entity, due, period, work.missed)

    def on_intake_error(self, error: BaseException) -> None:
        """Take an error of the intake: it comes out of spin."""
        self._fail(error)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the intake hands over becomes work for the engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mddag_executor.live.compat import ends_sleep
from mddag_executor.live.entity import Entity
from mddag_executor.live.intake.arrivals import Arrival
from mddag_executor.live.jobs import header_stamp, Origin, steady_time
from mddag_executor.live.pool import Pool
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry
from mddag_executor.live.work import Work
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

    def take_in(self, arrivals: Sequence[Arrival]) -> None:
        """Take in what became ready at one instant."""
        if len(arrivals) == 1:
            self._take_in(*arrivals[0])
            return
        self._pool.begin_batch()
        try:
            for arrival in arrivals:
                self._take_in(*arrival)
        finally:
            self._pool.end_batch()

    def _take_in(
        self, rclpy_entity: Any, function: Callable[..., Any], args: tuple[Any, ...],
        then: Callable[[Any], Any] | None, info: dict[str, Any] | None, due: int | None,
        missed: int,
    ) -> None:
        entity = self._registry[rclpy_entity]
        if entity is None:
            return
        pool, engine = self._pool, self._engine
        if pool.running and (
                entity.at_once or entity.callback is None and due is not None
                and ends_sleep(function)):
            function(*args)
            with pool.lock:
                engine.ran_at_once(entity)
            return
        work = Work(entity, function, args, then)
        if due is not None:
            due += self._clock.offset_ns
            pool.tell(engine.timer_due, entity, work, due)
            if missed:
                self._missed(entity, due, missed)
        elif info is not None:
            self._message(entity, work, args[0], info)
        elif entity.source >= 0:
            pool.tell(engine.arrived, work, None, self._clock.now(), -1)
        else:
            pool.tell(engine.ready, work)

    def _missed(self, entity: Entity, due_ns: int, count: int) -> None:
        """Take in that periods were skipped since nobody was there to look at the timer."""
        try:
            period = entity.rclpy.timer_period_ns
        except InvalidHandle:
            return  # destroyed meanwhile
        self._pool.tell(self._engine.timer_missed, entity, due_ns, period, count)

    def _message(self, entity: Entity, work: Work, message: Any, info: dict[str, Any]) -> None:
        origin: Origin | None = None
        release = stamp = -1
        if entity.source >= 0:
            release, stamp = self._engine.jobs.release(
                self._engine.tables.dag_of[entity.source], message, info['source_timestamp'],
                self._clock.now())
        elif entity.targets:
            origin = self._engine.jobs.find(
                entity.topic, info['source_timestamp'], info.get('publication_sequence_number'))
            if origin is None and entity.enters:
                stamp = header_stamp(message)
                release = steady_time(stamp, self._clock.now())
        if self._recorder is not None:
            self._recorder.taken(entity, message, info['source_timestamp'])
        self._pool.tell(self._engine.arrived, work, origin, release, stamp)

    def on_intake_error(self, error: BaseException) -> None:
        """Take an error of the intake: it comes out of spin."""
        self._fail(error)

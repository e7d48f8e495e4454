# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the intake hands over becomes work for the dispatcher."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import time
from typing import Any

from mddag_executor.live.attribution import Origin
from mddag_executor.live.compat import ends_sleep
from mddag_executor.live.crossings import header_stamp
from mddag_executor.live.dispatcher import Dispatcher
from mddag_executor.live.entries import Entry, Work
from mddag_executor.live.intake.arrivals import Arrival
from mddag_executor.live.pool import Pool
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry
from msg_graph import TaskSet
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
        self, dispatcher: Dispatcher, registry: Registry, task_set: TaskSet | None,
        executor: Any, fail: Callable[[BaseException], None], recorder: Recorder | None,
        pool: Pool,
    ) -> None:
        self._dispatcher = dispatcher
        self._registry = registry
        self._release_from = [d.release_from for d in task_set.dags] if task_set else []
        self.executor = executor
        self._fail = fail
        self._recorder = recorder
        self._pool = pool

    def take_in(self, arrivals: Sequence[Arrival]) -> None:
        """Take in what became ready at one instant."""
        if len(arrivals) == 1:
            self._take_in(*arrivals[0])
            return
        self._dispatcher.hold()
        try:
            for arrival in arrivals:
                self._take_in(*arrival)
        finally:
            self._dispatcher.let_go()

    def _take_in(
        self, entity: Any, function: Callable[..., Any], args: tuple[Any, ...],
        then: Callable[[Any], Any] | None, info: dict[str, Any] | None, due: int | None,
        missed: int,
    ) -> None:
        entry = self._registry[entity]
        if entry is None:
            return
        dispatcher = self._dispatcher
        if self._pool.running and (
                entry.at_once or entry.callback is None and due is not None
                and ends_sleep(function)):
            function(*args)
            dispatcher.ran_at_once(entry)
            return
        work = Work(entry, function, args, then)
        if due is not None:
            due += dispatcher.clock_offset
            dispatcher.timer_due(entry, work, due)
            if missed:
                self._missed(entry, due, missed)
        elif info is not None:
            self._message(entry, work, args[0], info)
        elif entry.source >= 0:
            dispatcher.message(entry, work, None, dispatcher.now())
        else:
            dispatcher.undeclared_ready(entry, work)

    def _missed(self, entry: Entry, due_ns: int, count: int) -> None:
        """Take in that periods were skipped since nobody was there to look at the timer."""
        try:
            period = entry.entity.timer_period_ns
        except InvalidHandle:
            return  # destroyed meanwhile
        self._dispatcher.timer_missed(entry, due_ns, period, count)

    def _message(self, entry: Entry, work: Work, message: Any, info: dict[str, Any]) -> None:
        origin: Origin | None = None
        release: int | None = None
        stamp = -1
        if entry.source >= 0:
            release, stamp = self._release(entry, message, info)
        elif entry.targets:
            origin = self._dispatcher.attribution.find(
                entry.topic, info['source_timestamp'], info.get('publication_sequence_number'))
            if origin is None and entry.enters:
                stamp = header_stamp(message)
                release = self._steady(stamp)
        if self._recorder is not None:
            self._recorder.taken(entry, message, info['source_timestamp'])
        self._dispatcher.message(entry, work, origin, release, stamp)

    def _release(self, entry: Entry, message: Any, info: dict[str, Any]) -> tuple[int, int]:
        """
        Return the release of the job that a source's message starts, on the trace's clock.

        :return: the release, and the header's stamp where it comes from that, else -1.
        """
        kind = self._release_from[self._dispatcher.tables.dag_of[entry.source]]
        if kind == 'arrival':
            return self._dispatcher.now(), -1
        if kind == 'source_timestamp':
            return self._steady(info['source_timestamp']), -1
        stamp = header_stamp(message)
        if stamp < 0:  # raw, without a header, or not stamped: all that is known is its arrival
            return self._dispatcher.now(), -1
        return self._steady(stamp), stamp

    def _steady(self, stamp: int) -> int:
        """Return a system time on the trace's clock."""
        return self._dispatcher.now() - time.time_ns() + stamp

    def on_intake_error(self, error: BaseException) -> None:
        """Take an error of the intake: it comes out of spin."""
        self._fail(error)

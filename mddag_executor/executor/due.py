# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When threads wake up: due times, the guard, and muting.

Theory of operation
-------------------
1.  *Due times* are those of timers, deadlines of open jobs, checks, and calls.  One timerfd
    (``EventLoop.timer``) is set to the earliest.  While there are executions to run, it may expire
    too early, but not too late.
2.  *Muting.*  Waking a thread costs 60 to 140 us while a callback computes.  So while a callback
    holds the GIL for long, callbacks that cannot start wake no thread.  Those that could start are
    known beforehand: they do not compute, or their relative deadline is below a bound (see
    ``Engine.overtaking_bound``).  Short callbacks compute, too: each needs the GIL to start.
    While the bound is at most the relative deadline of undeclared callbacks, the timers of all
    others do not count for the timerfd, and their sources are switched off (``loop``) if they are
    *patient*: their relative deadline is at least that of undeclared callbacks.  Their arrivals
    are collected when muting ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from heapq import heappop, heappush
from time import monotonic_ns, process_time_ns
from typing import TYPE_CHECKING

from mddag_executor.core import NEVER
from mddag_executor.executor.bounds import AGAIN_NS, SHORT_CALLBACK_NS, STOP_NS
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.gil import CHECK_NS, GilCheck, LAST_CHECK_NS
from mddag_executor.executor.listeners import TimerFd
from mddag_executor.executor.loop import ChannelSource
from mddag_executor.executor.shutdown import is_over
from mddag_executor.executor.sources import SubscriptionSource

if TYPE_CHECKING:
    from mddag_executor.executor.workers import WorkerPool


class DueTimes:
    """
    The times at which a worker pool has to act; all methods need the engine's lock.

    Times are monotonic ns, unless noted otherwise.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool
        self._engine = pool.engine
        self._timer = pool.loop.timer
        self._timers = pool.timers
        self._offset = pool.clock.offset_ns
        self._check_context_at = 0
        self._calls: list[tuple[int, int, Callable[[], None]]] = []
        self._n_calls = 0
        self._gil_check = GilCheck()
        # the next deadline, on the trace's clock, when the timerfd was set
        self.deadline = NEVER
        #: whether the timerfd may be set to a time at which nothing is due
        self.may_expire_early = False
        self._seen = monotonic_ns(), process_time_ns()

    def begin(self, now: int) -> None:
        """Set the timerfd at the beginning of a spin."""
        self._seen = now, process_time_ns()
        self.arm(now)

    def call_at(self, at: int, function: Callable[[], None]) -> None:
        """Call a function at a time, without the lock."""
        self._n_calls += 1
        heappush(self._calls, (at, self._n_calls, function))
        self._arm_by(at)

    def handle(self, now: int, since: int) -> None:
        """
        Handle everything due by now; calls wait until the lock is free.

        :param now: the time on the trace's clock.
        :param since: since when the calling thread has waited in the epoll, on the trace's clock;
            or now.
        """
        pool, monotonic = self._pool, now - self._offset
        self._notice_stop(monotonic, since)
        if monotonic > self._check_context_at:  # a context that was only destroyed is not reported
            self._check_context_at = monotonic + 20 * AGAIN_NS
            if is_over(pool.context):
                pool.wake_executor()
        self._timer.at = NEVER
        pool.fire_timers()
        if now > self._engine.deadlines.next:
            self._engine.judge_overdue(now)
        if self._gil_check.at <= monotonic:
            self._check_gil(monotonic)
        if 0 < pool.muting.until <= now:
            pool.muting.end()
        while self._calls and self._calls[0][0] <= monotonic:
            pool.deferred.append(heappop(self._calls)[2])
        pool.log_misses()

    def arm(self, now: int) -> None:
        """Set the timerfd to the next due time."""
        pool = self._pool
        deadline = self.deadline = self._engine.deadlines.next
        if not pool.running:
            self._timer.arm(NEVER)
            return
        offset, muting, check = self._offset, pool.muting, self._gil_check
        self._timers.has_new = False
        timer = muting.next_timer()
        first = timer
        if deadline < NEVER:
            first = min(first, deadline - offset + 1)
        if self._calls:
            first = min(first, self._calls[0][0])
        if muting.until:
            first = min(first, muting.until - offset)
        if self._engine.holders and self._engine.has_waiting:
            self._watch_holder(now)
            first = min(first, self._next_check(now))
        elif check.at < NEVER:
            check.end()
        self.may_expire_early = first != timer
        if first != self._timer.at:
            self._timer.arm(first)

    # --- the GIL ---------------------------------------------------------------------------------

    @property
    def is_checking(self) -> bool:
        """Return whether a check is due at some time."""
        return self._gil_check.at < NEVER

    def check_holder(self, now: int, is_late: bool = False) -> None:
        """
        Check whether the execution that holds the GIL computes, as another one waits for it.

        :param is_late: it is short, but runs longer than expected.
        """
        self._watch_holder(now, is_late)
        if is_late:
            self._check_gil(now)  # the first reading, with which the next one is compared
        self._arm_by(self._next_check(now))

    def _next_check(self, now: int) -> int:
        """Return when to check whether the first waiting execution may start; NEVER: no need."""
        if not self._engine.holders:
            return NEVER
        at = self._engine.overtaking_at() - self._offset
        return min(at if at > now else NEVER, self._gil_check.at)

    def _arm_by(self, at: int) -> None:
        """Set the timerfd to a time, unless it expires sooner."""
        if at < self._timer.at:
            self.may_expire_early = True
            self._timer.arm(at)

    def _watch_holder(self, now: int, is_late: bool = False) -> None:
        holder = self._engine.interpreter_holder()
        if holder is None:
            return
        after, step = LAST_CHECK_NS, min(CHECK_NS, self._engine.patience() // 2)
        if is_late or holder.entity.wall_ns > SHORT_CALLBACK_NS:
            after = max(step, 2 * holder.entity.habit.mean_ns)
        self._gil_check.begin(holder, now, after, step)

    def _check_gil(self, now: int) -> None:
        """Take the GIL from an execution that waits for anything else."""
        holder = self._engine.interpreter_holder()
        thread = None if holder is None else self._pool.thread_of(holder)
        if holder is None or thread is None:
            self._gil_check.end()
        elif holder is not self._gil_check.subject:  # one of several short callbacks in a row
            self._watch_holder(now)
        elif self._gil_check.waits(thread.ident, thread.vtid, now):
            self._gil_check.end()
            self._engine.stop_holding(holder)

    # --- stops of the machine --------------------------------------------------------------------

    def _notice_stop(self, now: int, since: int) -> None:
        """
        Notice that no thread of the process ran since the timerfd was to expire.

        If no thread waited for the timerfd, because all ran callbacks, its delay proves nothing.
        """
        at, cpu = self._timer.at, process_time_ns()
        seen, used = self._seen
        self._seen = now, cpu
        if now - max(at, seen) >= STOP_NS:
            waited = self._pool.waited_since(since) - self._offset
            late = now - max(at, seen, waited) - (cpu - used)
            if late >= STOP_NS:
                self._engine.verdicts.stopped(now - late + self._offset, now + self._offset)


class Guard(ChannelSource):
    """
    A time at which to wake a thread because a callback runs longer than expected.

    All methods but ``collect`` need the engine's lock.  The guard has a separate timerfd, which
    the spinning thread waits for.  Setting and clearing a time for each callback would cost more
    than the callback (9 us on a virtual machine).  So the time is not cleared until it expires,
    and changed only to an earlier one.

    :param expired: called when the time expires; it calls ``end``.
    :ivar at: the time that is set (monotonic ns); NEVER: none.
    """

    def __init__(self, expired: Callable[[], None]) -> None:
        self._timer = TimerFd()
        self.at = NEVER
        self.fd = self._timer.fd
        self._expired = expired

    def collect(self) -> None:
        """Handle the expiry."""
        self._expired()

    def set(self, at: int) -> None:
        """Set the time (monotonic ns)."""
        self.at = at
        self._timer.arm(at)

    def end(self) -> None:
        """Note that the time has expired."""
        self.at = NEVER

    def close(self) -> None:
        """Close the descriptor, once."""
        self.fd = -1
        self._timer.close()


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
        self._patience = pool.engine.tables.rad_offset[-1]
        self._pool = pool

    def update(self, now: int) -> None:
        """Mute sources whose callbacks cannot start while the dispatched one holds the GIL."""
        if not self._has_long:
            self._has_long = True
            for entity in list(self.entities):
                if entity.classify is not None:
                    entity.classify()
        bound, until = self._pool.engine.overtaking_bound(now)
        if not 0 < bound <= self._patience:
            self.end()
        else:
            self.until, self._bound = until, bound
            self._pool.loop.mute()

    def end(self) -> None:
        """End muting, and collect arrivals; timers only if callbacks may start."""
        if not self.until:
            return
        self.until = self._bound = 0
        for source in self._pool.loop.sources(self._pool.loop.unmute()):
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
        is_patient = self._pool.engine.relative_deadline(entity) >= self._patience
        self._pool.loop.move(source, is_patient and self._has_long and bool(habit.computes))

    def next_timer(self) -> int:
        """Return when the next timer that could start is due (monotonic ns); NEVER: never."""
        return self._pool.timers.next_due_of(self._could_start) if self.until else (
            self._pool.timers.next_due())

    def _could_start(self, entity: Entity) -> bool:
        habit = entity.habit
        return (not habit.computes or not habit.is_known
                or self._pool.engine.relative_deadline(entity) < self._bound)

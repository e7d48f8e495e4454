# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When threads wake up: due times, and looks.

Theory of operation
-------------------
1.  *Due times* are those of timers, deadlines of open jobs, checks, and calls.  While a thread
    waits in the epoll, its timerfd (``EventLoop.timer``) is set to the earliest.  While there are
    executions to run, it may expire too early, but not too late.
2.  *Looks.*  Waking a thread costs 60 to 140 us while a callback computes, so no thread waits for
    events then.  A parked thread *looks* instead, at the latest time at which anything that may
    have come would have to start (``Parking.watch``).  A callback that is known to wait has to
    start at once.  One that computes may wait for a part of its relative deadline
    (``LOOK_PART``).  Of timers it is known when they are due; messages of other processes may
    come at any time.  A callback that ends before the look costs no wake-up: the time is set
    again by the next one, unless it is good enough.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import monotonic_ns, process_time_ns
from typing import Any, Protocol

from mddag_executor.clocks import TraceClock
from mddag_executor.core import NEVER
from mddag_executor.executor.agenda import Agenda
from mddag_executor.executor.bounds import (
    AGAIN_NS,
    GUARD_NS,
    LOOK_PART,
    NET_NS,
    SHORT_CALLBACK_NS,
    SOON_NS,
    STOP_NS,
)
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.gil import CHECK_NS, CHECK_PART, GilCheck, LAST_CHECK_NS
from mddag_executor.executor.loop import EventLoop, Parking
from mddag_executor.executor.shutdown import is_over
from mddag_executor.executor.timers import TimerQueue
from mddag_executor.executor.work import Work


class Thread(Protocol):
    """A thread of the pool."""

    ident: int
    vtid: int


class Clocked(Protocol):
    """The worker pool, as its due times see it: see ``workers.WorkerPool``."""

    engine: Engine
    clock: TraceClock
    loop: EventLoop
    parking: Parking
    agenda: Agenda
    timers: TimerQueue
    deferred: deque[Callable[[], None]]
    now: int
    running: bool
    is_stepping: bool
    polling: int
    context: Any
    wake_executor: Callable[[], None]

    def log_misses(self) -> None:
        """Log misses, soon."""

    def is_busy(self) -> bool:
        """Return whether a callback computes."""

    def end_pauses(self) -> None:
        """Let paused callbacks go on."""

    @property
    def is_watched(self) -> bool:
        """Return whether a paused thread checks the execution that holds the GIL."""

    def waited_since(self, since: int) -> int:
        """Return since when a thread has waited for events."""

    def thread_of(self, work: Work) -> Thread | None:
        """Return the thread that runs an execution."""


class Call:
    """A call at a time, which waits until the lock is free."""

    def __init__(self, deferred: deque[Callable[[], None]], function: Callable[[], None]) -> None:
        self.entry: list[Any] | None = None
        self._deferred = deferred
        self._function = function

    def come_due(self) -> None:
        """Let the function be called."""
        self._deferred.append(self._function)


class Appointed:
    """A method of due times that is called at a time, with the lock."""

    def __init__(self, act: Callable[[], None]) -> None:
        self.entry: list[Any] | None = None
        self.come_due = act


class DueTimes:
    """
    The times at which a worker pool has to act; all methods need the engine's lock.

    Times are monotonic ns, unless noted otherwise.
    """

    def __init__(self, pool: Clocked) -> None:
        self._pool = pool
        self._engine = pool.engine
        self._timer = pool.loop.timer
        self._watch = pool.parking.watch
        self._agenda = pool.agenda
        self._timers = pool.timers
        self._timers.allowance = self.allowance
        # how long an arrival from outside may stay unnoticed while a callback computes
        self._allowance = NEVER
        self._offset = pool.clock.offset_ns
        self._check_context_at = 0
        self._gil_check = GilCheck()
        # the next deadline of a job that is in the agenda, on the trace's clock
        self._deadline = NEVER
        self._overdue = Appointed(self._judge_overdue)
        self._seen = monotonic_ns(), process_time_ns()

    def begin(self, now: int) -> None:
        """Set the timerfd at the beginning of a spin."""
        self._seen = now, process_time_ns()
        self.arm(now)

    def call_at(self, at: int, function: Callable[[], None]) -> None:
        """Call a function at a time, without the lock."""
        self._agenda.set(Call(self._pool.deferred, function), at, at)
        self.arm_by(at)

    def handle(self, now: int, since: int) -> None:
        """
        Handle everything due by now; calls wait until the lock is free.

        :param now: the time on the trace's clock.
        :param since: since when the calling thread has waited in the epoll, on the trace's clock;
            or now.
        """
        pool, agenda, monotonic = self._pool, self._agenda, now - self._offset
        self._notice_stop(monotonic, since)
        if monotonic > self._check_context_at:  # a context that was only destroyed is not reported
            self._check_context_at = monotonic + 20 * AGAIN_NS
            if is_over(pool.context):
                pool.wake_executor()
        self._timer.at = NEVER
        if self._timers.has_jumped:
            self._timers.ask_after_jump()
        last = agenda.last
        while agenda.handle_next(monotonic_ns(), last):
            pass
        if self._gil_check.at <= monotonic:
            self._check_gil(monotonic)
        pool.log_misses()

    def is_due(self, now: int) -> bool:
        """Return whether there is anything to ``handle``."""
        return (self._agenda.first() <= now or self._timer.at <= now
                or self._gil_check.at <= now or self._timers.has_jumped)

    def note_deadline(self) -> None:
        """Note the next deadline of a job."""
        deadline = self._engine.next_deadline()
        if deadline == self._deadline:
            return
        self._deadline = deadline
        if deadline == NEVER:
            self._agenda.cancel(self._overdue)
        else:  # a miss need not be reported at once while callbacks compute
            at = deadline - self._offset
            self._agenda.set(self._overdue, at + 1, at + NET_NS)

    def _judge_overdue(self) -> None:
        self._deadline = NEVER
        self._engine.judge_overdue(self._pool.now)

    def arm(self, now: int) -> None:
        """Set the time at which a thread wakes up: one in the epoll, else a parked one."""
        pool = self._pool
        if not pool.polling and not pool.is_stepping:
            self._timer.at = NEVER  # it may expire: nobody is woken
            if pool.running and pool.is_busy():
                self.look(now)
            return
        if not pool.running:
            self._timer.arm(NEVER)
            return
        first = self._first(now, bool(self._engine.holders))
        if first != self._timer.at:
            self._timer.arm(first)

    def _first(self, now: int, looks: bool) -> int:
        """Return the next due time, or that of a look."""
        engine, check = self._engine, self._gil_check
        self.note_deadline()
        first = self._agenda.first_latest() if looks else self._agenda.first()
        if engine.holders and engine.has_waiting:
            self._watch_holder(now)
            first = min(first, self._next_check(now))
        elif check.at < NEVER:
            check.end()
        return first

    # --- looks -----------------------------------------------------------------------------------

    def allowance(self, entity: Entity, period: int = NEVER) -> int:
        """Return how long an arrival at an entity may stay unnoticed while a callback computes."""
        if entity.is_eager():
            return 0
        deadline = self._engine.relative_deadline(entity)
        if entity.callback is not None:  # each release counts
            deadline = min(period, deadline)
        return deadline // LOOK_PART

    def expect(self, entity: Entity) -> None:
        """Note that something may arrive at an entity from outside."""
        self._allowance = min(self._allowance, max(SOON_NS, self.allowance(entity)))

    def look(self, now: int) -> None:
        """Set the time of the next look while callbacks run and no thread waits for events."""
        at = min(self._first(now, True), now + self._allowance)
        if at != self._watch.at:
            self._watch.arm(at)

    def look_after(self, now: int) -> None:
        """Set the time of a look in case that a short callback runs longer than expected."""
        watch = self._watch
        at = min(self._agenda.first_latest(), now + (
            self._engine.patience() if self._engine.has_waiting else NET_NS))
        if at < watch.at or watch.at < now + GUARD_NS:
            watch.arm(at)

    def has_looked(self, now: int) -> None:
        """Note that the time of a look has come."""
        if self._watch.at <= now:
            self._watch.at = NEVER

    # --- the GIL ---------------------------------------------------------------------------------

    def check_holder(self, now: int, is_late: bool = False) -> None:
        """
        Check whether the execution that holds the GIL computes, as another one waits for it.

        :param is_late: it is short, but runs longer than expected.
        """
        self._watch_holder(now, is_late)
        if is_late:
            self._check_gil(now)  # the first reading, with which the next one is compared
        self.arm_by(self._next_check(now))

    def check_late(self, now: int) -> None:
        """
        Check an execution that holds the GIL at once, if it has held it for longer than usual.

        :param now: the time on the trace's clock.
        """
        holder = self._engine.interpreter_holder()
        if (holder is not None and self._engine.usual_end(holder) < now
                and not self._pool.is_watched and not self._gil_check.has_begun(holder)):
            self.check_holder(now - self._offset, is_late=True)

    def _next_check(self, now: int) -> int:
        """Return when to check whether the first waiting execution may start; NEVER: no need."""
        if not self._engine.holders:
            return NEVER
        at = self._engine.overtaking_at() - self._offset
        return min(at if at > now else NEVER,
                   NEVER if self._pool.is_watched else self._gil_check.at)

    def arm_by(self, at: int) -> None:
        """Let a thread wake up at a time, unless it does sooner."""
        if self._pool.polling or self._pool.is_stepping:
            if at < self._timer.at:
                self._timer.arm(at)
        elif at < self._watch.at:
            self._watch.arm(at)

    def _watch_holder(self, now: int, is_late: bool = False) -> None:
        holder = self._engine.interpreter_holder()
        if holder is None:
            return
        after, step = LAST_CHECK_NS, min(CHECK_NS, self._engine.patience() // CHECK_PART)
        if is_late or holder.entity.wall_ns > SHORT_CALLBACK_NS:
            after = max(step, self._engine.usual_end(holder) - self._offset - now)
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
            self._pool.end_pauses()

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

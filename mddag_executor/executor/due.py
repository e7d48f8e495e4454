# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When threads wake up: the two timerfds, set to the next appointment and to the next look.

Theory of operation
-------------------
1.  *Appointments* (``agenda``) are those of timers, deadlines of open jobs, checks, and calls.
    While a thread waits in the epoll, its timerfd (``EventLoop.timer``) is set to the first one.
    While there are executions to run, it may expire too early, but not too late.
2.  *Looks.*  Waking a thread costs 60 to 140 us while a callback computes, so no thread waits for
    events then.  Instead, a parked thread *looks* for events (``Parking.watch``), at the latest
    time at which anything that may have come would have to start.  A callback that is known to
    wait has to start at once.  One that computes may wait for a part of its relative deadline
    (``LOOK_PART``).  The times at which timers are due are known, but messages of other processes
    may come at any time.  If a callback ends before the look, no thread is woken: the next
    callback puts the look off, unless its time is good enough.  What would have to be done within
    ``SHORT_CALLBACK_NS`` then, the thread of the callback that has ended does itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from time import monotonic_ns, process_time_ns
from typing import Any, Protocol

from mddag_executor.clocks import SystemClock, TraceClock
from mddag_executor.core import NEVER
from mddag_executor.executor.bounds import (
    AFTER_NS,
    AGAIN_NS,
    LOOK_PART,
    NET_NS,
    QUIET_NS,
    REPORT_NS,
    SHORT_CALLBACK_NS,
    SOON_NS,
    STOP_NS,
)
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.holder_check import HolderCheck, Threads
from mddag_executor.executor.loop import EventLoop, Parking
from mddag_executor.executor.shutdown import is_over
from mddag_executor.executor.timers import TimerQueue
from mddag_executor.executor.work import Work
from mddag_executor.text import step_text
from rclpy.logging import get_logger


class Clocked(Threads, Protocol):
    """The worker pool, as its due times see it: see ``workers.WorkerPool``."""

    clock: TraceClock
    loop: EventLoop
    parking: Parking
    timers: TimerQueue
    unlocked_calls: deque[Callable[[], None]]
    running: bool
    is_spin_once: bool
    polling: int
    context: Any
    wake_executor: Callable[[], None]

    def waited_since(self, since: int) -> int:
        """Return since when a thread has waited for events."""

    def reporting(self) -> list[Work]:
        """Return the executions that do not run now, but may have ended."""


class Call:
    """A call at a time, which waits until the lock is free."""

    def __init__(
        self, unlocked_calls: deque[Callable[[], None]], function: Callable[[], None]
    ) -> None:
        self.entry: list[Any] | None = None
        self._unlocked_calls = unlocked_calls
        self._function = function

    def come_due(self) -> None:
        """Let the function be called."""
        self._unlocked_calls.append(self._function)


def _warn_of_step(step: int) -> None:
    get_logger('mddag_executor').warning(step_text(step))


class Overdue:
    """The next deadline of a job, after which the engine is to judge it."""

    def __init__(self, pool: Clocked) -> None:
        self.entry: list[Any] | None = None
        self._pool = pool
        self._deadlines = pool.engine.deadlines
        #: ns on the trace's clock
        self.deadline = NEVER

    def update(self) -> None:
        """Set it to what it is now, or cancel it."""
        deadline = self._deadlines.first()
        if deadline == self.deadline:
            return
        self.deadline = deadline
        if deadline == NEVER:
            self._pool.agenda.cancel(self)
        else:  # a miss need not be reported at once while callbacks compute
            at = deadline - self._pool.clock.offset_ns
            self._pool.agenda.set(self, at + 1, at + NET_NS)

    def come_due(self) -> None:
        """
        Report what is overdue.

        A callback may have ended in time, while its thread still waits for the lock to say so.
        """
        self.deadline = NEVER
        pool = self._pool
        pool.engine.judge_overdue(pool.now, pool.reporting())
        deadline = self._deadlines.first()
        if deadline < pool.now:
            self.deadline = deadline
            at = pool.now - pool.clock.offset_ns + REPORT_NS
            pool.agenda.set(self, at, at + NET_NS)


class DueTimes:
    """
    The times at which a worker pool has to act; all methods need the engine's lock.

    Times are monotonic ns, unless noted otherwise.

    :ivar overdue: the next deadline.
    :ivar check: whether what holds the interpreter computes.
    """

    def __init__(self, pool: Clocked) -> None:
        self._pool = pool
        self._agenda = pool.agenda
        self._holders = pool.engine.interpreter.holders
        self._timer = pool.loop.timer
        self._watch = pool.parking.watch
        self._timers = pool.timers
        self._timers.allowance = self.allowance
        # how long an arrival from outside may stay unnoticed while a callback computes
        self._allowance = NEVER
        self._offset = pool.clock.offset_ns
        self._check_context_at = 0
        self._system_clock = SystemClock()
        self._rested_at = 0
        self.overdue = Overdue(pool)
        self.check = HolderCheck(pool, self._offset, self.arm_by)
        self._seen = monotonic_ns(), process_time_ns()

    def begin(self, now: int) -> None:
        """Set the timerfd at the beginning of a spin."""
        self._seen = now, process_time_ns()
        self.arm(now)

    def call_at(self, at: int, function: Callable[[], None]) -> None:
        """Call a function at a time, without the lock."""
        self._agenda.set(Call(self._pool.unlocked_calls, function), at, at)
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
            if step := self._system_clock.step():
                pool.engine.clock_was_set(step, now)
                pool.unlocked_calls.append(partial(_warn_of_step, step))
            if is_over(pool.context):
                pool.wake_executor()
        self._timer.at = NEVER
        if self._timers.has_jumped:
            self._timers.ask_after_jump()
        agenda.handle(monotonic_ns)

    # --- the timerfd of the thread that waits for events -----------------------------------------

    def arm(self, now: int) -> None:
        """Set the time at which a thread wakes up: one in the epoll, else a parked one."""
        pool = self._pool
        if not pool.polling and not pool.is_spin_once:
            self._timer.at = NEVER  # it may expire, and wakes no thread then
            if pool.running and pool.engine.is_busy:
                self.arm_look(now)
        elif not pool.running:
            self._timer.arm(NEVER)
        else:
            self.check.note(now)
            first = self._agenda.latest if self._holders else self._agenda.next
            if first != self._timer.at:
                self._timer.arm(first)

    def arm_for_new(self, now: int) -> None:
        """
        Let a parked thread look for new appointments and entities as well.

        The caller starts nothing, so the time of a look that was set before stays.  A thread in
        the epoll wakes up for each new entity anyway: its descriptor is ready at first.
        """
        pool = self._pool
        if pool.running and pool.engine.is_busy and not (pool.polling or pool.is_spin_once):
            self.arm_by(self._next_look(now))

    def arm_idle(self, now: int) -> None:
        """Set the time at which a thread in the epoll wakes up; no callback computes."""
        if self.check.entry:
            self.check.note(now)  # what was to be checked has ended
        first = self._agenda.next
        if first != self._timer.at:
            self._timer.arm(first)
        # A parked thread would look in vain, as this one waits.  The look is not cancelled but
        # put off, so that the next callback need not set it.
        watch, latest = self._watch, now + NET_NS
        soon = latest - QUIET_NS
        if first < soon or now - self._rested_at > QUIET_NS:
            soon, latest = first + AFTER_NS, first + NET_NS
        if watch.at < soon and watch.at < NEVER:
            at = self._agenda.latest  # the next callback would set it to this, or later
            watch.arm(at if soon <= at < latest else min(latest, NEVER))
        self._rested_at = now

    def arm_by(self, at: int) -> None:
        """Let a thread wake up at a time, unless it does sooner."""
        if self._pool.polling or self._pool.is_spin_once:
            if at < self._timer.at:
                self._timer.arm(at)
        elif at < self._watch.at:
            self._watch.arm(at)

    # --- looks -----------------------------------------------------------------------------------

    def allowance(self, entity: Entity, period: int = NEVER) -> int:
        """Return how long an arrival at an entity may stay unnoticed while a callback computes."""
        if entity.is_eager():
            return 0
        deadline = self._pool.engine.relative_deadline(entity)
        if entity.callback is not None:  # each release counts
            deadline = min(period, deadline)
        return deadline // LOOK_PART

    def expect(self, entity: Entity) -> None:
        """Note that something may arrive at an entity from outside."""
        self._allowance = min(self._allowance, max(SOON_NS, self.allowance(entity)))

    def arm_look(self, now: int) -> None:
        """Set the time of the next look while callbacks run and no thread waits for events."""
        self.check.note(now)
        at = self._next_look(now)
        if at != self._watch.at:
            self._watch.arm(at)

    def _next_look(self, now: int) -> int:
        return min(self._agenda.latest, now + self._allowance)

    def arm_late_look(self, now: int, patience: int) -> None:
        """
        Set the time of a look in case that a short callback runs longer than expected.

        :param patience: how long what waits, or may come, may wait for it.
        """
        if self.check.entry:
            self.check.note(now)  # what was to be checked may have ended
        at = now + patience
        if self._agenda.latest < at:
            at = self._agenda.latest
        is_set_to = self._watch.at
        if at < is_set_to or is_set_to < now + SHORT_CALLBACK_NS:  # else it is good enough
            self._watch.arm(at)

    def has_looked(self, now: int) -> None:
        """Note that the time of a look has come."""
        if self._watch.at <= now:
            self._watch.at = NEVER

    # --- stops of the machine --------------------------------------------------------------------

    def _notice_stop(self, now: int, since: int) -> None:
        """
        Notice that no thread of the process ran since the timerfd was to expire.

        If no thread waited for the timerfd, because all ran callbacks, its delay proves nothing.
        """
        at, cpu = self._timer.at, process_time_ns()
        seen, used = self._seen
        self._seen = now, cpu
        if now - at >= STOP_NS and now - seen >= STOP_NS:
            waited = self._pool.waited_since(since) - self._offset
            late = now - max(at, seen, waited) - (cpu - used)
            if late >= STOP_NS:
                self._pool.engine.machine_stopped(now - late + self._offset, now + self._offset)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Who holds the interpreter now, and who gives it back since he does not need it.

Theory of operation
-------------------
Python's lock lets one thread compute at a time.  The core therefore starts a callback that holds
the interpreter only if nothing as urgent holds it (rule 11 of ``core.rules``).  Which callbacks
do is declared or learnt (``habits``).  Here

1.  executions are measured for that;
2.  while something is held back, a thread looks every ``LOOK_NS`` at the most urgent callback that
    holds the interpreter, and so does on the way who takes in something that arrives.  A look
    costs who computes a tenth of a millisecond.  So one that has never waited yet is looked at
    only if the spinning thread, which wakes every 20 ms, finds it twice in a row
    (``look_at_late``).
    If its CPU clock stands still though no other process has its CPU, it waits: for a lock, an
    event, a service.  It gives the interpreter back at once, so that nobody is held back for one
    that waits for him; where the lock was not free meanwhile it may have waited for that, and is
    looked at once more.  If it computes while the looking thread has the lock, it
    computes with the lock released (numpy, hashlib): it gives the interpreter back, too, and that
    is remembered.  At first that is tried, too, whenever anything arrives.
3.  while nothing is held back nobody looks, and nobody is woken: an alarm is set when something is
    held back for the first time, and called off when nothing is any more.

Between two threads that compute, Python switches every ``sys.getswitchinterval()``, 5 ms by
default; while an executor spins it is shorter, so that an arrival is seen sooner, and shorter
still where who computes is to pause for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import ctypes
import os
import sys
import threading
from time import monotonic_ns

from mddag_executor.live.alarm import Alarm
from mddag_executor.live.engine import Engine
from mddag_executor.live.habits import Habit, LOOK_NS, WAITS
from mddag_executor.live.preemption import Preemption
from mddag_executor.live.seat import Seat
from mddag_executor.live.thread_clock import ThreadClock
from mddag_executor.live.work import Work

SOON_NS = 100_000
IDLE_LOOKS = 2
LITTLE = 0.05
TRIAL_US = 30
"""For so long a looking thread keeps the lock, to see who computes without it."""
_LIBRARY = ctypes.PyDLL(None)   # which does not release the lock

SWITCH_INTERVAL_S = 0.001
PREEMPTING_INTERVAL_S = 0.00025


class Interpreter:
    """
    Measures who computes, and looks after who holds the interpreter while others wait for it.

    Its thread is started when something is held back for the first time.

    :param lock: that of the engine.
    :param seats: the seat of each worker.
    :param hand_out: called, under the lock, when somebody has given the interpreter back.
    :param preemption: has those pause that are overtaken; None: they do not.
    :ivar rings_at: when it is looked next; 0: never.
    :ivar looks_late: whether somebody calls ``look_at_late`` now and then.
    """

    def __init__(
        self, engine: Engine, lock: threading.Lock, seats: list[Seat],
        hand_out: Callable[[], None], preemption: Preemption | None = None,
    ) -> None:
        self._engine = engine
        self._preemption = preemption
        if preemption is not None and not preemption.reason:
            engine.preempts = True
        self._lock = lock
        self._seats = seats
        self._hand_out = hand_out
        # with one CPU nothing computes beside anything
        self._may_overlap = len(os.sched_getaffinity(0)) > 1
        self._alarm: Alarm | None = None  # with the thread, which closes it
        self.rings_at = 0
        self.looks_late = False
        self._thread: threading.Thread | None = None
        self._closed = False
        # whom to look at, when that was done last, and what he had computed then
        self._seen: tuple[Work | None, int, int] = (None, 0, 0)
        # who held it when it was looked late
        self._late: Work | None = None
        self._idle = 0

    # --- measuring -------------------------------------------------------------------------------

    def begins(self, seat: Seat, habit: Habit) -> None:
        """Measure, in its thread, a seat's execution that begins."""
        assert seat.cpu_clock is not None
        seat.others_before = self._computed_by_all() - seat.cpu_clock.computed()
        seat.reading = seat.cpu_clock.read(habit.computes_at_all)

    def ended(self, seat: Seat, habit: Habit, duration: int) -> None:
        """Learn, in its thread, from a seat's execution."""
        before, clock = seat.reading, seat.cpu_clock
        assert before is not None and clock is not None
        after = clock.read(before[1] > 0)
        beside = self._computed_by_all() - after[0] - seat.others_before
        habit.ran(duration, before, after, beside)

    def _computed_by_all(self) -> int:
        """Return how long the workers' threads have computed."""
        return sum([seat.cpu_clock.computed() for seat in self._seats
                    if seat.cpu_clock is not None])

    # --- looking ---------------------------------------------------------------------------------

    def look_after(self) -> None:
        """Look soon if anything is held back or pauses; the caller holds the lock."""
        if self._closed:
            return  # the alarm rings for the end, and is not to be set anew
        engine = self._engine
        pauses = self._preemption is not None and self._preemption.update([
            (work, seat) for work in engine.overtaken()
            if (seat := self._seat(work)) is not None])
        holder = engine.interpreter_holder() if any(engine.queues) or pauses else None
        if holder is None:
            self._seen = None, 0, 0
            if self.rings_at and self._alarm is not None:
                self.rings_at = 0
                self._alarm.start(0)
            return
        habit = holder.entity.habit
        if self._may_overlap and habit.is_to_be_learnt:
            seat = self._seat(holder)
            if (seat is not None and seat.cpu_clock is not None
                    and seat.thread is not threading.current_thread()):
                habit.was_released(self._computes_now(seat.cpu_clock))
        is_trusted = self.looks_late and habit.is_trusted and not pauses
        if holder is not self._seen[0]:
            if not is_trusted:
                self._idle = 0
                self._note(holder)
                self._watch(LOOK_NS)
        elif not self.rings_at:
            if not is_trusted:
                self._watch(LOOK_NS)
        elif monotonic_ns() - self._seen[1] >= LOOK_NS and not self._has_computed(holder):
            self._watch(SOON_NS)  # it was seen on the way

    def look_at_late(self) -> None:
        """Look at who has kept others from the interpreter since the last call of this."""
        engine = self._engine
        if not engine.has_waiting:
            self._late = None
            return
        with self._lock:
            holder = engine.interpreter_holder()
            if holder is not None and holder is self._late and not self.rings_at:
                self._idle = 0
                self._note(holder)
                self._watch(LOOK_NS)
            self._late = holder

    def _watch(self, ns: int) -> None:
        """Set the alarm for the next look."""
        if self._alarm is None:
            self._alarm = Alarm(LOOK_NS)
            self._thread = threading.Thread(
                target=self._look_on, args=(self._alarm,), daemon=True, name='mddag-interpreter')
            self._thread.start()
        self.rings_at = monotonic_ns() + ns
        self._alarm.start(ns)

    def close(self) -> None:
        """End the thread."""
        with self._lock:
            self._closed = True
            thread, alarm = self._thread, self._alarm
        if thread is not None and alarm is not None and thread is not threading.current_thread():
            alarm.ring()
            thread.join()

    def _look_on(self, alarm: Alarm) -> None:
        while True:
            alarm.wait()
            with self._lock:
                if self._closed:
                    break
                if self.rings_at:
                    free = monotonic_ns() - self.rings_at < sys.getswitchinterval() * 0.5e9
                    self.rings_at = 0
                    self._look(free)
                    self._hand_out()
        alarm.close()

    def _look(self, free: bool) -> None:
        """
        Take the interpreter from the most urgent holder if it does not need it.

        :param free: whether the lock was free.
        """
        holder = self._engine.interpreter_holder()
        if holder is None:
            return
        if holder is not self._seen[0]:
            self._idle = 0
            self._note(holder)
        elif not self._needs_it(holder, free):
            self._engine.stop_holding(holder)

    def _clock(self, work: Work) -> ThreadClock | None:
        """Return the CPU clock of the worker's thread in which an execution runs."""
        seat = self._seat(work)
        return None if seat is None else seat.cpu_clock

    def _seat(self, work: Work) -> Seat | None:
        seat = self._seats[work.worker] if work.worker < len(self._seats) else None
        return seat if seat is not None and seat.work is work else None

    def _note(self, work: Work) -> tuple[int, int]:
        """Return how long the last look was ago, and for how long it has computed since."""
        _, then, before = self._seen
        clock, now = self._clock(work), monotonic_ns()
        computed = clock.computed() if clock is not None else 0
        self._seen = work, now, computed
        return now - then, computed - before

    def _has_computed(self, work: Work) -> bool:
        """Return whether it has computed at all since the last look; else it may wait."""
        passed, computed = self._note(work)
        if computed < LITTLE * passed:
            return False
        self._idle = 0
        return True

    def _needs_it(self, work: Work, free: bool) -> bool:
        clock, habit = self._clock(work), work.entity.habit
        if clock is None:  # in an intake's thread, where it was expected to end at once
            return False
        if self._may_overlap and habit.is_to_be_tried() and habit.was_released(
                self._computes_now(clock)):
            return False
        if self._has_computed(work) or clock.is_runnable():
            return True  # or other processes have the CPUs
        # Where the lock was not free it may have waited for that alone.
        self._idle += IDLE_LOOKS if free else 1
        if self._idle < IDLE_LOOKS:
            return True
        habit.has_waited()
        return False

    @staticmethod
    def _computes_now(clock: ThreadClock) -> bool:
        """Return whether a thread computes though the calling one has the lock."""
        begin, before = monotonic_ns(), clock.computed()
        # It sleeps with the lock: the other thread may have been on the same CPU.
        _LIBRARY.usleep(TRIAL_US)
        return clock.computed() - before >= WAITS * (monotonic_ns() - begin)


_switching = threading.Lock()
_switchers = 0
_usual_interval = 0.0


@contextmanager
def short_switch_interval(preempts: bool) -> Iterator[None]:
    """Have Python's threads take turns more often while entered; nested and from any thread."""
    global _switchers, _usual_interval
    with _switching:
        if _switchers == 0:
            _usual_interval = sys.getswitchinterval()
        _switchers += 1
        sys.setswitchinterval(min(
            sys.getswitchinterval(), PREEMPTING_INTERVAL_S if preempts else SWITCH_INTERVAL_S))
    try:
        yield
    finally:
        with _switching:
            _switchers -= 1
            if _switchers == 0:
                sys.setswitchinterval(_usual_interval)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Who holds the interpreter now, and who gives it back since he does not need it.

Theory of operation
-------------------
Python's lock lets one thread compute at a time.  The core therefore starts a callback that holds
the interpreter only if nothing as urgent holds it (rule 11 of ``core.rules``).  Which callbacks
do is declared or learnt (``habits``).  Here

1.  executions are measured for that, and it is known about how long all have computed;
2.  while something is held back for more than a moment, a thread looks every ``LOOK_S`` at the
    most urgent callback that holds the interpreter.  If its CPU clock stands still though no other
    process has its CPU, it waits: for a lock, an event, a service.  It gives the interpreter back
    at once, so that nobody is held back for one that waits for him; where the lock was not free
    meanwhile it may have waited for that, and is given ``IDLE_LOOKS``.  If it computes and the
    looking thread gets the lock within half a switch interval, ``FREE_LOOKS`` times in a row, it
    computes with the lock released (numpy, hashlib): it gives the interpreter back, too, and that
    is remembered.

Between two threads that compute, Python switches every ``sys.getswitchinterval()``, 5 ms by
default; while an executor spins it is shorter, so that an arrival is seen sooner.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
import sys
import threading
from time import monotonic_ns, sleep

from mddag_executor.live.engine import Engine
from mddag_executor.live.habits import Habit, WAITS
from mddag_executor.live.seat import Seat
from mddag_executor.live.work import Work

LOOK_S = 0.002
QUIET_LOOKS = 3
GLANCE_S = 0.02
"""While nothing is held back for longer, it is looked whether anything is only so often."""
QUIET_GLANCES = 50
"""After so many glances at which nothing was held back nobody looks any more."""
FREE_LOOKS = 3
IDLE_LOOKS = 10

SWITCH_INTERVAL_S = 0.001


class Interpreter:
    """
    Measures who computes, and looks after who holds the interpreter while others wait for it.

    Its thread is started when something is held back for the first time.

    :param lock: that of the engine.
    :param seats: the seat of each worker.
    :param hand_out: called, under the lock, when somebody has given the interpreter back.
    """

    def __init__(
        self, engine: Engine, lock: threading.Lock, seats: list[Seat],
        hand_out: Callable[[], None],
    ) -> None:
        self._engine = engine
        self._lock = lock
        self._seats = seats
        self._hand_out = hand_out
        # what all that have ended computed, about
        self._computed_ns = 0
        self._looking = False
        self._wanted = threading.Event()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._seen: tuple[Work | None, int, int] = (None, 0, 0)
        self._free = 0
        self._idle = 0

    # --- measuring -------------------------------------------------------------------------------

    def begins(self, seat: Seat, habit: Habit) -> None:
        """Measure, in its thread, a seat's execution that begins."""
        assert seat.cpu_clock is not None
        seat.reading = seat.cpu_clock.read(habit.computes_at_all)
        seat.began_ns = seat.reading[0]
        seat.computed_before = self._computed_ns

    def ended(self, seat: Seat, habit: Habit, start: int, end: int) -> None:
        """Learn, in its thread, from a seat's execution."""
        before, clock = seat.reading, seat.cpu_clock
        if before is not None and clock is not None:
            after = clock.read(before[1] > 0)
            habit.ran(end - start, before, after, partial(self._computed_beside, seat, end))
            self._computed_ns += after[0] - before[0]
        elif habit.holds:
            self._computed_ns += end - start

    def _computed_beside(self, seat: Seat, now: int) -> int:
        """Return how long others have computed since a seat's execution began; about."""
        computed = self._computed_ns - seat.computed_before
        for other in self._seats:
            work, clock = other.work, other.cpu_clock
            if other is seat or work is None or clock is None:
                continue
            if other.reading is not None:
                computed += clock.computed() - other.began_ns
            elif work.entity.habit.holds:
                computed += now - other.began_ns
        return computed

    # --- looking ---------------------------------------------------------------------------------

    def watch(self) -> None:
        """Look until nothing is held back any more; the caller holds the lock."""
        if self._looking:
            return
        self._looking = True
        if self._thread is None and not self._closed:
            self._thread = threading.Thread(
                target=self._look_on, daemon=True, name='mddag-interpreter')
            self._thread.start()
        self._wanted.set()

    def close(self) -> None:
        """End the thread."""
        self._closed = True
        self._wanted.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def _look_on(self) -> None:
        while not self._closed:
            self._wanted.wait()
            self._wanted.clear()
            pause, quiet = GLANCE_S, 0
            while self._looking and not self._closed:
                due = monotonic_ns() + int(pause * 1e9)
                sleep(pause)
                late = monotonic_ns() - due
                with self._lock:
                    if self._engine.holds_back:
                        if pause == LOOK_S:
                            self._look(due + late, late)
                        pause, quiet = LOOK_S, 0
                    else:
                        quiet += 1
                        pause = LOOK_S if quiet < QUIET_LOOKS and pause == LOOK_S else GLANCE_S
                        self._looking = quiet < QUIET_GLANCES

    def _look(self, now: int, late: int) -> None:
        """Take the interpreter from the most urgent holder if it does not need it."""
        x, worker = self._engine.interpreter_holder()
        if x < 0:
            return
        seat = self._seats[worker] if worker < len(self._seats) else None
        if seat is not None and seat.work is not None and seat.work.x == x:
            needs = self._needs_it(seat, seat.work, now, late)
        else:
            needs = False  # it runs in an intake's thread, and was expected to end at once
        if not needs:
            self._engine.stop_holding(x)
            self._hand_out()

    def _needs_it(self, seat: Seat, work: Work, now: int, late: int) -> bool:
        if seat.cpu_clock is None:
            return True  # its thread has just been started
        computed = seat.cpu_clock.computed()
        seen, since, before = self._seen
        self._seen = work, now, computed
        if seen is not work:
            self._free = self._idle = 0
            return True
        free = late < sys.getswitchinterval() * 0.5e9
        if computed - before >= WAITS * (now - since):
            self._idle = 0
            self._free = self._free + 1 if work.entity.habit.was_free(free) else 0
            return self._free < FREE_LOOKS
        if seat.cpu_clock.is_runnable():  # other processes have the CPUs
            return True
        # Where the lock was not free it may wait for that alone.
        self._idle += IDLE_LOOKS if free else 1
        return self._idle < IDLE_LOOKS


_switching = threading.Lock()
_switchers = 0
_usual_interval = 0.0


@contextmanager
def short_switch_interval() -> Iterator[None]:
    """Have Python's threads take turns more often while entered; nested and from any thread."""
    global _switchers, _usual_interval
    with _switching:
        if _switchers == 0:
            _usual_interval = sys.getswitchinterval()
            sys.setswitchinterval(min(_usual_interval, SWITCH_INTERVAL_S))
        _switchers += 1
    try:
        yield
    finally:
        with _switching:
            _switchers -= 1
            if _switchers == 0:
                sys.setswitchinterval(_usual_interval)

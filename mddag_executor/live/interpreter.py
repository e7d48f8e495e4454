# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which callbacks hold the interpreter: declared, or learnt from how they run.

Theory of operation
-------------------
Python's lock lets one thread compute at a time.  The core therefore starts a callback that holds
the interpreter only if nothing as urgent holds it (rule 11 of ``core.rules``); here is found out
which callbacks those are.  A declaration may say it (``holds_interpreter``); else

1.  **After an execution** its CPU time is compared with its duration; after the first executions
    for a sample of them only, because reading the clocks costs some microseconds.  Left out of the
    duration is what other executions computed meanwhile, and what other processes took: if two
    callbacks fight for the lock, each computes for half of the time, but for all of the time that
    the other one leaves.  A callback that computed for over four fifths of that time, lately,
    holds the interpreter; one that computed for less than half of it does not.  Executions of less
    than ``SHORT_NS`` of CPU are not worth an order.
2.  **While something is held back** for more than a moment, a thread looks every ``LOOK_S`` at the
    most urgent callback that holds the interpreter.  If its CPU clock stands still though no other
    process has its CPU, it waits: for a lock, an event, a service.  It gives the interpreter back
    at once, so that nobody is held back for one that waits for him; where the lock was not free
    meanwhile it may have waited for that, and is given ``IDLE_LOOKS``.  If it computes and the
    looking thread gets the lock within half a switch interval, ``FREE_LOOKS`` times in a row, it
    computes with the lock released (numpy, hashlib): it gives the interpreter back, too, and that
    is remembered.  One of ``TRY_EVERY`` measured executions is looked at again.

Between two threads that compute, Python switches every ``sys.getswitchinterval()``, 5 ms by
default; while an executor spins it is shorter, so that an arrival is seen sooner.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import sys
import threading
from time import (
    clock_gettime_ns,
    monotonic_ns,
    pthread_getcpuclockid,
    sleep,
    thread_time_ns,
)
from typing import Any, Protocol

from mddag_executor.core import Scheduler
from mddag_executor.core.state import N_HOLDING

COMPUTES = 0.8
WAITS = 0.5
SHORT_NS = 20_000
LATELY = 8
"""The last execution counts for one in so many."""
FIRST = 16
SAMPLE = 8
"""After the first executions one in so many is measured, and more where it behaves otherwise."""

LOOK_S = 0.002
QUIET_LOOKS = 3
GLANCE_S = 0.02
"""While nothing is held back for longer, it is looked whether anything is only so often."""
QUIET_GLANCES = 50
"""After so many glances at which nothing was held back nobody looks any more."""
FREE_LOOKS = 3
IDLE_LOOKS = 10
RELEASED = 0.6
TRY_EVERY = 8

SWITCH_INTERVAL_S = 0.001


Reading = tuple[int, int]
"""CPU time of a thread, and how long it waited for a CPU, ns."""


class Habit:
    """
    Whether one callback holds the interpreter while it runs.

    :param declared: what the declaration says, or None: it is learnt.
    :ivar holds: 1 or 0, for its next execution.
    """

    __slots__ = (
        'holds', '_declared', '_computed_ns', '_own_ns', '_released', '_passed', '_runs', '_close')

    def __init__(self, declared: bool | None = None) -> None:
        self.holds = int(declared or False)
        self._declared = declared is not None
        self._computed_ns = 0.0
        self._own_ns = 0.0
        self._released = 0.0
        self._passed = 0
        self._runs = 0
        self._close = FIRST

    def is_to_be_measured(self) -> bool:
        """Return whether to measure the execution that begins now."""
        if self._declared:
            return False
        if self._close > 0:
            self._close -= 1
            return True
        self._runs += 1
        return self._runs % SAMPLE == 0

    @property
    def computes_at_all(self) -> bool:
        """Return whether it may be one that holds the interpreter."""
        return self._computed_ns >= max(SHORT_NS / 2, self._own_ns / 8)

    def ran(
        self, duration: int, before: Reading, after: Reading, beside: Callable[[], int],
    ) -> None:
        """
        Learn from an execution.

        :param duration: how long it took, ns.
        :param before: what its thread's clock read when it began; ``after``: when it ended.
        :param beside: returns how long other executions computed meanwhile, ns.
        """
        computed = after[0] - before[0]
        own = duration - (after[1] - before[1])
        if SHORT_NS <= computed < COMPUTES * own:
            own -= beside()
        own = max(computed, own)
        if self._own_ns == 0.0:
            self._computed_ns, self._own_ns = computed, own
        else:
            self._computed_ns += (computed - self._computed_ns) / LATELY
            self._own_ns += (own - self._own_ns) / LATELY
        share, least_ns = (WAITS, SHORT_NS / 2) if self.holds else (COMPUTES, SHORT_NS)
        if (computed >= max(share * own, least_ns)) != self.holds:
            self._close = LATELY  # it may have changed
        self.holds = int(self._computed_ns >= max(share * self._own_ns, least_ns))
        if self._released >= RELEASED:
            self._passed += 1
            self.holds &= self._passed % TRY_EVERY == 0

    def was_free(self, free: bool) -> bool:
        """Learn whether the lock was free while it computed; False where a declaration knows."""
        if self._declared:
            return False
        self._released += (free - self._released) / LATELY
        if self._released >= RELEASED:
            self.holds = 0
        return free


class ThreadClock:
    """
    How long the thread that makes it has computed, and has waited for a CPU.

    It is to be closed when that thread ends.
    """

    def __init__(self) -> None:
        self._clock = pthread_getcpuclockid(threading.get_ident())
        self._folder = Path(f'/proc/self/task/{threading.get_native_id()}')  # proc(5)
        self._file = -1
        try:  # not everywhere
            self._file = os.open(self._folder / 'schedstat', os.O_RDONLY)
        except OSError:
            pass

    def computed(self) -> int:
        """Return its CPU time, ns; from any thread."""
        return clock_gettime_ns(self._clock)

    def read(self, closely: bool) -> Reading:
        """Return what it reads now, in the thread itself; 0 for waiting, unless ``closely``."""
        waited = 0
        if closely and self._file >= 0:
            waited = int(os.pread(self._file, 64, 0).split()[1])
        return thread_time_ns(), waited

    def is_runnable(self) -> bool:
        """Return whether it runs or waits for a CPU, and for nothing else; from any thread."""
        try:
            return (self._folder / 'stat').read_bytes().rpartition(b')')[2].split()[0] == b'R'
        except (OSError, IndexError):
            return False

    def close(self) -> None:
        """Close what it reads."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


class Place(Protocol):
    """A worker's place in the pool: what runs there, and the clock of its thread."""

    clock: ThreadClock | None
    work: Any


class Overseer:
    """
    Looks after who holds the interpreter while others are held back for it.

    Its thread is started when something is held back for the first time.

    :param lock: that of the scheduler.
    :param place_of: returns the place of a worker, None when it is not one of the pool's threads.
    :param dispatch: called, under the lock, when somebody has given the interpreter back.
    """

    def __init__(
        self, scheduler: Scheduler, lock: threading.Lock, place_of: Callable[[int], Place | None],
        dispatch: Callable[[], None],
    ) -> None:
        self.looking = False
        self._scheduler = scheduler
        self._lock = lock
        self._place_of = place_of
        self._dispatch = dispatch
        self._wanted = threading.Event()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._seen: tuple[Any, int, int] = (None, 0, 0)
        self._free = 0
        self._idle = 0

    def begin(self) -> None:
        """Begin to look, until nothing is held back any more; the caller holds the lock."""
        self.looking = True
        if self._thread is None and not self._closed:
            self._thread = threading.Thread(
                target=self._look_on, daemon=True, name='mddag-overseer')
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
            while self.looking and not self._closed:
                due = monotonic_ns() + int(pause * 1e9)
                sleep(pause)
                late = monotonic_ns() - due
                with self._lock:
                    if self._scheduler.state.held_back:
                        if pause == LOOK_S:
                            self._look(due + late, late)
                        pause, quiet = LOOK_S, 0
                    else:
                        quiet += 1
                        pause = LOOK_S if quiet < QUIET_LOOKS and pause == LOOK_S else GLANCE_S
                        self.looking = quiet < QUIET_GLANCES

    def _look(self, now: int, late: int) -> None:
        """Take the interpreter from the most urgent holder if it does not need it."""
        state = self._scheduler.state
        if state.scalars[N_HOLDING] == 0:
            return
        holder = min((x for x in state.worker_x if x >= 0 and state.x_holds[x]),
                     key=lambda x: state.x_key[x])
        place = self._place_of(state.x_worker[holder])
        if place is None or place.clock is None:
            return
        computed = place.clock.computed()
        seen, since, before = self._seen
        self._seen = place.work, now, computed
        if seen is not place.work:
            self._free = self._idle = 0
            return
        free = late < sys.getswitchinterval() * 0.5e9
        if computed - before >= WAITS * (now - since):
            self._idle = 0
            self._free = self._free + 1 if place.work.entry.habit.was_free(free) else 0
            needs = self._free < FREE_LOOKS
        elif place.clock.is_runnable():  # other processes have the CPUs
            needs = True
        else:
            # Where the lock was not free it may wait for that alone.
            self._idle += IDLE_LOOKS if free else 1
            needs = self._idle < IDLE_LOOKS
        if not needs:
            self._scheduler.stop_holding(holder)
            self._dispatch()


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

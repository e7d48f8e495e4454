# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether a callback holds the GIL: declared, or measured at each execution.

Theory of operation
-------------------
Python's global interpreter lock (GIL) lets one thread compute at a time.  The core therefore
starts a callback that holds the GIL only if no callback as urgent holds it (rule 10 of
``core.rules``).

1.  *Measured.*  Of an execution, three times are measured: its duration (wall), the CPU time of
    its thread (own), and the CPU time of all other threads of the process (others).  If own is
    over four fifths of wall, the callback holds the GIL.  If own is less than half of the time in
    which no other thread computed, the callback waits for something else and does not hold the
    GIL, unless it was preempted on its CPU and may have waited for that.  Anything between is
    inconclusive.  Each execution is measured until the habit is known.  After that one in
    ``SELDOM`` short executions is, one in ``LATELY`` of a callback that waits for long, and each
    one of a callback that computes for long or has just behaved differently.
2.  *Unknown.*  After inconclusive first executions, the next ones are treated as if they held the
    GIL: then no other callback computes, and the measurement is conclusive.  Later, one execution
    is treated so (a trial) after every ``LATELY`` inconclusive ones.
3.  *A callback that computes with the GIL released* (numpy, hashlib) is measured as if it held it.
    Declare ``holds_interpreter: false`` to run several such callbacks in parallel.
4.  *A callback that waits though it usually computes* would keep others from the GIL.
    ``GilCheck`` checks its thread while others wait for the GIL, first after ``CHECK_NS``, or less
    if what waits is urgent, and then at growing intervals.  If the thread waits, the execution
    gives the GIL up.
5.  *Waiting, not starving.* A thread that has not computed since the last check may have waited
    for an event, for the GIL, or for a CPU. It waited for an event if it got no CPU for
    ``CHECK_NS`` and is asleep, because a thread that waits for the GIL wakes up every
    ``SWITCH_INTERVAL_S``; later if the CPUs are busy (``LONG_SLEEP_NS``). It also did if, for a
    quarter of the time, it was not ready to run and no other thread computed. But if it got a CPU
    in less than ``CHECK_NS``, it may have been woken up for the GIL, late, as virtual CPUs are;
    and if the CPUs are busy with other programs, the thread that has the GIL may not have computed
    because it waited for a CPU (``BUSY``). The threads that check compute as well, for as long as
    the shortest interval. If the thread got no CPU meanwhile, they do not count: it would have got
    the GIL between two checks, when they gave that away. Anything else is unclear, and counts only
    after ``LATELY`` checks, so that the GIL is not withheld from others for ever.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from contextlib import contextmanager
import ctypes
import os
from resource import getrusage, RUSAGE_THREAD
import sys
import threading
from time import (
    clock_gettime_ns,
    monotonic_ns,
    process_time_ns,
    pthread_getcpuclockid,
    thread_time_ns,
)
from typing import NamedTuple

from mddag_executor.core import NEVER

COMPUTES = 0.8
"""A callback that computes for this fraction of its time holds the GIL."""
WAITS = 0.5
"""A callback that computes for less than this fraction of its available time has waited."""
FIRST_RUNS = 3
"""The first executions (loading, JIT, page faults) say little about the usual time."""
SHORT_NS = 2_000
"""A callback that computes for less than this is never inconclusive."""
LATELY = 8
"""
Averages cover about this many executions.

After as many inconclusive executions in a row, one runs as if it held the GIL; after as many
unclear checks in a row, about 100 ms, a thread is treated as waiting.
"""
SELDOM = 32
"""One in this many short executions is measured (8 us) if the callback's GIL habit is known."""

CHECK_NS = 2_000_000
LAST_CHECK_NS = 10 * CHECK_NS
CHECK_PART = 4
"""
The interval between checks grows from the first to the last; short callbacks use the last.

The first is shorter if what waits is urgent: this part of ``Interpreter.patience``.  With half of
it, the successor of a callback that waits after its publication started 0.1 ms later.
"""

BUSY = 10
"""
The CPUs are busy if a thread that is checked was ready for a tenth of the time without one.

That is the time since the first check of its execution: between two checks, a thread that waits
for the GIL may have been asleep all the time.
"""

LATE_CHECK_NS = 2 * CHECK_NS
"""A check that comes later than planned by this much shows that the CPUs are busy."""
LONG_SLEEP_NS = 5 * CHECK_NS
"""
How long a thread that waits for an event is asleep, if the CPUs are busy; else ``CHECK_NS``.

At a load of 20 on two virtual CPUs, threads that waited for the GIL woke up to 2.3 ms late.
"""

SWITCH_INTERVAL_S = 0.001
"""
Python's switch interval while an executor spins.

With the default of 5 ms, an arrival during a computing callback is known 5.4 ms late; with 1 ms,
1.3 ms late.  100 ms of computing take the same time with both.
"""


class GilHabit:
    """
    Whether one callback holds the GIL while it runs.

    :param declared: the declared value; None: it is measured.
    :ivar holds: 1 or 0, for its next execution; ``computes``: the same, unless that is a trial.
    :ivar mean_ns: recent average of its executions' CPU time.
    :ivar needs_ns: how long it takes when nothing disturbs it: ``mean_ns`` or, unless it computes,
        the least duration of recent executions if that is longer.  The first ``FIRST_RUNS`` do not
        count; -1: there was no other one yet.
    :ivar is_known: whether ``holds`` is declared, or has been measured.
    :ivar rests: how many of its next executions need not be measured, if it is positive.
    """

    __slots__ = ('holds', 'computes', 'mean_ns', 'needs_ns', 'is_known', 'is_declared', 'rests',
                 'share', '_least', '_first', '_unclear', '_runs', '_is_trial', '_has_waited')

    def __init__(self, declared: bool | None = None) -> None:
        self.is_declared = self.is_known = declared is not None
        self.holds = self.computes = int(declared or False)
        self.mean_ns = self._least = 0
        self.needs_ns = -1
        self._first = FIRST_RUNS
        self.rests = 0
        self.share: float | None = None if declared is None else float(declared)
        self._unclear = 0
        self._runs = 0
        self._is_trial = False
        # whether it is known to wait, and has when it was last measured
        self._has_waited = False

    def took(self, own: int, undisturbed: int) -> None:
        """
        Update the usual times.

        :param own: CPU time of an execution, ns.
        :param undisturbed: at most how long it would have taken if nothing had disturbed it, ns.
        """
        counts = self._first == 0
        if not counts:
            self._first -= 1
        elif self.needs_ns < 0:
            self._runs = 0  # begin again, without the first ones
        runs = self._runs = min(self._runs + 1, LATELY)
        self.mean_ns += (own - self.mean_ns) // runs
        if runs == 1:
            self._least = undisturbed
        else:
            self._note_duration(undisturbed)
        if counts:
            self.needs_ns = self.mean_ns if self.computes else max(
                self.mean_ns, self._least)

    def learn(self, wall: int, own: int, others: int, starved: bool = False) -> None:
        """
        Update whether it holds the GIL from the execution that was last given to ``took``.

        :param wall: its duration, ns.
        :param own: CPU time of its thread, ns.
        :param others: CPU time of all other threads of the process meanwhile, ns.
        :param starved: whether another thread preempted it on its CPU meanwhile.
        """
        if not self.is_declared:
            self._learn(wall, own, others, starved)
        self._has_waited = not self.computes and own < WAITS * (wall - others)
        self.rests = 0
        if self.is_known and not self._is_trial and self.needs_ns >= 0:
            self.rests = (SELDOM if self._runs == LATELY else LATELY) - 1

    def rest_less(self) -> None:
        """Let most of its next executions be measured, as the last one was long."""
        self.rests = min(self.rests, LATELY - 1) if self._has_waited else 0

    def waited(self, undisturbed: int) -> None:
        """
        Update the usual times after a long execution of which only the duration was measured.

        :param undisturbed: see ``took``.
        """
        if self._has_waited:
            self._note_duration(undisturbed)
            self.needs_ns = max(self.mean_ns, self._least)

    def _note_duration(self, undisturbed: int) -> None:
        """Update the least duration, which is forgotten slowly."""
        self._least = min(undisturbed, self._least + self._least // SELDOM + 1)

    def _learn(self, wall: int, own: int, others: int, starved: bool) -> None:
        usual = 0 if self._is_trial else self.holds
        self._is_trial = False
        if own >= COMPUTES * wall:
            part = own / max(1, wall)
        else:
            had = max(own, wall - others)
            if own >= SHORT_NS and (starved or own >= WAITS * had):
                self._unclear += 1
                if self.share is None:
                    self.holds = 1
                elif self._unclear >= LATELY:
                    self._unclear = 0
                    self._is_trial = not usual
                    self.holds = 1
                else:
                    self.holds = usual
                return
            part = own / max(1, had)
        self._unclear = 0
        share = self.share
        self.share = part if share is None else share + (part - share) / self._runs
        self.is_known = True
        self.holds = self.computes = int(self.share >= (WAITS if usual else COMPUTES))


class Measurement:
    """
    The CPU times during an execution; they update the ``habit`` at the end, unless it rests.

    The time between ``pause`` and ``resume``, while it waits without a worker, does not count.

    :ivar is_complete: whether it updates the habit.
    """

    __slots__ = ('_habit', '_process', '_preempted', '_own', '_start', '_sums', 'is_complete')

    def __init__(self, habit: GilHabit) -> None:
        self._habit = habit
        # other threads may change the habit meanwhile, so it is asked once
        self.is_complete = habit.rests < 1
        self._sums: list[int] | None = [0, 0, 0] if self.is_complete else None
        self._own = 0
        self._process = self._preempted = self._start = 0
        self.resume()

    def resume(self) -> None:
        """Begin to measure again."""
        if self._sums is not None:
            self._start, self._process = monotonic_ns(), process_time_ns()
            self._preempted = times_preempted()
        self._own -= thread_time_ns()

    def pause(self) -> None:
        """Measure nothing until ``resume``."""
        self._own += thread_time_ns()
        if self._sums is not None:
            self._sums[0] += monotonic_ns() - self._start
            self._sums[1] += process_time_ns() - self._process
            self._sums[2] += times_preempted() - self._preempted

    def end(self) -> int:
        """Return the CPU time of the calling thread, ns."""
        self.pause()
        own = self._own
        if self._sums is None:
            self._habit.rests -= 1
        else:
            wall, process, preempted = self._sums
            self._habit.took(own, wall)
            self._habit.learn(wall, own, process - own, preempted > 0)
        return own


class Schedule(NamedTuple):
    """
    The kernel's scheduling data of a thread.

    :ivar delay_ns: how long it was ready to run without a CPU; 0 if unknown.
    :ivar slices: how often it got a CPU; -1 if unknown.
    """

    delay_ns: int
    slices: int


_libc = ctypes.PyDLL(None)  # none of the calls below blocks, so the GIL is kept
_libc.read.restype = ctypes.c_ssize_t


def _read(path: str) -> bytes:
    """Return the beginning of a file of procfs; empty if there is no such file."""
    file = _libc.open(path.encode(), os.O_RDONLY | os.O_CLOEXEC)
    if file < 0:
        return b''
    buffer = ctypes.create_string_buffer(256)
    size = _libc.read(file, buffer, len(buffer))
    _libc.close(file)
    return buffer.raw[:max(0, size)]


def schedule_of(tid: int) -> Schedule:
    """Return the scheduling data of a thread of this process, by its native id."""
    figures = _read(f'/proc/self/task/{tid}/schedstat').split()
    if len(figures) != 3:
        return Schedule(0, -1)
    return Schedule(int(figures[1]), int(figures[2]))


def is_asleep(tid: int) -> bool:
    """Return whether a thread of this process neither runs nor is ready to run."""
    # the kernel needs longer to write this file than the one of ``schedule_of``
    return _read(f'/proc/self/task/{tid}/stat').rpartition(b') ')[2][:1] in b'SD'


def cpu_ns(ident: int) -> int:
    """Return the CPU time of a thread, ns."""
    return clock_gettime_ns(pthread_getcpuclockid(ident))


class _Reading(NamedTuple):
    at: int
    own: int
    process: int
    schedule: Schedule
    resting: Mapping[Hashable, int]

    def others_since(self, last: _Reading) -> int:
        """Return for how long other threads, but those that check, have computed, ns."""
        others = (self.process - self.own) - (last.process - last.own)
        if self.schedule.slices == last.schedule.slices >= 0:
            others -= sum(
                used - last.resting[key] for key, used in self.resting.items()
                if key in last.resting)
        return max(0, others)


_NONE: Mapping[Hashable, int] = {}


class GilCheck:
    """
    Finds out whether an execution that holds the GIL computes.

    :ivar at: when to check next, monotonic ns; NEVER: never.
    :ivar subject: the execution to check.
    """

    __slots__ = ('at', 'subject', '_step', '_first', '_last', '_unclear', '_observed', '_delayed')

    def __init__(self) -> None:
        self.at = NEVER
        self.subject: object = None
        self._step = self._first = 0
        # for how long it has been observed, and was ready to run without a CPU meanwhile
        self._observed = self._delayed = 0
        self._last: _Reading | None = None
        self._unclear = 0

    def begin(self, subject: object, now: int, after: int, step: int) -> None:
        """
        Start checking an execution, unless it is being checked already as soon.

        :param after: time until the first check, ns; ``step``: from that to the second one.
        """
        if self.subject is not subject:
            self._observed = self._delayed = 0
        if self.subject is not subject or after < self._step:
            self._first = step
            self.subject = subject
            self._step = after
            self._last = None
            self._unclear = 0
            self.at = now + after
            if after >= LAST_CHECK_NS:
                # on a grid, so that several short callbacks do not each set the timer again
                self.at = self.at // CHECK_NS * CHECK_NS + CHECK_NS

    def has_begun(self, subject: object) -> bool:
        """Return whether there is a first reading of an execution."""
        return self.subject is subject and self._last is not None

    def end(self) -> None:
        """Stop checking."""
        self.subject = None
        self.at = NEVER

    def waits(
        self, ident: int, tid: int, now: int, resting: Mapping[Hashable, int] = _NONE
    ) -> bool:
        """
        Return whether the thread has waited for anything but the GIL since the last check.

        :param ident: the thread's id in Python; ``tid``: its native id.
        :param now: monotonic ns.
        :param resting: the CPU times of the threads that only check and wait, ns; the key of each
            changes when it has run anything else.
        """
        last, late = self._last, now - self.at
        new = self._last = _Reading(
            now, cpu_ns(ident), process_time_ns(), schedule_of(tid), resting)
        self._step = self._first if last is None else min(2 * self._step, LAST_CHECK_NS)
        self.at = now + self._step
        if last is None:
            return False
        passed, own = now - last.at, new.own - last.own
        delayed = new.schedule.delay_ns - last.schedule.delay_ns
        self._observed += passed
        is_late = late >= LATE_CHECK_NS
        self._delayed += delayed + late * is_late
        if 20 * own >= passed:  # it computes for at least 5 % of the time
            self._unclear = 0
            return False
        if is_asleep(tid):
            is_busy = BUSY * self._delayed >= self._observed
            if passed >= (LONG_SLEEP_NS if is_busy else CHECK_NS) and not is_late and (
                    new.schedule.slices == last.schedule.slices >= 0):
                return True
            others = new.others_since(last)
            has_run = new.schedule.slices != last.schedule.slices
            if not is_busy and (passed >= CHECK_NS or not has_run) and (
                    4 * (passed - others - delayed) >= passed):
                return True
        self._unclear += 1
        return self._unclear >= LATELY


def times_preempted() -> int:
    """Return how often the kernel has preempted the calling thread."""
    return getrusage(RUSAGE_THREAD).ru_nivcsw


_lock = threading.Lock()
_spinning = 0
_usual_interval = 0.0


@contextmanager
def short_switch_interval() -> Iterator[None]:
    """Shorten Python's switch interval while entered; nested and from any thread."""
    global _spinning, _usual_interval
    with _lock:
        if _spinning == 0:
            _usual_interval = sys.getswitchinterval()
            sys.setswitchinterval(min(_usual_interval, SWITCH_INTERVAL_S))
        _spinning += 1
    try:
        yield
    finally:
        with _lock:
            _spinning -= 1
            if _spinning == 0:
                sys.setswitchinterval(_usual_interval)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Who holds the GIL: declared, or measured at each execution.

Theory of operation
-------------------
Python's global interpreter lock lets one thread compute at a time.  The core therefore starts a
callback that holds the GIL only if nothing as urgent holds it (rule 11 of ``core.rules``).

1.  *Measured.*  An execution takes some time (wall), its thread computes for a part of it (own),
    and the other threads of the process compute meanwhile (others).  If it computed for over four
    fifths of its time, it holds the GIL.  If it computed for less than half of the time in which
    no other thread computed, it waits for something else than the GIL, and does not hold it;
    unless a CPU was taken away from it, so that it may have waited for that.  Anything between
    says nothing.
2.  *Unknown.*  If the first executions say nothing, the next ones are treated as if they held
    the GIL: no other one computes then, which shows what they do.  Later, after every
    ``UNCLEAR_RUNS`` executions that said nothing, one execution is treated so (a trial).
3.  *A callback that computes with the GIL released* (numpy, hashlib) looks as if it held it.
    Declare ``holds_interpreter: false`` to have several of these run in parallel.
4.  *A callback that waits though it usually computes* would keep others from the GIL.
    ``GilCheck`` checks its thread, first after ``FIRST_CHECK_NS`` and then ever more seldom, but
    only while something waits for the GIL.  If the thread waits, the execution gives the GIL back.
5.  *Waiting, not starving.*  A thread that has not computed since the last check may have waited
    for something, for the GIL, or for a CPU.  It waited for something if it got no CPU at all and
    is asleep: a thread that waits for the GIL wakes up every ``SWITCH_INTERVAL_S``.  It also did
    if for half of the time it was not ready to run and no other thread computed, which it could
    have waited for.  Anything else is unclear, and counts only after ``UNCLEAR_CHECKS`` times, so
    that nothing is kept from the GIL for ever.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import ctypes
import os
from resource import getrusage, RUSAGE_THREAD
import sys
import threading
from time import clock_gettime_ns, process_time_ns, pthread_getcpuclockid
from typing import NamedTuple

COMPUTES = 0.8
"""A callback that computes for this part of its time holds the GIL."""
WAITS = 0.5
"""A callback that computes for less than this part of the time it had waits for something else."""
SHORT_NS = 2_000
"""A callback that usually computes for less than half of this is not worth an order."""
LATELY = 8
"""An average is over about so many executions; one of so many short ones is measured."""
UNCLEAR_RUNS = 8
"""After so many executions that said nothing, one runs as if it held the GIL."""

FIRST_CHECK_NS = 2_000_000
LAST_CHECK_NS = 20_000_000
"""The time between two checks grows from the first to the last; a brief callback begins there."""
IDLE_SHARE = 0.05
"""A thread that computed for this part of the time since the last check computes."""
UNCLEAR_CHECKS = 8
"""After so many unclear checks in a row, about 100 ms, a thread is treated as one that waits."""

SWITCH_INTERVAL_S = 0.001
"""
Python's switch interval while an executor spins.

With 5 ms, the default, an arrival beside a computing callback is known 5.4 ms late, with 1 ms
1.3 ms late, and 100 ms of computing take the same time.
"""


class GilHabit:
    """
    Whether one callback holds the GIL while it runs.

    :param declared: what the declaration says; None: it is measured.
    :ivar holds: 1 or 0, for its next execution.
    :ivar mean_ns: for how long its executions compute, lately.
    :ivar is_known: whether ``holds`` is declared, or has been measured.
    :ivar rests: how many of its next executions need not be measured.
    """

    __slots__ = ('holds', 'mean_ns', 'is_known', 'is_declared', 'rests', 'share',
                 '_unclear', '_runs', '_is_trial')

    def __init__(self, declared: bool | None = None) -> None:
        self.is_declared = self.is_known = declared is not None
        self.holds = int(declared or False)
        self.mean_ns = 0
        self.rests = 0
        self.share: float | None = None if declared is None else float(declared)
        self._unclear = 0
        self._runs = 0
        self._is_trial = False

    def ran(self, wall: int, own: int, others: int, starved: bool = False) -> None:
        """
        Learn from an execution that was measured.

        :param wall: how long it took, ns.
        :param own: for how long its thread computed, ns.
        :param others: for how long all other threads of the process computed meanwhile, ns.
        :param starved: whether another thread took the CPU away from it meanwhile.
        """
        runs = self._runs = min(self._runs + 1, LATELY)
        self.mean_ns += (own - self.mean_ns) // runs
        if not self.is_declared:
            self._learn(wall, own, others, starved, runs)
        self.rests = LATELY - 1 if self.is_known and not self._is_trial else 0

    def _learn(self, wall: int, own: int, others: int, starved: bool, runs: int) -> None:
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
                elif self._unclear >= UNCLEAR_RUNS:
                    self._unclear = 0
                    self._is_trial = not usual
                    self.holds = 1
                else:
                    self.holds = usual
                return
            part = own / max(1, had)
        self._unclear = 0
        share = self.share
        self.share = part if share is None else share + (part - share) / runs
        self.is_known = True
        least, short = (WAITS, SHORT_NS // 2) if usual else (COMPUTES, 2 * SHORT_NS)
        self.holds = int(self.share >= least and self.mean_ns >= short)


class Schedule(NamedTuple):
    """
    What the kernel says of a thread.

    :ivar delay_ns: for how long it was ready to run and got no CPU; 0 if that is not known.
    :ivar slices: how often it got a CPU; -1 if that is not known.
    :ivar is_asleep: whether it neither runs nor is ready to run.
    """

    delay_ns: int
    slices: int
    is_asleep: bool


_libc = ctypes.PyDLL(None)  # none of the calls below blocks, so the GIL is kept
_libc.read.restype = ctypes.c_ssize_t


def _read(path: str) -> bytes:
    """Return the beginning of a file of procfs; nothing if there is none."""
    file = _libc.open(path.encode(), os.O_RDONLY | os.O_CLOEXEC)
    if file < 0:
        return b''
    buffer = ctypes.create_string_buffer(256)
    size = _libc.read(file, buffer, len(buffer))
    _libc.close(file)
    return buffer.raw[:max(0, size)]


def schedule_of(tid: int) -> Schedule:
    """Return what the kernel says of a thread of this process, by its native id."""
    folder = f'/proc/self/task/{tid}'
    figures = _read(f'{folder}/schedstat').split()
    state = _read(f'{folder}/stat').rpartition(b') ')[2][:1]
    if len(figures) != 3 or not state:
        return Schedule(0, -1, True)
    return Schedule(int(figures[1]), int(figures[2]), state in b'SD')


def cpu_ns(ident: int) -> int:
    """Return for how long a thread has computed."""
    return clock_gettime_ns(pthread_getcpuclockid(ident))


class _Reading(NamedTuple):
    at: int
    own: int
    process: int
    schedule: Schedule


class GilCheck:
    """
    Finds out whether an execution that holds the GIL computes.

    :ivar at: when to check next, monotonic ns; 0: not.
    """

    __slots__ = ('at', '_subject', '_step', '_last', '_unclear')

    def __init__(self) -> None:
        self.at = 0
        self._subject: object = None
        self._step = 0
        self._last: _Reading | None = None
        self._unclear = 0

    def begin(self, subject: object, now: int, after: int) -> None:
        """
        Check an execution, unless that is done already.

        :param after: after how long to check first, ns.
        """
        if self._subject is not subject:
            self._subject = subject
            self._step = after
            self._last = None
            self._unclear = 0
            # on a grid, so that the timer is not set again for each of several short callbacks
            self.at = (now + self._step) // FIRST_CHECK_NS * FIRST_CHECK_NS + FIRST_CHECK_NS

    def end(self) -> None:
        """Check nothing more."""
        self._subject = None
        self.at = 0

    def waits(self, ident: int, tid: int, now: int) -> bool:
        """
        Return whether the thread has waited for something else than the GIL since the last check.

        :param ident: that of the thread in Python; ``tid``: its native id.
        :param now: monotonic ns.
        """
        last = self._last
        new = self._last = _Reading(now, cpu_ns(ident), process_time_ns(), schedule_of(tid))
        self._step = FIRST_CHECK_NS if last is None else min(2 * self._step, LAST_CHECK_NS)
        self.at = now + self._step
        if last is None:
            return False
        passed, own = now - last.at, new.own - last.own
        if own >= IDLE_SHARE * passed:
            self._unclear = 0
            return False
        if new.schedule.is_asleep:
            if new.schedule.slices == last.schedule.slices >= 0:
                return True
            others = max(0, new.process - last.process - own)
            delayed = new.schedule.delay_ns - last.schedule.delay_ns
            if passed - others - delayed >= WAITS * passed:
                return True
        self._unclear += 1
        return self._unclear >= UNCLEAR_CHECKS


def times_preempted() -> int:
    """Return how often the kernel took a CPU away from the calling thread."""
    return getrusage(RUSAGE_THREAD).ru_nivcsw


_lock = threading.Lock()
_spinning = 0
_usual_interval = 0.0


@contextmanager
def short_switch_interval() -> Iterator[None]:
    """Have Python's threads take turns more often while entered; nested and from any thread."""
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

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
    inconclusive.  Until the habit is known, after an inconclusive execution, and during a trial
    (2.), the kernel is asked how long the thread of a long callback has waited for a CPU.  This
    time does not count as a part of wall, and preemptions do not matter then.  (A callback that
    sleeps for a second is always preempted on a busy machine: without that time, nothing would
    ever follow.)
    Each execution is measured until the habit is known.  After that one in ``SELDOM`` short
    executions is, one in ``LATELY`` of a callback that waits for long, and each one of a callback
    that computes for long or has just behaved differently.
2.  *Unknown.*  After inconclusive first executions, the next ones are treated as if they held the
    GIL: then no other callback computes, and the measurement is conclusive.  Later, one execution
    is treated so (a trial) after every ``LATELY`` inconclusive ones.
3.  *A callback that computes with the GIL released* (numpy, hashlib) is measured as if it held it.
    Declare ``holds_interpreter: false`` to run several such callbacks in parallel.
4.  *A callback that waits though it usually computes* would keep others from the GIL.  So its
    thread is checked while others wait for the GIL (``gil_check``), first after ``CHECK_NS``, or
    less if what waits is urgent, and then at growing intervals.  If the thread waits for anything
    else, the execution gives the GIL up.
5.  *Why times, although the kernel shows exactly what a thread waits for.*  It shows that of an
    instant, and only to another thread, which has to be awake.  The habit is about the share of
    whole executions: an execution of 100 us would have to be looked at several times while it
    runs, and each look takes 16 us of CPU, more than the measurement of all times (14 us; both on
    a virtual machine).  So the kernel decides about one execution that keeps others waiting, and
    times decide how the next ones start.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from resource import getrusage, RUSAGE_THREAD
import sys
import threading
from time import monotonic_ns, process_time_ns, thread_time_ns

from mddag_executor.executor.bounds import SHORT_CALLBACK_NS
from mddag_executor.executor.gil_check import cpu_wait_ns

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

After as many inconclusive executions in a row, one runs as if it held the GIL.
"""
SELDOM = 32
"""One in this many short executions is measured (8 us) if the callback's GIL habit is known."""

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
    :ivar unclear: how many inconclusive executions were measured last, one after the other.
    """

    __slots__ = ('holds', 'computes', 'mean_ns', 'needs_ns', 'is_known', 'is_declared', 'rests',
                 'share', 'unclear', '_least', '_first', '_runs', '_is_trial', '_has_waited')

    def __init__(self, declared: bool | None = None) -> None:
        self.is_declared = self.is_known = declared is not None
        self.holds = self.computes = int(declared or False)
        self.mean_ns = self._least = 0
        self.needs_ns = -1
        self._first = FIRST_RUNS
        self.rests = 0
        self.share: float | None = None if declared is None else float(declared)
        self.unclear = 0
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

    @property
    def is_doubtful(self) -> bool:
        """Return whether its next execution should be measured exactly (25 us)."""
        return not self.is_declared and (
            not self.is_known or self.unclear > 0 or self._is_trial) and (
            not self._runs or max(self.mean_ns, self._least) > SHORT_CALLBACK_NS)

    def learn(self, wall: int, own: int, others: int, starved: bool = False) -> None:
        """
        Update whether it holds the GIL from the execution that was last given to ``took``.

        :param wall: its duration, ns, without the time in which it waited for a CPU if that is
            known.
        :param own: CPU time of its thread, ns.
        :param others: CPU time of all other threads of the process meanwhile, ns.
        :param starved: whether ``wall`` may contain time in which it waited for a CPU.
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
                self.unclear += 1
                if self.share is None:
                    self.holds = 1
                elif self.unclear >= LATELY:
                    self.unclear = 0
                    self._is_trial = not usual
                    self.holds = 1
                else:
                    self.holds = usual
                return
            part = own / max(1, had)
        self.unclear = 0
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

    __slots__ = ('_habit', '_process', '_preempted', '_own', '_start', '_sums', '_cpu_wait',
                 'is_complete')

    def __init__(self, habit: GilHabit) -> None:
        self._habit = habit
        # other threads may change the habit meanwhile, so it is asked once
        self.is_complete = habit.rests < 1
        self._sums: list[int] | None = [0, 0, 0] if self.is_complete else None
        # how long it has waited for a CPU; None: this is not asked, or not known
        self._cpu_wait: int | None = 0 if self.is_complete and habit.is_doubtful else None
        self._own = 0
        self._process = self._preempted = self._start = 0
        self.resume()

    def resume(self) -> None:
        """Begin to measure again."""
        if self._sums is not None:
            self._count_cpu_wait(-1)
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
            self._count_cpu_wait(1)

    def _count_cpu_wait(self, sign: int) -> None:
        if self._cpu_wait is not None:
            now = cpu_wait_ns()
            self._cpu_wait = None if now is None else self._cpu_wait + sign * now

    def end(self) -> int:
        """Return the CPU time of the calling thread, ns."""
        self.pause()
        own = self._own
        if self._sums is None:
            self._habit.rests -= 1
        else:
            wall, process, preempted = self._sums
            self._habit.took(own, wall)
            waited = self._cpu_wait
            self._habit.learn(
                max(own, wall - (waited or 0)), own, process - own,
                preempted > 0 and waited is None)
        return own


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

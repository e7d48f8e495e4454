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
    no other thread computed, it waits for something else than the GIL, and does not hold it.
    Anything between says nothing.
2.  *Unknown.*  As long as nothing is known, and after ``UNCLEAR_RUNS`` executions that said
    nothing, the next execution is treated as one that holds the GIL: no other one computes then,
    which shows what it does.
3.  *A callback that computes with the GIL released* (numpy, hashlib) looks as if it held it.
    Declare ``holds_interpreter: false`` to have several of these run in parallel.
4.  *A callback that waits though it usually computes* would keep others from the GIL.
    ``GilCheck`` reads the CPU clock of its thread, first after ``FIRST_CHECK_NS`` and then ever
    more seldom, but only while something waits for the GIL.  If the thread has not computed since
    the last check, the execution gives the GIL back.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import sys
import threading
from time import clock_gettime_ns, pthread_getcpuclockid

COMPUTES = 0.8
"""A callback that computes for this part of its time holds the GIL."""
WAITS = 0.5
"""A callback that computes for less than this part of the time it had waits for something else."""
SHORT_NS = 2_000
"""A callback that computes for less than this is not worth an order."""
LATELY = 8
"""An average over about so many executions; the figure of the first ones is their mean."""
UNCLEAR_RUNS = 8
"""After so many executions that said nothing, one runs as if it held the GIL."""

FIRST_CHECK_NS = 2_000_000
LAST_CHECK_NS = 20_000_000
"""The time between two checks grows from the first to the last of these."""
IDLE_SHARE = 0.05
"""A thread that computed for less than this part of the time since the last check waits."""

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
    """

    __slots__ = ('holds', 'mean_ns', 'is_known', 'is_declared', 'share', '_unclear', '_runs')

    def __init__(self, declared: bool | None = None) -> None:
        self.is_declared = self.is_known = declared is not None
        self.holds = int(declared or False)
        self.mean_ns = 0
        self.share: float | None = None if declared is None else float(declared)
        self._unclear = 0
        self._runs = 0

    def ran(self, wall: int, own: int, others: int) -> None:
        """
        Learn from an execution.

        :param wall: how long it took, ns.
        :param own: for how long its thread computed, ns.
        :param others: for how long all other threads of the process computed meanwhile, ns.
        """
        runs = self._runs = min(self._runs + 1, LATELY)
        self.mean_ns += (own - self.mean_ns) // runs
        if self.is_declared:
            return
        if own >= COMPUTES * wall:
            part = own / max(1, wall)
        else:
            had = max(own, wall - others)
            if own >= WAITS * had and own >= SHORT_NS:
                self._unclear += 1
                if self.share is None or self._unclear >= UNCLEAR_RUNS:
                    self._unclear = 0
                    self.holds = 1
                return
            part = own / max(1, had)
        self._unclear = 0
        share = self.share
        self.share = part if share is None else share + (part - share) / runs
        self.is_known = True
        least = WAITS if self.holds else COMPUTES
        self.holds = int(self.share >= least and own >= SHORT_NS)


class GilCheck:
    """
    Finds out whether an execution that holds the GIL computes.

    :ivar at: when to check next, monotonic ns; 0: not.
    """

    __slots__ = ('at', '_subject', '_step', '_checked_at', '_computed')

    def __init__(self) -> None:
        self.at = 0
        self._subject: object = None
        self._step = 0
        self._checked_at = 0
        self._computed = 0

    def begin(self, subject: object, now: int, expected: int) -> None:
        """
        Check an execution, unless that is done already.

        :param expected: after how long to check first, if that is longer than ``FIRST_CHECK_NS``.
        """
        if self._subject is not subject:
            self._subject = subject
            self._step = max(FIRST_CHECK_NS, expected)
            self._checked_at = 0
            # on a grid, so that the timer is not set again for each of several short callbacks
            self.at = (now + self._step) // FIRST_CHECK_NS * FIRST_CHECK_NS + FIRST_CHECK_NS

    def end(self) -> None:
        """Check nothing more."""
        self._subject = None
        self.at = 0

    def waits(self, thread: int, began: int, computed: int, now: int) -> bool:
        """
        Return whether the thread has not computed since the last check.

        :param thread: its ident.
        :param began: when the execution began, monotonic ns.
        :param computed: what the thread's CPU clock read then, ns.
        """
        is_first = not self._checked_at
        if is_first:
            self._checked_at, self._computed = began, computed
        passed, before = now - self._checked_at, self._computed
        self._checked_at = now
        self._computed = clock_gettime_ns(pthread_getcpuclockid(thread))
        # what it has computed before it began to wait shows in the first check only
        self._step = FIRST_CHECK_NS if is_first else min(2 * self._step, LAST_CHECK_NS)
        self.at = now + self._step
        return self._computed - before < IDLE_SHARE * passed


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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One CPU for all that holds the interpreter lock: the executor's threads are gathered on it.

Theory of operation
-------------------
Python lets one thread of a process compute at a time.  On several CPUs its threads hand each other
not only the lock, but also all that Python code writes to (every object's reference count) from
one CPU's caches to the other's, over and over.  So the workers and the intake share one CPU, their
*home*; what that saves is measured in ``docs/real_time.md``.

* A callback may let go of the lock and compute (numpy, a model), and then wants a CPU of its own.
  So a callback *roams*, over all CPUs that the executor may use, until ``LIGHT_FROM`` of its runs
  in a row took less than ``LIGHT_NS`` of CPU each.  What it starts in those first runs, say
  another library's threads, may use all CPUs, too; what it starts later stays at home.
* Others may use that CPU as well.  Every ``LOOK_S`` the home moves to the CPU that is used least,
  if others took more than ``CROWDED`` of the home in that time, and of the new one clearly less.

Who wakes up on a CPU usually preempts who runs there; here it would only wait for the lock that
the other one holds, and switch back.  So the threads are of SCHED_BATCH, unless of a real-time
policy: those run until they wait.

Affinity is a matter of threads (sched_setaffinity(2)): no other thread of the process is touched.
"""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import threading
import time
from time import thread_time_ns
from typing import Any

from mddag_executor.errors import UsageError
from mddag_executor.live.entries import Work

LIGHT_FROM = 8
LIGHT_NS = 500_000
SAMPLE = 16
"""Of those that stay at home, one run in so many is measured."""

LOOK_S = 1.0
CROWDED = 0.3
CLEARLY = 0.2
"""A move is worth it when the others' share of the new home is less by so much."""

_TICK_NS = 10 ** 9 // (os.sysconf('SC_CLK_TCK') if hasattr(os, 'sysconf') else 100)


def cpu_times() -> dict[int, int]:
    """Return for each CPU for how long it was busy since the machine started, ns (proc(5))."""
    found = {}
    for line in Path('/proc/stat').read_text().splitlines():
        name, *times = line.split()
        if name.startswith('cpu') and name != 'cpu':
            user, nice, system, _, _, *more = map(int, times)
            found[int(name[3:])] = (user + nice + system + sum(more[:3])) * _TICK_NS
    return found


def thread_cpu_time(thread: int) -> int:
    """Return how long a thread of this process has run, ns; 0 when it has ended."""
    try:
        return int(Path(f'/proc/self/task/{thread}/schedstat').read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return 0


def last_cpu() -> int:
    """Return the CPU on which this process' main thread ran last, -1 where that is unknown."""
    try:
        return int(Path('/proc/self/stat').read_text().rpartition(')')[2].split()[36])
    except (OSError, ValueError, IndexError):
        return -1


class Gathering:
    """
    The threads that share a CPU.

    :param cpus: those that they may use; None: all that the process may.
    :raises UsageError: where this system cannot do it.
    """

    def __init__(
        self, cpus: set[int] | None = None, *,
        cpu_times: Callable[[], dict[int, int]] = cpu_times,
        thread_cpu_time: Callable[[int], int] = thread_cpu_time,
    ) -> None:
        if not hasattr(os, 'sched_setaffinity'):
            raise UsageError('one_cpu: this system has no affinity of threads: leave it out')
        self.cpus = cpus or os.sched_getaffinity(0)
        here = last_cpu()
        self.home = here if here in self.cpus else min(self.cpus)
        self._cpu_times = cpu_times
        self._thread_cpu_time = thread_cpu_time
        self._lock = threading.Lock()
        self._threads: dict[int, int] = {}
        self._roaming: set[int] = set()
        self._roamed = 0
        self._looked = 0.0
        self._busy: dict[int, int] = {}

    def join(self) -> None:
        """Bring the calling thread home, and let it not be preempted by those that wake up."""
        thread = threading.get_native_id()
        if os.sched_getscheduler(0) == os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        with self._lock:
            self._threads[thread] = self._thread_cpu_time(thread)
            os.sched_setaffinity(0, {self.home})

    def step(self, work: Work) -> Any:
        """
        Run a step of a callback (see ``Work.step``), at home or wherever there is room.

        :raises BaseException: what the step raises.
        """
        entry = work.entry
        roams = entry.light < LIGHT_FROM
        if roams:
            self._roam()
        elif entry.ran % SAMPLE:
            return work.step()
        begin = thread_time_ns()
        try:
            return work.step()
        finally:
            took = thread_time_ns() - begin
            entry.light = entry.light + 1 if took < LIGHT_NS else 0
            if roams:
                self._return(took)

    def _roam(self) -> None:
        with self._lock:
            self._roaming.add(threading.get_native_id())
            os.sched_setaffinity(0, self.cpus)

    def _return(self, took: int) -> None:
        with self._lock:
            self._roamed += took
            self._roaming.discard(threading.get_native_id())
            os.sched_setaffinity(0, {self.home})

    def look(self) -> None:
        """Move where others crowd the home; to be called now and then."""
        now = time.monotonic()
        if now - self._looked < LOOK_S or len(self.cpus) < 2:
            return
        elapsed = (now - self._looked) * 1e9
        self._looked = now
        try:
            busy = self._cpu_times()
        except (OSError, ValueError):
            return  # a system without it
        before, self._busy = self._busy, busy
        with self._lock:
            mine, self._roamed = -self._roamed, 0
            for thread, ran in list(self._threads.items()):
                self._threads[thread] = self._thread_cpu_time(thread)
                mine += max(0, self._threads[thread] - ran)
                if self._threads[thread] == 0:
                    del self._threads[thread]  # it has ended
            if not before:
                return
            used = {cpu: (busy.get(cpu, 0) - before.get(cpu, 0)) / elapsed for cpu in self.cpus}
            used[self.home] -= mine / elapsed
            best = min(used, key=lambda cpu: used[cpu])
            if used[self.home] > CROWDED and used[best] + CLEARLY < used[self.home]:
                self._move(best)

    def _move(self, home: int) -> None:
        self.home = home
        for thread in self._threads.keys() - self._roaming:
            try:
                os.sched_setaffinity(thread, {home})
            except OSError:
                pass  # it has ended

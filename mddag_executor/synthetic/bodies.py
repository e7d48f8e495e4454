# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Emulations of a callback's execution time.

``sleep`` emulates work outside of Python (a GPU, a C++ library that releases the GIL).  It
occupies a worker but no CPU, so the CPU time that the process uses is overhead.  ``spin`` uses CPU
time and the GIL: all such callbacks together get at most one core.  ``native`` uses CPU time
without the GIL, like numpy or OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable
import hashlib
import statistics
import time

Emulate = Callable[[int], None]
"""Executes for this many nanoseconds in the calling thread."""


def typical_oversleep_ns() -> int:
    """Measure by how much time.sleep() is typically late on an idle machine: the median, ns."""
    late, asked_ns = [], 300_000
    for _ in range(100):
        start = time.monotonic_ns()
        time.sleep(asked_ns / 1e9)
        late.append(time.monotonic_ns() - start - asked_ns)
    return max(0, int(statistics.median(late)))


def sleeper(oversleep_ns: int) -> Emulate:
    """
    Make a function that occupies a worker for some time without using CPU.

    It reduces the argument of time.sleep() by the typical oversleep, so that the mean is right on
    an idle machine.  Shorter times (below about 70 us under Linux, whose timer slack is 50 us) are
    waited busily.  In an overload executions get longer, as those of real callbacks do.
    """
    monotonic_ns, sleep = time.monotonic_ns, time.sleep

    def emulate(execution_ns: int) -> None:
        if execution_ns > oversleep_ns:
            sleep((execution_ns - oversleep_ns) * 1e-9)
            return
        end = monotonic_ns() + execution_ns
        while monotonic_ns() < end:
            pass

    return emulate


def spin(execution_ns: int) -> None:
    """Use this much CPU time of the calling thread."""
    end = time.thread_time_ns() + execution_ns
    while time.thread_time_ns() < end:
        pass


def native() -> Emulate:
    """
    Make a function that uses about this much CPU time in C, without the GIL.

    Its speed is first measured (some milliseconds), and then adapted from recent executions: the
    speed of a virtual machine changes by a tenth.
    """
    def compute(iterations: int) -> int:
        """Compute; return the CPU time."""
        before = time.thread_time_ns()
        hashlib.pbkdf2_hmac('sha256', b'password', b'salt', iterations)
        return time.thread_time_ns() - before

    few, many = (min(compute(n) for _ in range(5)) for n in (1, 2000))
    each = max(1, many - few) / 1999

    def emulate(execution_ns: int) -> None:
        nonlocal each
        iterations = max(1, round((execution_ns - few) / each))
        took = compute(iterations)
        if iterations >= 500:
            each += ((took - few) / iterations - each) / 16

    return emulate

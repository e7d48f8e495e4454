# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What a synthetic callback does for its execution time.

``sleep`` is work outside of Python (a GPU, a C++ library that releases the GIL): it occupies a
worker but no CPU, so the CPU time that the process uses is overhead.  ``spin`` uses CPU time and
the GIL: all such callbacks together get at most one core.  ``native`` uses CPU time without the
GIL, as numpy or OpenCV do.
"""

from __future__ import annotations

from collections.abc import Callable
import hashlib
import statistics
import time

Emulate = Callable[[int], None]
"""Executes for that many nanoseconds in the calling thread."""


def typical_oversleep_ns(samples: int = 100, asked_ns: int = 300_000) -> int:
    """Measure by how much time.sleep() is late on this machine when it is idle: the median, ns."""
    late = []
    for _ in range(samples):
        start = time.monotonic_ns()
        time.sleep(asked_ns / 1e9)
        late.append(time.monotonic_ns() - start - asked_ns)
    return max(0, int(statistics.median(late)))


def sleeper(oversleep_ns: int) -> Emulate:
    """
    Make a function that takes a worker for some time without taking CPU.

    It asks time.sleep() for less by what this machine typically adds, so that the mean is right
    when the machine isn't overloaded.  What is shorter than that (about 70 us under Linux, whose
    timer slack is 50 us) is waited out busily.  When the machine is overloaded, executions get
    longer: that is so for real callbacks too, and it is not hidden.

    :param oversleep_ns: the typical oversleep.
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


def spinner() -> Emulate:
    """Make a function that takes that much CPU time of the calling thread."""
    thread_time_ns = time.thread_time_ns

    def emulate(execution_ns: int) -> None:
        end = thread_time_ns() + execution_ns
        while thread_time_ns() < end:
            pass

    return emulate


def native() -> Emulate:
    """
    Make a function that takes about that much CPU time in C, without the interpreter lock.

    How much C does in a time is measured first (some milliseconds), and then goes by what it did
    lately: the speed of a virtual machine changes by a tenth.
    """
    def compute(iterations: int) -> None:
        hashlib.pbkdf2_hmac('sha256', b'password', b'salt', iterations)

    def taken(iterations: int) -> int:
        before = time.thread_time_ns()
        compute(iterations)
        return time.thread_time_ns() - before

    few, many = (min(taken(n) for _ in range(5)) for n in (1, 2000))
    each = max(1, many - few) / 1999

    def emulate(execution_ns: int) -> None:
        nonlocal each
        iterations = max(1, round((execution_ns - few) / each))
        took = taken(iterations)
        if iterations >= 500:
            each += ((took - few) / iterations - each) / 16

    return emulate

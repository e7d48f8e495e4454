# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What tells the time, or waits for it, goes by virtual time while a run lasts.

Theory of operation
-------------------
====================================  =============================================================
a node's clock (ROS time)             is virtual; but where the recording has ``/clock`` and the
                                      node uses simulated time, it tells what that said last
steady and system clocks, ``time``    virtual if asked for; else what they always tell, and the
                                      first use of each by code of a node is warned of
``Clock.sleep_until``                 waits in virtual time, of a virtual clock
``Condition.wait``                    waits in virtual time in a strand; all that Python builds on
                                      it does, too: events, queues, rates, futures
``Thread.start``, ``Thread.join``     threads that strands start are strands; to wait for their end
                                      is to wait in virtual time
``uuid.uuid4``                        is drawn with the seed: goals of actions are called so
====================================  =============================================================

Threads that are no strands get what they always do, except from a node's clock.
"""

from __future__ import annotations

from collections.abc import Callable
import math
import queue
import random
import sys
import threading
import time
from typing import Any
import uuid
import weakref

from mddag_executor.rerun.loop import Loop
from mddag_executor.rerun.replacing import Replacements
from mddag_executor.rerun.strands import is_library, Strand
from mddag_executor.rerun.timers import Timers
from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.time import Time
from rclpy.timer import Timer

_READ_NS = ('time_ns', 'monotonic_ns', 'perf_counter_ns')
_READ_S = ('time', 'monotonic', 'perf_counter')


class VirtualTime:
    """
    Puts virtual time in the place of the machine's.

    :param all_clocks: whether steady and system clocks are virtual, too.
    :param simulated: whether the recording has ``/clock``.
    """

    def __init__(
        self, loop: Loop, all_clocks: bool, simulated: bool, seed: int,
        warn: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._all = all_clocks
        self._simulated = simulated
        self._warn = warn
        self._random = random.Random(seed)
        self._threads: weakref.WeakKeyDictionary[threading.Thread, Strand] = (
            weakref.WeakKeyDictionary())

    def install(self, replace: Callable[[Any, str, Callable[[Any], Any]], None]) -> None:
        """Put it in place."""
        replace(Clock, 'now', self._clock_now)
        replace(Clock, 'sleep_until', self._sleep_until)
        replace(threading.Condition, 'wait', self._condition_wait)
        replace(threading.Thread, 'start', self._thread_start)
        replace(threading.Thread, 'join', self._thread_join)
        # The one in C waits without asking anybody; pools of threads are built on it.
        replace(queue, 'SimpleQueue', lambda original: vars(queue)['_PySimpleQueue'])
        replace(uuid, 'uuid4', self._uuid4)
        for name in _READ_NS:
            replace(time, name, lambda original: self._reads(original, 1))
        for name in _READ_S:
            replace(time, name, lambda original: self._reads(original, 1_000_000_000))
        replace(time, 'sleep', self._time_sleep)

    # --- clocks ----------------------------------------------------------------------------------

    def _is_virtual(self, clock: Clock) -> bool:
        if clock.clock_type != ClockType.ROS_TIME:
            return self._all
        return not (self._simulated and isinstance(clock, ROSClock) and clock.ros_time_is_active)

    def _clock_now(self, original: Callable[[Clock], Time]) -> Callable[[Clock], Time]:
        ros_time, loop = ClockType.ROS_TIME, self._loop

        def now(clock: Clock) -> Time:
            kind = clock.clock_type
            if kind is ros_time and not self._simulated or self._is_virtual(clock):
                return Time(nanoseconds=loop.now, clock_type=kind)
            if kind is not ros_time:
                self._look(f'a clock of {kind.name}')
            return original(clock)

        return now

    def _sleep_until(self, original: Callable[..., bool]) -> Callable[..., bool]:
        def sleep_until(clock: Clock, until: Time, context: Any = None) -> bool:
            loop = self._loop
            if loop.strands.mine() is None or not (
                    self._is_virtual(clock) or clock.clock_type == ClockType.ROS_TIME):
                return original(clock, until, context)
            if until.clock_type != clock.clock_type:
                raise ValueError("until's clock type does not match this clock's type")
            if self._is_virtual(clock):
                loop.wait(None, until.nanoseconds, 'Clock.sleep_until')
            else:
                loop.wait(lambda: clock.now() >= until, None, 'Clock.sleep_until')
            return clock.now() >= until

        return sleep_until

    # --- Python's time ---------------------------------------------------------------------------

    def _reads(self, original: Callable[[], Any], divisor: int) -> Callable[[], Any]:
        loop, name = self._loop, f'time.{original.__name__}()'

        def read() -> Any:
            if loop.strands.mine() is None:
                return original()
            if self._all:
                return loop.now if divisor == 1 else loop.now / divisor
            self._look(name)
            return original()

        return read

    def _time_sleep(self, original: Callable[[float], None]) -> Callable[[float], None]:
        def sleep(seconds: float) -> None:
            loop = self._loop
            if loop.strands.mine() is None or not self._all:
                self._look('time.sleep()')
                original(seconds)
            elif seconds < 0:
                raise ValueError('sleep length must be non-negative')
            else:
                loop.wait(None, loop.now + round(seconds * 1e9), 'time.sleep')

        return sleep

    def _look(self, what: str) -> None:
        """Warn of something that code of a node asks for (who calls this was called by it)."""
        if self._loop.strands.mine() is None:
            return
        caller = sys._getframe(2)
        if is_library(caller.f_globals.get('__name__', '')):
            return
        name = caller.f_code.co_filename
        effect = 'takes real time' if 'sleep' in what else 'is not the same in each run'
        self._warn(f'{name}:{caller.f_lineno}: {what} {effect}: give --all-clocks')

    # --- waiting and threads ---------------------------------------------------------------------

    def _condition_wait(self, original: Callable[..., bool]) -> Callable[..., bool]:
        def wait(condition: Any, timeout: float | None = None) -> bool:
            loop = self._loop
            if loop.strands.mine() is None or loop.strands.over:
                return original(condition, timeout)
            deadline = None
            if timeout is not None and math.isfinite(timeout):
                deadline = loop.now + max(0, round(timeout * 1e9))
            return _wait_for_notify(
                condition, lambda until: loop.wait(until, deadline, 'for another thread'))

        return wait

    def _thread_start(self, original: Callable[[Any], None]) -> Callable[[Any], None]:
        def start(thread: threading.Thread) -> None:
            strands = self._loop.strands
            if strands.mine() is None or strands.over:
                original(thread)
                return
            strand = self._threads[thread] = strands.make(f'thread {thread.name}')
            run = thread.run
            thread.run = lambda: strands.run_as(strand, run)  # type: ignore[method-assign]
            with strands.set_aside():  # it waits until the thread is there
                original(thread)

        return start

    def _thread_join(self, original: Callable[..., None]) -> Callable[..., None]:
        def join(thread: threading.Thread, timeout: float | None = None) -> None:
            loop, strand = self._loop, self._threads.get(thread)
            if strand is None or loop.strands.mine() is None or loop.strands.over:
                original(thread, timeout)
                return
            deadline = None if timeout is None else loop.now + round(max(0.0, timeout) * 1e9)
            loop.wait(lambda: strand.ended, deadline, f'for thread {thread.name}')

        return join

    def _uuid4(self, original: Callable[[], uuid.UUID]) -> Callable[[], uuid.UUID]:
        def uuid4() -> uuid.UUID:
            if self._loop.strands.mine() is None:
                return original()
            return uuid.UUID(int=self._random.getrandbits(128), version=4)

        return uuid4


def _wait_for_notify(condition: Any, wait: Callable[[Callable[[], bool]], bool]) -> bool:
    """Wait for a condition's ``notify`` as ``Condition.wait`` does, but for how it waits."""
    if not condition._is_owned():
        raise RuntimeError('cannot wait on un-acquired lock')
    waiter = threading.Lock()
    waiter.acquire()
    condition._waiters.append(waiter)
    saved = condition._release_save()
    notified = False
    try:
        notified = wait(lambda: not waiter.locked())
        return notified
    finally:
        condition._acquire_restore(saved)
        if not notified:
            try:
                condition._waiters.remove(waiter)
            except ValueError:
                pass


def replace_timers(replacements: Replacements, timers: Timers) -> None:
    """Have what nodes do with their timers count in virtual time."""
    replace = replacements.replace

    def then(tell: Callable[[Timer], None]) -> Callable[[Any], Any]:
        def make(original: Callable[[Timer], None]) -> Callable[[Timer], None]:
            def method(timer: Timer) -> None:
                original(timer)
                tell(timer)

            return method

        return make

    replace(Timer, 'reset', then(timers.reset))
    replace(Timer, 'cancel', then(timers.cancelled))
    replace(Timer, 'time_until_next_call', lambda original: lambda timer: timers.until_next(timer))
    replace(Timer, 'time_since_last_call', lambda original: lambda timer: timers.since_last(timer))
    replace(Timer, 'is_ready', lambda original: lambda timer: timers.until_next(timer) == 0)

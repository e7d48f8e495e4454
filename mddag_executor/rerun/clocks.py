# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Functions that return the time, or wait for it, use virtual time during a run.

Theory of operation
-------------------
====================================  ============================================================
a node's clock (ROS time)             is virtual; but if the recording has ``/clock`` and the node
                                      uses simulated time, it has the last recorded time
steady and system clocks, ``time``    virtual on request; else real, and a warning names the first
                                      use of each by code of a node; but always virtual where
                                      Python or rclpy waits with them
``Clock.sleep_until``                 waits in virtual time for a virtual clock
``Condition.wait``                    waits at a lock of a run thread in virtual time, and so does
                                      all that builds on it: events, queues, rates, futures
``Thread.start``, ``Thread.join``     threads that a run thread starts are run threads; waiting
                                      for their end takes virtual time
``os.urandom``                        is drawn with the seed, so are ``uuid4``, by which goals of
                                      actions are named, ``secrets`` and generators of numpy
``random``, ``numpy.random``          generators that nodes make without a seed get one
====================================  ============================================================

In other threads everything is as always, except a node's clock.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
import os
import queue
import random
import sys
import threading
import time
from typing import Any, ClassVar
import weakref

from mddag_executor.replacements import Replacements
from mddag_executor.rerun.loop import Loop
from mddag_executor.rerun.run_threads import is_library, RunThread
from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.time import Time

_WAITING = ('rclpy', 'threading', 'queue', 'concurrent')
"""Packages that use real time only to wait."""
_READS = ('time', 'time_ns', 'monotonic', 'monotonic_ns', 'perf_counter', 'perf_counter_ns')


@cache
def _replaced(original: Callable[..., Any]) -> Callable[..., Any]:
    """
    Return a function that calls the current run instead of the original.

    It is made once: a module that imports it keeps it for later runs.
    """
    def function(*args: Any) -> Any:
        run = VirtualTime.current
        return original(*args) if run is None else run.call(original, args)

    return function


class VirtualTime:
    """
    Puts virtual time in the place of the machine's.

    :cvar current: that of the current run.
    :param all_clocks: whether steady and system clocks are virtual as well.
    :param simulated: whether the recording has ``/clock``.
    """

    current: ClassVar[VirtualTime | None] = None

    def __init__(self, loop: Loop, all_clocks: bool, simulated: bool, seed: int) -> None:
        self._loop = loop
        self._all = all_clocks
        self._simulated = simulated
        self._seed = seed
        self._random = random.Random(seed)
        self._threads: weakref.WeakKeyDictionary[threading.Thread, RunThread] = (
            weakref.WeakKeyDictionary())

    def install(self, replacements: Replacements) -> None:
        """Put it in place, with all random numbers beginning with the seed."""
        replace = replacements.replace
        replace(Clock, 'now', self._clock_now)
        replace(Clock, 'sleep_until', self._sleep_until)
        replace(threading, '_allocate_lock', self._allocate_lock)  # for ``Condition.wait``
        replace(threading.Thread, 'start', self._thread_start)
        replace(threading.Thread, 'join', self._thread_join)
        # The one in C waits without asking the run; pools of threads are built on it.
        replace(queue, 'SimpleQueue', lambda original: vars(queue)['_PySimpleQueue'])
        replace(random.Random, 'seed', self._random_seed)
        # that of the module is a method of a generator, bound before
        replace(random, 'seed', lambda original: partial(random.Random.seed, original.__self__))
        random.seed(self._seed)
        with suppress(ImportError):
            import numpy.random
            numpy.random.seed(self._seed % 2 ** 32)
        for owner, names in ((time, (*_READS, 'sleep')), (threading, ('_time',)),
                             (queue, ('time',)), (os, ('urandom',)), (random, ('_urandom',))):
            for name in names:
                replace(owner, name, _replaced)
        VirtualTime.current = self
        replacements.callback(setattr, VirtualTime, 'current', None)

    # --- clocks ----------------------------------------------------------------------------------

    def _is_virtual(self, clock: Clock) -> bool:
        if clock.clock_type != ClockType.ROS_TIME:
            return self._all
        return not self._simulated or not (
            isinstance(clock, ROSClock) and clock.ros_time_is_active)

    def _clock_now(self, original: Callable[[Clock], Time]) -> Callable[[Clock], Time]:
        loop = self._loop

        def now(clock: Clock) -> Time:
            kind = clock.clock_type
            if self._is_virtual(clock):
                if loop.in_run:
                    loop.note_poll()
                return Time(nanoseconds=loop.now, clock_type=kind)
            if kind is not ClockType.ROS_TIME:
                self._warn_of(f'a clock of {kind.name}', 2)
            return original(clock)

        return now

    def _sleep_until(self, original: Callable[..., bool]) -> Callable[..., bool]:
        def sleep_until(clock: Clock, until: Time, context: Any = None) -> bool:
            loop = self._loop
            if not loop.in_run or not (
                    self._is_virtual(clock) or clock.clock_type == ClockType.ROS_TIME):
                return original(clock, until, context)
            if until.clock_type != clock.clock_type:
                raise ValueError("until's clock type does not match this clock's type")
            if self._is_virtual(clock):
                loop.wait(None, (until.nanoseconds - loop.now) / 1e9, 'Clock.sleep_until')
            else:
                loop.wait(lambda: clock.now() >= until, None, 'Clock.sleep_until')
            return clock.now() >= until

        return sleep_until

    # --- Python's time ---------------------------------------------------------------------------

    def call(self, original: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        """Do what a function of ``time`` does, or ``urandom``."""
        loop, name = self._loop, original.__name__
        if not loop.in_run:
            return original(*args)
        if name == 'urandom':
            return self._random.randbytes(*args)
        caller = sys._getframe(2).f_globals.get('__name__', '')
        if not self._all and caller.partition('.')[0] not in _WAITING:
            self._warn_of(f'time.{name}()', 3)
            return original(*args)
        if name in _READS:
            loop.note_poll()
            return loop.now if name.endswith('_ns') else loop.now / 1e9
        seconds, = args
        if not seconds >= 0:  # or not a number
            raise ValueError('sleep length must be non-negative')
        loop.wait(None, seconds, 'time.sleep')
        return None

    def _warn_of(self, what: str, depth: int) -> None:
        """Warn of a function that is called by code of a node, ``depth`` calls further up."""
        if not self._loop.in_run:
            return
        caller = sys._getframe(depth)
        if is_library(caller.f_globals.get('__name__', '')):
            return
        name = caller.f_code.co_filename
        effect = 'takes real time' if 'sleep' in what else 'is not the same in each run'
        self._loop.warn(f'{name}:{caller.f_lineno}: {what} {effect}: give --all-clocks')

    # --- random numbers --------------------------------------------------------------------------

    def _random_seed(self, original: Callable[..., None]) -> Callable[..., None]:
        def seed(generator: random.Random, a: Any = None, version: int = 2) -> None:
            caller = sys._getframe(1)
            while caller.f_back is not None and caller.f_globals.get('__name__') == 'random':
                caller = caller.f_back
            # libraries keep what they draw
            if a is None and self._loop.in_run and not is_library(
                    caller.f_globals.get('__name__', '')):
                a = self._random.getrandbits(128)
            original(generator, a, version)

        return seed

    # --- waiting and threads ---------------------------------------------------------------------

    def _allocate_lock(self, original: Callable[[], Any]) -> Callable[[], Any]:
        def allocate() -> Any:
            loop = self._loop
            return original() if not loop.in_run or loop.run_threads.over else _VirtualLock(loop)

        return allocate

    def _thread_start(self, original: Callable[[Any], None]) -> Callable[[Any], None]:
        def start(thread: threading.Thread) -> None:
            run_threads = self._loop.run_threads
            if not self._loop.in_run or run_threads.over or thread.ident is not None:
                original(thread)  # raises if it has started before
                return
            run_thread = self._threads[thread] = run_threads.make(f'thread {thread.name}')
            thread.daemon = True  # one that does not end keeps no process from ending
            run = thread.run
            thread.run = lambda: run_threads.run_as(run_thread, run)  # type: ignore[method-assign]
            with run_threads.left_run():  # it waits until the thread is there
                original(thread)

        return start

    def _thread_join(self, original: Callable[..., None]) -> Callable[..., None]:
        def join(thread: threading.Thread, timeout: float | None = None) -> None:
            loop, run_thread = self._loop, self._threads.get(thread)
            if run_thread is None or not loop.in_run or loop.run_threads.over:
                original(thread, timeout)
                return
            loop.wait(lambda: run_thread.ended, timeout, f'for thread {thread.name}')

        return join


class _VirtualLock:
    """
    A lock of a run thread, which waits for it in virtual time.

    At the end of the run, a wait without a timeout returns although nothing has released the lock.
    ``Condition`` keeps such a lock in its list of waiters. The lock is then free, so
    ``Condition.notify`` gets the error of a free lock, and wakes the next waiter instead.
    """

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._locked = False

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        timeout_s = 0.0 if not blocking else None if timeout < 0 else timeout
        acquired = self._loop.wait(lambda: not self._locked, timeout_s, 'for another thread')
        self._locked = acquired or timeout_s is not None
        return acquired

    def release(self) -> None:
        if not self._locked:
            raise RuntimeError('release unlocked lock')
        self._locked = False

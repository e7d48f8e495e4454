# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What gives the time, or waits for it, uses virtual time while a run lasts.

Theory of operation
-------------------
====================================  =============================================================
a node's clock (ROS time)             is virtual; but where the recording has ``/clock`` and the
                                      node uses simulated time, it tells what that said last
steady and system clocks, ``time``    virtual if asked for; else what they always say, and the
                                      first use of each by code of a node is warned of
``Clock.sleep_until``                 waits in virtual time, of a virtual clock
``Condition.wait``                    waits in virtual time in a strand; all that Python builds on
                                      it does, too: events, queues, rates, futures
``Thread.start``, ``Thread.join``     threads that strands start are strands; to wait for their end
                                      is to wait in virtual time
``uuid.uuid4``                        is drawn with the seed: goals of actions are called so
``random``, ``numpy.random``          generators that nodes make without a seed get one
====================================  =============================================================

Threads that are no strands get what they always do, except from a node's clock.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import queue
import random
import sys
import threading
import time
from typing import Any, ClassVar
import uuid
import weakref

from mddag_executor.rerun.loop import Loop
from mddag_executor.rerun.strands import is_library, Strand
from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.time import Time

_READS = ('time', 'time_ns', 'monotonic', 'monotonic_ns', 'perf_counter', 'perf_counter_ns')


class _Asked:
    """
    Functions that stand in the place of those of ``time`` and of ``uuid4``, and whom they ask.

    They are made once: a module that imports one keeps it for later runs.
    """

    run: ClassVar[VirtualTime | None] = None
    functions: ClassVar[dict[str, Callable[..., Any]]] = {}


def _asking(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return what asks the run that is under way, in place of a function."""
    function = _Asked.functions.get(original.__name__)
    if function is None:
        def function(*args: Any) -> Any:
            run = _Asked.run
            return original(*args) if run is None else run.asked(original, args)

        _Asked.functions[original.__name__] = function
    return function


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
        replace(uuid, 'uuid4', _asking)
        replace(random.Random, 'seed', self._seed)
        # that of the module is a method of a generator, bound before
        replace(random, 'seed', lambda original: partial(random.Random.seed, original.__self__))
        try:
            from numpy.random import bit_generator
        except ImportError:
            pass
        else:  # what all of numpy's generators begin with that get no seed
            replace(bit_generator, 'randbits', self._randbits)
        for name in (*_READS, 'sleep'):
            replace(time, name, _asking)
        _Asked.run = self

    def uninstall(self) -> None:
        """Have the functions of ``time`` give real time again."""
        _Asked.run = None

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
                if loop.strands.mine() is not None:
                    loop.looked()
                return Time(nanoseconds=loop.now, clock_type=kind)
            if kind is not ros_time:
                self._look(f'a clock of {kind.name}', 2)
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

    def asked(self, original: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        """Do what a function of ``time`` does, or ``uuid4``."""
        loop, name = self._loop, original.__name__
        if loop.strands.mine() is None:
            return original(*args)
        if name == 'uuid4':
            return uuid.UUID(int=self._random.getrandbits(128), version=4)
        if not self._all:
            self._look(f'time.{name}()', 3)
            return original(*args)
        if name in _READS:
            loop.looked()
            return loop.now if name.endswith('_ns') else loop.now / 1e9
        seconds, = args
        if seconds < 0:
            raise ValueError('sleep length must be non-negative')
        loop.wait(None, loop.now + round(seconds * 1e9), 'time.sleep')
        return None

    def _look(self, what: str, depth: int) -> None:
        """Warn of something that code of a node asks for, which is so many calls further up."""
        if self._loop.strands.mine() is None:
            return
        caller = sys._getframe(depth)
        if is_library(caller.f_globals.get('__name__', '')):
            return
        name = caller.f_code.co_filename
        effect = 'takes real time' if 'sleep' in what else 'is not the same in each run'
        self._warn(f'{name}:{caller.f_lineno}: {what} {effect}: give --all-clocks')

    # --- random numbers --------------------------------------------------------------------------

    def _seed(self, original: Callable[..., None]) -> Callable[..., None]:
        def seed(generator: random.Random, a: Any = None, version: int = 2) -> None:
            if a is None and self._is_asked_by_node():
                a = self._random.getrandbits(128)
            original(generator, a, version)

        return seed

    def _randbits(self, original: Callable[[int], int]) -> Callable[[int], int]:
        def randbits(bits: int) -> int:
            draw = self._random.getrandbits if self._is_asked_by_node() else original
            return draw(bits)

        return randbits

    def _is_asked_by_node(self) -> bool:
        """Return whether code of a node calls what calls this; libraries keep what they draw."""
        caller = sys._getframe(2)
        while caller.f_back is not None and caller.f_globals.get('__name__') == 'random':
            caller = caller.f_back
        return self._loop.strands.mine() is not None and not is_library(
            caller.f_globals.get('__name__', ''))

    # --- waiting and threads ---------------------------------------------------------------------

    def _condition_wait(self, original: Callable[..., bool]) -> Callable[..., bool]:
        def wait(condition: Any, timeout: float | None = None) -> bool:
            loop = self._loop
            if loop.strands.mine() is None or loop.strands.over:
                return original(condition, timeout)
            deadline = loop.deadline_after(timeout)
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
            thread.daemon = True  # one that does not end keeps no process from ending
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
            loop.wait(lambda: strand.ended, loop.deadline_after(timeout),
                      f'for thread {thread.name}')

        return join


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

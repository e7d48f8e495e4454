# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Threads of which one runs at a time, in an order that does not depend on the machine.

Theory of operation
-------------------
1. A callback that waits (for a service, a rate, a time) needs its own thread meanwhile: other
   callbacks run, and may end before or after it. So do a program's ``main`` and the threads that
   nodes start. All of these are *run threads*. One of them has the *turn*. Each of the others
   waits at its own lock, so the operating system has nothing to choose.
2. The thread with the turn either runs code of a node, or drives the run: it calls ``step``, which
   does the next thing in virtual time. When code of a node waits, its thread passes the turn to a
   driving thread (an idle one, or a new one). That passes the turn back as soon as the condition
   is true or the deadline has passed. A callback that does not wait runs in the driving thread,
   without a switch of threads.
3. Threads that do not belong to the run (the middleware's) are not run threads: the functions that
   they call do what they always do.
4. A run thread that waits for something else (a socket, a lock that another run thread has) keeps
   the turn, and virtual time does not advance. The thread that started the run checks for that: if
   no virtual time passes and no callback ends, a run thread that waits for ``patience_s`` has
   *stalled*, and so has one that computes for ``_COMPUTES`` times as long.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import sys
import threading
import time
import traceback
from typing import Any

from mddag_executor.executor.starters import starting_for_all

_CHECK_S = 0.05
_LONGEST_CHECK_S = 1.0
"""More time between two checks is that of a process that was stopped."""
_COMPUTES = 10
_LITTLE = 0.1
"""A process that uses less than this share of a CPU waits."""
_END_S = 2.0
"""RunThreads have this much real time to end when the run is over."""


def _locked() -> threading.Lock:
    lock = threading.Lock()
    lock.acquire()
    return lock


@dataclass(eq=False, slots=True)
class RunThread:
    """
    A thread of the run, and what it waits for.

    :ivar until: returns whether that has come true; None: it waits for a time, or for the end.
    :ivar deadline: the virtual time at which it waits no longer; None: there is none.
    :ivar execution: what it runs: kept for the thread that drives the run.
    :ivar lock: free when it has the turn.
    :ivar ended: whether its function has ended.
    """

    name: str
    until: Callable[[], bool] | None = None
    deadline: int | None = None
    place: str = ''
    execution: Any = None
    lock: threading.Lock = field(default_factory=_locked)
    ident: int = 0
    ended: bool = False


class Stalled(Exception):
    """A run thread in which no virtual time passes."""

    def __init__(self, run_thread: RunThread, what: str, seconds: float) -> None:
        super().__init__(
            f'it has been {what} at {code_position(run_thread.ident)} for {seconds:g} s')


class RunThreads:
    """
    The run threads of a run.

    :param step: does the next thing in virtual time; False: the run is over.
    :param at_end: called then, before the run threads end that still wait.
    :ivar owner: the run thread that has the turn.
    """

    def __init__(self, step: Callable[[], bool], at_end: Callable[[], None]) -> None:
        self._step = step
        self._at_end = at_end
        self.owner: RunThread | None = None
        self._idle: list[RunThread] = []
        self._ready: deque[RunThread] = deque()
        self.waiting: list[RunThread] = []
        self._here = threading.local()
        self._finished = threading.Event()
        self.over = False
        self.error: BaseException | None = None

    # --- the turn --------------------------------------------------------------------------------

    def current(self) -> RunThread | None:
        """Return the run thread that calls, if it has the turn; None for threads of others."""
        run_thread: RunThread | None = getattr(self._here, 'run_thread', None)
        return run_thread if run_thread is not None and run_thread is self.owner else None

    @contextmanager
    def left_run(self) -> Iterator[None]:
        """Let the calling run thread wait for something real, of Python's own, while entered."""
        run_thread, self._here.run_thread = self._here.run_thread, None
        try:
            yield
        finally:
            self._here.run_thread = run_thread

    def _give(self, run_thread: RunThread) -> None:
        self.owner = run_thread
        run_thread.lock.release()

    def _pass_on(self) -> None:
        """Give the turn to a thread that drives."""
        if self._idle:
            self._give(self._idle.pop())
            return
        driver = RunThread('driver')
        self._give(driver)
        thread = threading.Thread(
            target=self._run_driver, args=(driver,), daemon=True, name='mddag-rerun')
        with starting_for_all():  # it runs any callbacks
            thread.start()

    def _begin(self, run_thread: RunThread) -> None:
        self._here.run_thread = run_thread
        run_thread.ident = threading.get_ident()
        run_thread.lock.acquire()

    # --- driving ---------------------------------------------------------------------------------

    def _run_driver(self, me: RunThread) -> None:
        self._begin(me)
        try:
            self._drive(me)
        except BaseException as error:  # what a node raised, or a defect: the run ends with it
            self.error = self.error or error
            self._end()
            self._drive(me)

    def _end(self) -> None:
        if not self.over:
            try:
                self._at_end()
            except BaseException as error:
                self.error = self.error or error
            self.over = True

    def _drive(self, me: RunThread) -> None:
        while not self._finished.is_set():
            run_thread = self._next()
            if run_thread is not None:
                self._idle.append(me)
                self._give(run_thread)
                me.lock.acquire()
            elif self.over:
                self._finish()
            elif not self._step():
                self._end()

    def _next(self) -> RunThread | None:
        if self._ready:
            return self._ready.popleft()
        for place, run_thread in enumerate(self.waiting):
            if self.over or run_thread.until is not None and run_thread.until():
                return self.waiting.pop(place)
        return None

    def _finish(self) -> None:
        """Let all threads that drive end: no run thread waits any more."""
        self.owner = None
        self._finished.set()
        for each in self._idle:
            each.lock.release()

    # --- what run threads do ---------------------------------------------------------------------

    def make(self, name: str) -> RunThread:
        """Make a run thread, which has the turn after the others; it must call ``run_as``."""
        run_thread = RunThread(name)
        self._ready.append(run_thread)
        return run_thread

    def run_as(self, run_thread: RunThread, function: Callable[[], Any]) -> None:
        """Run a function as a run thread, in a thread of its own."""
        self._begin(run_thread)
        try:
            function()
        finally:
            self._here.run_thread = None
            run_thread.ended = True
            if not self.over or self.owner is run_thread:
                self._pass_on()

    def wait(
        self, run_thread: RunThread, until: Callable[[], bool] | None, deadline: int | None,
        place: str,
    ) -> bool:
        """
        Wait in the calling run thread, which has the turn; return whether ``until`` came true.

        :param deadline: the virtual time at which it waits no longer; None: there is none.
        :param place: says what it waits for.
        """
        if self.over:
            return False
        run_thread.until, run_thread.deadline, run_thread.place = until, deadline, place
        self.waiting.append(run_thread)
        self._pass_on()
        run_thread.lock.acquire()
        return until is not None and not self.over and until()

    def has_waiting(self, thread: threading.Thread) -> bool:
        """Return whether a thread is a run thread that waits."""
        return any(each.ident == thread.ident for each in self.waiting)

    def expire(self, run_thread: RunThread, deadline: int) -> None:
        """Let a run thread go on whose time is over, if it still waits."""
        if run_thread in self.waiting and run_thread.deadline == deadline:
            self.waiting.remove(run_thread)
            self._ready.append(run_thread)

    # --- from outside ----------------------------------------------------------------------------

    def run(
        self, patience_s: float, progress: Callable[[], object], tick: Callable[[], None]
    ) -> None:
        """
        Run all until the run is over, watched by the calling thread, which is not a run thread.

        :param patience_s: a run thread that waits for this long is stuck.
        :param progress: returns what changes as long as the run goes on.
        :param tick: called now and then.
        :raises Stalled: if a run thread has stalled; its thread is abandoned.
        :raises BaseException: what ended the run.
        """
        self._pass_on()
        watch = _StallWatch(self, progress, patience_s)
        try:
            while not self._finished.wait(_CHECK_S):
                tick()
                if self.over:
                    self._finished.wait(_END_S)
                    break  # threads that have not ended are abandoned
                watch.check()
        finally:
            self.over = True
        if self.error is not None:
            raise self.error


class _StallWatch:
    """
    Finds out whether a run thread keeps virtual time from advancing for too long.

    It waits while the process uses little CPU time, else it computes.
    """

    def __init__(
        self, run_threads: RunThreads, progress: Callable[[], object], patience_s: float
    ) -> None:
        self._run_threads = run_threads
        self._progress = progress
        self._patience_s = patience_s
        self._seen: object = None
        self._before: tuple[float, float, RunThread | None] = (
            time.monotonic(), time.process_time(), None)
        self._waited_s = self._computed_s = 0.0

    def check(self) -> None:
        before_s, before_cpu_s, before_owner = self._before
        now_s, cpu_s, owner = self._before = (
            time.monotonic(), time.process_time(), self._run_threads.owner)
        passed_s, seen = min(now_s - before_s, _LONGEST_CHECK_S), self._progress()
        if owner is None or seen != self._seen:
            self._seen, self._waited_s, self._computed_s = seen, 0.0, 0.0
        if owner is None or owner is not before_owner:
            return
        if cpu_s - before_cpu_s > _LITTLE * passed_s:
            self._waited_s = 0.0  # a busy machine gives it little CPU time now and then
            self._computed_s += passed_s
        else:
            self._waited_s += passed_s
        for what, seconds, most in (
                ('blocking', self._waited_s, self._patience_s),
                ('computing', self._computed_s, _COMPUTES * self._patience_s)):
            if seconds > most:
                raise Stalled(owner, what, most)


def code_position(ident: int) -> str:
    """Return where a thread is: file and line of the innermost code outside of libraries."""
    stack = traceback.walk_stack(sys._current_frames().get(ident, sys._getframe()))
    places = [(f'{frame.f_code.co_filename}:{line}', frame.f_globals.get('__name__', ''))
              for frame, line in stack]
    return next((place for place, module in places if not is_library(module)), places[0][0])


def is_library(module: str) -> bool:
    """Return whether a module is part of Python, of rclpy or of this program."""
    top = module.partition('.')[0]
    return top in sys.stdlib_module_names and top != '__main__' or top in (
        'rclpy', 'mddag_executor', 'numpy')

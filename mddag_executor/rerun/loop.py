# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The run in virtual time: what happens next, and which callback runs.

Theory of operation
-------------------
Time jumps from event to event. At one instant first executions end, workers in ascending order;
then messages arrive, in the order in which they were sent; then come the recorded messages, in
their order, and the timers that are due; then run threads go on whose time is over; then the core
dispatches until it has nothing left to do. All that this causes at the same instant is done before
time goes on.

A callback runs, for real and at once, when the core dispatches it. In virtual time it takes as
long as ``times`` says, on the CPUs and with the interpreter that it shares as in the simulator
(``simulate.machine``), or as long as it has waited, if that is more. Its messages are kept until
its virtual end, or until it begins to wait, because others may have to answer them.

What a callback has started, threads and tasks for instance, publishes on its behalf until its
virtual end, as live (``executor.starters``). Such messages leave at once.

A message that another thread sends has no virtual time: it gets the time at which it arrives, and
a warning says so.

A recording may have pauses: the recorder was stopped, or the machine's clock set forward. No
timer fires in a pause, and executions that have begun are completed, for ``DRAIN_NS``
at most. Other events of the pause happen at its end, and a timer fires once.

The run is over when nothing is left to happen, or at ``end``. Then no timer fires any more,
and executions that have begun are completed.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from heapq import heappop, heappush
import itertools
import math
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.core.state import DONE, empty
from mddag_executor.executor.attribution import Origin
from mddag_executor.executor.compat import NEXT_TURN
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.sent_requests import Heritage
from mddag_executor.executor.starters import Claim, run_for
from mddag_executor.executor.work import Destroyed, Refused, starter_of, Work
from mddag_executor.hosting.loading import describe
from mddag_executor.rerun.durations import Durations
from mddag_executor.rerun.errors import CallbackFailed, RerunError
from mddag_executor.rerun.run_threads import RunThreads
from mddag_executor.simulate.machine import (
    advance_machine,
    assign_cpus,
    fill_machine,
    Machine,
    NEXT_TIME,
    set_phases,
)
from rclpy.exceptions import InvalidHandle

DRAIN_NS = 10_000_000_000
"""Work that has begun may continue this long after the end of the recording, and in a pause."""
POLL_NS = 1_000_000
"""How often a waiting callback polls, or asks again for the interpreter."""
MOST_POLLS = 1000
"""A callback that reads the time this often at one instant waits for time to pass."""
MOST_AT_ONCE = 20_000
"""More callbacks at one instant than this go in a circle in which nothing takes time."""

_LENT = 1 << 20
# What happens at one instant, in this order.
ENDED, ARRIVED, RECORDED, TIMER, WAITED = range(5)

Leave = Callable[[Origin | None, int], None]
"""Sends something, given the job and release of the execution that sends it."""


@dataclass(eq=False, slots=True)
class Execution:
    """
    A callback that runs, or has run for real and not ended in virtual time.

    :ivar sent: what it has sent, each with what records that, given the thread.
    """

    work: Work
    start: int
    worker: int
    thread: int
    release: int
    sent: list[tuple[Leave, Callable[[int], None]]] = field(default_factory=list)
    waits_for: Any = None


class Loop:
    """
    Runs callbacks in virtual time.

    :param cpus: how many there are; None: as many as are needed.
    :param python: whether all callbacks need the interpreter at their end: see ``Machine``.
    :param start: the virtual time at which it begins, ns since the epoch.
    :param end: when the recording ends.
    :param pauses: from when to when it has no messages.
    :param refresh: brings up to date which entities there are.
    :param begin: starts the programs; ``over``: is called at the end, before the run threads end
        that still wait.
    :ivar now: the virtual time.
    :ivar callbacks: how many callbacks have run.
    :ivar changed: whether there may be new entities, or some are gone.
    :ivar warnings: what is not the same in each run, or doubtful, one line each.
    :ivar on_ended: called with rclpy's entity when its callback has ended.
    :ivar lock: none is needed, as one thread runs at a time.
    """

    lock = nullcontext()

    def __init__(
        self, engine: Engine, times: Durations, cpus: int | None, python: bool, start: int,
        end: int, pauses: Sequence[tuple[int, int]], refresh: Callable[[], None],
        begin: Callable[[], None], over: Callable[[], None],
    ) -> None:
        self.engine = engine
        self.now = self.start = start
        self.end = end
        self._pauses = pauses
        self.callbacks = 0
        self.changed = True
        self.warnings: list[str] = []
        self._state = engine.scheduler.state
        self._machine = empty(Machine)
        fill_machine(self._state, self._machine, cpus or NEVER, int(python))
        advance_machine(self._state, self._machine, start)
        # by worker: what runs on it, and when that ends if nothing changes
        self._running: list[Execution | None] = [None] * engine.n_workers
        self._finish_at = [NEVER] * engine.n_workers
        self.on_ended: Callable[[Any], object] = lambda entity: None
        self.run_threads = RunThreads(self._step, over)
        self._times = times
        self._refresh = refresh
        self._events: list[tuple[int, int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._order = itertools.count()
        self._foreign: deque[Callable[[], None]] = deque()
        self._current: Execution | None = None
        self._at_once = 0
        self._stopped = False
        self._polled_at = self._polls = 0
        self.at(start, ENDED, begin)

    # --- what is to happen -----------------------------------------------------------------------

    def at(self, time: int, kind: int, function: Callable[..., None], *args: Any) -> None:
        """Have something happen; at one instant, in the order of kinds, then of these calls."""
        time = self.after_pause(time, DRAIN_NS)
        heappush(self._events, (time, kind, next(self._order), function, args))

    def after_pause(self, time: int, drain_ns: int = 0) -> int:
        """Return the end of the pause that a time lies in, or else that time."""
        place = bisect_left(self._pauses, (time - drain_ns,)) - 1
        return time if place < 0 else max(time, self._pauses[place][1])

    def call_in_run(self, function: Callable[[], None]) -> None:
        """Call a function at once, or, if a foreign thread calls, as soon as possible."""
        if self.in_run:
            function()
        else:
            self._foreign.append(function)

    def warn(self, text: str) -> None:
        """Add a warning, once."""
        if text not in self.warnings:
            self.warnings.append(text)

    def stop(self) -> None:
        """End the run at this instant, from any thread."""
        self._stopped = True

    @property
    def in_run(self) -> bool:
        """Return whether the calling thread is the run thread that has the turn."""
        return self.run_threads.current() is not None

    @property
    def current(self) -> Execution | None:
        """Return the execution whose callback runs in the calling thread; None for no callback."""
        return self._current if self.in_run else None

    def is_inside(self) -> bool:
        """Return whether the calling thread owns the lock, as ``WorkerPool.is_inside`` does."""
        return False

    def heritage(self, of_task: bool = False) -> Heritage | None:
        """Return what a request of the calling callback inherits, or its task; None: nothing."""
        execution = self.current
        if execution is None:
            return None
        inherited = self.engine.heritage_of_task if of_task else self.engine.heritage
        return inherited(execution.work)

    def here(self) -> str:
        """Return what runs, for messages."""
        if self._current is not None:
            return self._current.work.entity.name
        run_thread = self.run_threads.owner
        return 'the run' if run_thread is None else run_thread.name

    # --- the steps -------------------------------------------------------------------------------

    def _step(self) -> bool:
        """Do the next thing; False: there is none."""
        while self._foreign:
            self._foreign.popleft()()
        self.refresh_now()
        if self._stopped:
            return False
        events, now = self._events, self.now
        if self._end_finished():
            return True
        if events and events[0][0] <= now:
            _, _, _, function, args = heappop(events)
            function(*args)
            return True
        engine = self.engine
        work = engine.step(0, now).work
        if work is not None:
            self._execute(work)
            return True
        self._share()
        if self._end_finished():
            return True
        return self._advance()

    def _share(self) -> None:
        """Decide which executions go on, and when they end."""
        assign_cpus(self._state, self._machine, self.now, self._finish_at)
        for worker, execution in enumerate(self._running):
            if execution is None:  # it waits
                self._finish_at[worker] = NEVER

    def _end_finished(self) -> bool:
        """End the execution of the first worker on which one has finished."""
        for worker, execution in enumerate(self._running):
            if execution is not None and self._finish_at[worker] <= self.now:
                self._running[worker] = None
                self._finish_at[worker] = NEVER
                self._end(execution)
                return True
        return False

    def refresh_now(self) -> None:
        """Bring up to date which entities there are, if any may have come or gone."""
        if self.changed and self.in_run:
            self.changed = False
            self._refresh()

    def _advance(self) -> bool:
        next_at = max(
            self.now + 1, min(self._machine.scalars[NEXT_TIME], *self._finish_at))
        if self._events:
            next_at = min(next_at, self._events[0][0])
        if self.engine.interpreter.is_wanted():  # it may overtake by then
            next_at = min(next_at, self.now + POLL_NS)
        if next_at > self.end + DRAIN_NS:
            return False
        self.now = next_at
        self._at_once = 0
        advance_machine(self._state, self._machine, next_at)
        return True

    # --- callbacks -------------------------------------------------------------------------------

    def _execute(self, work: Work) -> None:
        """Run a callback that the core has dispatched, as far as it goes without waiting."""
        self._at_once += 1
        if self._at_once > MOST_AT_ONCE:
            raise RerunError(
                f'{work.entity.name}: virtual time does not advance after '
                f'{(self.now - self.start) / 1e9:.6f} s: callbacks start each other and take no '
                'time: declare their execution_time')
        origin = work.origin
        release = 0 if origin is None else self.engine.release_of(work)
        execution = Execution(work, self.now, work.worker, work.worker + 1, release)
        is_driven = work.entity.awaiting is not None
        takes = 0 if is_driven else self._execution_time(work, origin, release)
        set_phases(self._state, self._machine, work.x, 0, -1)  # for now it needs nothing
        if not self._call(execution):
            return
        self.callbacks += 1
        if is_driven:   # one that does not answer only stores its message
            origin = self.engine.answers.job_of(work)
            release = self.engine.open_release(origin) or 0 if origin is not None else 0
            if origin is not None and work.coroutine is None:
                takes = self._times.execution(origin.vertex, release)
        if origin is not None and takes:
            work.cpu_ns = max(0, self._times.computed(origin.vertex, release))
            work.entity.habit.took(takes, takes)
        if execution.worker >= 0 and self.now == execution.start:  # it has not waited
            state, x = self._state, work.x
            state.x_cost[x] = state.x_left[x] = takes
            set_phases(state, self._machine, x, takes, work.cpu_ns)
            self._running[work.worker] = execution
            return
        self.at(max(self.now, execution.start + takes), ENDED, self._end, execution)

    def _call(self, execution: Execution) -> bool:
        """Run an execution's callback; return whether it ran."""
        work = execution.work
        entity = work.entity
        self._current = execution
        try:
            run = work.run if entity.gate is None else partial(entity.gate, work)
            execution.waits_for = run_for(starter_of(work, self), run)
        except Destroyed as why:
            self.engine.destroyed(work, self.now, why.reason)
            return False
        except Refused:
            self.engine.refused(work, self.now)
            return False
        except (Exception, SystemExit) as error:
            if not self.run_threads.over:
                self.refresh_now()  # its node may just have been destroyed
            if isinstance(error, SystemExit) and error.code in (None, 0):
                self.stop()
            elif self.run_threads.over and isinstance(error, InvalidHandle):
                pass  # Kilted destroys the nodes of a context that ends
            elif self.run_threads.over or entity.removed:  # while it has waited
                end = 'the run' if self.run_threads.over else 'its node'
                self.warn(f'{entity.name}: after the end of {end} it raised {describe(error)}')
            else:
                raise CallbackFailed(entity.name, error, self.now - self.start) from error
        finally:
            self._current = None
        return True

    def _execution_time(self, work: Work, origin: Origin | None, release: int) -> int:
        """Return how long a callback takes: its first piece all of it, a sync its last leg."""
        if origin is None or work.coroutine is not None:
            return 0
        state, tables = self._state, self.engine.tables
        first = state.job_base[origin.slot] + tables.region_offset[origin.vertex]
        legs = range(first, first + tables.n_legs[origin.vertex])
        if any(state.x_state[x] != DONE for x in legs if x != work.x):
            return 0
        return self._times.execution(origin.vertex, release)

    def _end(self, execution: Execution) -> None:
        """End an execution in virtual time, or suspend it."""
        work, engine, worker = execution.work, self.engine, execution.worker
        start, waits_for, now = execution.start, execution.waits_for, self.now
        origin = self._origin_of(execution)
        for _, record in execution.sent:
            record(execution.thread)  # before its callback's end
        if waits_for is None:
            engine.finished(work, start, now, now, execution.thread, worker)
            self.on_ended(work.entity.rclpy_object)
        else:
            engine.suspended(work, start, now, execution.thread, worker)
            self._resume_when_done(work, waits_for)
        for leave, _ in execution.sent:
            leave(*origin)

    def _origin_of(self, execution: Execution) -> tuple[Origin | None, int]:
        """Return the job of what an execution publishes, and its release."""
        work = execution.work
        origin = self.engine.origin_of(work)
        if origin is None or origin is work.origin:
            return origin, execution.release
        return origin, self.engine.open_release(origin) or 0

    def _resume_when_done(self, work: Work, waits_for: Any) -> None:
        def resume() -> None:
            self.engine.resume(work, self.now)

        in_run = partial(self.call_in_run, resume)
        if waits_for is not NEXT_TURN and hasattr(waits_for, 'add_done_callback'):
            work.coroutine.suspended(in_run, waits_for)
            return
        work.coroutine.suspended(in_run)
        self.at(self.now + POLL_NS, ARRIVED, resume)

    def send(
        self, leave: Leave, record: Callable[[int], None] = lambda thread: None,
        claim: Claim | None = None,
    ) -> None:
        """
        Send something: when the callback that runs ends, or else at once.

        :param record: records that, as done by a thread of the trace.
        :param claim: on whose behalf it is sent; None: of the callback that runs, if any.
        """
        execution = self.current
        if execution is not None and claim is None:
            execution.sent.append((leave, record))
        elif not self.in_run:
            self.call_in_run(partial(leave, None, 0))
        else:
            record(_LENT + next(self._order))
            if claim is None:
                leave(None, 0)
            else:
                leave(claim.origin, self.engine.open_release(claim.origin) or 0)

    # --- waiting ---------------------------------------------------------------------------------

    def wait(
        self, until: Callable[[], bool] | None, timeout_s: float | None, place: str,
        lends: bool = False,
    ) -> bool:
        """
        Wait in virtual time, in the run thread that calls; return whether it came true.

        :param timeout_s: how long to wait at most; None: there is no timeout.
        :param lends: whether its worker may run something else meanwhile.
        """
        if until is not None and until():
            return True
        deadline = None
        if timeout_s is not None and math.isfinite(timeout_s):
            deadline = self.now + round(timeout_s * 1e9)
            if deadline <= self.now:
                self.note_poll()
                return until is not None and until()
            deadline = self.after_pause(deadline, DRAIN_NS)
        execution = self._current
        if execution is not None:
            sent, execution.sent = execution.sent, []
            for leave, record in sent:
                record(execution.thread)
                leave(*self._origin_of(execution))
            if lends and execution.worker >= 0 and execution.work.x >= 0:
                self.engine.lend(execution.work)
                execution.worker = -1
                execution.thread = _LENT + next(self._order)
        run_thread = self.run_threads.current()
        assert run_thread is not None
        if deadline is not None and deadline <= self.end:
            self.at(deadline, WAITED, self.run_threads.expire, run_thread, deadline)
        run_thread.execution, self._current = execution, None
        try:
            return self.run_threads.wait(run_thread, until, deadline, place)
        finally:
            self._current, run_thread.execution = run_thread.execution, None

    def note_poll(self) -> None:
        """
        Note that the calling run thread has read the time, or polled for something.

        A run thread that polls all the time waits for time to pass: so time passes.
        """
        if self._polled_at != self.now:
            self._polled_at, self._polls = self.now, 0
        self._polls += 1
        if self._polls >= MOST_POLLS:
            self._polls = 0
            self.wait(None, POLL_NS / 1e9, 'for time to pass')

    def warn_of_waiting(self) -> None:
        """Warn of callbacks that wait for something that has not come."""
        for run_thread in self.run_threads.waiting:
            if run_thread.execution is not None and run_thread.deadline is None:
                self.warn(f'{run_thread.execution.work.entity.name}: it still waits '
                          f'({run_thread.place})')

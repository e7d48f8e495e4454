# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The workers: a fixed pool of threads that run what the core dispatches.

Theory of operation
-------------------
A worker that completes takes its next execution itself; an idle worker is woken directly, through
a lock of its own (a *seat*), with the execution that it is to run.  Nobody polls and nobody wakes
more threads than there is work for.

A worker that publishes does not wake an idle one for what it starts by that, if its callback has
always ended *soon* after publishing, lately: then it goes on with that itself, with warm caches
and no switch of threads.  Where that guess is wrong, the next event of any kind wakes the idle
worker, at the latest the spinning thread, which looks every now and then; and it takes many more
right ones until the next guess.

A callback that waits inside ``Client.call`` lends its place: its seat leaves the worker, a spare
seat takes it over, and when the callback completes its thread becomes the next spare.

A coroutine that waits for a future is *suspended*: it keeps its callback group but no worker, and
becomes ready again, under the key it had, when the future is done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
import math
import threading
from time import monotonic_ns
from typing import Any

from mddag_executor.core.rules import schedule, take
from mddag_executor.core.state import N_IDLE
from mddag_executor.live.attribution import PublisherState
from mddag_executor.live.compat import UNKNOWN
from mddag_executor.live.dispatcher import Dispatcher
from mddag_executor.live.entries import AtOnce, Destroyed, Entry, Work
from mddag_executor.live.gates import Refused
from mddag_executor.live.hooks import current
from mddag_executor.live.interpreter import Overseer, ThreadClock
from mddag_executor.live.verdicts import NO_ORIGIN
from mddag_executor.trace.groups import PUBLICATION

STOP = -2
LOOK_AGAIN_S = 0.02
LOOK_POLLED_S = 0.002
ASK_AGAIN_S = 0.01

SOON_NS = 300_000
"""So much time between publishing and the end of a callback is not worth waking a worker."""
SOON_DOUBT = 8
"""After a wrong guess, so many times more often it must have been right before the next one."""


class Seat:
    """A worker thread's place: the worker it is (-1: spare), and what it is to run."""

    __slots__ = (
        'worker', 'wake', 'x', 'work', 'thread', 'vtid', 'clock', 'measured', 'began_ns', 'waits',
        'running')

    def __init__(self, pool: Pool, worker: int) -> None:
        self.running = Running(pool, self)
        self.worker = worker
        self.wake = threading.Lock()
        self.wake.acquire()
        self.x = -1
        self.work: Work | None = None
        self.thread: threading.Thread | None = None
        self.vtid = 0
        self.clock: ThreadClock | None = None
        # when what runs began: by that clock where it is measured, else by the trace's
        self.measured = False
        self.began_ns = 0
        self.waits = False


class Running:
    """What runs in a thread: the hooks find the executor and the job through it."""

    __slots__ = ('pool', 'seat', 'published')

    def __init__(self, pool: Pool, seat: Seat) -> None:
        self.pool = pool
        self.seat = seat
        # when the callback that runs published first (0: not yet)
        self.published = 0

    @property
    def work(self) -> Work:
        """Return the execution that runs on the seat."""
        assert self.seat.work is not None
        return self.seat.work

    def publish(self, send: Any, publisher: Any, msg: Any, state: PublisherState) -> None:
        """Publish on behalf of the running callback."""
        seat = self.seat
        work = seat.work
        assert work is not None
        dispatcher = self.pool.dispatcher
        if dispatcher.record is not None:
            dispatcher.record(PUBLICATION, dispatcher.now(), seat.vtid, id(publisher), id(msg))
        if state.topic not in work.entry.publishes:
            work.entry.publishes.add(state.topic)
        dispatcher.attribution.publish(send, publisher, msg, state, work.origin or NO_ORIGIN)
        if not self.published:
            self.published = monotonic_ns()

    def ends_soon(self, dispatcher: Dispatcher) -> bool:
        """Return whether this callback of this dispatcher is expected to end soon."""
        work = self.seat.work
        return (work is not None and work.entry.soon >= work.entry.soon_from
                and self.pool.dispatcher is dispatcher)

    def ended(self, entry: Entry, now: int) -> None:
        """Note how soon after publishing a callback has ended."""
        if now - self.published < SOON_NS:
            entry.soon += 1
        else:
            if entry.soon >= entry.soon_from:
                entry.soon_from *= SOON_DOUBT
            entry.soon = 0
        self.published = 0

    def waits(self) -> Any:
        """Lend the worker's place while entered."""
        return self.pool.lend(self)


class Pool:
    """
    The worker threads of a dispatcher.

    :param prepare_thread: called first in each worker thread (priority, CPU set).
    """

    def __init__(
        self, dispatcher: Dispatcher, prepare_thread: Callable[[], None] | None = None,
    ) -> None:
        self.dispatcher = dispatcher
        self.running = False
        self.lent = 0
        self._lock = dispatcher.lock
        self._scheduler = dispatcher.scheduler
        self._key = dispatcher.scheduler.policy.key
        self._prepare_thread = prepare_thread
        self._closed = False
        self._seats: list[Seat] = []
        self._spares: list[Seat] = []
        self._lenders: list[Seat] = []
        self._polled: list[Work] = []
        self._refusals = 0
        # what all that have ended computed, about
        self._computed_ns = 0
        self._overseer = Overseer(
            dispatcher.scheduler, dispatcher.lock, self._seat_of,
            lambda: self._dispatch(dispatcher.tick()))
        # entered while a callback that runs in the calling thread of spin_once waits
        self.pump: Callable[[], AbstractContextManager[None]] = nullcontext
        dispatcher.dispatch = self._dispatch

    def start(self) -> None:
        """Let workers run what is ready; starts their threads the first time."""
        with self._lock:
            if self._closed:
                return
            for worker in range(len(self._seats), self.dispatcher.n_workers):
                self._new_seat(worker)
            self.running = True
            self._dispatch(self.dispatcher.tick())

    def pause(self) -> None:
        """Start nothing more; what runs goes on."""
        with self._lock:
            self.running = False

    def start_no_more(self) -> None:
        """Start nothing more, from now on; for those who must not wait for the lock."""
        self.running = False

    def close(self, timeout: float | None) -> bool:
        """
        End the threads; return False when a callback still ran after ``timeout`` seconds.

        A callback that waits for a service is not waited for: nobody would answer it any more.
        """
        with self._lock:
            self.running = False
            seats = self._seats + self._spares + self._lenders
            for seat in seats:
                if not self._closed and seat.work is None:
                    seat.x = STOP
                    seat.wake.release()
            self._closed = True
        self._overseer.close()
        deadline = None if timeout is None else monotonic_ns() + int(timeout * 1e9)
        done = True
        for seat in seats:
            if seat.thread is not threading.current_thread():
                done = self._join(seat, deadline) and done
        return done

    @staticmethod
    def _join(seat: Seat, deadline: int | None) -> bool:
        assert seat.thread is not None
        while seat.thread.is_alive() and not seat.waits:
            left = LOOK_AGAIN_S
            if deadline is not None:
                left = min(left, (deadline - monotonic_ns()) / 1e9)
                if left <= 0:
                    return False
            seat.thread.join(left)
        return True

    def _new_seat(self, worker: int) -> None:
        seat = Seat(self, worker)
        seat.thread = threading.Thread(
            target=self._work_in, args=(seat,), daemon=True, name=f'mddag-worker-{worker}')
        self._seats[worker:worker + 1] = [seat]  # known also when starting it is interrupted
        seat.thread.start()

    def _work_in(self, seat: Seat) -> None:
        seat.vtid = threading.get_native_id()
        seat.clock = ThreadClock()
        if self._prepare_thread is not None:
            try:
                self._prepare_thread()
            except Exception as error:
                self.dispatcher.fail(error)
        while True:
            seat.wake.acquire()
            while seat.x >= 0:
                self._execute(seat, True)
            if seat.x == STOP:
                seat.clock.close()
                return

    def _dispatch(self, now: int) -> None:
        """Wake idle workers for what is ready; the caller holds the lock."""
        state = self._scheduler.state
        if self.dispatcher.held:
            return
        while (self.running and (state.ready or state.unpolled or state.held_back)
               and state.scalars[N_IDLE] > 0):
            x = schedule(self.dispatcher.tables, state, self._key, now)
            if state.decisions:
                self.dispatcher.decided(now)
            if x < 0:
                break
            seat = self._seats[state.x_worker[x]]
            self._assign(seat, x)
            seat.wake.release()
        if state.held_back and self.running and not self._overseer.looking:
            self._overseer.begin()

    def _computed_beside(self, seat: Seat, now: int, before: int) -> int:
        """Return how long others computed since all had computed for ``before`` ns; about."""
        computed = self._computed_ns - before
        for other in self._seats:
            work, clock = other.work, other.clock
            if other is seat or work is None or clock is None:
                continue
            if other.measured:
                computed += clock.computed() - other.began_ns
            elif work.entry.habit.holds:
                computed += now - other.began_ns
        return computed

    def _seat_of(self, worker: int) -> Seat | None:
        seat = self._seats[worker] if worker < len(self._seats) else None
        return seat if seat is not None and seat.work is not None else None

    def _assign(self, seat: Seat, x: int) -> None:
        seat.work = self.dispatcher.take_work(x)
        seat.x = x

    def run_one(self) -> bool:
        """Run one ready callback in the calling thread; False when none may run."""
        state = self._scheduler.state
        ran = False
        while not ran:
            with self._lock:
                if state.scalars[N_IDLE] == 0:
                    return False
                now = self.dispatcher.tick()
                x = self._scheduler.take(state.worker_x.index(-1), now)
                self.dispatcher.decided(now)
                if x < 0:
                    return False
                seat = Seat(self, state.x_worker[x])
                self._assign(seat, x)
            seat.vtid = threading.get_native_id()
            ran = self._execute(seat, False)
        return True

    def _execute(self, seat: Seat, more: bool) -> bool:
        """
        Run the seat's execution until it ends or waits; leave the next one in the seat.

        :return: False when its callback group did not let it run.
        """
        dispatcher = self.dispatcher
        work = seat.work
        assert work is not None
        previous = current.running
        running = current.running = seat.running
        waits_for: Any = None
        ran, refused = True, False
        raised: BaseException | None = None
        start = monotonic_ns() + dispatcher.clock_offset
        clock, habit, gate = seat.clock, work.entry.habit, work.entry.gate
        before = None
        if clock is not None and habit.is_to_be_measured():
            closely = habit.computes_at_all
            before = clock.read(closely)
        seat.began_ns = start if before is None else before[0]
        seat.measured = before is not None
        others = self._computed_ns
        try:
            waits_for = work.step() if gate is None else gate.step(work)
        except Destroyed:
            ran = False
        except Refused:
            refused = True
        except BaseException as error:
            raised = error
        end = monotonic_ns() + dispatcher.clock_offset
        if clock is not None and before is not None and not refused:
            after = clock.read(closely)
            habit.ran(end - start, before, after, partial(
                self._computed_beside, seat, end, others))
            self._computed_ns += after[0] - before[0]
        elif habit.holds:
            self._computed_ns += end - start
        current.running = previous
        if running.published:
            running.ended(work.entry, end - dispatcher.clock_offset)
        with self._lock:
            now = dispatcher.core_time(end)
            if not refused:
                work.entry.busy_ns += end - start
            if refused:
                dispatcher.refuse(work, now)
            elif not ran:
                dispatcher.give_up(work, now)
            elif raised is not None and dispatcher.context_ended():
                dispatcher.leave_open(work, start, end, seat)
            elif waits_for is None:
                dispatcher.complete(work, start, end, now, seat, raised is not None)
            else:
                dispatcher.suspend(work, start, end, seat)
            if dispatcher.refused and not refused:
                dispatcher.ask_again()
            self._next(seat, more, now)
        if raised is not None:  # now, when its job has failed for whoever catches it
            dispatcher.fail(raised)
            raised = None   # it refers to this frame
        if waits_for is not None:
            self._resume_when_done(work, waits_for)
        if dispatcher.verdicts.misses:
            dispatcher.verdicts.tell()
        return not refused

    def _next(self, seat: Seat, more: bool, now: int) -> None:
        """Leave the next execution in the seat; wake others for the rest."""
        seat.x = -1
        seat.work = None
        if self._closed:
            seat.x = STOP
        elif more and seat.worker < 0:
            self._lenders.remove(seat)
            self._spares.append(seat)
        elif more and self.running:
            state = self._scheduler.state
            x = take(self.dispatcher.tables, state, seat.worker, now)
            if state.decisions:
                self.dispatcher.decided(now)
            if x >= 0:
                self._assign(seat, x)
            if not state.ready and not state.unpolled and not state.held_back:
                return
        self._dispatch(now)

    # --- waiting ---------------------------------------------------------------------------------

    def _resume_when_done(self, work: Work, waits_for: Any) -> None:
        if waits_for is UNKNOWN or not hasattr(waits_for, 'add_done_callback'):
            with self._lock:
                self._polled.append(work)
        else:
            waits_for.add_done_callback(AtOnce(partial(self.dispatcher.resume, work)))

    def is_idle(self) -> bool:
        """Return whether nothing runs and nothing is ready."""
        state = self._scheduler.state
        waiting = state.ready or state.unpolled or state.held_back
        return not waiting and state.scalars[N_IDLE] >= self.dispatcher.n_workers

    def resume_polled(self) -> float:
        """
        Let coroutines look again that wait for something unknown; ask again for what was refused.

        And wake idle workers for what is still there because a worker was expected to take it.

        :return: after how many seconds to do so again.
        """
        state = self._scheduler.state
        refusals, self._refusals = self._refusals, self.dispatcher.refusals
        if state.ready or state.unpolled or self.dispatcher.refused:
            with self._lock:
                self.dispatcher.ask_again()
                self._dispatch(self.dispatcher.tick())
        if not self._polled:
            return math.inf if refusals == self._refusals else ASK_AGAIN_S
        with self._lock:
            polled, self._polled = self._polled, []
        for work in polled:
            self.dispatcher.resume(work)
        return LOOK_POLLED_S

    def _give_place(self, seat: Seat) -> None:
        """Have a spare thread take over a worker's place; the caller holds the lock."""
        worker, seat.worker = seat.worker, -1
        if seat.thread is None:  # spin_once: the workers' threads run while it waits
            return
        self._lenders.append(seat)
        if self._spares:
            self._seats[worker] = self._spares.pop()
            self._seats[worker].worker = worker
        else:
            self._new_seat(worker)

    @contextmanager
    def lend(self, running: Running) -> Iterator[None]:
        """Lend the place of a running callback's worker to a spare thread."""
        seat = running.seat
        with self._lock:
            if seat.worker >= 0:  # else it has lent its place before, and goes on without
                self._give_place(seat)
                self._scheduler.lend(running.work.x)
                self.lent += 1
            self._dispatch(self.dispatcher.tick())
        seat.waits = True
        try:
            with nullcontext() if seat.thread is not None else self.pump():
                yield
        finally:
            seat.waits = False

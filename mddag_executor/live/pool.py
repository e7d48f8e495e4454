# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The threads: a fixed pool of workers that run what the engine dispatches.

Theory of operation
-------------------
Everything that happens is given to the engine under one lock, with the time of it.  Times never
decrease: where two threads read the clock in one order and get the lock in the other, the later
gets the earlier one's time.  So the order of a trace's mddag events is that of the core.

1.  A worker that completes takes its next execution itself; an idle one is woken directly, through
    a lock of its own seat, with the execution that it is to run.  Nobody polls, and nobody wakes
    more threads than there is work for.
2.  A worker that publishes does not wake an idle one for what it starts by that, if its callback
    has always ended *soon* after publishing, lately: then it goes on with that itself, with warm
    caches and no switch of threads.  Where that guess is wrong, the next event of any kind wakes
    the idle worker, at the latest the spinning thread, which looks every now and then.
3.  The thread of an intake runs a callback itself, in place of an idle worker, if that has always
    been *brief*, lately (``serve_here``): to wake a worker costs more than such a callback.  Where
    that guess is wrong, ``relieve_intake`` has another thread look after the intake's entities:
    at once where the callback waits for a service, else when the spinning thread looks.
4.  A callback that waits inside ``Client.call`` lends its place: its seat leaves the worker, a
    spare seat takes it over, and when the callback completes its thread becomes the next spare.
5.  A coroutine that waits for a future is *suspended*: it keeps its callback group but no worker,
    and becomes ready again, under the key it had, when the future is done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
import math
import threading
from time import monotonic_ns, thread_time_ns
from typing import Any

from mddag_executor.clocks import TraceClock
from mddag_executor.core import NEVER
from mddag_executor.live.compat import UNKNOWN
from mddag_executor.live.cpu_order import CpuOrder
from mddag_executor.live.deadline_watch import DeadlineWatch
from mddag_executor.live.engine import Engine
from mddag_executor.live.entity import BRIEF_NS, MOST_DEBT, SOON_NS
from mddag_executor.live.groups import Refused
from mddag_executor.live.interpreter import Interpreter
from mddag_executor.live.preemption import Preemption
from mddag_executor.live.seat import current, Seat
from mddag_executor.live.thread_clock import ThreadClock
from mddag_executor.live.work import Destroyed, QuickCallback, Work

LOOK_AGAIN_S = 0.02
LOOK_POLLED_S = 0.002
ASK_AGAIN_S = 0.01

RELIEF_NS = 5_000_000
"""An intake whose thread runs a callback for so long gets another thread."""


class Pool:
    """
    The worker threads, and the lock and the clock of the engine.

    :param fail: gets every exception that a callback lets out.
    :param context_ended: whether the context has ended: callbacks fail then for that alone.
    :param prepare_thread: called first in each worker thread (priority, CPU set).
    :param preempt: whether what computes in Python is to pause for what is more urgent.
    """

    def __init__(
        self, engine: Engine, clock: TraceClock, fail: Callable[[BaseException], None],
        context_ended: Callable[[], bool], prepare_thread: Callable[[], None] | None = None,
        preempt: bool = False,
    ) -> None:
        self.engine = engine
        self.clock = clock
        self.lock = threading.Lock()
        self.running = False
        # when it began to start nothing more; 0: it has not
        self.stopped_at = 0
        self.lent = 0
        # whether the registry knows of all entities that were made or destroyed
        self.is_settled = False
        # called to have another thread do what the intake's does not (True), and no longer
        self.relieve_intake: Callable[[bool], None] = lambda relieved: None
        # entered while a callback that runs in the calling thread of spin_once waits
        self.pump: Callable[[], AbstractContextManager[None]] = nullcontext
        self._fail = fail
        self._context_ended = context_ended
        self._prepare_thread = prepare_thread
        self._last = 0
        self._batches = 0
        self._closed = False
        self._seats: list[Seat] = []
        self._spares: list[Seat] = []
        self._lenders: list[Seat] = []
        self._intakes: list[Seat] = []
        self._polled: list[Work] = []
        self._refusals = 0
        self.cpu_order: CpuOrder | None = None
        self.preemption = Preemption() if preempt else None
        self.watch = DeadlineWatch(self.lock, self.judge_overdue, clock.now, fail)
        # called, without the lock, after it was judged what is overdue
        self.after_judging: Callable[[], None] = lambda: None
        self.interpreter = Interpreter(
            engine, self.lock, self._seats, self._hand_out_now, self.preemption)

    # --- reports to the engine -------------------------------------------------------------------

    def report(self, event: Callable[..., None], *args: Any) -> None:
        """
        Give the engine an event, and have run what is ready then.

        :param event: a method of the engine; it gets the arguments and the time.
        """
        own = None
        with self.lock:
            now = monotonic_ns() + self.clock.offset_ns
            if now < self._last:
                now = self._last
            self._last = now
            event(*args, now)
            if self.engine.deadlines.next < self.watch.at:
                self.watch.wait_for(self.engine.deadlines.next)
            running = current.running
            if running is None:
                own = self._hand_out(now, current.intake)
            elif not (running.published and running.engine is self.engine
                      and running.work is not None and not running.work.entity.ends_soon.debt):
                self._hand_out(now)  # else who has published goes on with it soon
        if own is not None:
            self._run_here(own)

    def runs_alone(self, work: Work) -> bool:
        """Run an undeclared callback in the calling thread, an intake's, if it may at once."""
        seat = current.intake
        if seat is None or seat.work is not None:
            return False
        with self.lock:
            if not self.running or self._batches or not self.engine.begins_alone(work):
                return False
            seat.worker = work.worker
            seat.work = work
        self._run_here(seat)
        return True

    def _run_here(self, seat: Seat) -> None:
        """Run what is in the seat of an intake's thread, in that."""
        self._execute(seat)
        if seat.relieved:
            seat.relieved = False
            self.relieve_intake(False)

    @contextmanager
    def batch(self) -> Iterator[None]:
        """
        Start nothing while entered: more is going to become ready at this instant.

        Else the first of several would start though a more urgent one follows.
        """
        with self.lock:
            self._batches += 1
        try:
            yield
        finally:
            with self.lock:
                self._batches -= 1
                self._hand_out(self.tick())

    def tick(self) -> int:
        """Return the engine's time now; the caller holds the lock."""
        self._last = max(self._last, self.clock.now())
        return self._last

    def judge_overdue(self) -> None:
        """Report the sinks whose deadlines are over; of a run that has ended, as of its end."""
        with self.lock:
            now = self.tick()
            self.engine.judge_overdue(min(now, self.stopped_at or now))
            if self.running:
                self.watch.wait_for(self.engine.deadlines.next)
        self.after_judging()

    def resume(self, work: Work) -> None:
        """Make a suspended execution ready to go on."""
        with self.lock:
            self.engine.resume(work)
            self._hand_out(self.tick())

    def leave_group(self, work: Work) -> None:
        """Note that an execution may run: its callback group has let it through."""
        with self.lock:
            self.engine.leave_group(work)
            self._hand_out(self.tick())

    # --- threads ---------------------------------------------------------------------------------

    def start(self) -> None:
        """Let workers run what is ready; starts their threads the first time."""
        with self.lock:
            if self._closed:
                return
            for worker in range(len(self._seats), self.engine.n_workers):
                self._new_thread(worker)
            self.running = True
            self.stopped_at = 0
            self.watch.wait_for(self.engine.deadlines.next)
            self._hand_out(self.tick())

    def pause(self) -> None:
        """Start nothing more; what runs goes on."""
        with self.lock:
            self.start_no_more()
            if self.preemption is not None:
                self.preemption.update(())

    def start_no_more(self) -> None:
        """Start nothing more, from now on; for those who must not wait for the lock."""
        if self.running:
            self.stopped_at = self.clock.now()
            self.running = False

    def close(self, timeout: float | None) -> bool:
        """
        End the threads; return False when a callback still ran after ``timeout`` seconds.

        A callback that waits for a service is not waited for: nobody would answer it any more.
        """
        with self.lock:
            self.start_no_more()
            seats = self._seats + self._spares + self._lenders
            for seat in seats:
                if not self._closed and seat.work is None:
                    seat.ended = True
                    seat.wake.release()
            self._closed = True
            if self.preemption is not None:
                self.preemption.close()
            seats += self._intakes
        self.interpreter.close()
        self.watch.close()
        deadline = None if timeout is None else monotonic_ns() + int(timeout * 1e9)
        done = True
        for seat in seats:
            done = self._join(seat, deadline) and done
        return done

    @staticmethod
    def _join(seat: Seat, deadline: int | None) -> bool:
        """Wait until a seat's thread has ended, of an intake's until it runs nothing."""
        if seat.vtid == threading.get_native_id():
            return True
        while (seat.thread.is_alive() if seat.thread is not None else seat.work) and (
                not seat.waits):
            left = LOOK_AGAIN_S
            if deadline is not None:
                left = min(left, (deadline - monotonic_ns()) / 1e9)
                if left <= 0:
                    return False
            if seat.thread is not None:
                seat.thread.join(left)
            else:
                threading.Event().wait(min(left, 0.001))
        return True

    def _new_seat(self, worker: int) -> Seat:
        return Seat(self.engine, self.clock, worker, self._lend)

    def _new_thread(self, worker: int) -> None:
        seat = self._new_seat(worker)
        seat.thread = threading.Thread(
            target=self._work_in, args=(seat,), daemon=True, name=f'mddag-worker-{worker}')
        self._seats[worker:worker + 1] = [seat]  # known also when starting it is interrupted
        seat.thread.start()

    def _work_in(self, seat: Seat) -> None:
        seat.vtid = threading.get_native_id()
        seat.cpu_clock = ThreadClock()
        if self._prepare_thread is not None:
            try:
                self._prepare_thread()
            except Exception as error:
                self._fail(error)
        while not seat.ended:
            seat.wake.acquire()  # once for each assignment by another thread
            goes_on = seat.work is not None  # else it was woken to end
            while goes_on:
                goes_on = False
                try:
                    goes_on = self._execute(seat)
                except BaseException as error:  # the executor's own: a callback's were handled
                    self._fail(error)
        seat.cpu_clock.close()

    @contextmanager
    def serve_here(self) -> Iterator[None]:
        """Let the calling thread, an intake's, run brief callbacks itself while entered."""
        if self._prepare_thread is not None:  # it is not as the workers are
            yield
            return
        seat = self._new_seat(-1)
        seat.vtid = threading.get_native_id()
        with self.lock:
            self._intakes.append(seat)
        current.intake = seat
        try:
            yield
        finally:
            current.intake = None
            with self.lock:
                self._intakes.remove(seat)

    # --- what to run -----------------------------------------------------------------------------

    def _hand_out(self, now: int, own: Seat | None = None) -> Seat | None:
        """
        Wake idle workers for what is ready; the caller holds the lock.

        :param own: the caller's seat where it may run a brief callback itself.
        :return: that seat where it is to run one.
        """
        engine = self.engine
        chosen = None
        more = self.running and not self._batches
        while more:
            work = engine.dispatch(now)
            more = engine.has_more and work is not None
            if work is None:
                break
            if own is not None and chosen is None and not work.entity.is_brief.debt:
                chosen = own
                own.worker = work.worker
                own.work = work
                continue
            seat = self._seats[work.worker]
            seat.work = work
            seat.wake.release()
        if engine.holders and any(engine.queues) or engine.is_shared or self.interpreter.rings_at:
            self.interpreter.look_after()
        return chosen

    def _hand_out_now(self) -> None:
        self._hand_out(self.tick())

    def run_one(self) -> bool:
        """Run one ready callback in the calling thread; False when none may run."""
        while True:
            with self.lock:
                work = self.engine.dispatch(self.tick())
                if work is None:
                    return False
                seat = self._new_seat(work.worker)
                seat.work = work
            seat.vtid = threading.get_native_id()
            before = current.running    # a callback that steps the executor itself
            self._execute(seat)
            current.running = before
            if not seat.refused:
                return True

    def _execute(self, seat: Seat) -> bool:
        """
        Run the seat's execution until it ends or waits; leave a worker's next one in the seat.

        :return: whether there is a next one. What another thread puts into the seat later is not
            meant: that thread wakes the worker for it.
        """
        work, engine, offset = seat.work, self.engine, self.clock.offset_ns
        assert work is not None
        goes_on = False
        entity = work.entity
        waits_for: Any = None
        raised: BaseException | None = None
        current.running = seat
        seat.began_ns = start = monotonic_ns() + offset
        if seat.cpu_clock is not None:
            if self.cpu_order is not None:
                self.cpu_order.starts(seat, start)
            seat.reading = None
            habit = entity.habit
            habit.runs += 1
            if habit.runs >= habit.due and habit.is_to_be_measured():
                self.interpreter.begins(seat, habit)
        # In this order: what was dispatched just before it was removed is not settled, either.
        work.is_known = self.is_settled and not entity.removed
        traced = engine.record is not None
        if traced:
            work.cpu_ns -= thread_time_ns()
        try:
            waits_for = work.step() if entity.gate is None else entity.gate.step(work)
        except BaseException as error:
            raised = error
        if traced:
            work.cpu_ns += thread_time_ns()
        end = monotonic_ns() + offset
        current.running = None
        if seat.published:
            after = end - offset - seat.published
            if entity.ends_soon.debt or after > SOON_NS:
                entity.ends_soon.took(after, entity.ran)
            seat.published = 0
        took, debt = end - start, entity.is_brief.debt
        if debt < MOST_DEBT if took > BRIEF_NS else debt:
            entity.is_brief.took(took, entity.ran)
        if seat.reading is not None:
            self.interpreter.ended(seat, entity.habit, took)
        with self.lock:
            now = self._last = end if end > self._last else self._last
            if raised is None and waits_for is None:
                entity.busy_ns += took
                engine.finished(work, start, end, now, seat.vtid, seat.worker)
            else:
                self._report_outcome(seat, work, waits_for, raised, start, end, now)
            if engine.to_ask_again and type(raised) is not Refused:
                engine.ask_again()
            seat.work = None
            if seat.thread is None:
                seat.began_ns = NEVER
                if any(engine.queues) or engine.is_shared or self.interpreter.rings_at:
                    self._hand_out(now)
            elif self._closed or not self.running or seat.worker < 0:
                self._leave(seat, now)
            else:
                seat.work = engine.dispatch(now, seat.worker)
                goes_on = seat.work is not None
                if engine.has_more:
                    self._hand_out(now)
                elif (engine.holders and any(engine.queues) or engine.is_shared
                        or self.interpreter.rings_at):
                    self.interpreter.look_after()
        if waits_for is not None:
            self._resume_when_done(work, waits_for)
        elif raised is not None:  # now, when its job has failed for whoever catches it
            if not isinstance(raised, (Destroyed, Refused)):
                self._fail(raised)
            raised = None   # it refers to this frame
        return goes_on

    def _report_outcome(
        self, seat: Seat, work: Work, waits_for: Any, raised: BaseException | None, start: int,
        end: int, now: int,
    ) -> None:
        """Give the engine what became of an execution that has not simply ended."""
        engine = self.engine
        if isinstance(raised, Refused):
            seat.refused = True
            engine.refused(work, now)
            return
        engine.report_alone(now)
        work.entity.busy_ns += end - start
        if waits_for is not None:
            engine.suspended(work, start, end, seat.vtid, seat.worker)
        elif self._context_ended():  # which may destroy nodes, too
            engine.left_open(
                work, start, end, seat.vtid, seat.worker, not isinstance(raised, Destroyed))
        elif isinstance(raised, Destroyed):
            engine.destroyed(work, now)
        else:
            engine.finished(work, start, end, now, seat.vtid, seat.worker, True)

    def _leave(self, seat: Seat, now: int) -> None:
        """Leave nothing to run in a thread's seat: it ends, is a spare again, or pauses."""
        if self._closed:
            seat.ended = True
        elif seat.worker < 0:
            self._lenders.remove(seat)
            self._spares.append(seat)
        self._hand_out(now)

    # --- waiting ---------------------------------------------------------------------------------

    def _resume_when_done(self, work: Work, waits_for: Any) -> None:
        if waits_for is UNKNOWN or not hasattr(waits_for, 'add_done_callback'):
            with self.lock:
                self._polled.append(work)
            return
        try:
            waits_for.add_done_callback(QuickCallback(partial(self.resume, work)))
        except BaseException as error:  # it may be of a class of the user's
            self._fail(error)

    def is_idle(self) -> bool:
        """Return whether nothing runs and nothing is ready."""
        return not self.engine.has_waiting and self.engine.alone is None and (
            self.engine.idle_workers >= self.engine.n_workers)

    def look_around(self) -> float:
        """
        Do what nobody else does; the thread that spins calls this now and then.

        Coroutines look again that wait for something unknown, callback groups are asked again
        that have refused something, idle workers are woken for what is still there because a
        worker was expected to take it, and an intake is relieved whose callback does not end.

        :return: after how many seconds to do so again.
        """
        engine = self.engine
        refusals, self._refusals = self._refusals, engine.refusals
        if engine.has_waiting or engine.to_ask_again:
            with self.lock:
                engine.ask_again()
                self._hand_out(self.tick())
        self.relieve_late_intakes()
        if not self._polled:
            return math.inf if refusals == self._refusals else ASK_AGAIN_S
        with self.lock:
            polled, self._polled = self._polled, []
        for work in polled:
            self.resume(work)
        return LOOK_POLLED_S

    def relieve_late_intakes(self) -> None:
        """Relieve the intake if its thread has been running a callback for long."""
        for seat in self._intakes:
            if seat.work is not None and not seat.relieved and (
                    self.clock.now() - seat.began_ns > RELIEF_NS):
                self._relieve(seat)

    def _relieve(self, seat: Seat) -> None:
        seat.relieved = True
        self.relieve_intake(True)

    def _give_place(self, seat: Seat) -> None:
        """Have a spare thread take over a worker's place; the caller holds the lock."""
        worker, seat.worker = seat.worker, -1
        if seat.thread is None:  # the worker's own thread goes on
            return
        self._lenders.append(seat)
        if self._spares:
            self._seats[worker] = self._spares.pop()
            self._seats[worker].worker = worker
        else:
            self._new_thread(worker)

    @contextmanager
    def _lend(self, seat: Seat) -> Iterator[None]:
        """Lend the worker of a running callback to a spare thread."""
        with self.lock:
            self.engine.report_alone(self.tick())
            if seat.worker >= 0:  # else it has lent its place before, and goes on without
                self._give_place(seat)
                assert seat.work is not None
                self.engine.lend(seat.work)
                self.lent += 1
            self._hand_out(self.tick())
        goes_on: AbstractContextManager[None] = nullcontext()
        if seat in self._intakes:
            self._relieve(seat)
        elif seat.thread is None:
            goes_on = self.pump()
        seat.waits = True
        try:
            with goes_on:
                yield
        finally:
            seat.waits = False

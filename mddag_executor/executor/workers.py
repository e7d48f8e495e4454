# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The worker threads: they wait for what happens, tell the engine, and run what it dispatches.

Theory of operation
-------------------
1.  *A turn.*  A worker thread reports the end of its last execution, takes what has arrived, and
    asks the engine for the next execution: all of it in one section under one lock.  If there is
    none, it waits in the epoll (``loop``); the kernel wakes exactly one thread for each event.
2.  *Nothing is overlooked.*  When no thread waits in the epoll after an execution, the thread
    polls it before it asks the engine, so that an urgent arrival is known before the next choice.
3.  *Waking others.*  If more than one execution may start, one waiting thread is woken, which
    does the same.  But whatever waits is left to a thread that will be there for it within
    ``SOON_NS``: its callback usually ends so soon, or did so after it had published, lately.
    The timerfd wakes another thread ``WAKE_GUARD_NS`` later in any case, so a wrong guess costs
    no more than that.
4.  *Threads wait in the epoll as they are needed.*  A spin begins with one of them; another is
    admitted when an execution starts and none waits.  All others are parked, each on a lock of
    its own, which is released exactly once for each admission.
5.  *Time.*  One timerfd stands for the next timer, deadline of an open job, check of who holds
    the GIL, and call that somebody asked for (``call_at``).
6.  *Lending.*  A callback that waits inside ``Client.call`` gives its worker back to the core; if
    fewer threads are left than there are workers, a new one is made.  ``MOST_LENT`` may do so at
    the same time; more of them keep their workers.
7.  *Coroutines.*  A coroutine that waits for a future is suspended: it keeps its callback group
    but no worker, and becomes ready again, under the key it had, when the future is done.
8.  Whatever a callback raises, or a thread of the pool itself, goes to ``fail`` and ends the
    spin.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from heapq import heappop, heappush
import threading
from time import monotonic_ns, process_time_ns, thread_time_ns
from typing import Any

from mddag_executor.clocks import TraceClock
from mddag_executor.core import NEVER
from mddag_executor.executor.compat import NEXT_TURN
from mddag_executor.executor.debugging import engine_lock
from mddag_executor.executor.engine import Engine, LONG_NS
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.gil import (
    FIRST_CHECK_NS,
    GilCheck,
    SURE_CHECK_NS,
    times_preempted,
)
from mddag_executor.executor.groups import Refused
from mddag_executor.executor.inbox import Inbox
from mddag_executor.executor.jobs import Publication
from mddag_executor.executor.loop import ALWAYS, ChannelSource, EventLoop, Events, urgency_of
from mddag_executor.executor.sources import SubscriptionSource
from mddag_executor.executor.timers import TimerQueue
from mddag_executor.executor.work import current, Destroyed, QuickCallback, Work
from mddag_executor.trace.groups import PUBLICATION

SOON_NS = 300_000
"""
No other thread is woken while a callback runs that usually ends within this time.

Waking a thread costs 60 to 140 us beside a callback that computes.
"""
WAKE_GUARD_NS = 1_000_000
"""The longest that something ready waits because a callback was expected to end."""
STOP_NS = 5_000_000
"""A wake-up that is late by this, while the process computes nothing, is a stop of the machine."""
YIELD_STEP_NS, MOST_YIELD_NS = 1_000, 2_000_000
"""
A coroutine that yields continues in the next turn, each time in a row this much later, up to 2 ms.

So one that yields a few times loses nothing, and one that polls does not compute all the time.
"""
ASK_AGAIN_NS = 10_000_000
"""A callback group that has refused an execution is asked again after this."""
CONTEXT_CHECK_NS = 100_000_000
"""How often it is checked, when a timer is due, whether the context has been destroyed."""
LEAVE_S = 1.0
"""How long a pause waits for the threads in the epoll to leave it; it takes less than 1 ms."""
MOST_LENT = 64
"""So many callbacks may wait in ``Client.call`` without a worker."""


class WorkerThread:
    """
    A thread that runs callbacks.

    :ivar work: the execution that it runs.
    :ivar worker: the worker of the core that it was last.
    :ivar permit: released when it is admitted to the epoll.
    :ivar has_lent: whether its callback has given its worker back; ``waits``: and waits.
    :ivar is_polling: whether it waits in the epoll; ``is_parked``: for a permit.
    :ivar published: when the callback that runs has published first (monotonic ns); 0: not yet.
    :ivar start: when the execution began that has just ended, and ``end``: when it ended, on the
        trace's clock.
    :ivar waits_for: what that waits for, if it goes on later; ``raised``: what it has raised.
    """

    __slots__ = ('work', 'worker', 'permit', 'thread', 'vtid', 'ident', 'waits', 'published',
                 'is_polling', 'is_parked', 'has_lent', 'pool', 'engine', 'start', 'end',
                 'waits_for', 'raised')

    def __init__(self, pool: WorkerPool, thread: threading.Thread | None) -> None:
        self.pool = pool
        self.engine = pool.engine
        self.thread = thread
        self.work: Work | None = None
        self.worker = 0
        self.permit = threading.Lock()
        self.permit.acquire()
        self.vtid = self.ident = 0
        self.waits = self.has_lent = self.is_polling = False
        self.is_parked = True
        self.published = self.start = self.end = 0
        self.waits_for: Any = None
        self.raised: BaseException | None = None

    def begin(self) -> None:
        """Note which thread it is; called in the thread."""
        self.vtid, self.ident = threading.get_native_id(), threading.get_ident()

    def publishes(self, publisher: Any, msg: Any, topic: str) -> None:
        """Note that its callback publishes."""
        record, work = self.engine.record, self.work
        if record is not None:
            record(PUBLICATION, self.pool.clock.now(), self.vtid, id(publisher), id(msg))
        if work is not None and topic not in work.entity.publishes:
            work.entity.publishes.add(topic)
        if not self.published:
            self.published = monotonic_ns()

    def lend(self) -> Any:
        """Lend its worker while entered: the callback waits for a service."""
        return self.pool.lend(self)

    @property
    def job(self) -> tuple[str, int, int] | None:
        """Return DAG, index and release of the job whose callback runs; None for no job."""
        work = self.work
        if work is None or work.origin is None:
            return None
        return (self.engine.dag_names[work.origin.dag], work.origin.job,
                self.engine.release_of(work))


class WorkerPool:
    """
    The worker threads, with the lock and the clock of the engine.

    :param fail: gets every exception that a callback lets out.
    :param context_ended: whether the context has ended: callbacks fail then for that reason.
    :param prepare_thread: called first in each worker thread (priority, CPU set).
    :param inbox: gets what was taken.
    :ivar running: whether executions may start.
    :ivar stopped_at: when that ended, on the trace's clock; 0: it has not.
    :ivar is_current: whether the registry knows of all entities that were made or destroyed.
    """

    def __init__(
        self, engine: Engine, clock: TraceClock, inbox: Inbox,
        fail: Callable[[BaseException], None], context_ended: Callable[[], bool],
        prepare_thread: Callable[[], None] | None = None,
    ) -> None:
        self.engine = engine
        self.clock = clock
        # reentrant only so that it knows its owner, as a signal handler may run in there
        self.lock = engine_lock(engine.validate, engine.size)
        self._deferred: deque[Callable[[], None]] = deque()
        self.loop = EventLoop()
        self.inbox = inbox
        inbox.tick = self.tick
        self.timers = TimerQueue(self._jumped, lambda: self.entities_changed(), fail)
        self.running = False
        self.stopped_at = 0
        self.is_current = False
        self.lent = 0
        #: called with something to run while a callback of ``spin_once`` waits in ``Client.call``
        self.serve_meanwhile: Callable[[], Any] | None = None
        #: called with a future that a coroutine awaits
        self.adopt: Callable[[Any], None] = lambda future: None
        #: called after each callback: see ``MultiDeadlineExecutor.on_callback_ended``
        self.callback_ended: Callable[[Any, BaseException | None], bool] | None = None
        #: called when there is something that the registry does not know of
        self.entities_changed: Callable[[], None] = lambda: None
        #: called when deadlines were missed
        self.missed: Callable[[], None] = lambda: None
        #: called when it is noticed that the context has ended
        self.context_ended: Callable[[], None] = lambda: None
        #: called with begin and end of a time in which no thread of the process ran (monotonic)
        self.stopped: Callable[[int, int], None] = lambda begin, end: None
        self._fail = fail
        self._context_ended = context_ended
        self._prepare_thread = prepare_thread
        self._threads: list[WorkerThread] = []
        self._parked: list[WorkerThread] = []
        self._visitors: list[WorkerThread] = []
        self._polling = 0
        self._waiting_calls = 0
        self._bell_rings = False
        self._closed = False
        self._leaving = False
        self._all_left = threading.Event()
        self._is_stepping = False
        # the coroutines that have yielded: they continue in the next step
        self._of_next_step: list[Work] = []
        self._last = 0
        self._misses = 0
        self._check_context_at = 0
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._agenda_entries = 0
        self._gil_check = GilCheck()
        self._muted_until = 0
        self._muted_bound = 0
        # when to look at what was left to a callback that was to end soon; 0: nothing was
        self._guard_at = 0
        # whether the timerfd is set to something that may not have to be done
        self._may_expire_early = False
        self._seen = monotonic_ns(), process_time_ns()

    # --- what happens elsewhere ------------------------------------------------------------------

    def tick(self) -> int:
        """Return the engine's time now; it never decreases.  The caller has the lock."""
        now = monotonic_ns() + self.clock.offset_ns
        if now < self._last:
            now = self._last
        self._last = self.inbox.now = now
        return now

    def report(self, event: Callable[..., None], *args: Any) -> None:
        """
        Give the engine an event, and have run what is ready then.

        :param event: a method of the engine; it gets the arguments and the time.
        """
        if self._is_inside():
            self._defer(partial(self.report, event, *args))
            return
        with self.lock:
            event(*args, self.tick())
            self._wake_for_more()

    def _is_inside(self) -> bool:
        """Return whether the calling thread has the lock: in a signal handler or a finalizer."""
        return self.lock._is_owned()  # type: ignore[no-any-return]

    def _defer(self, function: Callable[[], None]) -> None:
        """Have something done as soon as the lock is free."""
        self._deferred.append(function)
        self.loop.wake()

    def post(self, several: list[Work]) -> None:
        """Make executions ready that no DAG declares."""
        if self._is_inside():
            self._defer(partial(self.post, several))
            return
        with self.lock:
            now = self.tick()
            for work in several:
                self.engine.ready(work, now)
            self._wake_for_more()

    def resume(self, work: Work) -> None:
        """Make a suspended execution ready to go on."""
        if self._is_inside():
            self._defer(partial(self.resume, work))
            return
        with self.lock:
            self.tick()
            self.engine.resume(work)
            self._wake_for_more()

    def leave_group(self, work: Work) -> None:
        """Note that an execution may run: its callback group has let it through."""
        with self.lock:
            self.tick()
            self.engine.leave_group(work)
            self._wake_for_more()

    def call_at(self, at: int, function: Callable[[], None]) -> None:
        """Have a function called at a time (monotonic ns), without the lock, by a worker."""
        with self.lock:
            self.call_at_locked(at, function)
            self._arm(monotonic_ns())

    def call_at_locked(self, at: int, function: Callable[[], None]) -> None:
        """Like ``call_at``; the caller has the lock, and it is armed at the end of its turn."""
        self._agenda_entries += 1
        heappush(self._agenda, (at, self._agenda_entries, function))

    def _jumped(self) -> None:
        """Note, from any thread, that the clock of timers has jumped."""
        self.loop.wake()

    def _wake_for_more(self) -> None:
        """Wake a thread if an idle worker may start something; the caller has the lock."""
        if not self.running:
            return
        if self.engine.may_start_more(self._last):
            running = current.running
            if (running is None or running.pool is not self or not running.published
                    or running.work is None or running.work.entity.tail_ns > SOON_NS):
                self._wake_one()
            elif not self._guard_at:
                self._guard_at = self._last - self.clock.offset_ns + WAKE_GUARD_NS
                self._arm_earlier(self._guard_at)
        elif self.engine.holders and self.engine.has_waiting:
            self._watch_holder(monotonic_ns())
            at = self._gil_check.at
            if at:
                self._arm_earlier(at)

    def _arm_earlier(self, at: int) -> None:
        """Have the timerfd expire by this time (monotonic ns)."""
        if not 0 < self.loop.timer.at <= at:
            self._may_expire_early = True
            self.loop.timer.arm(at)

    def _wake_one(self) -> None:
        if self._polling or self._is_stepping:
            if not self._bell_rings:
                self._bell_rings = True
                self.loop.wake()
        else:
            self._admit()

    def _admit(self) -> None:
        """Let one more thread wait in the epoll; the caller has the lock."""
        if self._parked and (self.running or self._closed) and not self._is_stepping:
            self._parked.pop().permit.release()

    # --- threads ---------------------------------------------------------------------------------

    def start(self) -> None:
        """Let executions start; makes the threads the first time."""
        self._resume_of_last_step()
        with self.lock:
            if self._closed:
                return
            self.running = True
            self._is_stepping = False
            self.stopped_at = 0
            self._seen = monotonic_ns(), process_time_ns()
            self._arm(self.tick() - self.clock.offset_ns)
            while len(self._threads) < self.engine.n_workers:
                self._new_thread()
            if not self._polling:
                self._admit()

    def pause(self) -> None:
        """Start nothing more; what runs goes on.  No thread waits in the epoll any more then."""
        with self.lock:
            self.start_no_more()
            self._unmute()
            self._arm(0)
            if not self._polling or self._leaving:
                return
            self._leaving = True
            self._all_left.clear()
            self.loop.wake_all()
        self._all_left.wait(LEAVE_S)
        with self.lock:
            self._leaving = False
            self.loop.let_wait()

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
        self.pause()
        with self.lock:
            self._closed = True
            while self._parked:
                self._admit()
            threads = list(self._threads)
        deadline = None if timeout is None else monotonic_ns() + int(timeout * 1e9)
        done = True
        for each in threads:
            done = self._join(each, deadline) and done
        return done

    @staticmethod
    def _join(each: WorkerThread, deadline: int | None) -> bool:
        """Wait until a thread has ended; return whether it has."""
        thread = each.thread
        if thread is None or thread is threading.current_thread():
            return True
        while thread.is_alive() and not each.waits:
            left = 0.02  # its callback may begin to wait
            if deadline is not None:
                left = min(left, (deadline - monotonic_ns()) / 1e9)
                if left <= 0:
                    return False
            try:
                thread.join(left)
            except RuntimeError:
                break  # just being started
        return True

    def _new_thread(self) -> WorkerThread:
        me = WorkerThread(self, None)
        me.worker = len(self._threads) % self.engine.n_workers
        me.thread = threading.Thread(
            target=self._run, args=(me,), daemon=True, name=f'mddag-worker-{len(self._threads)}')
        self._threads.append(me)
        self._parked.append(me)
        me.thread.start()
        return me

    def _run(self, me: WorkerThread) -> None:
        me.begin()
        try:
            if self._prepare_thread is not None:
                self._prepare_thread()
        except Exception as error:
            self._fail(error)
        try:
            self._work(me)
        except BaseException as error:
            self._fail(error)
        finally:
            with self.lock:
                self._threads.remove(me)
                if me in self._parked:
                    self._parked.remove(me)
                if me.is_polling:  # it has failed
                    me.is_polling = False
                    self._polling -= 1

    def _work(self, me: WorkerThread) -> None:
        """Take turns until the pool is closed."""
        loop = self.loop
        me.permit.acquire()
        me.is_parked = False
        has_ended = False
        events: Events = []
        while True:
            has_ended = self._turn(me, has_ended, events)
            events = []
            if has_ended:
                self._execute(me)
                if not self._polling:
                    events = loop.wait(0)
            elif me.is_parked:
                if self._closed:
                    return
                me.permit.acquire()
                me.is_parked = False
            else:
                events = loop.wait()

    # --- a turn ----------------------------------------------------------------------------------

    def _turn(
        self, me: WorkerThread, has_ended: bool, events: Events, is_last: bool = False
    ) -> bool:
        """
        Report what has ended, take what has arrived, and find what to run: ``me.work``.

        False: there is nothing, and the thread is to wait in the epoll, or is parked.

        :param has_ended: the thread has just run ``me.work``.
        :param is_last: nothing more is to run in this thread.
        """
        arrived: list[ChannelSource] = []
        expired = False
        if events:
            arrived, asking, expired = self.loop.sources(events)
            for source in asking:
                if self.running:
                    source.collect()
                else:
                    self.loop.announce(source)  # for the next spin
        if self._deferred:
            self._do_deferred()
        calls: list[Callable[[], None]] = []
        timed: list[Callable[[], None]] = []
        with self.lock:
            now = self.tick()
            if me.is_polling:
                me.is_polling = False
                self._polling -= 1
                if not self._polling:
                    self._all_left.set()
            if has_ended:
                self._report_end(me, now, calls)
            if events:
                self._bell_rings = False  # whoever waits may have heard it
                for source in arrived:
                    if self.running:
                        source.collect()
                    else:
                        self.loop.announce(source)
            if self._muted_until and not self.engine.holders:
                self._unmute()
            if (expired or self.timers.has_jumped) and self.running:
                timed = self._on_time(now, waited=not has_ended)
            found = not timed and not is_last and self._choose(me, now)
            if (expired or self._may_expire_early and not found
                    or self._is_due_earlier(now - self.clock.offset_ns)):
                self._arm(now - self.clock.offset_ns)
            if self._misses != self.engine.verdicts.missed:
                self._misses = self.engine.verdicts.missed
                calls.append(self.missed)
        if calls or timed:
            self._call(calls + timed)
        return self._turn(me, False, []) if timed else found

    def _do_deferred(self) -> None:
        """Do what was to wait for the lock."""
        while self._deferred:
            try:
                function = self._deferred.popleft()
            except IndexError:
                break  # another thread has taken it
            function()

    def _call(self, functions: list[Callable[[], None]]) -> None:
        """Call functions, of which none may end the thread."""
        for function in functions:
            try:
                function()
            except BaseException as error:
                self._fail(error)

    def _choose(self, me: WorkerThread, now: int) -> bool:
        """Set what to run, or where to wait; return whether there is something to run."""
        engine = self.engine
        self._guard_at = 0
        work = engine.dispatch(me.worker, now) if self.running else None
        if work is None:
            self._rest(me)
            return False
        me.worker = work.worker
        me.work = work
        holders = engine.holders
        if holders and (self._muted_until or holders[0].entity.habit.mean_ns >= LONG_NS):
            self._mute_if_long(work, now)
        if not self._polling and not self._is_stepping:
            self._admit()
        elif engine.may_start_more(now):
            if work.entity.wall_ns > SOON_NS:
                self._wake_one()
            else:
                self._guard_at = now - self.clock.offset_ns + WAKE_GUARD_NS
        return True

    def _rest(self, me: WorkerThread) -> None:
        """Have a thread that found nothing to run wait in the epoll, or be parked."""
        active = len(self._threads) - self._waiting_calls - len(self._parked)
        if me.thread is None:  # a visitor: the thread of a spin_once
            return
        if self.running and active <= self.engine.n_workers:
            me.is_polling = True
            self._polling += 1
        else:
            me.is_parked = True
            if not self._closed:
                self._parked.append(me)

    def _on_time(self, now: int, waited: bool) -> list[Callable[[], None]]:
        """
        Handle what is due by now; return what is to be called without the lock.

        :param waited: the thread has waited in the epoll until now.
        """
        monotonic = now - self.clock.offset_ns
        self._notice_stop(monotonic, waited)
        if monotonic > self._check_context_at:  # nobody says so if it was only destroyed
            self._check_context_at = monotonic + CONTEXT_CHECK_NS
            if self._context_ended():
                self.context_ended()
        self.loop.timer.at = 0
        for fired in self.timers.fire():
            self.inbox.timer(fired)
        if now > self.engine.deadlines.next:
            self.engine.judge_overdue(now)
        check = self._gil_check
        if 0 < check.at <= monotonic:
            self._check_gil(monotonic)
        if 0 < self._muted_until <= now:
            self._unmute()
        calls = []
        while self._agenda and self._agenda[0][0] <= monotonic:
            calls.append(heappop(self._agenda)[2])
        return calls

    def arm(self) -> None:
        """Set the timerfd anew, since timers have come; the caller has the lock."""
        self._arm(monotonic_ns())

    def _is_due_earlier(self, now: int) -> bool:
        """
        Return whether something may be due before the timerfd expires (monotonic ns).

        As long as there is something to run, the timerfd may expire too early, but not too late.
        """
        at = self.loop.timer.at or NEVER
        engine = self.engine
        deadline = engine.deadlines.next
        return bool(
            self.timers.has_new or at > self._guard_at > 0
            or deadline < NEVER and deadline - self.clock.offset_ns < at
            or self._agenda and self._agenda[0][0] < at
            or engine.holders and engine.has_waiting
            and at > now + self._check_after(engine.holders[0]) + FIRST_CHECK_NS)

    def _arm(self, now: int) -> None:
        """Set the timerfd to when something is to be done next (monotonic ns)."""
        if not self.running:
            self.loop.timer.arm(0)
            return
        offset = self.clock.offset_ns
        self.timers.has_new = False
        at = [self._next_timer() if self._muted_until else self.timers.next_due()]
        deadline = self.engine.deadlines.next
        if deadline < NEVER:
            at.append(deadline - offset + 1)
        if self._agenda:
            at.append(self._agenda[0][0])
        at += [self._muted_until and self._muted_until - offset, self._guard_at]
        check = self._gil_check
        if self.engine.holders and self.engine.has_waiting:
            self._watch_holder(now)
            at.append(check.at)
        elif check.at:
            check.end()
        first = min(filter(None, at), default=0)
        self._may_expire_early = first != at[0]
        if first != self.loop.timer.at:
            self.loop.timer.arm(first)

    def _next_timer(self) -> int:
        """Return when the next timer is due that could start though others are muted."""
        return self.timers.next_due_of(self._could_start)

    def _could_start(self, entity: Entity) -> bool:
        """Return whether something of an entity could start while others are muted."""
        habit = entity.habit
        return (not habit.holds or not habit.is_known
                or self.engine.relative_deadline(entity) < self._muted_bound)

    # --- the GIL ---------------------------------------------------------------------------------

    def _mute_if_long(self, work: Work, now: int) -> None:
        """Have nothing announced that could not start while the callback holds the GIL."""
        bound, until = self.engine.overtaking_bound(now)
        if bound:
            self._muted_until, self._muted_bound = until, bound
            self.loop.mute(bound)
        elif self._muted_until:
            self._unmute()

    def classify(self, source: SubscriptionSource) -> None:
        """Have a source muted, or not, by what is known of its callback; under the lock."""
        entity = source.entity
        habit = entity.habit
        if not habit.is_known:
            return
        entity.is_nested = habit.holds
        urgency = urgency_of(self.engine.relative_deadline(entity)) if habit.holds else ALWAYS
        self.loop.move(source, urgency)

    def _unmute(self) -> None:
        """Have everything announced again, and collect what has arrived."""
        if not self._muted_until:
            return
        self._muted_until = self._muted_bound = 0
        for source in self.loop.sources(self.loop.unmute())[0]:
            source.collect()
        if self.running:
            for fired in self.timers.fire():
                self.inbox.timer(fired)

    def _thread_of(self, work: Work) -> WorkerThread | None:
        return next(
            (each for each in (*self._threads, *self._visitors) if each.work is work), None)

    def _watch_holder(self, now: int) -> None:
        """Check whether what holds the GIL computes, as something waits for that."""
        holder = self.engine.interpreter_holder()
        if holder is not None:
            self._gil_check.begin(holder, now, self._check_after(holder))

    @staticmethod
    def _check_after(holder: Work) -> int:
        """Return after how long to check first whether what holds the GIL computes, ns."""
        habit = holder.entity.habit
        if habit.is_settled and holder.entity.wall_ns <= SOON_NS:
            return SURE_CHECK_NS
        return max(FIRST_CHECK_NS, 2 * habit.mean_ns)

    def _check_gil(self, now: int) -> None:
        """Take the GIL from an execution that waits for something else."""
        holder = self.engine.interpreter_holder()
        thread = None if holder is None else self._thread_of(holder)
        if holder is None or thread is None:
            self._gil_check.end()
        elif self._gil_check.waits(thread.ident, thread.vtid, now):
            self._gil_check.end()
            self.engine.stop_holding(holder)

    # --- stops of the machine --------------------------------------------------------------------

    def _notice_stop(self, now: int, waited: bool) -> None:
        """
        Notice that nothing of the process ran since the timerfd was to expire.

        If no thread waited for the timerfd, as all ran callbacks, its being late says nothing.
        """
        at, cpu = self.loop.timer.at, process_time_ns()
        seen, used = self._seen
        self._seen = now, cpu
        if at and waited:
            late = now - max(at, seen) - (cpu - used)
            if late >= STOP_NS:
                self.stopped(now - late, now)

    # --- executions ------------------------------------------------------------------------------

    def _execute(self, me: WorkerThread) -> None:
        """Run the thread's execution until it ends or waits."""
        work = me.work
        assert work is not None
        entity = work.entity
        before = current.running
        current.running = me
        me.published = 0
        me.waits_for = me.raised = None
        work.is_known = self.is_current and not entity.removed
        habit = entity.habit
        is_settled = habit.is_settled
        process = preempted = 0
        if not is_settled:
            process, preempted = process_time_ns(), times_preempted()
        own, start = thread_time_ns(), monotonic_ns()
        try:
            me.waits_for = work.step() if entity.gate is None else entity.gate.step(work)
        except BaseException as error:
            me.raised = error
        end = monotonic_ns()
        own = thread_time_ns() - own
        wall = end - start
        if is_settled:
            habit.ran(wall, own)
        else:
            habit.ran(wall, own, process_time_ns() - process - own, times_preempted() > preempted)
        current.running = before
        work.cpu_ns += own
        entity.wall_ns += (wall - entity.wall_ns) >> 3
        if me.published:
            entity.tail_ns += (end - me.published - entity.tail_ns) >> 3
        offset = self.clock.offset_ns
        me.start, me.end = start + offset, end + offset

    def _report_end(
        self, me: WorkerThread, now: int, calls: list[Callable[[], None]]
    ) -> None:
        """
        Report what became of a thread's execution; the caller has the lock.

        :param calls: gets what is to be called then, without the lock.
        """
        engine = self.engine
        work, waits_for, raised, start, end = me.work, me.waits_for, me.raised, me.start, me.end
        assert work is not None
        worker = -1 if me.has_lent else work.worker
        me.work = None
        if waits_for is not None or raised is not None or self.callback_ended is not None:
            calls.append(partial(self._settle_end, work, waits_for, raised))
        if me.has_lent:
            me.has_lent = False
            self._waiting_calls -= 1
        if isinstance(raised, Refused):
            engine.refused(work, now)
            return
        entity = work.entity
        entity.busy_ns += end - start
        if raised is None and waits_for is None:
            engine.finished(work, start, end, now, me.vtid, worker)
        elif waits_for is not None:
            engine.suspended(work, start, end, me.vtid, worker)
        elif self._context_ended():  # which may destroy nodes, too
            engine.left_open(
                work, start, end, me.vtid, worker, not isinstance(raised, Destroyed))
        elif isinstance(raised, Destroyed):
            engine.destroyed(work, now)
        else:
            engine.finished(work, start, end, now, me.vtid, worker, True)
        if engine.to_ask_again:
            engine.ask_again()
        if entity.removed:
            self.entities_changed()  # it can be forgotten now
        if entity.classify is not None and entity.is_nested != entity.habit.holds:
            entity.classify()

    def _settle_end(self, work: Work, waits_for: Any, raised: BaseException | None) -> None:
        """Have a suspended execution resumed, or an exception reported; without the lock."""
        if waits_for is not None:
            if waits_for is NEXT_TURN or not hasattr(waits_for, 'add_done_callback'):
                if self._is_stepping:
                    self._of_next_step.append(work)
                    return
                work.yields += 1
                rest = min(work.yields * YIELD_STEP_NS, MOST_YIELD_NS)
                self.call_at(monotonic_ns() + rest, partial(self.resume, work))
            else:
                work.yields = 0
                self.adopt(waits_for)
                waits_for.add_done_callback(QuickCallback(partial(self.resume, work)))
        elif isinstance(raised, Refused):
            self.call_at(monotonic_ns() + ASK_AGAIN_NS, self._ask_again)
        elif isinstance(raised, Destroyed):
            pass
        elif self.callback_ended is not None and self.callback_ended(work.entity.rclpy, raised):
            pass
        elif raised is not None:
            self._fail(raised)

    def _ask_again(self) -> None:
        with self.lock:
            self.tick()
            self.engine.ask_again()
            self._wake_for_more()

    @contextmanager
    def lend(self, me: WorkerThread) -> Iterator[None]:
        """Lend the worker of a running callback to other threads."""
        with self.lock:
            if not me.has_lent and me.work is not None and self._waiting_calls < MOST_LENT:
                me.has_lent = True
                self._waiting_calls += 1
                self.lent += 1
                self.tick()
                self.engine.lend(me.work)
                free = len(self._threads) - self._waiting_calls
                if me.thread is not None and self.running and free < self.engine.n_workers:
                    self._new_thread()
                if self._polling:
                    self._wake_for_more()
                else:
                    self._admit()
        waits_before, me.waits = me.waits, me.has_lent
        try:
            if me.thread is None and self.serve_meanwhile is not None:
                with self.serve_meanwhile():
                    yield
            else:
                yield
        finally:
            me.waits = waits_before

    # --- a thread that visits --------------------------------------------------------------------

    @contextmanager
    def stepping(self) -> Iterator[None]:
        """Let the calling thread run executions one by one (``run_one``) while entered."""
        self.resume_stepping()
        try:
            yield
        finally:
            with self.lock:
                self.running = self._is_stepping = False
                self._unmute()

    def resume_stepping(self) -> None:
        """Go on as in ``stepping``, after ``start`` and ``pause``."""
        with self.lock:
            self.running = self._is_stepping = True
            self.stopped_at = 0
            self._seen = monotonic_ns(), process_time_ns()
            self._arm(self.tick() - self.clock.offset_ns)

    def run_one(self, events: Events) -> bool:
        """Take what has arrived, and run one execution in the calling thread, if there is one."""
        me = WorkerThread(self, None)
        me.begin()
        self._resume_of_last_step()
        with self.lock:
            self._visitors.append(me)
        try:
            found = self._turn(me, False, events)
            while found:
                self._execute(me)
                self._turn(me, True, [], is_last=True)
                if not isinstance(me.raised, Refused):
                    return True
                found = self._turn(me, False, [])
            return False
        finally:
            with self.lock:
                self._visitors.remove(me)

    def _resume_of_last_step(self) -> None:
        several, self._of_next_step = self._of_next_step, []
        for work in several:
            self.resume(work)

    def is_idle(self) -> bool:
        """Return whether nothing runs and nothing is ready."""
        return not self.engine.has_waiting and (
            self.engine.idle_workers >= self.engine.n_workers)


class LocalDelivery:
    """
    The subscriptions on one topic that publishing threads of this process take from.

    :param sources: theirs.
    """

    __slots__ = ('sources', '_pool')

    def __init__(self, sources: tuple[SubscriptionSource, ...], pool: WorkerPool) -> None:
        self.sources = sources
        self._pool = pool

    def hold(self) -> None:
        """Announce nothing for now."""
        self._pool.loop.hold(self.sources)

    def listen_again(self, subscription: Any) -> None:
        """Have a subscription announced again whose reader the middleware has replaced."""
        for source in self.sources:
            if source.entity.rclpy is subscription:
                source.listen()

    def collect_published(self, publication: Publication | None) -> None:
        """Take what was announced since ``hold``, and announce again."""
        pool = self._pool
        running = current.running
        if running is None or running.pool is not pool:
            publication = None  # of another executor, whose jobs are others
        if not pool._is_inside():
            with pool.lock:
                pool.tick()
                posted = False
                for source in self.sources:
                    posted |= source.collect_published(publication)
                if posted:
                    pool._wake_for_more()
        pool.loop.release(self.sources)

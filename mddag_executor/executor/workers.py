# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The worker threads: they wait for events, report them to the engine, and run its choice.

Theory of operation
-------------------
1.  *A turn.*  A worker thread reports the end of its last execution, and asks the engine for the
    next one: all in one section under one lock.  If there is none, the thread waits in the epoll
    (``loop``).  When it wakes, it collects the arrivals and asks again.  The kernel wakes exactly
    one thread for each event.
2.  *Who waits for events.*  As a rule one thread (``ThreadState.WAITING``); all others are
    *parked*.  While a callback computes, no thread waits: the one that runs it goes on with what
    comes first when it ends, and a parked one *looks* now and then (``due``).  If anything may
    start then, because it is urgent or waits, that thread runs it.  So callbacks that compute are
    run by one thread, one after the other, and no other thread is woken in vain.  A callback that
    is known to wait (for a server, a disk, a sleep) leaves the events to another thread.  While
    messages or requests may come for such a callback (``Entity.is_eager``), a thread always waits.
3.  *No event is overlooked.*  When no thread waits in the epoll, a thread that has more to run
    polls it first, every ``SHORT_CALLBACK_NS``.  So an urgent arrival is known before the next
    choice.
4.  *Waking others.*  If more than one execution may start, one thread is called, which does the
    same.  No thread is called while a *short* callback runs, because its thread will be free in
    time.  A callback is short if it usually ends within ``SHORT_CALLBACK_NS`` of its start or of a
    publication that it has made.  If it runs longer, a parked thread looks for events.
5.  *Time.*  ``due`` sets the two timers: for a thread that waits for events, and for a parked one.
6.  *Lending.*  A callback that waits inside ``Client.call`` has no worker meanwhile
    (``lending``).
7.  *Coroutines.*  A coroutine that waits for a future is suspended.  It keeps its callback group
    but no worker.  When the future is done, the coroutine becomes ready again.
8.  *Errors.*  An exception of a callback or of a thread of the pool goes to ``fail`` and ends the
    spin.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
import threading
from time import monotonic_ns
from typing import Any, TYPE_CHECKING
import weakref

from mddag_executor.clocks import TraceClock
from mddag_executor.executor.agenda import Agenda
from mddag_executor.executor.bounds import (
    AGAIN_NS,
    END_S,
    HISTORY,
    MOST_YIELD_NS,
    SHORT_CALLBACK_NS,
)
from mddag_executor.executor.compat import adopt_awaited, NEXT_TURN
from mddag_executor.executor.debugging import engine_lock, InvariantError
from mddag_executor.executor.due import DueTimes
from mddag_executor.executor.engine import Engine, Step
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.hall import Announced, Spinner
from mddag_executor.executor.interrupts import waits
from mddag_executor.executor.lending import Lending
from mddag_executor.executor.loop import EventLoop, Events, Parking
from mddag_executor.executor.misses import MissLog
from mddag_executor.executor.outside import Outside
from mddag_executor.executor.pausing import can_pause, Pauses
from mddag_executor.executor.shutdown import is_over
from mddag_executor.executor.stamps import StampedReleases
from mddag_executor.executor.threads import RUNS, ThreadState, WorkerThread
from mddag_executor.executor.timers import Fired, TimerQueue
from mddag_executor.executor.weakly import weakly
from mddag_executor.executor.work import current, Destroyed, Refused, Work
from msg_graph.errors import printable
from rclpy.logging import get_logger

if TYPE_CHECKING:
    from mddag_executor.executor.coroutines import Loops


def _nothing() -> None:
    pass


# module globals are quicker to read than members of the enum
_PARKED, _WAITING, _RUNNING = ThreadState.PARKED, ThreadState.WAITING, ThreadState.RUNNING


class WorkerPool:
    """
    The worker threads, with the lock and the clock of the engine.

    :param fail: receives every exception that a callback raises.
    :param prepare_thread: called first in each worker thread (priority, CPU set).
    :ivar running: whether executions may start.
    :ivar stopped_at: when the last spin stopped starting executions, on the trace's clock; 0:
        ``spin_once`` has started some since.
    :ivar is_current: whether the registry knows all entities.
    :ivar now: the time of the last event, on the trace's clock.
    :ivar announcements: of other processes; None: there are none.
    """

    # more attributes than CPython reads quickly from a dictionary; the most used are first
    __slots__ = (
        'lock', 'now', 'offset', 'running', 'is_spin_once', 'polling', 'engine', '_next_step',
        '_rejoining', '_interpreter', '_holders', 'unlocked_calls', '_polled_at', 'last_end',
        '_paused', '_verdicts', '_misses', '_judges', 'due', '_history', '_leaving', '_n_parked',
        '_eager', '_bell_rings', '_channels', '_timer', 'agenda', 'timers', 'is_current',
        'is_recorded', 'callback_ended', 'loop', '_has_called', 'clock', 'stamped_releases',
        'parking', 'announcements', 'stopped_at', 'pauses', 'lending', 'outer_groups',
        'freed_outer_groups', 'context', 'wake_executor', '_executor', 'fail', '_miss_log',
        '_logs_later', '_prepare_thread', '_threads', '_visitors', '_lacks_threads', '_closed',
        '_at_end', '_close', '_all_left', '_asks_later', '_of_next_turn', '_loops', 'outside',
        '__weakref__')

    def __init__(
        self, engine: Engine, clock: TraceClock, fail: Callable[[BaseException], None],
        prepare_thread: Callable[[], None] | None = None,
    ) -> None:
        self.engine = engine
        engine.allow_bypass()
        self.is_recorded = engine.record is not None
        self.clock = clock
        self.offset = clock.offset_ns
        self.stamped_releases = StampedReleases(clock, self._warn)
        # reentrant only to know its owner: a signal handler may run inside
        self.lock = engine_lock(engine, self._story)
        # the last changes of threads: time, name, and new state
        self._history = deque([(0, '', _PARKED)] * HISTORY, HISTORY)
        #: functions to call when the calling thread does not own the lock
        self.unlocked_calls: deque[Callable[[], None]] = deque()
        self.loop = EventLoop()
        self._channels, self._timer = self.loop.channels, self.loop.timer
        self.parking = Parking()
        self.announcements: Announced | None = None
        self.agenda = Agenda()
        self.timers = TimerQueue(self.agenda, self._timer_fired, self.loop.wake, fail)
        self.running = False
        self.stopped_at = 0
        self.is_current = False
        self.pauses = Pauses(self)
        self._paused = self.pauses.paused
        engine.interpreter.pauses = can_pause()
        self._next_step = engine.step
        self._judges = engine.tables.n_dags > 0
        self._interpreter = engine.interpreter
        self._holders = engine.interpreter.holders
        self.lending = Lending(self)
        self._rejoining = self.lending.rejoining
        #: when the last execution ended, on the trace's clock
        self.last_end = 0
        #: called after each callback: see ``MultiDeadlineExecutor.on_callback_ended``
        self.callback_ended: Callable[[Any, BaseException | None, int], bool] | None = None
        #: by number: see ``MultiDeadlineExecutor.new_outer_group``
        self.outer_groups: Any = weakref.WeakValueDictionary()
        #: numbers of those that have been destroyed
        self.freed_outer_groups: deque[int] = deque()
        self.context: Any = None
        #: called when entities have changed, or the context has ended
        self.wake_executor: Callable[[], None] = _nothing
        self._executor: Callable[[], Spinner | None] = _nothing
        self.fail = fail
        self._verdicts = engine.verdicts
        self._miss_log = MissLog(engine.verdicts)
        # how many misses were noted; whether a line is to be logged later
        self._misses = 0
        self._logs_later = False
        self._prepare_thread = prepare_thread
        self._threads: list[WorkerThread] = []
        self._visitors: list[WorkerThread] = []
        #: how many threads wait for events
        self.polling = 0
        self._n_parked = 0
        self._lacks_threads = False     # that no thread could be made has been reported
        # how many callbacks are known to wait, and may get messages or requests
        self._eager = 0
        self._polled_at = 0  # when the epoll was last polled
        self._bell_rings = self._has_called = False
        self._closed = False
        self._at_end: Callable[[], None] = _nothing
        self._close: Callable[[], None] = _nothing
        self._leaving = False
        self._all_left = threading.Event()
        #: whether the thread of a ``spin_once`` runs everything
        self.is_spin_once = False
        # whether groups that have refused an execution will be asked again at a time
        self._asks_later = False
        # coroutines that have yielded: they continue in the next step
        self._of_next_turn: list[Work] = []
        self._loops: Loops | None = None
        self.now = 0
        self.due = DueTimes(self)
        #: counts messages that no declared callback has published; None: nothing is declared
        self.outside: Outside | None = None

    def loops(self) -> Loops:
        """Return the event loops of coroutines, made for the first one."""
        with self.lock:
            if self._loops is None:
                from mddag_executor.executor.coroutines import Loops
                self._loops = Loops(get_logger('mddag_executor').warning, self.is_inside)
            return self._loops

    def end_coroutines(self) -> None:
        """Cancel coroutines that await asyncio, and end its event loop; no callback runs."""
        if self._loops is not None:
            with self.lock:
                several = [(work.entity.name, work.coroutine) for work in self.engine.begun()]
            self._loops.end(several)

    def attach(self, executor: Spinner) -> None:
        """Set the executor; threads do not keep it alive (``ending``)."""
        self.context = executor.context
        self._executor = weakref.ref(executor)
        self.wake_executor = weakly(executor.wake)

    @property
    def executor(self) -> Spinner | None:
        """Return the executor; None: it has been destroyed."""
        return self._executor()

    # --- events ----------------------------------------------------------------------------------

    def tick(self) -> int:
        """Return the engine's time now; it never decreases.  The caller holds the lock."""
        now = self.now = monotonic_ns() + self.offset
        return now

    def _timer_fired(self, fired: Fired) -> None:
        """Report a timer that is due to the engine; the caller holds the lock."""
        work, due, missed, period = fired
        due += self.offset
        now = self.tick()   # it may have become due since the turn began
        self.engine.timer_due(work, due, now)
        if missed:
            self.engine.timer_missed(work.entity, due, period, missed, now)

    def report(self, event: Callable[..., None], *args: Any) -> None:
        """Report an event to a method of the engine, and wake a thread for ready executions."""
        if self.is_inside():
            self._call_unlocked(partial(self.report, event, *args))
            return
        with self.lock:
            event(*args, self.tick())
            self.wake_for_more()

    def is_inside(self) -> bool:
        """Return whether the calling thread owns the lock: in a signal handler or a finalizer."""
        return self.lock._is_owned()  # type: ignore[no-any-return]

    def _call_unlocked(self, function: Callable[[], None]) -> None:
        """Call a function as soon as the lock is free."""
        self.unlocked_calls.append(function)
        self.loop.wake()

    def _warn(self, text: str) -> None:
        """Log a warning; the caller owns the lock."""
        self.unlocked_calls.append(
            partial(get_logger('mddag_executor').warning, printable(text)))

    def post(self, several: list[Work]) -> None:
        """Make undeclared executions ready, some of which may inherit."""
        self.report(self._post, several)

    def _post(self, several: list[Work], now: int) -> None:
        for work in several:
            self.engine.posted(work, now)
            now = self.tick()  # a recording distinguishes them by it

    def resume(self, work: Work) -> None:
        """Make a suspended execution ready to go on."""
        self.report(partial(self.engine.resume, work))

    def leave_group(self, work: Work) -> None:
        """Note that the callback group of an execution has let it run."""
        self.report(lambda now: self.engine.leave_group(work))

    def call_at(self, at: int, function: Callable[[], None]) -> None:
        """Let a worker thread call a function at a time (monotonic ns), without the lock."""
        with self.lock:
            self.due.call_at(at, function)

    def wake_for_more(self) -> None:
        """Wake a thread if an idle worker may start an execution; the caller holds the lock."""
        if not self.running:
            return
        running = current.running
        if running is not None and running.pool is self and running.is_short():
            self.due.arm_by(self.now - self.offset + self.engine.patience())
        else:
            self.wake_for(self.now)

    def wake_for(self, now: int) -> None:
        """Wake a thread if it may start an execution, or check what that has to wait for."""
        if self.engine.may_start_more(now):
            self.call()
        elif self.engine.idle_workers:
            self.due.check.begin_if_wanted(now - self.offset)

    def call(self) -> None:
        """Wake a thread, which starts what may start, or waits for events."""
        if self.polling or self.is_spin_once:
            if not self._bell_rings:
                self._bell_rings = True
                self.loop.wake()
        elif self._n_parked and not self._has_called:
            self._has_called = True
            self.parking.call()

    def note_eager(self, entity: Entity) -> None:
        """Note whether a thread must wait for an entity's messages or requests, at any time."""
        is_eager = entity.may_come_from_outside() and entity.is_eager()
        if is_eager != entity.counts_as_eager:
            with self.lock:
                if is_eager != entity.counts_as_eager and not entity.removed:
                    entity.counts_as_eager = is_eager
                    self._eager += 1 if is_eager else -1

    def forget_eager(self, entity: Entity) -> None:
        """End ``note_eager`` for an entity that is removed; the caller holds the lock."""
        if entity.counts_as_eager:
            entity.counts_as_eager = False
            self._eager -= 1

    # --- threads ---------------------------------------------------------------------------------

    def start(self) -> None:
        """Let executions start; the first call makes the threads."""
        self._resume_of_last_turn()
        with self.lock:
            if self._closed:
                return
            self.running = True
            self.is_spin_once = False
            self.due.begin(self.tick() - self.offset)
            while len(self._threads) < self.engine.n_workers:
                self._new_thread()
            # one that did not leave after the last spin (``pause``) is asleep, and not parked
            self._bell_rings = self._has_called = False
            self.call()

    def pause(self) -> None:
        """Start no more executions; running ones finish.  No thread waits in the epoll then."""
        is_first = False
        try:
            with self.lock:
                self.start_no_more()
                self.lending.let_go_on()
                self.due.arm(0)
                if not self.polling or self._leaving:
                    return
                is_first = self._leaving = True
                self._all_left.clear()
                self.loop.wake_all()
            self._all_left.wait(END_S)
        finally:  # also after an interrupt
            if is_first:
                with self.lock:
                    self._leaving = False
                    self.loop.let_wait()

    def start_no_more(self) -> None:
        """Start no more executions; for callers that must not wait for the lock."""
        if self.running:
            self.stopped_at = self.clock.now()
            self.running = False

    def close(self, timeout: float | None) -> bool:
        """
        End the threads; return False if a callback still ran after ``timeout`` seconds.

        Callbacks that wait for a service are not waited for: no thread would answer them any more.
        """
        self.pause()
        with self.lock:
            if not self._closed:
                for work in self.engine.begun():  # it never goes on
                    if work.entity.exclusive is not None:
                        work.entity.exclusive.ending_execution(work.entity.rclpy_object)
            self._closed = True
            self.parking.end()
            threads = list(self._threads)
        deadline = None if timeout is None else monotonic_ns() + int(timeout * 1e9)
        done = True
        for each in threads:
            done = self._join(each, deadline) and done
        return done

    def leave(self, then: Callable[[], None]) -> None:
        """
        End the threads without waiting for a lock or for them; no thread spins.

        :param then: called when all have ended, by the last one; if there is none, soon.
        """
        self.start_no_more()
        self._at_end = then
        self._closed = True
        self.parking.end()
        if not self._threads:
            self._all_have_ended()

    def _all_have_ended(self) -> None:
        """Do the rest of ``leave``, once."""
        if self.is_inside():
            self._call_unlocked(self._all_have_ended)
            return
        with self.lock:
            then, self._at_end = self._at_end, _nothing
        then()

    def close_descriptors(self, close: Callable[[], None]) -> None:
        """
        Call a function that closes the descriptors, once no thread waits for one; it has the lock.

        The kernel wakes parked threads one after the other, and none any more once the descriptor
        that wakes them is closed.
        """
        with self.lock:
            self._close = close
            self._close_descriptors()

    def _close_descriptors(self) -> None:
        if not self._n_parked and not self.polling:
            close, self._close = self._close, _nothing
            close()

    @staticmethod
    @waits
    def _join(each: WorkerThread, deadline: int | None) -> bool:
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
                break  # it is just being started
        return True

    def need_threads(self, n_out: int) -> None:
        """
        Make a thread if fewer than ``n_workers`` remain when ``n_out`` have no worker.

        :raises RuntimeError: if none can be made, and none remains.
        """
        n_left = len(self._threads) - n_out
        if n_left >= self.engine.n_workers:
            return
        try:
            self._new_thread()
        except RuntimeError as error:   # there are too many
            if not n_left:
                raise
            if not self._lacks_threads:
                self._lacks_threads = True
                self._warn(f'{error}: while callbacks wait in Client.call, fewer than '
                           f'{self.engine.n_workers} others run')

    def _new_thread(self) -> WorkerThread:
        me = WorkerThread(self, None)
        me.state = ThreadState.PARKED
        me.worker = len(self._threads) % self.engine.n_workers
        me.name = f'mddag-worker-{len(self._threads)}'
        me.thread = threading.Thread(target=self._run, args=(me,), daemon=True, name=me.name)
        self._threads.append(me)
        self._n_parked += 1
        try:
            me.thread.start()
        except BaseException:  # too many threads, or an interrupt
            if me.thread.ident is None:
                self._threads.remove(me)
                self._n_parked -= 1
            raise
        return me

    def _run(self, me: WorkerThread) -> None:
        me.begin()
        try:
            if self._prepare_thread is not None:
                self._prepare_thread()
        except Exception as error:
            self.fail(error)
        try:
            self._take_turns(me)
        except BaseException as error:
            self.fail(error)
        finally:
            with self.lock:
                self._threads.remove(me)
                if me.state is ThreadState.WAITING:  # it has failed
                    self.become(me, ThreadState.PARKED)
                self._n_parked -= me.state is ThreadState.PARKED
                is_last = self._closed and not self._threads
                self._close_descriptors()
            if is_last:
                self._all_have_ended()

    def _take_turns(self, me: WorkerThread) -> None:
        """Take turns until the pool is closed."""
        wait, park, receive, go_on, execute = (
            self.loop.wait, self.parking.wait, self._receive, self._go_on, me.execute)
        current.running = me
        while True:
            if me.state is not _PARKED:
                found = receive(me, wait())
            else:
                if not self._closed:
                    park()
                if self._closed:
                    return
                found = receive(me, None)
            while found:
                execute()
                found = go_on(me)

    def _story(self) -> list[str]:
        return [f'{(at - self.now) / 1e6:+.3f} ms {name} {state.value}'
                for at, name, state in self._history if name]

    def become(self, me: WorkerThread, state: ThreadState) -> None:
        """Change the state of a thread; the caller holds the lock."""
        before = me.state
        if state not in before.next:
            if before is state:
                return
            raise InvariantError(
                [f'a thread that was {before.value} is {state.value}', *self._story()])
        me.state = state
        self._history.append((self.now, me.name, state))
        if before is _WAITING:
            self.polling -= 1
            if state is _PARKED:  # a visitor never is
                self._n_parked += 1
            if self._leaving and not self.polling:
                self._all_left.set()
        elif state is _WAITING:
            self.polling += 1
            me.waits_since = self.now
            if before is _PARKED:
                self._n_parked -= 1
        else:
            self._n_parked += (state is _PARKED) - (before is _PARKED)

    # --- a turn ----------------------------------------------------------------------------------

    def _receive(self, me: WorkerThread, events: Events | None) -> bool:
        """
        Handle events, and find the thread's next execution if it has none; see ``_go_on``.

        :param events: None: a parked thread looks for them.
        """
        with self.lock:
            # inlined tick: saves a call for each execution
            now = self.now = monotonic_ns() + self.offset
            if events is None:
                self._has_called = False
                self.due.has_looked(now - self.offset)
                self._look()
            else:
                self._bell_rings = False  # the waiting thread may have received it
                self._polled_at = now
                self._collect(events, me)
            found = None
            if me.work is None and not self.unlocked_calls:
                found = self._choose(me, self.now)
        if self.unlocked_calls:
            self._make_unlocked_calls()
        if found is None:
            found = me.work is None and self._go_on(me)
        return found

    def _collect(self, events: Events, me: WorkerThread | None) -> None:
        """
        Collect the arrivals of events, and handle what is due; the caller holds the lock.

        :param me: the calling thread, if it has waited for them.
        """
        if not self.running:
            for source in self.loop.sources(events):
                self.loop.announce(source)  # for the next spin
            return
        for fd, _ in events:
            for source in self._channels.get(fd, ()):
                source.collect()
        now = self.now - self.offset  # a recorded message is later than the turn began
        if self._timer.at <= now or self.agenda.next <= now or self.timers.has_jumped:
            self.due.handle(
                self.now, self.now if me is None or me.state is not _WAITING else me.waits_since)

    def _look(self) -> None:
        """Collect what has come while no thread waited for it; the caller holds the lock."""
        if self.running and not self.polling:
            # The poll takes the bell's event, and that of the timerfd if it has just expired:
            # no thread gets these any more, so the flag and the time must be those after it.
            events = self.loop.poll()
            self._bell_rings = False
            now = self._polled_at = self.tick()
            self._collect(events, None)
            if self.engine.interpreter.is_wanted():
                self.due.check.begin_late(now - self.offset)

    def _go_on(self, me: WorkerThread, is_last: bool = False) -> bool:
        """
        Report the end of the thread's last execution, and find the next one: ``me.work``.

        :param is_last: run nothing more in this thread.
        :return: False: there is no execution, and the thread is to wait in the epoll or is parked.
        """
        engine = self.engine
        with self.lock:
            now = self.now = monotonic_ns() + self.offset
            work: Any = me.work
            if work is not None:
                me.work = None
                self.last_end = now
                if me.outcome is None and not me.has_lent:
                    engine.finished(work, me.start, me.end, now, me.vtid, work.worker)
                else:
                    self._report_unusual_end(me, work, now)
                if not self.running and self._rejoining:
                    self.lending.let_go_on()
                if work.entity.removed:
                    self.wake_executor()  # the registry can forget it now
                if me.thread is not None and (
                        now - self._polled_at > SHORT_CALLBACK_NS
                        or self.agenda.latest < now - self.offset + SHORT_CALLBACK_NS):
                    self._look()  # else another thread may have to, in a moment
            if is_last:
                found = False
                self.due.arm(now - self.offset)
                if self._verdicts.missed != self._misses:
                    self._note_misses()
            else:
                found = self._choose(me, self.now)
            if self._paused:
                self.pauses.end()
        if self.unlocked_calls:
            self._make_unlocked_calls()
        return found

    def _note_misses(self) -> None:
        """Let new misses be logged when the lock is free, or when the next line may follow."""
        self._misses = self._verdicts.missed
        if self._miss_log.is_behind():
            self.unlocked_calls.append(self._log_misses)
        elif not self._logs_later:
            self._logs_later = True
            self.due.call_at(self._miss_log.next_at(), self._log_misses)

    def _log_misses(self) -> None:
        self._miss_log.write()
        with self.lock:
            self._logs_later = False
            if self._miss_log.has_new():
                self._note_misses()

    def waited_since(self, mine: int) -> int:
        """
        Return since when any thread has waited in the epoll.

        :param mine: since when the calling one has, or now.
        """
        return min([mine, *(
            each.waits_since for each in self._threads if each.state is ThreadState.WAITING)])

    def _make_unlocked_calls(self) -> None:
        """Call the functions that waited for the lock; exceptions do not end the thread."""
        while self.unlocked_calls:
            try:
                function = self.unlocked_calls.popleft()
            except IndexError:
                break  # another thread has removed it
            try:
                function()
            except BaseException as error:
                self.fail(error)

    def _choose(self, me: WorkerThread, now: int) -> bool:
        """Set the next execution, or where to wait; return whether there is an execution."""
        # a worker whose callback outlasts a spin leaves the rest to the thread of a spin_once
        if self.running and (not self.is_spin_once or me.thread is None):
            step = self._next_step(me.worker, now)
            if self._rejoining:
                step = self._hand_over(me, step, now)
        else:
            step = self.engine.no_step
        work = step.work
        if step.overtaken:
            self.pauses.begin(step.overtaken, None if work is None else me)
        if work is None:
            self._rest(me, now)
            return False
        me.work = work
        step.work = None  # else it would keep the message
        me.worker = work.worker
        if me.state is not _RUNNING:
            self.become(me, _RUNNING)
        if step.is_short and not self.polling and not self.is_spin_once:  # nearly always
            me.is_spare = False
            if step.n_idle:
                self.due.arm_late_look(now - self.offset, step.patience_ns)
        else:
            self._share_events(me, step, now)
        return True

    def _hand_over(self, me: WorkerThread, step: Step, now: int) -> Step:
        """Let executions go on that were dispatched again; return the step after these."""
        while step.work in self._rejoining:
            self.lending.hand_over(step)
            step = self._next_step(me.worker, now)
        return step

    def _share_events(self, me: WorkerThread, step: Step, now: int) -> None:
        """Let another thread wait for events, or look for them, while one runs an execution."""
        due = self.due
        me.is_spare = not (step.is_short or self._interpreter.holder is me.work)
        if self.polling or not step.is_short:  # else there is time until it ends
            due.overdue.update()
        if self.is_spin_once:
            due.arm(now - self.offset)
        elif self.polling:
            if self.engine.may_start_more(now):
                self.call()
            elif self.agenda.next < self._timer.at or self._interpreter.is_wanted():
                due.arm(now - self.offset)
        elif step.n_idle:
            if me.is_spare or self._eager or self.engine.may_start_more(now):
                self.call()
            else:
                due.arm_look(now - self.offset)

    def _rest(self, me: WorkerThread, now: int) -> None:
        """Let a thread without an execution wait for events, or park it."""
        if self._judges:
            self.due.overdue.update()
            if self._verdicts.missed != self._misses:
                self._note_misses()
        if me.thread is not None:  # else a visitor: the thread of a spin_once
            state = _PARKED
            # while a callback computes, its thread handles the events when it ends
            if self.running and not self.is_spin_once and (not self._holders or self._eager):
                others = self.polling - (me.state is _WAITING)
                if not others or me.is_spare and others < self.engine.idle_workers:
                    state = _WAITING
            self.become(me, state)
            if self.is_spin_once and self.engine.may_start_more(now):
                self.call()
        if self._holders or not self.polling or not self.running:
            self.due.arm(now - self.offset)
        else:
            self.due.arm_idle(now - self.offset)

    def threads(self) -> list[WorkerThread]:
        """Return all threads that run callbacks, from any thread."""
        return [*self._threads, *self._visitors]

    def thread_of(self, work: Work) -> WorkerThread | None:
        """Return the thread that runs an execution."""
        return next(
            (each for each in self.threads() if each.work is work), None)

    def reporting(self) -> list[Work]:
        """Return the executions that do not run now, but have ended, or are about to begin."""
        return [work for each in self.threads()
                if (work := each.work) is not None and each.outcome is not RUNS]

    def running_threads(self) -> list[WorkerThread]:
        """Return the threads whose callbacks run with a worker."""
        return [each for each in self._threads
                if each.state is ThreadState.RUNNING and each.work is not None]

    # --- executions ------------------------------------------------------------------------------

    def _report_unusual_end(self, me: WorkerThread, work: Work, now: int) -> None:
        """Report an execution that was refused, waits, has failed, or has lent its worker."""
        engine, start, end = self.engine, me.start, me.end
        outcome, worker = me.outcome, work.worker
        me.outcome = None
        if me.has_lent:
            worker = -1
            self.lending.is_back(me)
            me.has_lent = False
        if isinstance(outcome, Refused):
            engine.refused(work, now)
            if not self._asks_later:
                self._asks_later = True
                self.due.call_at(
                    now - self.offset + AGAIN_NS, partial(self.report, self._ask_again))
            return
        if outcome is None:
            engine.finished(work, start, end, now, me.vtid, worker)
        elif not isinstance(outcome, BaseException):
            engine.suspended(work, start, end, me.vtid, worker)
            self.unlocked_calls.append(partial(self._resume_after, work, outcome))
        else:
            is_gone = isinstance(outcome, Destroyed)
            if is_over(self.context):  # this may also destroy nodes
                engine.left_open(work, start, end, me.vtid, worker, not is_gone)
            elif isinstance(outcome, Destroyed):
                engine.destroyed(work, now, outcome.reason)
            else:
                engine.finished(work, start, end, now, me.vtid, worker, True)
            if not is_gone and self.callback_ended is None:
                self.fail(outcome)  # at once: the spin may be about to end
            elif not is_gone:
                self.unlocked_calls.append(partial(self._report_error, work, outcome))

    def _ask_again(self, _: int) -> None:
        """Ask the callback groups again that have refused executions."""
        self._asks_later = False
        self.engine.ask_again()

    def _report_error(self, work: Work, error: BaseException) -> None:
        if self.callback_ended is None or not self.callback_ended(
                work.entity.rclpy_object, error, work.entity.outer):
            self.fail(error)

    def _resume_after(self, work: Work, awaited: Any) -> None:
        """Resume a suspended execution when the future that it waits for is done."""
        resume = partial(self.resume, work)
        if awaited is not NEXT_TURN and hasattr(awaited, 'add_done_callback'):
            work.yields = 0
            adopt_awaited(awaited, self.executor)
            work.coroutine.suspended(resume, awaited)
            return
        work.coroutine.suspended(resume)
        if self.is_spin_once:
            self._of_next_turn.append(work)
            return
        work.yields += 1
        rest = min(work.yields * 1_000, MOST_YIELD_NS)
        self.call_at(monotonic_ns() + rest, resume)

    # --- spin_once -------------------------------------------------------------------------------

    @contextmanager
    def in_spin_once(self) -> Iterator[None]:
        """Let the calling thread run executions one by one (``run_one``) while entered."""
        self.resume_spin_once()
        try:
            yield
        finally:
            with self.lock:
                self.running = self.is_spin_once = False
                self.lending.let_go_on()

    def resume_spin_once(self) -> None:
        """Continue as in ``in_spin_once``, after ``start`` and ``pause``."""
        with self.lock:
            self.running = self.is_spin_once = True
            self.stopped_at = 0
            self.due.begin(self.tick() - self.offset)

    def run_one(self, events: Events) -> bool:
        """Collect arrivals, and run one execution in the calling thread, if there is one."""
        me = WorkerThread(self, None)
        me.begin()
        self._resume_of_last_turn()
        with self.lock:
            self._visitors.append(me)
        before, current.running = current.running, me
        try:
            found = self._receive(me, events)
            while found:
                me.execute()
                is_refused = isinstance(me.outcome, Refused)
                self._go_on(me, is_last=True)
                if not is_refused:
                    return True
                found = self._go_on(me)
            return False
        finally:
            current.running = before
            with self.lock:
                self._visitors.remove(me)

    def _resume_of_last_turn(self) -> None:
        several, self._of_next_turn = self._of_next_turn, []
        for work in several:
            self.resume(work)

    def n_running(self, with_waiting: bool) -> int:
        """Return how many callbacks run, with or without those that wait for a service."""
        return sum(each.work is not None and (with_waiting or not each.waits)
                   for each in list(self._threads))

    def n_running_of(self, outer: int) -> int:
        """Return how many callbacks of an outer group run, also those that have lent workers."""
        return sum(each.work is not None and each.work.entity.outer == outer
                   for each in self._threads)

    def is_idle(self) -> bool:
        """Return whether no execution runs or is ready."""
        return not (self.engine.has_waiting or self.engine.is_busy)

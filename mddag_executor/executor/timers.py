# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When timers are due: appointments in the agenda, instead of an rcl wait set.

Theory of operation
-------------------
1.  rcl has the authority over a timer's state (next call time, period, cancelled).  A timer runs
    only if rcl reports it due, and ``call_timer`` advances it; rcl skips missed periods and keeps
    the phase.  This module only stores when to ask.
2.  *Nominal due time.*  rcl's next call time is exact, on the timer's clock.  The offset to the
    monotonic clock is measured once for each timer and kept while it is right within
    ``TOLERANCE_NS``, so due times are points of an exact grid.
3.  *Changes.*  A timer that is due later than expected is found when rcl is asked.  One that is
    due earlier (reset after it was cancelled or its period was shortened) is announced by rcl's
    listener for resets.
    A reset after a timer was due, and before its callback has started, withdraws the execution
    (``is_withdrawn``): rclpy's executors ask rcl again just before they run a timer.
4.  *Simulated time.*  A timer whose clock is overridden has no due time on the monotonic clock.
    rcl is asked after each jump of its clock.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import time
from typing import Any

from mddag_executor.clocks import epoch_offset_ns
from mddag_executor.executor.agenda import Agenda
from mddag_executor.executor.compat import (
    ends_sleep,
    RCL_ERRORS,
    timer_functions,
    with_timer_info,
)
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.kinds import ListenerEntity, Rooms
from mddag_executor.executor.listeners import NextCall
from mddag_executor.executor.work import Work
from msg_graph.binding import Entity as Declarable
from msg_graph.duration import exact_duration
from rclpy.clock import Clock, JumpHandle, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle

TOLERANCE_NS = 20_000
"""How far a clock may be off before the offset is measured again (system clocks are slewed)."""

ZERO_PERIOD_NS = 100_000
"""
A timer without a period is always due; it becomes ready at most this often.

Not while it waits: it runs as often as the other callbacks let it.
"""

Fired = tuple[Work, int, int, int]
"""Execution and nominal due time (monotonic ns) of a timer, the periods missed, the period."""

_now = time.monotonic_ns


class TimerEntity(ListenerEntity):
    """
    A timer.

    Its listener announces that it is reset.  The timer of a ``Rate`` is handled at once.

    :ivar due: when to ask rcl next (monotonic ns), while its entry in the agenda is not empty.
    :ivar n_resets: how many resets were noticed; those before it was due do not matter.
    """

    kind = 'timer'
    list_name = 'timers'
    is_due_at_release = True
    keeps_oldest = True
    is_known_to_caret = True

    __slots__ = (
        'until', 'period', 'last_period', 'due', 'entry', 'simulated', 'may_be_simulated',
        'n_resets', '_n_before', '_next_at', '_next_call', '_call', '_clock', '_is_steady',
        '_offset', '_queue', 'allowance', 'period_of_allowance')

    def describe(self) -> None:
        """Set label, depth and whatever else does not change."""
        period = self.rclpy_object.timer_period_ns
        self.depth, self.label = 1, exact_duration(period)
        self.may_be_gone = True
        self.n_resets = self._n_before = 0
        self._next_at: int | None = None
        self.declarable = Declarable(self.node, self.kind, '', period)

    def is_withdrawn(self, work: Work) -> bool:
        """Return whether it was cancelled or reset after it had become due: rclpy checks both."""
        if self.fd >= 0 and self._next_call.read() != self._next_at:
            with self.rooms.pool.lock:  # else it may just be called once more
                self._note_reset()
        return work.n_resets != self.n_resets or bool(self.rclpy_object.is_canceled())

    def _note_reset(self) -> None:
        """Note whether rcl's next call time was changed since the last call: by a reset."""
        at = self._next_call.read()
        if at != self._next_at:
            self._next_at, self.n_resets = at, self.n_resets + 1

    def record(self, say: Callable[..., None], node: int) -> None:
        """Record it with CARET's tracepoints."""
        handle = id(self.rclpy_object)
        say('rcl_timer_init', handle, self.rclpy_object.timer_period_ns)
        say('rclcpp_timer_callback_added', handle, self.address)
        say('rclcpp_timer_link_node', handle, node)
        say('rclcpp_callback_register', self.address, self.symbol)

    def listen(self, rooms: Rooms) -> None:
        """Let rcl announce resets, and begin to ask when it is due."""
        timer = self.rclpy_object
        # ``create_rate`` sets the callback only after it has notified the executor
        is_of_rate = self.callback is None and (
            timer.callback is None or ends_sleep(timer.callback))
        place = rooms.at_once if is_of_rate else rooms.pool
        self._queue = place.timers
        with self.handle:
            self._next_call = NextCall(self.handle.pointer)
            self._next_at = self._next_call.read()
        self.until, self._call, self.period = timer_functions(timer)
        self._clock: Any = timer.clock
        self._is_steady = timer.clock.clock_type == ClockType.STEADY_TIME
        self.may_be_simulated = timer.clock.clock_type == ClockType.ROS_TIME
        self._offset = self.due = 0
        self.last_period = timer.timer_period_ns
        # how long it may stay unnoticed while a callback computes, and with which period
        self.allowance = self.period_of_allowance = -1
        self.entry: list[Any] | None = None
        self.simulated = False
        self.listen_in(rooms, place.loop, f'timers {self.node}')
        with rooms.pool.lock:
            self._queue.add(self)

    def ignore(self) -> None:
        """End ``listen``."""
        if self.fd >= 0:
            with self.rooms.pool.lock:
                self._queue.remove(self)
        super().ignore()

    def collect(self) -> None:
        """Ask rcl when it is due, as it was reset."""
        with self.rooms.pool.lock:
            if self.fd >= 0:  # else it was removed after its arrival was found
                self._queue.ask(self)

    def come_due(self) -> None:
        """Fire, if rcl agrees."""
        self._queue.fire(self)

    def next_due(self) -> int | None:
        """Return the time of its next call by rcl, monotonic ns; None while it is cancelled."""
        at = self._next_call.read()
        if at is None:
            return None
        if self._is_steady:
            return at
        if abs(time.time_ns() - _now() - self._offset) > TOLERANCE_NS:
            self._offset = epoch_offset_ns()
        return at - self._offset

    def is_simulated(self) -> bool:
        """Return whether its clock shows simulated time now."""
        return self.may_be_simulated and bool(self._clock.ros_time_is_active)

    def is_due(self) -> bool:
        """Return whether rcl reports it due."""
        until = self.until()
        return until is not None and until <= 0

    def call(self) -> Work | None:
        """Let rcl advance it; return its execution, None if it has no callback."""
        self._note_reset()
        info = self._call()
        self._next_at = self._next_call.read()
        callback = self.rclpy_object.callback
        if callback is None:
            return None
        return self.work(with_timer_info(self.rclpy_object, callback, info))

    def work(self, callback: Any) -> Work:
        """Return an execution, as it is due now."""
        work = Work(self, callback)
        work.was_reset = self.n_resets != self._n_before
        work.n_resets = self._n_before = self.n_resets
        return work


class TimerQueue:
    """
    The timers whose due times are in an agenda; all methods need one lock.

    :param agenda: it has an appointment for each timer.
    :param report: receives each timer that has fired.
    :param on_change: called, from any thread, when the clock of a timer has jumped: call
        ``ask_after_jump`` soon.
    :param on_error: receives errors of rcl.
    :ivar has_jumped: whether the clock of a timer has jumped since ``ask_after_jump``.
    """

    def __init__(
        self, agenda: Agenda, report: Callable[[Fired], None], on_change: Callable[[], None],
        on_error: Callable[[BaseException], None],
    ) -> None:
        self._agenda = agenda
        self._report = report
        self._on_change = on_change
        self._on_error = on_error
        self._timers: dict[int, TimerEntity] = {}
        #: returns how long a timer with a period may stay unnoticed while a callback computes
        self.allowance: Callable[[Entity, int], int] = lambda *_: 0
        self._jumps: dict[int, tuple[Clock, JumpHandle]] = {}
        self._followers: list[tuple[Clock, Callable[[], None]]] = []
        self.has_jumped = False

    # --- timers --- ------------------------------------------------------------------------------

    def add(self, source: TimerEntity) -> None:
        """Add a timer."""
        self._timers[id(source)] = source
        if source.may_be_simulated:
            self._watch(source.rclpy_object.clock)
        self.ask(source)

    def remove(self, source: TimerEntity) -> None:
        """Remove a timer."""
        self._timers.pop(id(source), None)
        self._agenda.cancel(source)
        if source.may_be_simulated:
            self._watch_no_more(source.rclpy_object.clock)

    def follow(self, clock: Clock, ask: Callable[[], None]) -> None:
        """Call a function after each jump of a clock, under the lock."""
        self._followers.append((clock, ask))
        self._watch(clock)

    def follow_no_more(self, clock: Clock, ask: Callable[[], None]) -> None:
        """End ``follow``."""
        self._followers.remove((clock, ask))
        self._watch_no_more(clock)

    def _watch(self, clock: Clock) -> None:
        """Watch a clock for jumps.  A clock only borrows its jump callbacks, so this must end."""
        if id(clock) not in self._jumps:
            threshold = JumpThreshold(
                min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1),
                on_clock_change=True)
            try:
                handle = clock.create_jump_callback(threshold, post_callback=self._jump)
            except InvalidHandle:
                return  # its node is being destroyed
            self._jumps[id(clock)] = clock, handle

    def _watch_no_more(self, clock: Clock) -> None:
        """End ``_watch``, if nothing else depends on the clock."""
        if any(each.rclpy_object.clock is clock for each in self._timers.values()) or any(
                each is clock for each, _ in self._followers):
            return
        watched = self._jumps.pop(id(clock), None)
        if watched is not None:
            try:
                watched[1].unregister()
            except InvalidHandle:
                pass

    def _jump(self, _: Any) -> None:
        if not self.has_jumped:
            self.has_jumped = True
            self._on_change()

    # --- due times -------------------------------------------------------------------------------

    def ask(self, source: TimerEntity) -> None:
        """Ask rcl when a timer is due that is new or was reset."""
        try:
            with source.handle:
                self._ask(source)
        except RCL_ERRORS as error:
            self._failed(source, error)

    def _ask(self, source: TimerEntity) -> None:
        source.simulated = source.is_simulated()
        if source.simulated:
            self._agenda.cancel(source)
            if source.is_due():
                self._push(source, _now())
            return
        due = source.next_due()
        if due is None:
            self._agenda.cancel(source)
        elif not source.entry or due != source.due:
            self._push(source, due)

    def _push(self, source: TimerEntity, due: int) -> None:
        source.due = due
        latest = due
        if not source.is_eager():
            if source.period_of_allowance != source.last_period:
                source.period_of_allowance = source.last_period
                source.allowance = self.allowance(source, source.last_period)
            latest += source.allowance
        self._agenda.set(source, due, latest)

    def ask_after_jump(self) -> None:
        """Ask rcl about all timers whose clocks may have jumped."""
        self.has_jumped = False
        for source in list(self._timers.values()):
            if source.may_be_simulated:
                self.ask(source)
        for _, ask in self._followers:
            ask()

    def fire(self, source: TimerEntity) -> None:
        """Report a timer that is due, if rcl agrees, and set its next due time."""
        try:
            with source.handle:
                fired = self._fire(source)
        except RCL_ERRORS as error:
            self._failed(source, error)
            return
        if fired is not None:
            self._report(fired)

    def _fire(self, source: TimerEntity) -> Fired | None:
        """Call a timer if rcl reports it due, and push its next due time."""
        if source.waiting and source.period() <= 0:
            source.collect_more = partial(self._fire_again, source)
            return None
        if source.simulated:  # since the last jump of its clock, which is handled first
            return self._fire_simulated(source)
        due, now, until = source.due, _now(), source.until()
        if until is None:
            return None
        if abs(now + until - due) > TOLERANCE_NS:  # it was reset, or its clock was set
            new = source.next_due()
            if new is None:
                return None
            if new > now:
                self._push(source, new)
                return None
            due = new
        work = source.call()
        period = source.period()
        after: int | None = due + period
        if period <= 0 or due + period <= now or period != source.last_period:
            after = source.next_due()  # rcl skips missed periods
        source.last_period = period
        if after is None:
            return None
        if period <= 0:
            self._push(source, now + ZERO_PERIOD_NS)
            return None if work is None else (work, now, 0, 0)
        self._push(source, after)
        missed = (after - due + period // 2) // period - 1
        return None if work is None else (work, due, missed if missed > 0 else 0, period)

    def _fire_simulated(self, source: TimerEntity) -> Fired | None:
        if not source.is_due():
            return None
        work = source.call()
        if source.is_due():  # without a period: rcl skips all but the last of several
            self._push(source, _now() + ZERO_PERIOD_NS)
        return None if work is None else (work, _now(), 0, 0)

    def _fire_again(self, source: TimerEntity) -> None:
        """Continue with a timer without a period, as its execution has started."""
        if id(source) in self._timers:
            self._push(source, _now() + ZERO_PERIOD_NS)

    def _failed(self, source: TimerEntity, error: Exception) -> None:
        """Classify an exception of rcl: the timer is destroyed or cancelled, or it is an error."""
        self._agenda.cancel(source)
        try:
            with source.handle:  # keeps rcl's memory valid
                is_cancelled = source.next_due() is None
        except InvalidHandle:
            self._timers.pop(id(source), None)
        else:
            if not is_cancelled:
                self._on_error(error)

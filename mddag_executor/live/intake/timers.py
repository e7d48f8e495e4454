# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When timers are due: a queue by due time instead of an rcl wait set.

Theory of operation
-------------------
rcl keeps a timer's state (next call time, period, cancelled), and stays the authority: whether a
timer is due is asked of rcl, and ``call_timer`` moves it on (missed periods are skipped there, the
phase is kept; ``on_missed`` gets how many they were). What is kept here is only when to ask: the
next due time of each timer in a heap. So a wake-up costs the same beside ten timers and beside a
thousand, where a wait set has to be filled with all of them again.

Nominal due time
    rcl says how long it is *until* the next call, not when that is. Reading the clock before and
    after asking gives an interval that holds the next call time. Once for each timer the interval
    is made narrow and its middle becomes the anchor of the timer's phase grid, anchor + k*period;
    from then on due times are points of that grid as long as they lie in the interval (widened by
    ``TOLERANCE_NS``). When none does, the phase has changed (``reset()``, a stepped system clock,
    a steady clock that is not slewed like the monotonic one) and a new anchor is taken.

Changes that nobody announces
    rclpy has no notification for ``cancel()``, ``reset()`` and a new period. A due time that goes
    back shows when the timer is asked at its old due time. One that comes closer (a cancelled
    timer reset, a period shortened before a reset) shows in a scan over all timers: at wake-ups
    that happen anyway, and at the latest after the shortest period of a cancelled timer, since a
    reset timer is due no sooner than a period later.

Rounds
    Timers that come due while others are called are handed over with them. Nobody waits for them,
    but a callback of little urgency that came due some microseconds earlier would else take the
    last worker, and keep it.

Simulated time
    Timers of a clock whose time is overridden have no due time on the monotonic clock. They are
    asked after each jump of their clock (its jump callbacks wake the queue's thread).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import ctypes
from heapq import heapify, heappop, heappush
import time
from typing import Any

from mddag_executor.live.intake.arrivals import Receiver
from mddag_executor.live.intake.entities import alive
from mddag_executor.live.intake.phase import PhasedTimer, TOLERANCE_NS, WIDE_NS
from mddag_executor.live.work import Work
from rclpy.clock import Clock, JumpHandle, JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle
from rclpy.timer import Timer

# Scans happen at most and at least that often, and at most while a timer is cancelled; and they
# are repeated only after so many times what the last one took, so they have 1 % of a CPU at most.
SCAN_GAP_NS, SCAN_LATEST_NS, SCAN_CANCELLED_NS = 50_000_000, 100_000_000, 5_000_000
SCAN_SHARE = 100

# A timer without a period is always due; so often it is handed over.
ZERO_PERIOD_NS = 1_000_000

_now = time.monotonic_ns
_PR_SET_TIMERSLACK = 29


def sharpen_wake_ups() -> None:
    """
    Ask Linux not to delay the calling thread's timed wake-ups for joining them with others.

    The default (timer slack, prctl(2)) delays each by up to 50 us. Elsewhere nothing happens.
    """
    try:
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    except (AttributeError, OSError, TypeError):
        pass


class TimerQueue:
    """
    The timers of an intake, by due time. All methods belong to one thread at a time.

    :param receiver: whom to hand over to.
    :param wake: called, from any thread, when a clock jumped: ``fire`` is to be called soon.
    """

    def __init__(self, receiver: Receiver, wake: Callable[[], None]) -> None:
        self._take_in = receiver.take_in
        self._on_error = receiver.on_intake_error
        self._wake = wake
        self._timers: dict[int, PhasedTimer] = {}
        self._heap: list[tuple[int, int, PhasedTimer]] = []
        self._entries = 0
        self._jumps: dict[int, tuple[Clock, JumpHandle]] | None = None
        self._jumped = False
        self._scan_early = 0
        self._scan_latest = 0

    def update(self, timers: Iterable[Timer]) -> None:
        """Set which timers there are; those that stay keep their phase grid."""
        known, self._timers = self._timers, {}
        for timer in timers:
            phased = known.get(id(timer))
            if phased is None:
                try:
                    phased = PhasedTimer(timer)
                except Exception as error:
                    if not isinstance(error, InvalidHandle) and alive(timer):
                        self._on_error(error)
                    continue
            self._timers[id(timer)] = phased
        self._heap = [entry for entry in self._heap if id(entry[2].timer) in self._timers]
        heapify(self._heap)
        if self._jumps is not None:
            self.watch_clocks(True)
        self.scan()

    def watch_clocks(self, watch: bool) -> None:
        """
        Wake on jumps of the timers' ROS clocks, or no longer.

        A clock only borrows its jump callbacks, so who starts watching must end it.
        """
        wanted = {}
        if watch:
            wanted = {
                id(s.timer.clock): s.timer.clock
                for s in self._timers.values() if s.may_be_overridden}
        jumps = self._jumps or {}
        for key in [key for key in jumps if key not in wanted]:
            try:
                jumps.pop(key)[1].unregister()
            except InvalidHandle:
                pass
        for key, clock in wanted.items():
            if key not in jumps:
                try:
                    jumps[key] = clock, clock.create_jump_callback(
                        JumpThreshold(
                            min_forward=Duration(nanoseconds=1),
                            min_backward=Duration(nanoseconds=-1), on_clock_change=True),
                        post_callback=self._on_jump)
                except InvalidHandle:
                    pass
        self._jumps = jumps if watch else None

    def _on_jump(self, _: Any) -> None:
        if not self._jumped:
            self._jumped = True
            self._wake()

    def next_look(self) -> int | None:
        """Return when to call ``fire`` next (monotonic ns), None for never."""
        if self._jumped:
            return 0
        if not self._timers:
            return None
        heap = self._heap
        while heap and heap[0][2].entry != heap[0][1]:
            heappop(heap)
        if heap and heap[0][0] < self._scan_latest:
            return heap[0][0]
        return self._scan_latest

    def fire(self, now: int) -> int:
        """Hand over what is due, and what comes due meanwhile; return how many it were."""
        if self._jumped or (now >= self._scan_early and self._timers):
            self.scan()
        heap = self._heap
        if not heap or heap[0][0] > now:
            return 0
        arrivals: list[Work] = []
        # An entry made meanwhile is of the next round, so this ends.
        last = self._entries
        while heap and heap[0][1] <= last and (heap[0][0] <= now or heap[0][0] <= _now()):
            _, entry, timer = heappop(heap)
            if timer.entry == entry:
                timer.entry = 0
                self._fire(timer, arrivals)
        if arrivals:
            try:
                self._take_in(arrivals)
            except Exception as error:
                self._on_error(error)
        return len(arrivals)

    def scan(self) -> None:
        """Ask every timer when it is due, and find out about changes."""
        self._jumped = False
        start = _now()
        shortest = SCAN_LATEST_NS
        for timer in list(self._timers.values()):
            try:
                self._look_at(timer)
            except Exception as error:
                self._failed(timer, error)
            if timer.cancelled and timer.period < shortest:
                shortest = max(timer.period, SCAN_CANCELLED_NS)
        end = _now()
        rest = (end - start) * SCAN_SHARE
        self._scan_early = end + max(min(SCAN_GAP_NS, shortest), rest)
        self._scan_latest = end + max(shortest, rest)

    def _look_at(self, timer: PhasedTimer) -> None:
        simulated = timer.overridden()
        if simulated != timer.simulated:
            timer.simulated = simulated
            timer.entry = 0
        if simulated:
            until = timer.until()
            timer.cancelled = until is None
            if until is None or until > 0:
                timer.entry = 0
            elif not timer.entry:
                self._push(timer, 0)
            return
        interval = timer.measure()
        timer.cancelled = interval is None
        if interval is None:
            timer.period = timer.get_period()
            timer.entry = 0
            return
        low, high = interval
        if timer.entry and low - TOLERANCE_NS <= timer.due <= high + TOLERANCE_NS:
            return
        self._aim(timer, low, high)

    def _aim(self, timer: PhasedTimer, low: int, high: int) -> None:
        """Put a timer into the heap whose next call time lies in this interval."""
        period = timer.get_period()
        point = timer.grid_point(low, high) if period == timer.period and timer.anchor else None
        if point is not None:
            timer.due = point
        elif not timer.take_anchor():
            self._park(timer)
            return
        self._push(timer, timer.due)

    def _park(self, timer: PhasedTimer) -> None:
        """Note that a timer is cancelled: only a scan finds out that it was reset."""
        timer.cancelled = True
        self._scan_latest = min(
            self._scan_latest, _now() + max(timer.period, SCAN_CANCELLED_NS))

    def _push(self, timer: PhasedTimer, due: int) -> None:
        self._entries += 1
        timer.entry = self._entries
        heappush(self._heap, (due, self._entries, timer))

    def _fire(self, timer: PhasedTimer, arrivals: list[Work]) -> None:
        """Call a timer if rcl agrees that it is due."""
        try:
            with timer.handle:
                due = self._call(timer)
                arrival = None if due is None else timer.arrival(due)
        except Exception as error:
            self._failed(timer, error)
            return
        if arrival is not None:
            arrivals.append(arrival)

    def _call(self, timer: PhasedTimer) -> int | None:
        """Call a timer and aim at its next due time; return the one that it had, if it had."""
        before = _now()
        until = timer.until()
        after = _now()
        if timer.simulated:
            if until is None or until > 0:
                return None
            timer.call()
            return before
        if after - before > WIDE_NS:
            interval = timer.measure()
        else:
            interval = None if until is None else (before + until, after + until)
        if interval is None:
            self._park(timer)
            return None
        low, high = interval
        if low > _now():
            # It was reset, or its period has changed: not due yet.
            self._aim(timer, low, high)
            return None
        period = timer.get_period()
        if period <= 0:
            timer.call()
            timer.period = period
            timer.due = before + ZERO_PERIOD_NS
            self._push(timer, timer.due)
            return before
        due = timer.grid_point(low, high)
        if due is None:
            if not timer.take_anchor():
                self._park(timer)
                return None
            due = timer.anchor
        if period != timer.period:
            # The call that is due now was still aimed at by the old period.
            timer.period, timer.anchor = period, due
        timer.call()
        timer.due = due + period
        if timer.due < before:
            # rcl skips missed periods too; it read its clock later, so it can be ahead of this,
            # which then shows as "not due yet".
            timer.missed = -(-(before - timer.due) // period)
            timer.due += timer.missed * period
        self._push(timer, timer.due)
        return due

    def _failed(self, timer: PhasedTimer, error: Exception) -> None:
        """Sort out an exception of rcl: the timer was destroyed, cancelled, or it is an error."""
        timer.entry = 0
        if isinstance(error, InvalidHandle) or not alive(timer.timer):
            self._timers.pop(id(timer.timer), None)
            return
        if timer.until() is None:
            self._park(timer)
        else:
            self._on_error(error)

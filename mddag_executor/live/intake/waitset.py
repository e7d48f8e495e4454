# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Intake by an rcl wait set that is built once and refilled, and by a queue of timers.

Theory of operation
-------------------
One wait: fill the wait set with the handles of all entities (rcl empties it at each wait), wait
without the GIL, and ask it for what is ready; each of that is taken and handed over at once.

What is built once for a set of entities is the wait set itself, the lists of handles and, for
each entity, its source, found by the address that the wait set gives (``compat.wait_set``). What
makes rclpy's own executors slow with many entities is not done here: asking every node for its
entities, a callback group for each, and a new wait set, at every wait.

Entities are held (``with handle``) while they are waited for, so a destroyed one goes when the
wait ends. Taking from it enters its handle once more, which fails after ``destroy``: nothing is
handed over for it.

From a ready subscription messages are taken until there are none, at most its depth: that is as
many as were there when it became ready. One message a wait would cost a wait for each message
under load; more than the depth could keep the others waiting.

Timers are not in the wait set (see ``timers``): their next due time is the wait's time-out. An
intake of timers only, or one that has nothing else yet, sleeps on a lock instead, which is
cheaper.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Iterable
import threading
import time

from mddag_executor.live.alarm import Bell
from mddag_executor.live.compat import RCLError
from mddag_executor.live.compat.wait_set import RefilledSet
from mddag_executor.live.intake.arrivals import Receiver
from mddag_executor.live.intake.entities import EMPTY, EntitySet
from mddag_executor.live.intake.sources import SOURCES, sources
from mddag_executor.live.intake.timers import sharpen_wake_ups, TimerQueue
from mddag_executor.live.shutdown import (
    call_at_shutdown,
    ContextChecks,
    is_over,
    join,
    stop_at_exit,
)
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition

ALL_KINDS = frozenset(('timers', *SOURCES))
"""The kinds of entities: lists of ``EntitySet``."""

REBUILD_SHARE = 10
"""A wait set is built anew at the earliest after so many times what building it took last."""

REBUILD_LATEST_NS = 50_000_000

EVENTS_NS = 100_000_000
"""A thread looks at QoS events so often, if that takes no more than their share of a CPU."""

QOS_EVENTS = {'events': 200, 'logged_events': 2000}
"""The kinds of QoS events, each with its share: one part of so many."""

PATIENCE = 3
"""So many waits in a row may bring errors before the thread slows down."""

_now = time.monotonic_ns


class WaitSetIntake:
    """
    Hands over what becomes ready, from a thread (``start``) or from the caller (``poll``).

    In a thread, QoS events are only looked at ten times a second, or less often if they are that
    many: there are several for each publisher and subscription, they hardly ever become ready, and
    waiting for them would cost more than all the rest. Those that only write to the log are looked
    at ten times less often where they are many. (Waiting for them in a thread of their own
    does not help: with Fast DDS a message that is not taken yet ends the wait for the events of
    its subscription.)

    :param context: the context of all nodes.
    :param receiver: whom to hand over to.
    :param guards: guard conditions that end a wait without anything to hand over, such as an
        executor's own, and rclpy's ``SignalHandlerGuardCondition``. A guard condition wakes only
        one of several waits, so give it to one intake only.
    :param kinds: the kinds of entities to look after, of ``ALL_KINDS``.
    :param name: what the thread is called, after ``mddag-intake-``.
    :param on_shutdown: called in the intake's thread when it ends because the context has ended.
    """

    def __init__(
        self,
        context: Context,
        receiver: Receiver,
        guards: Iterable[GuardCondition] = (),
        kinds: Iterable[str] = ALL_KINDS,
        *,
        name: str = 'waitset',
        on_shutdown: Callable[[], None] | None = None,
    ) -> None:
        self._context = context
        self._receiver = receiver
        self._guards = tuple(guards)
        self._kinds = frozenset(kinds)
        self._name = f'mddag-intake-{name}'
        self._on_shutdown = on_shutdown
        self._timers = TimerQueue(receiver, self.wake)
        self._latest = EMPTY
        self._changed = False
        self._rebuild_at = 0
        self._filled: RefilledSet | None = None
        # Whoever sleeps, sleeps on this bell or on this guard condition; a wake rings both.
        self._bell = Bell()
        self._guard: GuardCondition | None = None
        if self._guards or self._kinds != {'timers'}:
            self._guard = GuardCondition(None, None, context)
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._failures = 0
        self._looks = ContextChecks()
        self._waiting = False  # in a poll
        # in a thread: QoS events with the part of their share, by when to look at them next
        self._events: list[tuple[int, int, RefilledSet]] = []
        call_at_shutdown(context, self.wake)

    # --- what to wait for ------------------------------------------------------------------------

    def update(self, entities: EntitySet) -> None:
        """Set what to wait for; from any thread. It comes into force soon, also in a wait."""
        if entities is not self._latest:
            self._latest = entities
            self._changed = True
            if self._waiting or self.running:
                self.wake()

    def settled(self) -> bool:
        """Return whether what was set by ``update`` has come into force."""
        return not self._changed or not self.running

    def wake(self) -> None:
        """End the present wait, or the next one, early; from any thread."""
        self._bell.ring()
        if self._guard is not None:
            try:
                self._guard.trigger()
            except InvalidHandle:
                pass

    def _apply(self) -> None:
        """Build the wait set for the latest entities."""
        start = _now()
        self._changed = False
        latest = self._latest
        self._drop()
        if self._guard is not None:
            apart = self._kinds & QOS_EVENTS.keys() if self._thread is not None else set[str]()
            self._filled = self._set_for(self._kinds - apart, (*self._guards, self._guard))
            self._events = [
                (0, QOS_EVENTS[kind], self._set_for({kind}))
                for kind in sorted(apart) if getattr(latest, kind)]
        if 'timers' in self._kinds:
            self._timers.update(latest.timers)
        end = _now()
        self._rebuild_at = end + min((end - start) * REBUILD_SHARE, REBUILD_LATEST_NS)

    def _set_for(
        self, kinds: Iterable[str], bells: Iterable[GuardCondition] = ()
    ) -> RefilledSet:
        receiver = self._receiver
        return RefilledSet(
            self._context, sources(self._latest, kinds, receiver), bells,
            receiver.on_intake_error)

    def _drop(self) -> None:
        for _, _, events in self._events:
            events.release()
        self._events = []
        if self._filled is not None:
            self._filled.release()
            self._filled = None

    # --- waiting ---------------------------------------------------------------------------------

    def _turn(self, limit: int | None = None) -> tuple[int, bool]:
        """
        Wait once and hand over what is ready.

        :param limit: when to end the wait at the latest (monotonic ns).
        :return: how many things were handed over, and whether something rang to end the wait.
        """
        if self._changed and _now() >= self._rebuild_at:
            self._apply()
        timers = self._timers
        count = timers.fire(_now())
        if self._events and _now() >= self._events[0][0]:
            self._look_at_events()
        ends = [
            limit, timers.next_look(), self._looks.at,
            self._events[0][0] if self._events else None,
            self._rebuild_at if self._changed else None,
            0 if count and self._waiting else None]
        until = min((end for end in ends if end is not None), default=None)
        more, rang = self._wait(-1 if until is None else max(0, until - _now()))
        return count + more + timers.fire(_now()), rang

    def _wait(self, timeout_ns: int) -> tuple[int, bool]:
        """Wait for all but timers, for ever if the time is negative (see ``_turn``)."""
        filled = self._filled
        if filled is None or not (filled.size or self._guards):
            return 0, self._bell.wait(timeout_ns / 1e9 if timeout_ns >= 0 else -1)
        try:
            filled.wait(timeout_ns)
        except InvalidHandle:
            # A waitable was destroyed; what it consists of is held, but it refuses to be used.
            self._apply()
            return 0, False
        rang = filled.rung()
        count, failed = filled.take_ready()
        self._failures = self._failures + 1 if failed else 0
        return count, rang

    def poll(self, timeout_sec: float | None = None) -> int:
        """
        Wait once, in the calling thread, and hand over what is ready.

        :param timeout_sec: seconds to wait; None or negative: until something is ready.
        :return: how many things were handed over: 0 after the time, and when a guard condition
            or ``wake`` ended the wait, or the context has been shut down.
        :raises RCLError: when rcl cannot wait for another reason.
        """
        limit = None
        if timeout_sec is not None and timeout_sec >= 0:
            limit = _now() + int(min(timeout_sec, 1e9) * 1e9)
        self._waiting = True
        try:
            self._timers.scan()
            if self._changed or self._filled is None or not self._filled.hold():
                self._apply()
            while True:
                count, rang = self._turn(limit)
                ended = self._context_ended(rang)
                if count or rang or ended or (limit is not None and _now() >= limit):
                    return count
        except RCLError:
            if not is_over(self._context):
                raise
            return 0
        finally:
            self._waiting = False
            if self._filled is not None:
                self._filled.release()

    @property
    def running(self) -> bool:
        """Whether the intake's thread runs."""
        return self._thread is not None and self._thread.is_alive()

    def _context_ended(self, rang: bool) -> bool:
        """Return whether the context has ended, which it does not without a ring."""
        if rang:
            self._looks.begin()
        elif not self._looks.due():
            return False
        return is_over(self._context)

    # --- thread ----------------------------------------------------------------------------------

    def start(self) -> None:
        """Hand over from a thread of the intake's own until ``stop``: once."""
        stop_at_exit(self)
        self._changed = True
        self._rebuild_at = 0
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """
        End the thread and release all entities; from any thread, and in any state.

        What is ready by then stays where it is. Called by a receiver from the intake's thread, it
        returns at once and the thread ends after that call.
        """
        self._stopping = True
        if self._thread is not None:
            self.wake()
            join(self._thread)

    def _run(self) -> None:
        sharpen_wake_ups()
        self._timers.watch_clocks(True)
        ended = False
        try:
            while not self._stopping and not ended:
                try:
                    ended = self._context_ended(self._turn()[1])
                except Exception as error:
                    ended = is_over(self._context)
                    if not ended:
                        self._failures += 1
                        self._changed = True
                        self._receiver.on_intake_error(error)
                if self._failures > PATIENCE and not ended:
                    # Something fails again and again without being used up: no busy loop.
                    self._bell.wait(min(0.1, 0.001 * self._failures))
        finally:
            self._timers.watch_clocks(False)
            self._timers.update(())
            self._drop()
        if ended and self._on_shutdown is not None:
            self._on_shutdown()

    def _look_at_events(self) -> None:
        """Look at those QoS events whose turn it is."""
        _, share, events = self._events.pop(0)
        start = _now()
        try:
            if events.size:  # else all were destroyed by then
                events.wait(0)
                events.take_ready()
        except InvalidHandle:
            self._changed = True  # one was destroyed
        end = _now()
        insort(self._events, (end + max(EVENTS_NS, (end - start) * share), share, events))

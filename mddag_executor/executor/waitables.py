# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Waitables (actions, QoS events, and user-defined ones), and guard conditions.

Theory of operation
-------------------
1.  A waitable consists of rcl entities, which a wait set contains after the waitable has been
    added to it.  Each of these entities gets the listener of its kind (``listeners``).  rcl has
    none for guard conditions, so their trigger is wrapped (``publishing``).  After an arrival the
    waitable is asked with its own wait set, which does not wait (``WaitableSource``).
2.  Each waitable and each guard condition has a source of its own.  Only QoS events share one, as
    they are rare.
3.  Setting the listener of a QoS event marks earlier events as known, so a wait set does not
    report them any more.  Therefore all events are taken, and those with unchanged counts are
    dropped.  It also forgets by how much the counts have changed since they were taken.  So an
    event keeps its listener when the shared source is made again.  Meanwhile both sources contain
    it.  It notes in itself its place in the wait set that was filled last, so only one source may
    fill its set and ask it at a time (``_filling``).
4.  A timer within a waitable (the expiry of an action's goals) is checked when it is due next; in
    simulated time, after each jump of the clock.
5.  *The exception* is a thread that waits in a wait set (``WaitSetThread``).  It waits for rclpy's
    signal condition, because rclpy's handler of SIGTERM is written in C++: it triggers the
    condition without Python, and writes to no descriptor.  The thread also waits for waitables
    for which the middleware has no listener, and for waitables without any entity.  The latter
    are asked whenever the executor is woken (``Executor.wake``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
import threading
import time
from typing import Any, TypeVar
import weakref

from mddag_executor.executor import compat
from mddag_executor.executor.bounds import END_S, MOST
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.hall import Hall
from mddag_executor.executor.kinds import Kind, Rooms
from mddag_executor.executor.listeners import clear_listener, ListenerError, NextCall, set_listener
from mddag_executor.executor.loop import ChannelSource
from mddag_executor.executor.shutdown import call_at_shutdown, is_over, join, stop_at_exit
from mddag_executor.executor.waitsets import FilledSet
from mddag_executor.executor.work import Work
from rclpy.clock_type import ClockType
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.waitable import Waitable

TIMER_NS = 1_000_000
"""How late a timer within a waitable may be noticed that is due earlier than it was before."""
SENDER_CHECKS = 500
"""For how many ms to wait with a response until its request is noted (7.1.5)."""

_SHORTEST_NAP_S, _LONGEST_NAP_S = 0.001, 0.1
"""How long to wait before waitables of which one has failed are asked again."""

Result = TypeVar('Result')


class AskedEntity(Kind):
    """An entity with a wait set of its own."""

    __slots__ = ('_rooms', '_source')

    def __init__(self, rclpy_object: Any, node: str) -> None:
        super().__init__(rclpy_object, node)
        self._rooms: Rooms | None = None
        self._source: WaitableSource | None = None

    def listen(self, rooms: Rooms) -> None:
        """Let it be asked when one of its parts has announced an arrival."""
        self._rooms = rooms
        try:
            self._source = open_source(WaitableSource, [self], rooms.pool)
        except ListenerError:
            rooms.unlistened.add(self)

    def ignore(self) -> None:
        """End ``listen``."""
        rooms, self._rooms = self._rooms, None
        source, self._source = self._source, None
        if source is not None:
            source.close()
        elif rooms is not None:
            rooms.unlistened.remove(self)


class WaitableEntity(AskedEntity):
    """A waitable of an action, or a user-defined one."""

    kind = 'waitable'
    list_name = 'waitables'

    __slots__ = ()

    def listen(self, rooms: Rooms) -> None:
        """Let it be asked when one of its parts has announced an arrival."""
        super().listen(rooms)
        key = compat.receiver_of(self.rclpy_object)
        if key is not None and self._source is not None:
            rooms.pool.engine.sent_requests.add_receiver(key, self._source.ask_now)
        if self._source is not None and self._source.has_timers:
            clock = compat.clock_of(self.rclpy_object)
            if clock is not None and clock.clock_type == ClockType.ROS_TIME:
                self._source.clock = clock
                with rooms.pool.lock:
                    rooms.pool.timers.follow(clock, self._source.collect)

    def ignore(self) -> None:
        """End ``listen``."""
        rooms, source = self._rooms, self._source
        if rooms is not None and source is not None and source.clock is not None:
            with rooms.pool.lock:
                rooms.pool.timers.follow_no_more(source.clock, source.collect)
        key = compat.receiver_of(self.rclpy_object)
        if key is not None and rooms is not None and source is not None:
            rooms.pool.engine.sent_requests.remove_receiver(key, source.ask_now)
        super().ignore()


class GuardEntity(AskedEntity):
    """A guard condition of a node."""

    kind = 'guard'
    list_name = 'guards'

    __slots__ = ()

    def describe(self) -> None:
        """Set its label."""
        self.label = 'condition'


class EventEntity(Kind):
    """A QoS event: rclpy's ``EventHandler``, if it waits and takes as rclpy's does."""

    kind = 'waitable'
    list_name = 'waitables'

    __slots__ = ('_rooms',)

    def __init__(self, rclpy_object: Any, node: str) -> None:
        super().__init__(rclpy_object, node)
        self._rooms: Rooms | None = None

    @classmethod
    def fits(cls, rclpy_object: Any) -> bool:
        """Return whether a waitable is of this kind."""
        kind = type(rclpy_object)
        return isinstance(rclpy_object, EventHandler) and all(
            getattr(kind, name) is getattr(EventHandler, name)
            for name in ('add_to_wait_set', 'is_ready', 'take_data', 'get_num_entities'))

    def listen(self, rooms: Rooms) -> None:
        """Let it be asked with the other events."""
        self._rooms = rooms
        rooms.events.add(self)

    def ignore(self) -> None:
        """End ``listen``."""
        rooms, self._rooms = self._rooms, None
        if rooms is not None:
            rooms.events.remove(self)


# --- sources -------------------------------------------------------------------------------------

def executions_of(entity: Entity, pool: Hall) -> list[Work]:
    """
    Take the ready data of a waitable; return the executions that handle them.

    An action client forgets the callback of a goal's feedback when the goal's result has come.  So
    each feedback is a separate execution, with its callback.
    """
    waitable = entity.rclpy_object
    data = waitable.take_data()
    compat.attach_futures(waitable, pool.outer_groups.get(entity.outer) or pool.executor)
    found = [Work(entity, callback, (message,))
             for callback, message in compat.feedback_taken(waitable, data, MOST)]
    if data or not found:
        work = Work(entity, waitable.execute, (data,))
        requests = pool.engine.sent_requests
        if not requests.is_empty():
            work.heritage = requests.of_action(compat.exchanged(waitable, data))
        found.append(work)
    return found


class Asked:
    """
    Waitables and guard conditions that are asked with one wait set.

    :param more_guards: conditions that are in the set as well, and are not entities.
    :raises InvalidHandle: when one of them has been destroyed.
    """

    def __init__(
        self, entities: Iterable[Entity], pool: Hall, more_guards: Iterable[GuardCondition] = (),
    ) -> None:
        self._pool = pool
        self.by_id = {id(entity.rclpy_object): entity for entity in entities}
        objects = [entity.rclpy_object for entity in self.by_id.values()]
        self.set = FilledSet(
            pool.context, [each for each in objects if isinstance(each, Waitable)],
            [*more_guards, *(each for each in objects if not isinstance(each, Waitable))])

    def ask(self, timeout_ns: int | None) -> tuple[list[Work], list[GuardCondition]]:
        """
        Return the executions that are ready, and the triggered conditions that are not entities.

        :param timeout_ns: see ``FilledSet.wait``.
        """
        found: list[Work] = []
        others = []

        def take(waitable: Waitable) -> None:
            found.extend(executions_of(self.by_id[id(waitable)], self._pool))

        for guard in self.set.wait(timeout_ns, take):
            entity = self.by_id.get(id(guard))
            if entity is None:
                others.append(guard)
            elif guard.callback is not None:
                found.append(Work(entity, guard.callback))
        return found, others


class WaitableSource(ChannelSource):
    """
    Waitables and guard conditions that share a descriptor.

    :param entities: those of the waitables and guard conditions.
    :ivar clock: of the timers in it; None: it cannot show simulated time.
    :raises ListenerError: when they contain an entity that has no listener, or none at all.
    :raises InvalidHandle: when one of them has been destroyed.
    """

    def __init__(self, entities: Iterable[Entity], pool: Hall) -> None:
        super().__init__()
        self.clock: Any = None
        self.entities = list(entities)
        self._pool = pool
        self._asked = Asked(self.entities, pool)
        self._set = self._asked.set
        self._timers: list[NextCall] = []
        self._guards: list[int] = []
        self._has_parts = False
        self._set.parts(self._add_part)
        if not self._has_parts:
            raise ListenerError('a waitable that contains no entity has no listener')
        self._lock = threading.Lock()
        self._has_more = False
        self._ignored = False
        # when it is asked next because of a timer, monotonic ns
        self._asks_at = 0

    @property
    def has_timers(self) -> bool:
        """Return whether it contains timers."""
        return bool(self._timers)

    def _add_part(self, kind: str, address: int) -> None:
        self._has_parts = True
        if kind == 'guard_condition':
            self._guards.append(address)
        if kind == 'timer':
            self._timers.append(NextCall(address))

    def listen(self, before: WaitableSource | None = None) -> None:
        """
        Let the middleware announce arrivals, or raise ListenerError or InvalidHandle.

        :param before: a source with the same descriptor, whose entities have listeners already.
        """
        new = None if before is None else [each.rclpy_object for each in self._without(before)]
        with self._lock:  # announcements meanwhile must not also fill the wait set
            self._set.parts(lambda kind, address: set_listener(kind, address, self.fd), new)
        # arrivals that were announced to ``before`` are collected here
        if self._has_more or before is not None:
            self._ask()

    def _without(self, other: WaitableSource | None) -> list[Entity]:
        theirs = () if other is None else other.entities
        return [each for each in self.entities if each not in theirs]

    def close(self, kept_by: WaitableSource | None = None) -> None:
        """
        End ``listen``, and wait until no thread collects from it.

        :param kept_by: a source with the same descriptor, whose entities keep their listeners.
        """
        self._ignored = True
        with self._lock:
            for address in self._guards:  # of destroyed ones as well
                clear_listener('guard_condition', address, self.fd)
            call_with_living([each for each in self._without(kept_by)
                              if isinstance(each.rclpy_object, Waitable)], self._clear)
        with self._pool.lock:
            self._pool.loop.remove(self)

    def _clear(self, living: list[Entity]) -> None:
        self._set.parts(lambda kind, address: clear_listener(kind, address, self.fd),
                        [each.rclpy_object for each in living])

    def collect(self) -> None:
        """Collect the arrivals soon: without the engine's lock, as this calls foreign code."""
        self._pool.unlocked_calls.append(self._ask)

    def ask_now(self) -> None:
        """Collect what has just been sent in the thread that calls."""
        if self._pool.running and not self._pool.is_inside():
            self._ask()

    def _ask(self) -> None:
        self._has_more = True
        while self._has_more and not self._ignored and self._lock.acquire(blocking=False):
            try:
                self._has_more = False
                self._collect()
            except InvalidHandle:
                pass  # destroyed: the next refresh forgets it
            except Exception as error:
                self._pool.fail(error)
            finally:
                self._lock.release()

    def _collect(self) -> None:
        found: list[Work] = []
        for _ in range(MOST):
            more, _ = self._asked.ask(0)
            if not more:
                break
            found += more
        else:  # there may be more, after the other sources
            self._pool.call_at(time.monotonic_ns(), self._ask)
        if found:
            self._post_noted(found)
        if self.clock is not None and self.clock.ros_time_is_active:
            return  # its timers are due after a jump of the clock only
        with self._set.protected():
            times = [timer.until() for timer in self._timers]
        for until in times:
            if until is not None and until > 0:  # else its handling is posted, which resets it
                self._ask_in(until)

    def _ask_in(self, ns: int) -> None:
        """
        Collect again after a time, unless that is done by then anyway.

        A collection for each arrival would lead to one more each time that the timer is due.
        """
        now = time.monotonic_ns()
        if not now < self._asks_at <= now + ns + TIMER_NS:
            self._asks_at = now + ns
            self._pool.call_at(now + ns, self._ask)

    def _post_noted(self, found: list[Work], checks: int = 0) -> None:
        """Post executions; a response only after the sending thread has noted the request."""
        early = [] if checks >= SENDER_CHECKS else [
            work for work in found
            if work.args and compat.sender_is_behind(work.entity.rclpy_object, work.args[0])]
        if len(early) < len(found):
            self._pool.post([work for work in found if work not in early])
        if early:
            self._pool.call_at(
                time.monotonic_ns() + 1_000_000, partial(self._post_noted, early, checks + 1))


def call_with_living(
    entities: list[Entity], call: Callable[[list[Entity]], Result],
) -> Result | None:
    """
    Call with those waitables that are not destroyed; again without those destroyed meanwhile.

    :return: the result; None when none is left.
    """
    before = len(entities) + 1
    while 0 < len(living := _living(entities)) < before:
        before = len(living)
        try:
            return call(living)
        except InvalidHandle:
            pass
    return None


def _living(entities: list[Entity]) -> list[Entity]:
    return [each for each in entities if compat.alive(each.rclpy_object)]


def open_source(
    make: Callable[[list[Entity], Hall], WaitableSource], entities: list[Entity], pool: Hall,
    share: str = '', before: WaitableSource | None = None,
) -> WaitableSource | None:
    """
    Return a source of the entities that listens; None: they are all destroyed.

    :param share: see ``EventLoop.add``; ``before``: see ``WaitableSource.listen``.
    :raises ListenerError: when there is no listener for one of them.
    """
    def listen(alive: list[Entity]) -> WaitableSource:
        source = make(alive, pool)
        with pool.lock:
            pool.loop.add(source, share)
        try:
            source.listen(before)
        except (InvalidHandle, ListenerError):
            source.close(before)
            raise
        return source

    return call_with_living(entities, listen)


_known: weakref.WeakKeyDictionary[Entity, list[int]] = weakref.WeakKeyDictionary()
"""The counts of each QoS event at the last take."""


_filling = threading.Lock()


class EventsSource(WaitableSource):
    """
    QoS events (rclpy's ``EventHandler``) that share a descriptor.

    :param note: called with each event and its status.
    """

    def __init__(
        self, note: Callable[[Any, Any], None], entities: Iterable[Entity], pool: Hall
    ) -> None:
        with _filling:
            super().__init__(entities, pool)
        self._note = note

    def _collect(self) -> None:
        found: list[Work] = []

        def take(event: Waitable) -> None:
            entity = self._asked.by_id[id(event)]
            status = event.take_data()
            values = {name: getattr(status, name) for name in dir(status) if '_count' in name}
            counts = [value for name, value in values.items() if not name.endswith('_change')]
            before = _known.get(entity, [0] * len(counts))
            _known[entity] = counts
            if counts != before or any(
                    value for name, value in values.items() if name.endswith('_change')):
                self._note(event, status)
                found.append(Work(entity, event.execute, (status,)))

        with _filling:
            self._set.wait(None, take)
        if found:
            self._pool.post(found)


class SharedSource:
    """
    Entities that share one source, which is made again when there are others.

    :param make: makes the source.
    :param unlistened: where those listen for which the middleware has no listener.
    """

    def __init__(
        self, make: Callable[[list[Entity], Hall], WaitableSource], pool: Hall,
        unlistened: WaitSetThread,
    ) -> None:
        self._make = make
        self._pool = pool
        self._unlistened = unlistened
        self._entities: list[Entity] = []
        self._source: WaitableSource | None = None
        self._has_changed = False

    def add(self, entity: Entity) -> None:
        """Add an entity; the source contains it after the next ``apply``."""
        self._entities.append(entity)
        self._has_changed = True

    def remove(self, entity: Entity) -> None:
        """Remove an entity."""
        self._entities.remove(entity)
        self._unlistened.remove(entity)
        self._has_changed = True

    def apply(self) -> None:
        """Listen to the entities that there are now, and to no other one any more."""
        if not self._has_changed:
            return
        self._has_changed = False
        before, self._source = self._source, None
        for entity in self._entities:
            self._unlistened.remove(entity)
        try:
            self._source = open_source(
                self._make, list(self._entities), self._pool, 'QoS events', before)
        except ListenerError:
            for entity in self._entities:
                self._unlistened.add(entity)
        if before is not None:
            before.close(self._source)


class WaitSetThread:
    """
    A thread that waits for a signal, and for entities without a listener.

    :param signals: rclpy's signal condition, or None.
    :param on_signal: called when it is triggered.
    :param has_failed: returns whether the next spin raises an exception already.
    """

    def __init__(
        self, pool: Hall, signals: Any, on_signal: Callable[[], None],
        has_failed: Callable[[], bool],
    ) -> None:
        self._pool = pool
        self._context = pool.context
        self._signals = signals
        self._on_signal = on_signal
        self._has_failed = has_failed
        self._guard = GuardCondition(None, None, self._context)
        # those to wait for from the next ``apply`` on, and now
        self._next_entities: list[Entity] = []
        self._entities: list[Entity] = []
        self._has_begun = False
        self._changed = False
        self._ending = False
        self._applied = threading.Event()
        self._asked = self._answered = 0
        self._has_answered = threading.Event()
        self._thread: threading.Thread | None = None
        call_at_shutdown(self._context, self.wake)

    def add(self, entity: Entity) -> None:
        """Wait for an entity as well, from the next ``apply`` on."""
        self._next_entities.append(entity)

    def remove(self, entity: Entity) -> None:
        """End ``add``; does nothing for other entities."""
        if entity in self._next_entities:
            self._next_entities.remove(entity)

    def apply(self) -> None:
        """
        Wait for the entities that there are now.

        Returns when no data of removed ones are being taken any more.
        """
        if self._next_entities == self._entities:
            return
        self._entities = list(self._next_entities)
        self._changed = True
        if self._has_begun:
            self.start()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._applied.clear()
            self.wake()
            while self._changed and self._thread.is_alive() and not self._applied.wait(0.1):
                pass

    def poll(self) -> None:
        """Post ready executions, for a stepping thread; not for several at the same time."""
        thread = self._thread
        if self._entities and thread is not None:
            self._has_answered.clear()
            self._asked += 1
            self.wake()
            for _ in range(5):  # an entity may be being destroyed
                if self._answered == self._asked or not thread.is_alive():
                    break
                self._has_answered.wait(0.1)
                self._has_answered.clear()

    def ask_again(self) -> None:
        """Ask the waitables again, as the executor was woken: they may be ready."""
        if self._entities:
            self.wake()

    def wake(self) -> None:
        """End the current wait."""
        try:
            self._guard.trigger()
        except InvalidHandle:
            pass

    def start(self) -> None:
        """Begin to wait if there is anything to wait for; further calls do nothing."""
        self._has_begun = True
        if self._signals is None and not self._entities:
            return
        if self._thread is None or not self._thread.is_alive() and not self._ending:
            stop_at_exit(self)
            self._changed = True
            self._thread = threading.Thread(
                target=self._run, name='mddag-wait-set', daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._ending = True
        self.wake()
        if self._thread is not None:
            join(self._thread, END_S)

    def _run(self) -> None:
        waiting: Asked | None = None
        reported, nap_s = '', _SHORTEST_NAP_S
        while not self._ending and not is_over(self._context):
            try:
                is_new = self._changed or waiting is None
                if is_new or waiting is None:
                    self._changed = False
                    waiting = None  # releases the earlier ones
                    waiting = self._build(self._entities)
                    self._applied.set()
                asked = self._asked
                self._wait(waiting, 0 if is_new or asked != self._answered else -1)
                self._answered = asked
                self._has_answered.set()
                nap_s = _SHORTEST_NAP_S
            except Exception as error:
                waiting = None
                if is_over(self._context):
                    break
                # the same one comes again and again: each spin raises it once
                if not isinstance(error, InvalidHandle) and not (
                        self._has_failed() and reported == repr(error)):
                    reported = repr(error)
                    self._pool.fail(error)
                time.sleep(nap_s)  # an entity is being destroyed; avoids a busy loop if it stays
                nap_s = min(2 * nap_s, _LONGEST_NAP_S)
        self._applied.set()
        self._on_signal()

    def _build(self, entities: list[Entity]) -> Asked:
        own = [self._guard] + ([self._signals] if self._signals is not None else [])
        return Asked(_living(entities), self._pool, own)

    def _wait(self, waiting: Asked, timeout_ns: int) -> None:
        found, triggered = waiting.ask(timeout_ns)
        if self._signals in triggered:
            self._on_signal()
        if found:
            self._pool.post(found)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Waitables (actions, QoS events, and user-defined ones), and guard conditions.

Theory of operation
-------------------
1.  A waitable consists of rcl entities, which a wait set contains after the waitable has been
    added to it.  Each entity gets the listener of its kind, so a waitable is a source like others
    (``WaitableSource``).  After an arrival the waitable is asked with its own wait set, which does
    not wait.  The QoS events of all nodes share one such source, as they are rare.  Setting the
    listener of an event marks earlier events as known, so a wait set does not report them any
    more.  Therefore all events are taken, and those with unchanged counts are dropped.
2.  A timer within a waitable (the expiry of an action's goals) is checked when it is due next.
3.  rcl has no listener for guard conditions.  One thread waits in a wait set (``WaitSetThread``)
    for these, for user-defined waitables that contain any, and for rclpy's signal condition.
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
from mddag_executor.executor.listeners import clear_listener, ListenerError, NextCall, set_listener
from mddag_executor.executor.loop import ChannelSource
from mddag_executor.executor.shutdown import call_at_shutdown, is_over, join, stop_at_exit
from mddag_executor.executor.waitsets import FilledSet
from mddag_executor.executor.work import Work
from mddag_executor.executor.workers import WorkerPool
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.waitable import Waitable

SENDER_CHECKS = 500
"""For how many ms to wait with a response until its request is noted (7.1.5)."""

Result = TypeVar('Result')


def executions_of(entity: Entity, pool: WorkerPool) -> list[Work]:
    """
    Take the ready data of a waitable; return the executions that handle them.

    An action client forgets the callback of a goal's feedback when the goal's result has come.  So
    each feedback is a separate execution, with its callback.
    """
    waitable = entity.rclpy
    data = waitable.take_data()
    compat.attach_futures(waitable, pool.outer_groups.get(entity.outer) or pool.executor)
    found = [Work(entity, callback, (message,))
             for callback, message in compat.feedback_taken(waitable, data, MOST)]
    if data or not found:
        found.append(Work(entity, waitable.execute, (data,)))
    return found


class WaitableSource(ChannelSource):
    """
    Waitables that share a descriptor.

    :param entities: those of the waitables.
    :raises ListenerError: when they contain an entity that has no listener.
    :raises InvalidHandle: when one of them has been destroyed.
    """

    def __init__(self, entities: Iterable[Entity], pool: WorkerPool) -> None:
        self._by_id = {id(entity.rclpy): entity for entity in entities}
        self._pool = pool
        self._set = FilledSet(pool.context, [entity.rclpy for entity in entities])
        self._timers: list[NextCall] = []
        self._has_parts = False
        self._set.parts(self._set.waitables, self._add_part)
        if not self._has_parts:
            raise ListenerError('nothing has no listener')  # it is ready when another one is
        self._lock = threading.Lock()
        self._has_more = False
        self._ignored = False

    def _add_part(self, kind: str, address: int) -> None:
        self._has_parts = True
        if kind == 'guard_condition':
            raise ListenerError('a guard condition has no listener')
        if kind == 'timer':
            self._timers.append(NextCall(address))

    def listen(self) -> None:
        """Let the middleware announce arrivals, or raise ListenerError or InvalidHandle."""
        with self._lock:  # announcements meanwhile must not also fill the wait set
            self._set.parts(self._set.waitables,
                            lambda kind, address: set_listener(kind, address, self.fd))
        if self._has_more:
            self._ask()

    def ignore(self) -> None:
        """End ``listen``, and wait until no thread collects from it."""
        self._ignored = True
        with self._lock:
            call_with_living(list(self._by_id.values()), self._clear)

    def _clear(self, living: list[Entity]) -> None:
        self._set.parts([each.rclpy for each in living], clear_listener)

    def collect(self) -> None:
        """Collect the arrivals soon: without the engine's lock, as this calls foreign code."""
        self._pool.deferred.append(self._ask)

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

        def take(waitable: Waitable) -> None:
            found.extend(executions_of(self._by_id[id(waitable)], self._pool))

        for _ in range(MOST):
            before = len(found)
            self._set.wait(0, take)
            if len(found) == before:
                break
        else:  # there may be more, after the other sources
            self._pool.call_at(time.monotonic_ns(), self._ask)
        if found:
            self._post_noted(found)
        with self._set.held():
            times = [timer.until() for timer in self._timers]
        for until in times:
            if until is not None and until > 0:  # else its handling is posted, which resets it
                self._pool.call_at(time.monotonic_ns() + until, self._ask)

    def _post_noted(self, found: list[Work], checks: int = 0) -> None:
        """Post executions; a response only after the sending thread has noted the request."""
        early = [] if checks >= SENDER_CHECKS else [
            work for work in found if compat.sender_is_behind(work.entity.rclpy, work.args[0])]
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
    while 0 < len(living := [each for each in entities if compat.alive(each.rclpy)]) < before:
        before = len(living)
        try:
            return call(living)
        except InvalidHandle:
            pass
    return None


def is_qos_event(waitable: Waitable) -> bool:
    """Return whether a waitable is an ``EventHandler`` that waits and takes as rclpy's does."""
    kind = type(waitable)
    return isinstance(waitable, EventHandler) and all(
        getattr(kind, name) is getattr(EventHandler, name)
        for name in ('add_to_wait_set', 'is_ready', 'take_data', 'get_num_entities'))


_known: weakref.WeakKeyDictionary[Entity, list[int]] = weakref.WeakKeyDictionary()
"""The counts of each QoS event at the last take."""


class EventsSource(WaitableSource):
    """
    QoS events (rclpy's ``EventHandler``) that share a descriptor.

    :param note: called with each event and its status.
    """

    def __init__(self, note: Callable[[Any, Any], None], *others: Any) -> None:
        super().__init__(*others)
        self._note = note

    def _collect(self) -> None:
        found: list[Work] = []

        def take(event: Waitable) -> None:
            entity = self._by_id[id(event)]
            status = event.take_data()
            values = {name: getattr(status, name) for name in dir(status) if '_count' in name}
            counts = [value for name, value in values.items() if not name.endswith('_change')]
            before = _known.get(entity, [0] * len(counts))
            _known[entity] = counts
            if counts != before or any(
                    value for name, value in values.items() if name.endswith('_change')):
                self._note(event, status)
                found.append(Work(entity, event.execute, (status,)))

        self._set.wait(None, take)
        if found:
            self._pool.post(found)


class WaitSetThread:
    """
    A thread that waits for entities without a listener.

    :param signals: rclpy's signal condition, or None.
    :param on_signal: called when it is triggered.
    """

    def __init__(self, pool: WorkerPool, signals: Any, on_signal: Callable[[], None]) -> None:
        self._pool = pool
        self._context = pool.context
        self._signals = signals
        self._on_signal = on_signal
        self._guard = GuardCondition(None, None, self._context)
        self._entities: list[Entity] = []
        self._changed = False
        self._ending = False
        self._applied = threading.Event()
        self._asked = self._answered = 0
        self._has_answered = threading.Event()
        self._thread: threading.Thread | None = None
        call_at_shutdown(self._context, self.wake)

    def update(self, entities: list[Entity]) -> None:
        """
        Set the guard conditions and waitables to wait for.

        Returns when no data of the earlier ones are being taken any more.
        """
        if entities == self._entities:
            return
        self._entities = entities
        self._changed = True
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

    def wake(self) -> None:
        """End the current wait."""
        try:
            self._guard.trigger()
        except InvalidHandle:
            pass

    def start(self) -> None:
        """Begin to wait; further calls do nothing."""
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
        waiting: FilledSet | None = None
        by_id: dict[int, Entity] = {}
        while not self._ending and not is_over(self._context):
            try:
                if self._changed or waiting is None:
                    self._changed = False
                    waiting = None  # releases the earlier ones
                    by_id = {id(each.rclpy): each for each in self._entities}
                    waiting = self._build(self._entities)
                    self._applied.set()
                asked = self._asked
                self._wait(waiting, by_id, -1 if asked == self._answered else 0)
                self._answered = asked
                self._has_answered.set()
            except Exception as error:
                waiting = None
                if is_over(self._context):
                    break
                if not isinstance(error, InvalidHandle):
                    self._pool.fail(error)
                time.sleep(0.001)  # an entity is being destroyed; avoids a busy loop if it stays
        self._applied.set()
        self._on_signal()

    def _build(self, entities: list[Entity]) -> FilledSet:
        own = [self._guard] + ([self._signals] if self._signals is not None else [])
        alive = [each.rclpy for each in entities if compat.alive(each.rclpy)]
        return FilledSet(
            self._context, [each for each in alive if isinstance(each, Waitable)],
            [*own, *(each for each in alive if not isinstance(each, Waitable))])

    def _wait(self, waiting: FilledSet, by_id: dict[int, Entity], timeout_ns: int) -> None:
        found: list[Work] = []

        def take(waitable: Waitable) -> None:
            found.extend(executions_of(by_id[id(waitable)], self._pool))

        for guard in waiting.wait(timeout_ns, take):
            entity = by_id.get(id(guard))
            if guard is self._signals:
                self._on_signal()
            elif entity is not None and guard.callback is not None:
                found.append(Work(entity, guard.callback))
        if found:
            self._pool.post(found)

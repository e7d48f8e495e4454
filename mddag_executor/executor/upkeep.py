# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Keeps registry, sources and trace up to date with the nodes' entities.

Nodes notify the executor that their entities have changed (``Executor.wake``), but not how.  So
the spinning thread refreshes everything at once; when many entities are made in a row, not for
each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import threading
import time
from typing import Any
import weakref

from mddag_executor.executor import publishing
from mddag_executor.executor.at_once import AtOnce, ClientSource, ClockSource
from mddag_executor.executor.compat import (
    alive,
    ends_sleep,
    is_builtin,
    is_of_wait_for_message,
    publisher_ids,
)
from mddag_executor.executor.entity import (
    CLIENT,
    Entity,
    GUARD,
    SERVICE,
    SUBSCRIPTION,
    TIMER,
    WAITABLE,
)
from mddag_executor.executor.listeners import ListenerError
from mddag_executor.executor.recorder import Recorder
from mddag_executor.executor.registry import Registry, snapshot
from mddag_executor.executor.sources import ServiceSource, Source, SubscriptionSource
from mddag_executor.executor.timers import TimerSource
from mddag_executor.executor.waitables import (
    call_with_living,
    EventsSource,
    is_qos_event,
    WaitableSource,
    WaitSetThread,
)
from mddag_executor.executor.workers import WorkerPool
from rclpy.exceptions import InvalidHandle


class Upkeep:
    """
    The entities of the executor's nodes, as sources.

    :param nodes: returns the nodes.
    :ivar changed: whether there may be new or removed entities (see ``change``).
    """

    def __init__(
        self, nodes: Callable[[], list[Any]], registry: Registry, pool: WorkerPool,
        at_once: AtOnce, recorder: Recorder | None, wait_sets: WaitSetThread,
    ) -> None:
        self.changed = True
        self._has_waitables = False
        self._nodes = nodes
        self._living: list[weakref.ref[Any]] = []
        self._registry = registry
        self._pool = pool
        self._at_once = at_once
        self._recorder = recorder
        self._wait_sets = wait_sets
        self._lock = threading.RLock()
        self._refresh_at = 0.0
        self._sources: dict[Entity, Source | TimerSource | WaitableSource] = {}
        self._deliveries: dict[str, publishing.LocalDelivery] = {}
        self._events: WaitableSource | None = None
        self._unlistened: list[Entity] = []
        # entities without listener which the next refresh may find again
        self._silent: list[Entity] = []

    def change(self) -> None:
        """Note that entities may have been created or destroyed."""
        self.changed = True
        self._pool.is_current = False

    def rest_s(self) -> float | None:
        """Return the seconds until the next ``refresh``; None: nothing has changed."""
        return max(0.0, self._refresh_at - time.monotonic()) if self.changed else None

    def refresh(self) -> None:
        """Update everything if anything may have changed."""
        with self._lock:
            if not self.changed:
                return
            start = time.monotonic()
            self.changed = False
            self._refresh()
            self._pool.is_current = not self.changed  # it may have changed meanwhile
            end = time.monotonic()
            self._refresh_at = end + 3 * (end - start)  # for a quarter of the time at most

    def stop_listening(self) -> None:
        """
        Clear the listeners of removed entities; an entity has only one.

        The rest is done by the next ``refresh``.
        """
        with self._lock:
            present = {id(entity) for lists in snapshot(self._nodes()).values()
                       for some in lists for entity in some}
            gone = [each for each in self._registry.by_id.values()
                    if id(each.rclpy) not in present and each not in self._silent]
            with self._pool.lock:
                for entity in gone:
                    self._forget(entity)
            self._silent += gone
            self._refresh_waitables([], gone)

    def _refresh(self) -> None:
        pool, registry, engine = self._pool, self._registry, self._pool.engine
        nodes = self._nodes()
        self._living = [weakref.ref(node) for node in nodes]
        found = snapshot(nodes)
        with pool.lock:
            now = pool.tick()
            added, gone = registry.refresh(found)
            lost = set(gone)
            back = [each for each in self._silent if each not in lost]
            self._silent = []
            if engine.other_processes is not None and (added or gone):
                engine.other_processes.host(
                    registry.hosted(), registry.subscriptions(), engine.record, now)
            for entity in gone:
                self._forget(entity)
                engine.remove(entity, now)
            if self._recorder is not None:
                self._recorder.entities(nodes, added)
            for entity in added:
                entity.since = now
            for entity in (*added, *back):
                try:
                    self._listen(entity)
                except InvalidHandle:
                    pass  # destroyed meanwhile: the next refresh forgets it
            pool.due.arm(time.monotonic_ns())
        self._refresh_waitables([*added, *back], gone)

    def _publishers(self, subscription: Any) -> frozenset[bytes] | None:
        """Return the ids of the publishers of a subscription, None if they are unknown."""
        nodes = (node for each in self._living if (node := each()) is not None and alive(node))
        return next((publisher_ids(node, subscription) for node in nodes), None)

    # --- sources ---------------------------------------------------------------------------------

    def _listen(self, entity: Entity) -> None:
        """Make the source of an entity; the caller holds the engine's lock."""
        pool, at_once, share = self._pool, self._at_once, ''
        loop = at_once.loop if entity.kind == CLIENT or entity.at_once else pool.loop
        source: Source | TimerSource
        if entity.kind == TIMER:
            # ``create_rate`` sets the callback only after it has notified the executor
            if entity.callback is None and (
                    entity.rclpy.callback is None or ends_sleep(entity.rclpy.callback)):
                loop = at_once.loop
            share = f'timers {entity.node}'
            source = TimerSource(entity, pool.timers if loop is pool.loop else at_once.timers)
        elif entity.kind == SUBSCRIPTION:
            if is_of_wait_for_message(entity.rclpy):
                return
            source = (ClockSource(entity, at_once) if entity.at_once
                      else SubscriptionSource(entity, pool, self._publishers))
        elif entity.kind == SERVICE:
            share = f'services {entity.node}' if is_builtin(entity.rclpy) else ''
            source = ServiceSource(entity, pool)
        elif entity.kind == CLIENT:
            source = ClientSource(entity, at_once)
        else:
            return
        if entity.kind in (SUBSCRIPTION, SERVICE) and entity.may_come_from_outside():
            pool.due.expect(entity)
        loop.add(source, share)
        self._sources[entity] = source
        try:
            source.listen()
        except ListenerError as error:
            self._pool.fail(error)
        if isinstance(source, SubscriptionSource) and source.is_counted:
            before = self._deliveries.get(entity.label)
            self._deliver(entity.label, (*(before.sources if before else ()), source))

    def _deliver(self, topic: str, sources: tuple[SubscriptionSource, ...]) -> None:
        """Let publishing threads of this process collect for these subscriptions of a topic."""
        new = publishing.LocalDelivery(sources, self._pool) if sources else None
        publishing.replace_delivery(topic, self._deliveries.pop(topic, None), new)
        if new is not None:
            self._deliveries[topic] = new

    def _forget(self, entity: Entity) -> None:
        """Remove the source of an entity; the caller holds the engine's lock."""
        source = self._sources.pop(entity, None)
        delivery = self._deliveries.get(entity.label)
        if delivery is not None and source in delivery.sources:
            self._deliver(
                entity.label, tuple(each for each in delivery.sources if each is not source))
        if isinstance(source, WaitableSource):
            self._sources[entity] = source  # later, without the lock
        if source is None or isinstance(source, WaitableSource):
            return
        self._pool.forget_eager(entity)
        source.ignore()
        for loop in (self._pool.loop, self._at_once.loop):
            if loop.has(source):
                loop.remove(source)

    def handled_waitables(self) -> int:
        """Return how many executions of actions and user-defined waitables became ready."""
        if not self._has_waitables:
            return 0
        return sum(
            each.ready for each in list(self._registry.by_id.values())
            if each.kind == WAITABLE and not is_qos_event(each.rclpy))

    # --- waitables -------------------------------------------------------------------------------

    def _refresh_waitables(self, added: list[Entity], gone: list[Entity]) -> None:
        """Make and remove sources that call foreign code, without the engine's lock."""
        if not any(each.kind in (WAITABLE, GUARD) for each in (*added, *gone)):
            return
        for entity in gone:
            source = self._sources.pop(entity, None)
            if isinstance(source, WaitableSource):
                self._drop(source)
        registry = self._registry
        present = [e for e in registry.by_id.values()
                   if e.kind in (WAITABLE, GUARD) and e not in self._silent]
        events = [e for e in present if e.kind == WAITABLE and is_qos_event(e.rclpy)]
        if any(e.kind == WAITABLE and is_qos_event(e.rclpy) for e in (*added, *gone)):
            if self._events is not None:
                dropped, self._events = self._events, None
                self._drop(dropped)
            self._events = self._listen_to(
                events, partial(EventsSource, self._registry.note_event)) if events else None
        left = [e for e in self._unlistened if e in present]
        for entity in added:
            if entity.kind == GUARD:
                left.append(entity)
            elif entity.kind == WAITABLE and not is_qos_event(entity.rclpy):
                source = self._listen_to([entity])
                if source is None:
                    left.append(entity)
                else:
                    self._sources[entity] = source
        if self._events is None:
            left += [e for e in events if e not in left]
        self._unlistened = left
        self._has_waitables = len(present) > len(events)
        self._wait_sets.update(left)

    def _listen_to(
        self, entities: list[Entity], make: Callable[..., WaitableSource] = WaitableSource
    ) -> WaitableSource | None:
        """Return the source of waitables; None: there are no listeners for them."""
        pool = self._pool

        def listen(alive: list[Entity]) -> WaitableSource:
            source = make(alive, pool)
            with pool.lock:
                pool.loop.add(source)
            try:
                source.listen()
            except (InvalidHandle, ListenerError):
                self._drop(source)
                raise
            return source

        try:
            return call_with_living(entities, listen)
        except ListenerError:
            return None

    def _drop(self, source: WaitableSource) -> None:
        source.ignore()
        with self._pool.lock:
            self._pool.loop.remove(source)

    def clear(self) -> None:
        """Remove everything, at the end."""
        with self._lock:
            with self._pool.lock:
                for entity in list(self._sources):
                    self._forget(entity)
            for source in list(self._sources.values()):
                if isinstance(source, WaitableSource):
                    self._drop(source)
            self._sources.clear()
            if self._events is not None:
                self._drop(self._events)
                self._events = None

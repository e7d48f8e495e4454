# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Keeps the registry of a live executor up to date, and lets its entities listen.

The spinning thread refreshes everything at once (``registry``); when many entities are made in a
row, it does not refresh for each of them.  An entity listens from its appearance until it
disappears.  If a node is removed while nothing spins, its entities only stop listening: the node
may be added again before the next spin.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import threading
import time
from typing import Any
import weakref

from mddag_executor.executor import publishing
from mddag_executor.executor.at_once import AtOnce
from mddag_executor.executor.compat import alive, publisher_ids
from mddag_executor.executor.kinds import Kind, Rooms
from mddag_executor.executor.registry import Registry, snapshot
from mddag_executor.executor.transfers import transfer_of
from mddag_executor.executor.waitables import (
    EventsSource,
    SharedSource,
    WaitableEntity,
    WaitSetThread,
)
from mddag_executor.executor.work import Work
from mddag_executor.executor.workers import WorkerPool
from rclpy.exceptions import InvalidHandle


class Upkeep:
    """
    The entities of the executor's nodes, as they listen.

    :param nodes: returns the nodes.
    :ivar changed: whether there may be new or removed entities (see ``change``).
    """

    def __init__(
        self, nodes: Callable[[], list[Any]], registry: Registry, pool: WorkerPool,
        at_once: AtOnce, wait_sets: WaitSetThread,
    ) -> None:
        self.changed = True
        self._nodes = nodes
        self._living: list[weakref.ref[Any]] = []
        self._registry = registry
        self._pool = pool
        self._rooms = Rooms(
            pool, at_once, self._publishers, publishing.Deliveries(pool),
            SharedSource(partial(EventsSource, registry.note_event), pool, wait_sets),
            wait_sets)
        self._lock = threading.RLock()
        self._refresh_at = 0.0
        # entities without listener which the next refresh may find again
        self._silent: list[Kind] = []

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
            start = time.thread_time()  # a refresh takes longer while the machine is busy
            self.changed = False
            self._refresh()
            self._pool.is_current = not self.changed  # it may have changed meanwhile
            # for a quarter of the time at most
            self._refresh_at = time.monotonic() + 3 * (time.thread_time() - start)

    def stop_listening(self) -> None:
        """
        Clear the listeners of removed entities; an entity has only one.

        The rest is done by the next ``refresh``.
        """
        with self._lock:
            present = {id(entity) for lists in snapshot(self._nodes()).values()
                       for some in lists for entity in some}
            gone = [each for each in self._registry.by_id.values()
                    if id(each.rclpy_object) not in present and each not in self._silent]
            for entity in gone:
                self._ignore(entity)
            self._silent += gone
            self._apply()

    def _refresh(self) -> None:
        pool, registry = self._pool, self._registry
        nodes = self._nodes()
        self._living = [weakref.ref(node) for node in nodes]
        found = snapshot(nodes)
        with pool.lock:
            added, gone, moved = registry.refresh(found, pool.tick())
        back = [each for each in self._silent if not each.removed]
        self._silent = []
        for entity in gone:
            self._ignore(entity)
        for entity in (*added, *back):
            transfer_of(entity.rclpy_object).claim(self, entity.rclpy_object)
            self._run_left(entity)  # first: later messages come after them
            self._listen(entity)
        self._apply()
        for entity in list(registry.by_id.values()):
            self._run_left(entity)
        with pool.lock:
            pool.due.arm_for_new(time.monotonic_ns())
            if moved:
                pool.wake_for_more()  # its new outer group may be open

    def _publishers(self, subscription: Any) -> frozenset[bytes] | None:
        """Return the ids of the publishers of a subscription, None if they are unknown."""
        nodes = (node for each in self._living if (node := each()) is not None and alive(node))
        return next((publisher_ids(node, subscription) for node in nodes), None)

    # --- executions of other executors (``transfers``) -------------------------------------------

    def _run_left(self, entity: Kind) -> None:
        """Make those executions ready that another executor has left."""
        left = transfer_of(entity.rclpy_object).left
        for _ in range(len(left)):  # an engine that has finished leaves them again
            before = left.popleft()
            work = Work(entity, before.function, before.args, before.then)
            self._pool.report(partial(self._arrived, work))

    def _arrived(self, work: Work, now: int) -> None:
        self._pool.engine.arrived(work, None, now, -1, now)

    def give_up(self, rclpy_object: Any) -> None:
        """Leave the executions of an object whose node was removed while nothing spun."""
        with self._pool.lock:
            entity = self._registry.by_id.get(id(rclpy_object))
            if entity is not None and not entity.removed:
                self._pool.engine.remove(entity, self._pool.tick())

    def note_left(self) -> None:
        """Note that executions were left for one of its objects; from any thread."""
        self.change()
        self._rooms.at_once.ring()

    # --- sources ---------------------------------------------------------------------------------

    def _listen(self, entity: Kind) -> None:
        """Let arrivals at an entity be collected."""
        try:
            entity.listen(self._rooms)
        except InvalidHandle:
            return  # destroyed meanwhile: the next refresh forgets it
        if entity.may_come_from_outside():
            with self._pool.lock:
                self._pool.due.expect(entity)

    def _ignore(self, entity: Kind) -> None:
        """Stop collecting the arrivals at an entity."""
        entity.ignore()
        with self._pool.lock:
            self._pool.forget_eager(entity)

    def _apply(self) -> None:
        """Listen to the entities that listen together."""
        for group in (self._rooms.events, self._rooms.unlistened):
            group.apply()

    def handled_waitables(self) -> int:
        """Return how many executions of actions and user-defined waitables became ready."""
        return sum(each.ready for each in self._registry.of_kind(WaitableEntity))

    def clear(self) -> None:
        """Remove everything, at the end."""
        with self._lock:
            for entity in self._registry.by_id.values():
                self._ignore(entity)
                with self._pool.lock:
                    self._pool.engine.leave_waiting(entity)
            self._apply()

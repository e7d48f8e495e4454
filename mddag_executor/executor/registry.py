# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The entities of the executor's nodes: how each appears, changes and disappears.

Theory of operation
-------------------
Nodes notify an executor that their entities have changed (``Executor.wake``), but not how.  So
``refresh`` compares the entities that the nodes have now with those that it knows::

    a node makes it                                       a node destroys it, or is removed
          │                                                               │
          ▼                                                               ▼
       appears ──────────────────▶ is there ────────────────────────▶ disappears
          │                         │    ▲                                │
          │ describe (``kinds``)    └────┘                                │ its callback is free
          │ its callback group     changes: its node moves                │ again; its executions
          │ (``groups``)           to another outer group                 │ that wait are dropped
          │ its declared callback                                         ▼
          │ (``bindings``)                                             retired
          │ its tracepoints           until its last execution has ended; then only
          ▼ (``recorder``)            its counts are kept, by the name of its callback
       it listens (``upkeep``);
       in a rerun nothing does

Live runs and reruns share all of this but for listening.  ``upkeep`` decides when to refresh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import threading
from typing import Any, NamedTuple, TypeVar
import weakref

from mddag_executor.executor.bindings import Bindings
from mddag_executor.executor.bounds import REMEMBERED
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import COUNTS
from mddag_executor.executor.groups import CallbackGroups
from mddag_executor.executor.kinds import Kind
from mddag_executor.executor.recorder import Recorder
from mddag_executor.executor.sources import (
    ClientEntity,
    ClockEntity,
    ServiceEntity,
    SubscriptionEntity,
)
from mddag_executor.executor.timers import TimerEntity
from mddag_executor.executor.waitables import EventEntity, GuardEntity, WaitableEntity
from mddag_executor.executor.work import Work
from msg_graph import TaskSet
from rclpy.event_handler import EventHandler, QoSSubscriptionEventType
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import qos_policy_name_from_kind

KINDS: tuple[type[Kind], ...] = (
    TimerEntity, ClockEntity, SubscriptionEntity, ServiceEntity, ClientEntity, GuardEntity,
    EventEntity, WaitableEntity)
"""The kinds of a node's entities; an entity is of the first one that fits."""

LISTS = tuple(dict.fromkeys(kind.list_name for kind in KINDS))
"""The properties of a node that list its entities."""

OTHERS = 'other destroyed callbacks'
"""The name for the counts of undeclared callbacks that are gone, after ``REMEMBERED`` names."""

EntitySet = dict[Node, tuple[list[Any], ...]]
"""The entities of each node, for each of ``LISTS``, in the order of creation."""

SomeKind = TypeVar('SomeKind', bound=Kind)


def snapshot(nodes: Iterable[Node]) -> EntitySet:
    """
    Return the entities that these nodes have now.

    Nodes notify an executor that their entities have changed (``Executor.wake``), but not how.

    :param nodes: may be changed by other threads meanwhile, which must cause another snapshot, as
        rclpy's nodes do by waking their executor.
    """
    return {node: tuple(_listed(node, name) for name in LISTS) for node in nodes}


def _listed(node: Node, name: str) -> list[Any]:
    """List entities until the list is unchanged: a concurrent removal may hide the next entity."""
    before: list[Any] | None = None
    found = list(getattr(node, name))
    while found != before:
        before, found = found, list(getattr(node, name))
    return found


class Changes(NamedTuple):
    """The entities that have appeared, disappeared, and moved to another outer group."""

    added: list[Kind]
    gone: list[Kind]
    moved: list[Kind]


class Registry:
    """
    The records of all entities of the executor's nodes.

    It is refreshed under the engine's lock; other threads may look entities up and read counts at
    any time.

    :param passed: called with each execution that a callback group has let run (see ``work``).
    :param recorder: of the trace; None: there is none.
    :ivar by_id: the ``Entity`` of each rclpy entity, by the ``id`` of the latter.
    :ivar outer_groups: the outer groups of nodes.
    :ivar own: the executor's own subscriptions.
    """

    def __init__(
        self, task_set: TaskSet | None, engine: Engine, passed: Callable[[Work], None],
        recorder: Recorder | None,
    ) -> None:
        self._engine = engine
        self._recorder = recorder
        self._groups = CallbackGroups(engine, passed)
        self.bindings = Bindings(task_set, engine)
        self.by_id: dict[int, Kind] = {}
        self.own: set[Any] = set()
        self.outer_groups: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()
        self._counting = threading.Lock()
        # destroyed entities with unfinished executions, and the counts of earlier ones
        self._retired: list[Kind] = []
        self._past: dict[str, dict[str, Any]] = {}
        self._names: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()

    # --- the life of an entity -------------------------------------------------------------------

    def refresh(self, found: EntitySet, now: int) -> Changes:
        """
        Update the entities to those that the nodes have now.

        :param found: the ``snapshot`` of the nodes.
        :param now: the engine's time.
        """
        present: dict[int, Kind] = {}
        new: list[tuple[str, Any, str, int]] = []
        moved: list[Kind] = []
        for node, lists in found.items():
            try:
                name = self._name(node)
            except InvalidHandle:
                continue  # destroyed after it was listed
            group = self.outer_groups.get(node)
            outer = -1 if group is None else group.number
            for list_name, some in zip(LISTS, lists):
                for rclpy_object in some:
                    entity = self.by_id.get(id(rclpy_object))
                    if entity is None or entity.removed or (
                            entity.rclpy_object is not rclpy_object):
                        new.append((list_name, rclpy_object, name, outer))
                    else:
                        present[id(rclpy_object)] = entity
                        if entity.outer != outer:
                            self._engine.outer.move(entity, outer)
                            moved.append(entity)
        gone = [each for key, each in self.by_id.items() if key not in present]
        for each in gone:  # first: a new one may be their callback's next entity
            self.bindings.unbind(each, now)
        appeared = [self._appear(*each, now) for each in new]
        added = [each for each in appeared if each is not None]
        present.update((id(each.rclpy_object), each) for each in added)
        with self._counting:
            self.by_id = present
            self._retired.extend(gone)
            self._fold()
        self._groups.free()
        engine = self._engine
        if engine.other_processes is not None and (added or gone):
            engine.other_processes.host(
                self.hosted(), self.of_kind(SubscriptionEntity), engine.record, now)
        for each in gone:
            engine.remove(each, now)
        if self._recorder is not None:
            self._recorder.gone(gone)
            self._recorder.entities(found, added)
            singles = {group.number for group in self.outer_groups.values()
                       if group is not None and group.is_single}
            self._recorder.programs(
                entity for entity in (*added, *moved) if entity.outer in singles)
        return Changes(added, gone, moved)

    def _appear(
        self, list_name: str, rclpy_object: Any, node: str, outer: int, now: int
    ) -> Kind | None:
        kind = next(each for each in KINDS
                    if each.list_name == list_name and each.fits(rclpy_object))
        try:
            entity = kind(rclpy_object, node)
            entity.describe()
        except InvalidHandle:
            return None  # destroyed after it was listed
        entity.outer = outer
        entity.since = now
        entity.is_own = rclpy_object in self.own
        self._groups.enter(entity)
        self.bindings.bind(entity)
        return entity

    def _name(self, node: Any) -> str:
        """Return a node's name, even if it has been destroyed but not removed."""
        name: str | None = self._names.get(node)
        if name is None:
            name = self._names[node] = node.get_fully_qualified_name()
        return name

    # --- those that there are --------------------------------------------------------------------

    def of_kind(self, kind: type[SomeKind]) -> list[SomeKind]:
        """Return the current entities of a kind."""
        return [entity for entity in list(self.by_id.values()) if isinstance(entity, kind)]

    def hosted(self) -> set[str]:
        """Return the keys of the declared callbacks that an entity is bound to now."""
        return {entity.callback.key for entity in list(self.by_id.values())
                if entity.callback is not None}

    def note_event(self, handler: EventHandler, status: Any) -> None:
        """Note a QoS event: the policy because of which a subscription gets no messages."""
        incompatible = QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS
        if status is None or handler.event_type != incompatible:
            return
        for entity in self.of_kind(SubscriptionEntity):
            if handler in entity.rclpy_object.event_handlers:
                entity.incompatible_qos = qos_policy_name_from_kind(status.last_policy_kind)

    # --- counts ----------------------------------------------------------------------------------

    def _fold(self) -> None:
        """Keep only the counts of retired entities without executions: memory is bounded."""
        retired, self._retired = self._retired, []
        for entity in retired:
            if entity.is_through():
                entity.count_into(self._past, self._name_to_keep(entity))
                self.bindings.note_received(entity)
            else:
                self._retired.append(entity)

    def _name_to_keep(self, entity: Kind) -> str | None:
        """Return the name for the counts of a retired entity; None: its own."""
        if entity.callback is None and len(self._past) >= REMEMBERED and (
                entity.name not in self._past):
            return OTHERS
        return None

    def counts(self) -> dict[str, dict[str, Any]]:
        """Return the counts of all entities, also removed ones, by callback (see ``Entity``)."""
        with self._counting:
            counts = {name: dict(past) for name, past in self._past.items()}
            for entity in (*self._retired, *self.by_id.values()):
                entity.count_into(counts)
        return counts

    def totals(self) -> dict[str, int]:
        """Return the sums of the counts of all callbacks, from any thread."""
        every = self.counts().values()
        return {key: sum(each[key] for each in every) for key in COUNTS}

    def computing(self) -> int:
        """Return how many of the callbacks that have run hold the interpreter."""
        return sum(bool(e.ran and e.habit.holds) for e in list(self.by_id.values()))

    def received(self) -> dict[str, set[str]]:
        """Return of which topics each sync has got messages."""
        with self._counting:
            for entity in (*self._retired, *self.by_id.values()):
                self.bindings.note_received(entity)
            return self.bindings.received()

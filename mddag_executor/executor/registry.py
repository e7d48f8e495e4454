# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The registry of entities: the declared callback of each, and its callback group in the core."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
import threading
from typing import Any, TypeVar
import weakref

from mddag_executor.core.jobs import source_depth
from mddag_executor.executor.bounds import REMEMBERED
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import COUNTS, link
from mddag_executor.executor.kinds import Kind
from mddag_executor.executor.sources import (
    ClientEntity,
    ClockEntity,
    ServiceEntity,
    SubscriptionEntity,
)
from mddag_executor.executor.timers import TimerEntity
from mddag_executor.executor.waitables import EventEntity, GuardEntity, WaitableEntity
from mddag_executor.executor.work import decides_itself, step_in_group, Work
from msg_graph import binding, Callback, TaskSet
from rclpy.callback_groups import ReentrantCallbackGroup
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


class Registry:
    """
    The records of all entities of the executor's nodes.

    It is refreshed under the engine's lock; other threads may look entities up and read counts at
    any time.

    :ivar by_id: the ``Entity`` of each rclpy entity, by the ``id`` of the latter.
    :param passed: called with each execution that a callback group has let run (see ``work``).
    """

    def __init__(
        self, task_set: TaskSet | None, engine: Engine, passed: Callable[[Work], None],
    ) -> None:
        self._task_set = task_set
        self._tables = engine.tables
        self._engine = engine
        self._passed = passed
        self._binder = binding.Binder(task_set) if task_set is not None else None
        # the core's numbers of callback groups (of user-defined groups: of their entities), and
        # all that are not freed yet
        self._groups: weakref.WeakKeyDictionary[Any, int] = weakref.WeakKeyDictionary()
        self._numbers: set[int] = set()
        #: the outer groups of nodes
        self.outer_groups: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()
        self._counting = threading.Lock()
        self.by_id: dict[int, Kind] = {}
        # the executor's own subscriptions
        self.own: set[Any] = set()
        # destroyed entities with unfinished executions, and the counts of earlier ones
        self._retired: list[Kind] = []
        self._past: dict[str, dict[str, Any]] = {}
        # by declared callback: the topics that its entities, also removed ones, have published
        # (they share the set), and have got messages of
        self._published: dict[str, set[str]] = {c.key: set() for c in self.declared}
        self._received: dict[str, set[str]] = {c.key: set() for c in self.declared}
        self._undeclared: dict[binding.Entity, None] = {}
        self._names: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()

    @property
    def declared(self) -> tuple[Callback, ...]:
        """Return the declared callbacks."""
        return self._task_set.callbacks if self._task_set is not None else ()

    def refresh(self, found: EntitySet) -> tuple[list[Kind], list[Kind]]:
        """Update the entities to those that the nodes have now; return new and removed ones."""
        present: dict[int, Kind] = {}
        new: list[tuple[str, Any, str, int]] = []
        for node, lists in found.items():
            try:
                name = self._name(node)
            except InvalidHandle:
                continue  # destroyed after it was listed
            group = self.outer_groups.get(node)
            outer = -1 if group is None else group.number
            for list_name, some in zip(LISTS, lists):
                for rclpy_entity in some:
                    key = id(rclpy_entity)
                    entity = self.by_id.get(key)
                    if entity is None or entity.rclpy is not rclpy_entity:
                        new.append((list_name, rclpy_entity, name, outer))
                    else:
                        present[key] = entity
                        if entity.outer != outer:
                            self._engine.move(entity, outer)
        gone = [each for key, each in self.by_id.items() if key not in present]
        for each in gone:  # first: a new one may be their callback's next entity
            self._unbind(each)
        made = [self._new_entity(*each) for each in new]
        added = [each for each in made if each is not None]
        present.update((id(each.rclpy), each) for each in added)
        with self._counting:
            self.by_id = present
            self._retired.extend(gone)
            self._fold()
        self._free_groups()
        return added, gone

    def _name(self, node: Any) -> str:
        """Return a node's name, even if it has been destroyed but not removed."""
        name: str | None = self._names.get(node)
        if name is None:
            name = self._names[node] = node.get_fully_qualified_name()
        return name

    def _fold(self) -> None:
        """Keep only the counts of retired entities without executions: memory is bounded."""
        retired, self._retired = self._retired, []
        for entity in retired:
            if entity.is_through():
                entity.count_into(self._past)
                self._note_received(entity)
            else:
                self._retired.append(entity)

    def publishes(self) -> dict[str, set[str]]:
        """Return on which topics each declared callback has published."""
        return {key: set(topics) for key, topics in self._published.items()}

    def came(self) -> dict[str, set[str]]:
        """Return of which topics each sync has got messages."""
        with self._counting:
            for entity in (*self._retired, *self.by_id.values()):
                self._note_received(entity)
            return {c.key: set(self._received[c.key]) for c in self.declared if c.kind == 'sync'}

    def _note_received(self, entity: Kind) -> None:
        if entity.callback is not None and entity.ready:
            self._received[entity.callback.key].add(entity.topic)

    def counts(self) -> dict[str, dict[str, Any]]:
        """Return the counts of all entities, also removed ones, by callback (see ``Entity``)."""
        with self._counting:
            counts = {name: dict(past) for name, past in self._past.items()}
            for entity in (*self._retired, *self.by_id.values()):
                entity.count_into(counts)
        return counts

    def computing(self) -> int:
        """Return how many of the callbacks that have run hold the interpreter."""
        return sum(bool(e.ran and e.habit.holds) for e in list(self.by_id.values()))

    def totals(self) -> dict[str, int]:
        """Return the sums of the counts of all callbacks, from any thread."""
        every = self.counts().values()
        return {key: sum(each[key] for each in every) for key in COUNTS}

    def hosted(self) -> set[str]:
        """Return the keys of the declared callbacks that an entity is bound to now."""
        return {
            entity.callback.key for entity in self.by_id.values()
            if entity.callback is not None}

    def elsewhere(self, process: str | None) -> set[str]:
        """Return the declared callbacks that run in other processes."""
        if self._task_set is None or process is None:
            return set()
        return {c.key for c in self.declared if self._task_set.process_of(c.node) != process}

    def unbound(self) -> list[Callback]:
        """Return the declared callbacks that no entity is bound to now."""
        return [] if self._binder is None else self._binder.unbound()

    def undeclared(self) -> list[binding.Entity]:
        """Return all undeclared timers, subscriptions and services, including removed ones."""
        return list(self._undeclared)

    def of_kind(self, kind: type[SomeKind]) -> list[SomeKind]:
        """Return the current entities of a kind."""
        return [entity for entity in list(self.by_id.values()) if isinstance(entity, kind)]

    def note_event(self, handler: EventHandler, status: Any) -> None:
        """Note a QoS event: the policy because of which a subscription gets no messages."""
        incompatible = QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS
        if status is None or handler.event_type != incompatible:
            return
        for entity in self.of_kind(SubscriptionEntity):
            if handler in entity.rclpy.event_handlers:
                entity.incompatible_qos = qos_policy_name_from_kind(status.last_policy_kind)

    def _new_entity(
        self, list_name: str, rclpy_entity: Any, node: str, outer: int
    ) -> Kind | None:
        kind = next(each for each in KINDS
                    if each.list_name == list_name and each.fits(rclpy_entity))
        try:
            entity = kind(rclpy_entity, node)
            entity.describe()
        except InvalidHandle:
            return None  # destroyed after it was listed
        entity.outer = outer
        entity.is_own = rclpy_entity in self.own
        self._set_group(entity)
        self._bind(entity)
        return entity

    def _set_group(self, entity: Kind) -> None:
        """Set the callback group of a new entity."""
        rclpy_entity = entity.rclpy
        group = getattr(rclpy_entity, 'callback_group', None)
        decides = group is not None and decides_itself(group)
        entity.group = self._number(rclpy_entity if decides else group)
        if decides:
            entity.gate = partial(step_in_group, group, rclpy_entity, self._passed)
        elif group is not None and entity.group >= 0 and group.has_entity(rclpy_entity):
            entity.exclusive = group

    def _bind(self, entity: Kind) -> None:
        """Bind a new entity to its declared callback, if there is one."""
        declarable = entity.declarable
        if declarable is None:
            return
        callback = None if self._binder is None else self._binder.bind(declarable)
        if callback is None:
            if not entity.is_own and len(self._undeclared) < REMEMBERED:
                self._undeclared[declarable] = None
            return
        assert self._task_set is not None
        entity.declare(callback)
        link(entity, self._task_set, self._tables)
        entity.awaiting = self._engine.awaiting.get(callback.key)
        entity.publishes = self._published[callback.key]
        if entity.is_due_at_release and entity.source >= 0:
            scheduler = self._engine.scheduler
            entity.depth = source_depth(
                scheduler.tables, scheduler.state, self._tables.dag_of[entity.source])

    def _number(self, group: Any) -> int:
        """Return the core's number of a callback group, -1 for a reentrant one and for none."""
        if group is None or isinstance(group, ReentrantCallbackGroup):
            return -1
        number = self._groups.get(group)
        if number is None:
            number = self._groups[group] = self._engine.scheduler.new_group()
            self._numbers.add(number)
        return number

    def _free_groups(self) -> None:
        """Free the numbers of destroyed groups: memory is bounded."""
        if len(self._groups) < len(self._numbers):
            for number in self._numbers.difference(list(self._groups.values())):
                self._numbers.remove(number)
                self._engine.scheduler.free_group(number)

    def _unbind(self, entity: Kind) -> None:
        if self._binder is not None and entity.callback is not None:
            self._binder.release(entity.callback, entity.topic or None)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which entities there are: an entry for each, its declared callback, its place in a trace."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any
import weakref

from mddag_executor.core import Scheduler, Tables
from mddag_executor.live.compat import keeps_time, service_name
from mddag_executor.live.entries import (
    CLIENT,
    COUNTS,
    Entry,
    GUARD,
    link,
    SERVICE,
    SUBSCRIPTION,
    TIMER,
    WAITABLE,
    Work,
)
from mddag_executor.live.gates import decides_itself, Gate
from msg_graph import Callback, TaskSet
from msg_graph.binding import Binder, Entity
from msg_graph.duration import exact_duration
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.qos import HistoryPolicy

_MOST_UNDECLARED = 4096

KINDS = (
    ('timers', TIMER), ('subscriptions', SUBSCRIPTION), ('services', SERVICE),
    ('clients', CLIENT), ('guards', GUARD), ('waitables', WAITABLE))


def source_depth(period_ns: int, deadline_ns: int) -> int:
    """Return how many releases of a timer source may wait: as many as can still be in time."""
    return max(1, -(-deadline_ns // period_ns))


class Registry:
    """
    The entries of all entities of the executor's nodes.

    Not thread-safe: the executor refreshes it under a lock of its own, and other threads only
    look entities up.

    :param passed: told of each execution that a callback group has let through (see ``gates``).
    """

    def __init__(
        self, task_set: TaskSet | None, tables: Tables, scheduler: Scheduler,
        passed: Callable[[Work], None],
    ) -> None:
        self._task_set = task_set
        self._tables = tables
        self._scheduler = scheduler
        self._passed = passed
        self._binder = Binder(task_set) if task_set is not None else None
        # the core's numbers of callback groups (where a group decides itself, of its entities),
        # and all that are not given back yet
        self._groups: weakref.WeakKeyDictionary[Any, int] = weakref.WeakKeyDictionary()
        self._numbers: set[int] = set()
        self._entries: dict[int, Entry] = {}
        # entries of destroyed entities whose last executions are not done yet, and the counts
        # of those before
        self._retired: list[Entry] = []
        self._past: dict[str, dict[str, Any]] = {}
        self._published: dict[str, set[str]] = {}
        self._undeclared: dict[Entity, None] = {}
        self._names: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()

    def __getitem__(self, entity: Any) -> Entry | None:
        """Return the entry of an entity, None for one that is not (or no longer) known."""
        return self._entries.get(id(entity))

    @property
    def declared(self) -> tuple[Callback, ...]:
        """Return the declared callbacks."""
        return self._task_set.callbacks if self._task_set is not None else ()

    def refresh(
        self, nodes: Iterable[Any], keep: bool = False
    ) -> tuple[list[Entry], list[Entry]]:
        """
        Look which entities the nodes have now.

        :param keep: whether entities that are gone stay known for now.
        :return: entries that are new, and those whose entity is gone.
        """
        present: dict[int, Entry] = {}
        added: list[Entry] = []
        for node in nodes:
            name = self._name(node)
            for attribute, kind in KINDS:
                for entity in getattr(node, attribute):
                    entry = self._entries.get(id(entity))
                    if entry is None or entry.entity is not entity or self._retimed(entry):
                        entry = self._new_entry(kind, entity, name)
                        if entry is None:
                            continue
                        added.append(entry)
                    present[id(entity)] = entry
        if keep:
            present = {**self._entries, **present}
        gone = [e for key, e in self._entries.items() if present.get(key) is not e]
        for entry in gone:
            self._unbind(entry)
        self._entries = present
        self._retired.extend(gone)
        self._fold()
        self._free_groups()
        return added, gone

    def is_stale(self) -> bool:
        """
        Return whether `refresh` would change something though no entity has come or gone.

        An undeclared timer has another period: it may be declared. Or what still ran of an entity
        that had gone is through.
        """
        return (any(self._retimed(entry) for entry in self.timers())
                or any(entry.is_through() for entry in self._retired))

    def _retimed(self, entry: Entry) -> bool:
        if entry.kind != TIMER or entry.callback is not None or self._binder is None:
            return False
        try:
            return entry.label != exact_duration(entry.entity.timer_period_ns)
        except InvalidHandle:
            return False  # destroyed meanwhile

    def _name(self, node: Any) -> str:
        """Return a node's name, also when it has been destroyed and not removed."""
        name: str | None = self._names.get(node)
        if name is None:
            name = self._names[node] = node.get_fully_qualified_name()
        return name

    def _fold(self) -> None:
        """Keep of retired entries that are through only their counts: memory is bounded."""
        retired, self._retired = self._retired, []
        for entry in retired:
            if entry.is_through():
                entry.count_into(self._past)
                if entry.callback is not None:
                    self._published.setdefault(entry.callback.key, set()).update(entry.publishes)
            else:
                self._retired.append(entry)

    def publishes(self) -> dict[str, set[str]]:
        """Return on which topics each declared callback has published."""
        found = {callback.key: set(self._published.get(callback.key, ()))
                 for callback in self.declared}
        for entry in (*self._retired, *self._entries.values()):
            if entry.callback is not None:
                found[entry.callback.key] |= entry.publishes
        return found

    def counts(self) -> dict[str, dict[str, Any]]:
        """Return the counts of all entities there have been, by callback (see ``Entry``)."""
        counts = {name: dict(past) for name, past in self._past.items()}
        for entry in (*self._retired, *self._entries.values()):
            entry.count_into(counts)
        return counts

    def totals(self) -> dict[str, int]:
        """
        Return the counts of all callbacks together, from any thread.

        Unlike ``counts`` this costs next to nothing for an entity that nobody uses.
        """
        totals = dict.fromkeys(COUNTS, 0)
        for past in list(self._past.values()):
            for key in COUNTS:
                totals[key] += past[key]
        for entry in (*self._retired, *self._entries.values()):
            if entry.ready or entry.skipped:
                for key in COUNTS:
                    totals[key] += getattr(entry, key)
        return totals

    def hosted(self) -> set[str]:
        """Return the keys of the declared callbacks that an entity is bound to now."""
        return {
            entry.callback.key for entry in self._entries.values() if entry.callback is not None}

    def undeclared(self) -> list[Entity]:
        """Return the timers, subscriptions and services there were that are not declared."""
        return list(self._undeclared)

    def subscriptions(self) -> list[Entry]:
        """Return the entries of the subscriptions that there are now."""
        return [entry for entry in self._entries.values() if entry.kind == SUBSCRIPTION]

    def timers(self) -> list[Entry]:
        """Return the entries of the timers that there are now."""
        return [entry for entry in self._entries.values() if entry.kind == TIMER]

    def _new_entry(self, kind: str, entity: Any, node: str) -> Entry | None:
        callback, topic, depth, label, period = None, '', 0, '', None
        try:
            if kind == TIMER:
                period = entity.timer_period_ns
                depth, label = 1, exact_duration(period)
            elif kind == SUBSCRIPTION:
                topic = label = entity.topic_name
                qos = entity.qos_profile
                depth = qos.depth if qos.history == HistoryPolicy.KEEP_LAST else 0
            elif kind in (SERVICE, CLIENT):
                label = service_name(entity)
            elif kind == GUARD:
                label = 'condition'
        except Exception as error:
            if type(error).__name__ == 'InvalidHandle':
                return None  # destroyed between being listed and looked at
            raise
        bindable = Entity(node, kind, '' if kind == TIMER else label, period)
        if kind in (TIMER, SUBSCRIPTION, SERVICE) and self._binder is not None:
            callback = self._binder.bind(bindable)
        group = getattr(entity, 'callback_group', None)
        decides = group is not None and decides_itself(group)
        number = self._number(entity if decides else group)
        entry = Entry(kind, entity, node, callback, number, depth, label)
        if decides:
            entry.gate = Gate(group, entity, self._passed)
        entry.at_once = callback is None and kind == SUBSCRIPTION and keeps_time(entity)
        if callback is None and kind in (TIMER, SUBSCRIPTION, SERVICE):
            if len(self._undeclared) < _MOST_UNDECLARED:
                self._undeclared[bindable] = None
        if callback is not None:
            assert self._task_set is not None
            link(entry, self._task_set, self._tables, topic)
            if kind == TIMER and entry.source >= 0:
                dag = self._tables.dag_of[entry.source]
                entry.depth = source_depth(
                    self._tables.period[dag], self._tables.dag_deadline[dag])
        return entry

    def _number(self, group: Any) -> int:
        """Return the core's number of a callback group, -1 for a reentrant one and for none."""
        if group is None or isinstance(group, ReentrantCallbackGroup):
            return -1
        number = self._groups.get(group)
        if number is None:
            number = self._groups[group] = self._scheduler.new_group()
            self._numbers.add(number)
        return number

    def _free_groups(self) -> None:
        """Give the numbers back of groups that are gone, as memory is bounded."""
        if len(self._groups) < len(self._numbers):
            for number in self._numbers.difference(list(self._groups.values())):
                self._numbers.remove(number)
                self._scheduler.free_group(number)

    def _unbind(self, entry: Entry) -> None:
        if self._binder is not None and entry.callback is not None:
            self._binder.release(entry.callback, entry.topic or None)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""An rcl wait set that is made once for its entities, and filled again for each wait."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from mddag_executor.live.entities import EntitySet, Receiver
from mddag_executor.live.takes import take_function
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.waitable import NumberOfEntities


class RefilledSet:
    """
    A wait set with what it is filled with; the entities are held from the start.

    :param guards: guard conditions that only end a wait.
    """

    def __init__(
        self, context: Context, entities: EntitySet, kinds: frozenset[str],
        guards: Iterable[GuardCondition], receiver: Receiver,
    ) -> None:
        self._receiver = receiver
        self._held: list[Any] = []
        self._things: list[Any] = []
        self._fill: list[tuple[Callable[[Any], Any], list[Any]]] = []
        self._takes: list[tuple[str, dict[int, Callable[[], int]]]] = []
        self._waitables: list[Any] = []
        self._take_data: list[Callable[[], int]] = []
        self.size = 0
        try:
            self._build(context, entities, kinds, guards)
        except BaseException:
            self.release()
            raise

    def _build(
        self, context: Context, entities: EntitySet, kinds: frozenset[str],
        guards: Iterable[GuardCondition],
    ) -> None:
        self._hold(context.handle)
        handles: dict[str, list[Any]] = {}
        for kind, name, some in (
            ('subscription', 'subscription', entities.subscriptions),
            ('guard', 'guard_condition', entities.guards),
            ('service', 'service', entities.services),
            ('client', 'client', entities.clients),
        ):
            takes = {}
            handles[name] = []
            for entity in some if kind in kinds else ():
                handle = entity.handle
                if self._hold(handle):
                    handles[name].append(handle)
                    takes[handle.pointer] = take_function(kind, entity, self._receiver)
            if takes:
                self._takes.append((name, takes))
        counts = NumberOfEntities(
            len(handles['subscription']), len(handles['guard_condition']), 0,
            len(handles['client']), len(handles['service']), 0)
        for waitable in (
            *(entities.waitables if 'waitable' in kinds else ()),
            *(entities.events if 'event' in kinds else ()),
        ):
            if self._hold(waitable):
                counts += waitable.get_num_entities()
                self._waitables.append(waitable)
                self._take_data.append(take_function('waitable', waitable, self._receiver))
        self.size = len(self._waitables) + sum(map(len, handles.values()))
        self._bells = set()
        for guard in guards:
            handle = guard.handle
            if self._hold(handle):
                handles['guard_condition'].append(handle)
                self._bells.add(handle.pointer)
                counts.num_guard_conditions += 1
        self._set = _rclpy.WaitSet(
            counts.num_subscriptions, counts.num_guard_conditions, counts.num_timers,
            counts.num_clients, counts.num_services, counts.num_events, context.handle)
        self._fill = [
            (getattr(self._set, f'add_{name}'), some) for name, some in handles.items() if some]

    def _hold(self, thing: Any) -> bool:
        """Keep an entity from being destroyed; False when it is already."""
        try:
            thing.__enter__()
        except InvalidHandle:
            return False
        self._held.append(thing)
        return True

    def hold(self) -> bool:
        """Hold all entities again; False when one has been destroyed since, so none is held."""
        things, self._things = self._things, []
        if all(self._hold(thing) for thing in things):
            return True
        self.release()
        return False

    def release(self) -> None:
        """Let go of the entities until ``hold``."""
        self._things, self._held = self._held, []
        for thing in self._things:
            thing.__exit__(None, None, None)

    def wait(self, timeout_ns: int) -> None:
        """
        Wait until something is ready, or for a time (negative: for ever).

        :raises RCLError: when rcl cannot.
        """
        wait_set = self._set
        wait_set.clear_entities()
        for add, handles in self._fill:
            deque(map(add, handles), maxlen=0)
        for waitable in self._waitables:
            waitable.add_to_wait_set(wait_set)
        wait_set.wait(timeout_ns)

    def rung(self) -> bool:
        """Return whether one of the guard conditions that only end a wait did so."""
        return not self._bells.isdisjoint(self._set.get_ready_entities('guard_condition'))

    def hand_over(self) -> tuple[int, bool]:
        """
        Take what is ready and hand it over.

        :return: how many things that were, and whether taking failed somewhere.
        """
        count = 0
        failed = False
        wait_set = self._set
        for waitable, take in zip(self._waitables, self._take_data):
            try:
                if waitable.is_ready(wait_set):
                    count += take()
            except Exception as error:
                failed |= self._failure(error)
        for name, takes in self._takes:
            for pointer in wait_set.get_ready_entities(name):
                function = takes.get(pointer)
                if function is None:
                    continue  # something that a waitable consists of
                try:
                    count += function()
                except Exception as error:
                    failed |= self._failure(error)
        return count, failed

    def _failure(self, error: Exception) -> bool:
        """Pass on an exception of a take; return whether it is one (and no destroyed entity)."""
        if isinstance(error, InvalidHandle):
            return False
        self._receiver.on_intake_error(error)
        return True

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
An rcl wait set that is made once for its entities, and filled again for each wait.

Used of ``_rclpy.WaitSet``: the constructor with the number of each kind, and ``clear_entities``,
``add_KIND``, ``wait`` and ``get_ready_entities``; of handles: ``pointer``. Seen in 7.1 and 9.1.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from mddag_executor.live.intake.sources import Source
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.waitable import NumberOfEntities

_KINDS = ('subscription', 'guard_condition', 'service', 'client')


class RefilledSet:
    """
    A wait set with what it is filled with; the entities are held from the start.

    :param guards: guard conditions that only end a wait.
    :param on_error: gets an exception of a take.
    :ivar size: how many sources it waits for.
    """

    def __init__(
        self, context: Context, sources: Iterable[Source], guards: Iterable[GuardCondition],
        on_error: Callable[[BaseException], None],
    ) -> None:
        self._on_error = on_error
        self._held: list[Any] = []
        self._released: list[Any] = []
        self._waitables: list[Source] = []
        self._by_address: dict[str, dict[int, Source]] = {kind: {} for kind in _KINDS}
        try:
            self._build(context, sources, guards)
        except BaseException:
            self.release()
            raise

    def _build(
        self, context: Context, sources: Iterable[Source], guards: Iterable[GuardCondition]
    ) -> None:
        self._hold(context.handle)
        handles: dict[str, list[Any]] = {kind: [] for kind in _KINDS}
        counts = NumberOfEntities()
        for source in sources:
            handle = source.handle
            if not self._hold(handle):
                continue
            if source.kind == 'waitable':
                counts += source.entity.get_num_entities()
                self._waitables.append(source)
            else:
                handles[source.kind].append(handle)
                self._by_address[source.kind][handle.pointer] = source
        self.size = len(self._waitables) + sum(map(len, handles.values()))
        self._bells = set()
        for guard in guards:
            handle = guard.handle
            if self._hold(handle):
                handles['guard_condition'].append(handle)
                self._bells.add(handle.pointer)
        counts += NumberOfEntities(
            len(handles['subscription']), len(handles['guard_condition']), 0,
            len(handles['client']), len(handles['service']), 0)
        self._set = _rclpy.WaitSet(
            counts.num_subscriptions, counts.num_guard_conditions, counts.num_timers,
            counts.num_clients, counts.num_services, counts.num_events, context.handle)
        self._fill = [
            (getattr(self._set, f'add_{kind}'), some) for kind, some in handles.items() if some]

    def _hold(self, handle: Any) -> bool:
        """Keep an entity from being destroyed; False when it is already."""
        try:
            handle.__enter__()
        except InvalidHandle:
            return False
        self._held.append(handle)
        return True

    def hold(self) -> bool:
        """Hold all entities again; False when one has been destroyed since, so none is held."""
        handles, self._released = self._released, []
        if all(self._hold(handle) for handle in handles):
            return True
        self.release()
        return False

    def release(self) -> None:
        """Let the entities be destroyed until ``hold``."""
        self._released, self._held = self._held, []
        for handle in self._released:
            handle.__exit__(None, None, None)

    def wait(self, timeout_ns: int) -> None:
        """
        Wait until something is ready, or for a time (negative: for ever).

        :raises RCLError: when rcl cannot.
        """
        wait_set = self._set
        wait_set.clear_entities()
        for add, handles in self._fill:
            deque(map(add, handles), maxlen=0)
        for source in self._waitables:
            source.entity.add_to_wait_set(wait_set)
        wait_set.wait(timeout_ns)

    def rung(self) -> bool:
        """Return whether one of the guard conditions that only end a wait did so."""
        return not self._bells.isdisjoint(self._set.get_ready_entities('guard_condition'))

    def take_ready(self) -> tuple[int, bool]:
        """
        Take what is ready.

        A waitable keeps in itself what ``is_ready`` has found, for ``take_data``: so the two are
        called one after the other.

        :return: how many things that were, and whether taking failed somewhere.
        """
        count = 0
        failed = False
        wait_set = self._set
        for waitable in self._waitables:
            try:
                if waitable.entity.is_ready(wait_set):
                    count += waitable.take()
            except Exception as error:
                failed |= self._failure(error)
        for kind, by_address in self._by_address.items():
            for address in wait_set.get_ready_entities(kind) if by_address else ():
                source = by_address.get(address)
                if source is None:
                    continue  # something that a waitable consists of
                try:
                    count += source.take()
                except Exception as error:
                    failed |= self._failure(error)
        return count, failed

    def _failure(self, error: Exception) -> bool:
        """Report an exception of a take; return whether it is one (and no destroyed entity)."""
        if isinstance(error, InvalidHandle):
            return False
        self._on_error(error)
        return True

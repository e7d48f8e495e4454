# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
An rcl wait set that is made once, and filled again for each wait.

Uses of ``_rclpy.WaitSet``: the constructor with the number of each kind, ``pointer``,
``clear_entities``, ``add_guard_condition``, ``wait`` and ``get_ready_entities``; of handles:
``pointer``.  Seen in 7.1 and 9.1.  ``rcl_wait_set_t`` is public (``rcl/wait.h``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, ExitStack
import ctypes
from typing import Any

from rclpy.context import Context
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.waitable import NumberOfEntities, Waitable

_KINDS = ('subscription', 'guard_condition', 'timer', 'client', 'service', 'event')


class _RclWaitSet(ctypes.Structure):
    """The public fields of ``rcl_wait_set_t``: for each kind an array of pointers and its size."""

    _fields_ = [
        field for kind in _KINDS
        for field in ((kind, ctypes.POINTER(ctypes.c_void_p)), (f'n_{kind}', ctypes.c_size_t))]


class FilledSet:
    """
    A wait set over waitables and guard conditions.

    Their handles are entered during a wait, so that they are not destroyed.

    :raises InvalidHandle: when one of them has been destroyed.
    """

    def __init__(
        self, context: Context, waitables: Iterable[Waitable],
        guards: Iterable[GuardCondition] = (),
    ) -> None:
        self.waitables = list(waitables)
        self._guards = {}
        self._context: Any = context.handle
        self._protected = [self._context, *self.waitables]
        counts = NumberOfEntities()
        for guard in guards:
            handle: Any = guard.handle
            with handle:
                self._guards[handle.pointer] = guard
            self._protected.append(handle)
        with _protected(self._protected):
            for waitable in self.waitables:
                counts += waitable.get_num_entities()
            self._set = _rclpy.WaitSet(
                counts.num_subscriptions, counts.num_guard_conditions + len(self._guards),
                counts.num_timers, counts.num_clients, counts.num_services, counts.num_events,
                context.handle)

    def protected(self) -> AbstractContextManager[None]:
        """Protect all of them from being destroyed while entered, or raise InvalidHandle."""
        return _protected(self._protected)

    def parts(
        self, call: Callable[[str, int], None], waitables: Iterable[Waitable] | None = None
    ) -> None:
        """
        Call a function with kind and address of each rcl entity.

        Kinds are ``subscription``, ``guard_condition``, ``timer``, ``client``, ``service``,
        ``event``.

        :param waitables: only those in these waitables; None: all, with the guard conditions.
        :raises InvalidHandle: when one of them has been destroyed.
        """
        chosen = self._protected if waitables is None else [self._context, *waitables]
        with _protected(chosen):
            self._fill(self.waitables if waitables is None else waitables,
                       self._guards.values() if waitables is None else ())
            filled = _RclWaitSet.from_address(self._set.pointer)
            for kind in _KINDS:
                for index in range(getattr(filled, f'n_{kind}')):
                    address = getattr(filled, kind)[index]
                    if address is not None:
                        call(kind, address)

    def _fill(self, waitables: Iterable[Waitable], guards: Iterable[GuardCondition]) -> None:
        self._set.clear_entities()
        for guard in guards:
            self._set.add_guard_condition(guard.handle)
        for waitable in waitables:
            waitable.add_to_wait_set(self._set)

    def wait(
        self, timeout_ns: int | None, take: Callable[[Waitable], None],
    ) -> list[GuardCondition]:
        """
        Wait until an entity is ready, or for a time (negative: for ever).

        With None it does not wait, and all entities count as ready.

        A waitable stores the findings of ``is_ready`` for ``take_data``, so these are called one
        right after the other.

        :param take: called with each waitable that is ready.
        :return: the guard conditions that were triggered.
        :raises InvalidHandle: when one of them has been destroyed.
        """
        with _protected(self._protected):
            self._fill(self.waitables, self._guards.values())
            if timeout_ns is not None:
                self._set.wait(timeout_ns)
            for waitable in self.waitables:
                if waitable.is_ready(self._set):
                    take(waitable)
            ready = self._set.get_ready_entities('guard_condition')
            return [self._guards[address] for address in ready if address in self._guards]


@contextmanager
def _protected(handles: Iterable[Any]) -> Iterator[None]:
    """Protect handles from being destroyed while entered."""
    with ExitStack() as stack:
        for handle in handles:
            stack.enter_context(handle)
        yield

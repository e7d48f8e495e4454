# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What the executor does for an entity of a node, whatever kind of callback it has.

Theory of operation
-------------------
Each kind is one subclass of ``Kind``, and a row of ``registry.KINDS``.  Nothing else of the
executor asks of which kind an entity is.

::

    rclpy's object ──▶ describe ──▶ listen ──▶ collect ──▶ ignore
                       what is it?   │          │           stop
                                     │          └─ an arrival becomes a ``Work`` for the engine
                                     └─ let the middleware write to a descriptor at each arrival

``record`` writes its tracepoints.  In reruns there is no middleware: entities are described and
recorded there, and nothing listens.

``listen`` and ``ignore`` are called without the engine's lock, because some of them call foreign
code; they take it for whatever needs it.  ``collect`` is called by a thread that owns it, except
for sources that are handled at once (``at_once``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from mddag_executor.executor.compat import alive
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.hall import Hall, Timers
from mddag_executor.executor.listeners import clear_listener, ListenerError, set_listener
from mddag_executor.executor.loop import EventLoop
from mddag_executor.executor.transfers import transfer_of
from rclpy.exceptions import InvalidHandle


class AtOnceHall(Protocol):
    """The spinning thread, to a source that it handles at once: see ``at_once.AtOnce``."""

    loop: EventLoop

    @property
    def timers(self) -> Timers:
        """Return the timers that it fires."""

    def handled(self, entity: Entity) -> None:
        """Note that an arrival has been handled."""

    def count(self, entity: Entity) -> None:
        """Count a callback that has run."""

    def ring(self) -> None:
        """End the current wait, or the next one."""


class Group(Protocol):
    """Entities that listen together: see ``waitables.SharedSource`` and ``WaitSetThread``."""

    def add(self, entity: Any) -> None:
        """Add an entity; the group listens to it after the next ``apply``."""

    def remove(self, entity: Any) -> None:
        """Remove an entity, if it is one of the group."""

    def apply(self) -> None:
        """Listen to the entities that the group has now, and to no other one any more."""


@dataclass(frozen=True)
class Rooms:
    """
    Where entities listen.

    :ivar publishers: returns the ids of the publishers of a subscription (see ``gaps``).
    :ivar deliveries: the subscriptions that publishing threads of this process take from.
    :ivar events: QoS events.
    :ivar unlistened: waitables for which the middleware has no listener.
    """

    pool: Hall
    at_once: AtOnceHall
    publishers: Callable[[Any], frozenset[bytes] | None]
    deliveries: Any
    events: Group
    unlistened: Group


class Kind(Entity):
    """
    An entity of a node.

    :cvar list_name: the property of a node that lists them.
    """

    list_name: ClassVar[str] = ''

    __slots__ = ()

    @classmethod
    def fits(cls, rclpy_object: Any) -> bool:
        """Return whether one of rclpy's objects in that list is of this kind."""
        return True

    def describe(self) -> None:
        """
        Set label, depth and whatever else does not change.

        :raises InvalidHandle: if it has been destroyed.
        """

    def listen(self, rooms: Rooms) -> None:
        """
        Let arrivals be collected from now on.

        :raises InvalidHandle: if it has been destroyed.
        """

    def ignore(self) -> None:
        """End ``listen``; does nothing if it does not listen."""

    def collect(self) -> None:
        """Collect the arrivals."""

    def leave(self, several: list[Any]) -> None:
        """Leave executions that will not run here to the next executor of its node, if any."""
        if several and alive(self.rclpy_object):
            transfer_of(self.rclpy_object).leave(several)


class ListenerEntity(Kind):
    """
    An entity with a listener of the middleware.

    :ivar rooms: where it listens, and ``loop``: in which loop; both are set by ``listen``.
    """

    __slots__ = ('rooms', 'loop')

    rooms: Rooms
    loop: EventLoop

    def __init__(self, rclpy_object: Any, node: str) -> None:
        super().__init__(rclpy_object, node)
        self.handle = rclpy_object.handle

    def listen_in(self, rooms: Rooms, loop: EventLoop, share: str = '') -> None:
        """
        Listen in one of the loops.

        :param share: see ``EventLoop.add``.
        """
        self.rooms, self.loop = rooms, loop
        with rooms.pool.lock:
            loop.add(self, share)
        try:
            with self.handle:
                set_listener(self.kind, self.handle.pointer, self.fd)
        except InvalidHandle:
            self._leave_loop()
            raise
        except ListenerError as error:
            rooms.pool.fail(error)

    def ignore(self) -> None:
        """End ``listen``."""
        if self.fd < 0:
            return
        try:
            with self.handle:
                clear_listener(self.kind, self.handle.pointer, self.fd)
        except InvalidHandle:
            pass  # it is just being destroyed
        self._leave_loop()

    def _leave_loop(self) -> None:
        with self.rooms.pool.lock:
            self.loop.remove(self)

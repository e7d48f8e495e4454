# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Stand-ins through which rclpy's native EventsExecutor takes for an intake.

Theory of operation
-------------------
``_rclpy.EventsExecutor`` asks nodes for their entities and has the middleware call it for each
message, request and response: its cost does not grow with the number of entities. It looks at
attributes only, so it is given one stand-in for a node, with one stand-in for each entity whose
``callback`` (and the like) hands over what was taken, instead of running the user's callback.

It keeps bare pointers to entities, and names callbacks by the address of the rcl entity. These
rules keep it from using what is gone, or what has come in its place:

1. Entities come and go only in its own thread: when it reads ``NodeStandIn.subscriptions``,
   which it does first, after each ``wake()``.
2. What it borrows (``handle``, ``callback``, ``msg_type``, ``srv_type``) are attributes set once,
   or replaced by something while the old value lives on.
3. A stand-in holds the handle (``with handle``) of its entity from before it is shown to after
   it was withdrawn, so an address cannot be used again while events for it may be queued. It is
   withdrawn in one update of the native executor; the events queued by then are through before
   an update begins that was asked for after that one: two updates later it lets go.
4. Adding an entity that is destroyed fails half way, which the native executor does not survive.
   So it is made to try the handles of new ones at the very last, when it reads ``guards``: that is
   an iterator without elements, which enters and leaves the handles as it is read, all in C.
   If that fails, nothing was added yet; and from there to the adding no bytecode runs, so no
   other thread can destroy an entity in between.

Before an entity is shown, everything is taken from it, and once more an update later. For the
native executor takes as many as the middleware announces, and that does not announce everything
that was there before: messages that an executor before this one was told of and did not take, QoS
events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import chain
from operator import length_hint, methodcaller
from typing import Any

from mddag_executor.live.entities import alive, EMPTY, EntitySet, Receiver
from mddag_executor.live.standins import STAND_INS, StandIn
from rclpy.exceptions import InvalidHandle


class _Trial:
    """
    The handles of new entities, to be entered and left all in C: by reading ``iterator``.

    Both yield None, which ``filter`` leaves out: the iterator has no elements.
    """

    def __init__(self, stand_ins: list[StandIn]) -> None:
        self.stand_ins = stand_ins
        handles = [stand_in.handle for stand_in in stand_ins]
        self._in, self._out = iter(handles), iter(handles)
        self.iterator = chain(
            filter(methodcaller('__enter__'), self._in),
            filter(methodcaller('__exit__', None, None, None), self._out))

    def passed(self) -> bool:
        """Return whether the iterator was read to its end."""
        return length_hint(self._out) == 0

    def failed(self) -> bool:
        """Return whether a handle could not be entered; if so, leave those that were."""
        count = len(self.stand_ins)
        if length_hint(self._out) < count or length_hint(self._in) == count:
            return False
        for stand_in in self.stand_ins[:count - length_hint(self._in) - 1]:
            stand_in.handle.__exit__(None, None, None)
        return True


class NodeStandIn:
    """
    Stand in for a node that has all entities of some kinds.

    :param kinds: of ``subscriptions``, ``services``, ``clients``, ``events``.
    :param wake: the native executor's ``wake``.
    """

    timers = ()

    def __init__(
        self, kinds: Iterable[str], receiver: Receiver, wake: Callable[[], None]
    ) -> None:
        self._receiver = receiver
        self._wake = wake
        self.wanted: EntitySet = EMPTY
        self._applied: EntitySet = EMPTY
        self._by_kind: dict[str, dict[int, Any]] = {kind: {} for kind in kinds}
        self._subscriptions: list[Any] = []
        self.services: list[Any] = []
        self.clients: list[Any] = []
        self.waitables: list[Any] = []
        self.guards: Iterable[None] = ()
        self._updates = 0
        # What is shown for the first time: until the next update begins, the native executor may
        # fail to add it.
        self._trial: _Trial | None = None
        self._withdrawn: list[tuple[int, StandIn]] = []

    @property
    def executor(self) -> None:
        """Ignore what is set: a node would hold the executor, and that one the node."""

    @executor.setter
    def executor(self, executor: Any) -> None:
        pass

    @property
    def subscriptions(self) -> list[Any]:
        """Give what the native executor reads first in each update, in its own thread."""
        self._updates += 1
        trial = self._trial
        if trial is not None and trial.passed():
            self._trial = None
            for stand_in in trial.stand_ins:
                stand_in.drain()
        if self.wanted is not self._applied:
            try:
                self._change()
            except Exception as error:
                self._receiver.on_intake_error(error)
        self._let_go(self._updates - 2)
        if self._trial is not None or self._withdrawn:
            self._wake()
        return self._subscriptions

    def settled(self) -> bool:
        """Return whether what is wanted is in force, and what was withdrawn is let go of."""
        return self.wanted is self._applied and not self._withdrawn

    def survives(self, error: Exception) -> bool:
        """
        Return whether the native executor can go on after an exception that came out of it.

        An entity that was destroyed before it could be added is taken back, and then it can.
        """
        trial = self._trial
        if trial is None:
            return True
        if trial.failed():
            self._try([s for s in trial.stand_ins if not self._took_back(s)])
            # What was to be removed in this update stays until the next one.
            self._withdrawn = [
                (self._updates + 1 if update == self._updates else update, stand_in)
                for update, stand_in in self._withdrawn]
            self._show()
            self._wake()
            return True
        return type(error) not in (RuntimeError, KeyError, InvalidHandle)

    def _took_back(self, stand_in: StandIn) -> bool:
        """Take back a stand-in that was never added, if its entity has been destroyed."""
        if alive(stand_in):
            return False
        for known in self._by_kind.values():
            known.pop(stand_in.key, None)
        stand_in.let_go()
        return True

    def _change(self) -> None:
        wanted = self._applied = self.wanted
        new: list[StandIn] = []
        for kind, known in self._by_kind.items():
            self._by_kind[kind] = self._changed(kind, known, getattr(wanted, kind), new)
        self._show()
        untried = self._trial.stand_ins if self._trial is not None else []
        self._try([stand_in for stand_in in untried if stand_in.live] + new)

    def _try(self, stand_ins: list[StandIn]) -> None:
        """Have these tried in the next update, or in the present one."""
        self._trial = _Trial(stand_ins) if stand_ins else None
        self.guards = self._trial.iterator if self._trial is not None else ()

    def _show(self) -> None:
        shown = {kind: list(known.values()) for kind, known in self._by_kind.items()}
        self._subscriptions = shown.get('subscriptions', [])
        self.services = shown.get('services', [])
        self.clients = shown.get('clients', [])
        self.waitables = shown.get('events', [])

    def _changed(
        self, kind: str, known: dict[int, Any], entities: Iterable[Any], new: list[StandIn]
    ) -> dict[int, Any]:
        """Return the stand-ins for these entities; withdraw those of others."""
        found: dict[int, Any] = {}
        for entity in entities:
            key = id(entity)
            stand_in = known.pop(key, None)
            if stand_in is None:
                try:
                    stand_in = STAND_INS[kind](entity, self._receiver)
                except InvalidHandle:
                    continue
                stand_in.drain()
                new.append(stand_in)
            found[key] = stand_in
        for old in known.values():
            old.withdraw()
            self._withdrawn.append((self._updates, old))
        return found

    def _let_go(self, update: int) -> None:
        """Let go of what was withdrawn in this update or before."""
        for entry in [entry for entry in self._withdrawn if entry[0] <= update]:
            self._withdrawn.remove(entry)
            entry[1].let_go()

    def drain(self) -> None:
        """Take what is there from all entities, in the native executor's thread."""
        for known in self._by_kind.values():
            for stand_in in list(known.values()):
                stand_in.drain()

    def withdraw(self) -> None:
        """Hand over nothing any more, and hold on to everything."""
        for known in self._by_kind.values():
            for stand_in in known.values():
                stand_in.withdraw()

    def close(self) -> None:
        """Let go of everything, after the native executor has been shut down."""
        self.withdraw()
        for kind, known in self._by_kind.items():
            for stand_in in known.values():
                stand_in.let_go()
            self._by_kind[kind] = {}
        self._show()
        self._let_go(self._updates)
        self.wanted = self._applied = EMPTY

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
rclpy's native EventsExecutor, as a part of an intake.

Theory of operation
-------------------
``_rclpy.EventsExecutor`` asks nodes for their entities and has the middleware call it for each
message, request and response: its cost does not grow with the number of entities. It looks at
attributes only, so it is given one stand-in for a node, with one stand-in for each entity, whose
``callback`` (and the like) hands over what was taken instead of running the user's callback.

It keeps bare pointers to entities, and names callbacks by the address of the rcl entity. These
rules keep it from using what is gone, or what has come in its place:

1. Entities come and go only in its own thread: when it reads ``_Node.subscriptions``, which it
   does first, after each ``wake()``.
2. What it borrows (``handle``, ``callback``, ``msg_type``, ``srv_type``) are attributes set once,
   or replaced by something while the old value lives on.
3. A stand-in holds the handle of its entity from before it is shown to after it was withdrawn, so
   an address cannot be used again while events for it may be queued. It is withdrawn in one
   update of the native executor; the events queued by then are through before an update begins
   that was asked for after that one: two updates later the handle is released.
4. Adding an entity that is destroyed fails half way, which the native executor does not survive.
   So it is made to try the handles of new ones at the very last, when it reads ``guards``: that is
   an iterator without elements, which enters and leaves the handles as it is read, all in C.
   If that fails, nothing was added yet; and from there to the adding no bytecode runs, so no
   other thread can destroy an entity in between.

Before an entity is shown, everything is taken from it, and once more an update later. For the
native executor takes as many as the middleware announces, and that does not announce everything
that was there before: messages that an executor before this one did not take.

Seen in 7.1 and 9.1. In 7.1.5 it dispatches only with a time-out. Waitables (actions, QoS events)
crash it when they are removed, and it refuses guard conditions: it gets none of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from itertools import chain
from operator import length_hint, methodcaller
from types import SimpleNamespace
from typing import Any

from mddag_executor.live.intake.sources import Source
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.subscription import Subscription
from rclpy.task import Future

DRAIN_TURNS = 16
"""So many times a source's share is taken from a new entity at the most."""

KINDS = ('subscription', 'service', 'client')
"""The kinds of entities that it can look after."""


class _OpenContext:
    """
    Stand in for the context.

    The native executor asks whether it is ok in its updates, and forgets all entities if not. The
    real one would answer under a lock, which a shutdown holds while it waits for others.
    """

    def __init__(self, handle: Any) -> None:
        self.handle = handle

    def ok(self) -> bool:
        """Return True."""
        return True


def _nothing(*_: Any) -> None:
    """Stand for the callback of an entity that is no longer looked after."""


class _StandIn:
    """
    Stand in for an entity, with the attributes that the native executor reads.

    :ivar live: cleared when the entity is looked after no more.
    """

    CallbackType = Subscription.CallbackType
    _callback_type = Subscription.CallbackType.WithMessageInfo  # so it gives both, as one tuple

    def __init__(self, source: Source) -> None:
        entity = source.entity
        self.source = source
        self.handle = source.handle
        self.live = True
        self.handle.__enter__()
        self.callback = self._taken = source.arrived
        if source.kind == 'subscription':
            self.msg_type, self.raw = entity.msg_type, entity.raw
        else:
            self.srv_type = entity.srv_type
        if source.kind == 'service':
            # The request itself is what is "sent" as its response, now that the header is known.
            self.callback = lambda request, _: request
            self.send_response = self._arrived
        elif source.kind == 'client':
            self.get_pending_request = self._pending_request

    def _pending_request(self, number: int) -> Any:
        """Return what stands for the future of a request."""
        return SimpleNamespace(
            _set_executor=_nothing, set_result=lambda response: self._arrived(number, response))

    def _arrived(self, *what: Any) -> None:
        if self.live:
            self._taken(*what)

    def withdraw(self) -> None:
        """Hand over nothing any more."""
        self.live = False
        if self.source.kind == 'subscription':
            self.callback = _nothing  # the old one may be in use: it stays, as `_taken`

    def release(self) -> None:
        """Allow the entity to be destroyed."""
        self.handle.__exit__(None, None, None)

    def is_destroyed(self) -> bool:
        """Return whether somebody has destroyed the entity."""
        try:
            with self.handle:
                return False
        except InvalidHandle:
            return True


class _Trial:
    """
    The handles of new entities, to be entered and left all in C: by reading ``iterator``.

    Both yield None, which ``filter`` leaves out: the iterator has no elements.
    """

    def __init__(self, stand_ins: list[_StandIn]) -> None:
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
            stand_in.release()
        return True


class _Node:
    """Stand in for a node that has all entities."""

    timers = waitables = ()

    def __init__(
        self, wake: Callable[[], None], on_error: Callable[[BaseException], None]
    ) -> None:
        self._wake = wake
        self._on_error = on_error
        self.wanted: Iterable[Source] = ()
        self._applied: Iterable[Source] = ()
        self._known: dict[int, _StandIn] = {}
        self._subscriptions: list[Any] = []
        self.services: list[Any] = []
        self.clients: list[Any] = []
        self.guards: Iterable[None] = ()
        self._updates = 0
        # What is shown for the first time: until the next update begins, the native executor may
        # fail to add it.
        self._trial: _Trial | None = None
        self._withdrawn: list[tuple[int, _StandIn]] = []

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
            self.drain(trial.stand_ins)
        if self.wanted is not self._applied:
            try:
                self._change()
            except Exception as error:
                self._on_error(error)
        self._release(self._updates - 2)
        if self._trial is not None or self._withdrawn:
            self._wake()
        return self._subscriptions

    def settled(self) -> bool:
        """Return whether what is wanted is in force, and what was withdrawn is released."""
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
            gone = [stand_in for stand_in in trial.stand_ins if stand_in.is_destroyed()]
            for stand_in in gone:
                self._known.pop(id(stand_in.source.entity), None)
                stand_in.release()
            self._try([stand_in for stand_in in trial.stand_ins if stand_in not in gone])
            # What was to be removed in this update stays until the next one.
            self._withdrawn = [
                (self._updates + 1 if update == self._updates else update, stand_in)
                for update, stand_in in self._withdrawn]
            self._show()
            self._wake()
            return True
        return type(error) not in (RuntimeError, KeyError, InvalidHandle)

    def _change(self) -> None:
        self._applied = self.wanted
        known, self._known = self._known, {}
        new: list[_StandIn] = []
        for source in self._applied:
            key = id(source.entity)
            stand_in = known.pop(key, None)
            if stand_in is None:
                try:
                    stand_in = _StandIn(source)
                except InvalidHandle:
                    continue
                new.append(stand_in)
            self._known[key] = stand_in
        self.drain(new)
        for old in known.values():
            old.withdraw()
            self._withdrawn.append((self._updates, old))
        self._show()
        untried = self._trial.stand_ins if self._trial is not None else []
        self._try([stand_in for stand_in in untried if stand_in.live] + new)

    def _try(self, stand_ins: list[_StandIn]) -> None:
        """Have these tried in the next update, or in the present one."""
        self._trial = _Trial(stand_ins) if stand_ins else None
        self.guards = self._trial.iterator if self._trial is not None else ()

    def _show(self) -> None:
        self._subscriptions, self.services, self.clients = (
            [known for known in self._known.values() if known.source.kind == kind]
            for kind in KINDS)

    def _release(self, update: int) -> None:
        """Release what was withdrawn in this update or before."""
        for entry in [entry for entry in self._withdrawn if entry[0] <= update]:
            self._withdrawn.remove(entry)
            entry[1].release()

    def drain(self, stand_ins: Iterable[_StandIn] | None = None) -> None:
        """Take what is there from some entities, or from all, in the executor's thread."""
        for stand_in in list(self._known.values()) if stand_ins is None else stand_ins:
            try:
                for _ in range(DRAIN_TURNS if stand_in.live else 0):
                    if not stand_in.source.take():
                        break
            except InvalidHandle:
                pass
            except Exception as error:
                self._on_error(error)

    def withdraw(self) -> None:
        """Hand over nothing any more, and hold on to everything."""
        for stand_in in self._known.values():
            stand_in.withdraw()

    def close(self) -> None:
        """Release everything, after the native executor has been shut down."""
        self.withdraw()
        for stand_in in self._known.values():
            stand_in.release()
        self._known = {}
        self._show()
        self._release(self._updates)
        self.wanted = self._applied = ()


_left_lying: list[Any] = []


class NativeExecutor:
    """
    A native EventsExecutor that hands over what it takes.

    It installs no signal handler; rclpy's own, where it is installed, ends its spin on SIGINT and
    SIGTERM.

    :param on_error: gets an exception of a take, and one that came out of a spin.
    """

    def __init__(self, context: Any, on_error: Callable[[BaseException], None]) -> None:
        self._on_error = on_error
        self._native: Any = _rclpy.EventsExecutor(_OpenContext(context.handle))
        self.wake: Callable[[], None] = self._native.wake
        self._node = _Node(self.wake, on_error)
        self._native.add_node(self._node)

    def show(self, sources: Iterable[Source]) -> None:
        """Set what to look after; it comes into force in the next update, after ``wake``."""
        self._node.wanted = sources

    def settled(self) -> bool:
        """Return whether what was shown last has come into force."""
        return self._node.settled()

    def spin(self, future: Future, seconds: float) -> bool:
        """
        Hand over until a future is done, or for a time, or until a signal comes.

        :return: False when the native executor has failed for good: then only ``abandon`` it.
        :raises Exception: what a take has raised; nothing is lost by it.
        """
        try:
            self._native.spin_until_future_complete(future, seconds)
        except ExternalShutdownException:
            return True
        except InvalidHandle as error:
            if self._node.survives(error):
                return True
            self._on_error(error)
            return False
        except Exception as error:
            if not self._node.survives(error):
                self._on_error(error)
                return False
            # A take failed. What was announced with it is announced no more.
            self._node.drain()
            raise
        return True

    def close(self) -> None:
        """End it, and release all entities."""
        self._native.shutdown()
        self._node.close()

    def abandon(self) -> None:
        """Hand over nothing any more. It cannot even be disposed of: it is left lying."""
        _left_lying.append((self._native, self._node))
        self._node.withdraw()


def events_executor_modules() -> list[Any]:
    """Return the modules that offer rclpy's ``EventsExecutor`` to users; the same holds for it."""
    names = ('rclpy.experimental', 'rclpy.experimental.events_executor')
    return [import_module(name) for name in names] if is_available() else []


def is_available() -> bool:
    """Return whether this rclpy has a native EventsExecutor. The first ones of 7.1 had none."""
    return hasattr(_rclpy, 'EventsExecutor')

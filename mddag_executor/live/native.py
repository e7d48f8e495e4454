# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
   it was withdrawn, so an address can not be used again while events for it may be queued. It is
   withdrawn in one update of the native executor; the events queued by then are through before
   an update begins that was asked for after that one: two updates later it lets go.
4. Adding can not fail half way, which the native executor does not survive: a destroyed entity
   is noticed when its handle is entered, and from there to the adding no bytecode runs, so no
   other thread can destroy it in between.

Before an entity is shown, everything is taken from it. For the native executor takes as many as
the middleware announces, and what an executor before this one was told of and did not take is
announced no more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from mddag_executor.live.entities import EMPTY, EntitySet, Receiver
from mddag_executor.live.takes import take_function
from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.service import Service
from rclpy.subscription import Subscription

DRAIN_TURNS = 16
"""So many times ``takes.MOST_AT_ONCE`` messages are taken from a new entity at the most."""


def _ignore(*_: Any) -> None:
    """Stand for the callback of an entity that is no longer looked after."""


def _keep_request(request: Any, _: Any) -> Any:
    """Stand for a service's callback: the request itself is what is "sent" as its response."""
    return request


class _StandIn:
    """What all stand-ins have; ``live`` is cleared when the entity is looked after no more."""

    __slots__ = ('handle', 'live', 'take', '_on_error')

    def __init__(self, kind: str, entity: Any, receiver: Receiver) -> None:
        self.handle: Any = entity.handle
        self.live = True
        self.take = take_function(kind, entity, receiver)
        self._on_error = receiver.on_intake_error
        self.handle.__enter__()

    def drain(self) -> None:
        """Take what is there."""
        try:
            for _ in range(DRAIN_TURNS):
                if not self.take():
                    return
        except InvalidHandle:
            pass
        except Exception as error:
            self._on_error(error)

    def withdraw(self) -> None:
        """Hand over nothing any more."""
        self.live = False

    def let_go(self) -> None:
        """Allow the entity to be destroyed."""
        self.handle.__exit__(None, None, None)


class SubscriptionStandIn(_StandIn):
    """Stand in for a subscription."""

    __slots__ = ('msg_type', 'raw', 'callback', '_callback_type', '_deliver')

    CallbackType = Subscription.CallbackType

    def __init__(self, subscription: Subscription, receiver: Receiver) -> None:
        super().__init__('subscription', subscription, receiver)
        self.msg_type = subscription.msg_type
        self.raw = subscription.raw
        self._callback_type = Subscription.CallbackType.WithMessageInfo
        on_message, on_error = receiver.on_message, receiver.on_intake_error

        def deliver(message: Any, info: Any = None) -> None:
            if info is None:
                message, info = message  # rclpy 7.1 gives both as one tuple
            try:
                on_message(subscription, message, info)
            except Exception as error:
                on_error(error)

        self._deliver = deliver
        self.callback: Callable[..., None] = deliver

    def withdraw(self) -> None:
        """Hand over nothing any more."""
        self.live = False
        self.callback = _ignore  # the native executor may be using the old one: it stays


class ServiceStandIn(_StandIn):
    """Stand in for a service."""

    __slots__ = ('srv_type', 'callback', '_service', '_on_request')

    def __init__(self, service: Service, receiver: Receiver) -> None:
        super().__init__('service', service, receiver)
        self.srv_type = service.srv_type
        self.callback = _keep_request
        self._service = service
        self._on_request = receiver.on_request

    def send_response(self, request: Any, header: Any) -> None:
        """Hand over what ``callback`` kept, now that the header is known too."""
        if self.live:
            try:
                self._on_request(self._service, request, header)
            except Exception as error:
                self._on_error(error)


class ClientStandIn(_StandIn):
    """Stand in for a client, and for the future of each of its requests."""

    __slots__ = ('srv_type', '_client', '_on_response', '_sequence')

    def __init__(self, client: Client, receiver: Receiver) -> None:
        super().__init__('client', client, receiver)
        self.srv_type = client.srv_type
        self._client = client
        self._on_response = receiver.on_response
        self._sequence = 0

    def get_pending_request(self, sequence: int) -> ClientStandIn:
        """Stand for the future of a request: its result comes next, in the same thread."""
        self._sequence = sequence
        return self

    def _set_executor(self, _: Any) -> None:
        """Do nothing: the real future gets its executor where it is completed."""

    def set_result(self, response: Any) -> None:
        """Hand over a response."""
        if self.live:
            try:
                self._on_response(self._client, self._sequence, None, response)
            except Exception as error:
                self._on_error(error)


class NodeStandIn:
    """
    Stand in for a node that has all subscriptions, services and clients.

    :param wake: the native executor's ``wake``.
    """

    timers = clients = services = waitables = guards = ()  # type: Any

    def __init__(self, receiver: Receiver, wake: Callable[[], None]) -> None:
        self._receiver = receiver
        self._wake = wake
        self.wanted: EntitySet = EMPTY
        self._shown: EntitySet = EMPTY
        self._by_kind: tuple[dict[int, Any], dict[int, Any], dict[int, Any]] = ({}, {}, {})
        self._subscriptions: list[SubscriptionStandIn] = []
        self._updates = 0
        self._withdrawn: list[tuple[int, _StandIn]] = []

    @property
    def executor(self) -> None:
        """Whatever is set is ignored: a node would hold the executor, and that one the node."""

    @executor.setter
    def executor(self, executor: Any) -> None:
        pass

    @property
    def subscriptions(self) -> list[SubscriptionStandIn]:
        """What the native executor reads first in each of its updates, in its own thread."""
        self._updates += 1
        if self.wanted is not self._shown:
            try:
                self._change()
            except Exception as error:
                self._receiver.on_intake_error(error)
        self._let_go(self._updates - 2)
        if self._withdrawn:
            self._wake()
        return self._subscriptions

    def _change(self) -> None:
        wanted = self._shown = self.wanted
        subscriptions, services, clients = self._by_kind
        subscriptions = self._changed(subscriptions, wanted.subscriptions, SubscriptionStandIn)
        services = self._changed(services, wanted.services, ServiceStandIn)
        clients = self._changed(clients, wanted.clients, ClientStandIn)
        self._by_kind = subscriptions, services, clients
        self._subscriptions = list(subscriptions.values())
        self.services = list(services.values())
        self.clients = list(clients.values())

    def _changed(
        self, known: dict[int, Any], entities: Iterable[Any], stand_in: Callable[..., Any]
    ) -> dict[int, Any]:
        """Return the stand-ins for these entities; withdraw those of others."""
        found: dict[int, Any] = {}
        for entity in entities:
            key = id(entity)
            if key in known:
                found[key] = known.pop(key)
                continue
            try:
                new = stand_in(entity, self._receiver)
            except InvalidHandle:
                continue
            new.drain()
            found[key] = new
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
        for known in self._by_kind:
            for stand_in in list(known.values()):
                stand_in.drain()

    def close(self) -> None:
        """Let go of everything, after the native executor has been shut down."""
        for known in self._by_kind:
            for stand_in in known.values():
                stand_in.withdraw()
                stand_in.let_go()
        self._by_kind = ({}, {}, {})
        self._subscriptions = []
        self.services = self.clients = []
        self._let_go(self._updates)

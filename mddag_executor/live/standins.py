# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Stand-ins for single entities, which rclpy's native EventsExecutor takes for rclpy's own.

It uses attributes only; what it borrows of them is set once, or stays alive when it is replaced
(see ``native`` for all of the rules).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.live.entities import Receiver
from mddag_executor.live.takes import take_function
from rclpy.client import Client
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.waitable import NumberOfEntities

DRAIN_TURNS = 16
"""So many times ``takes.MOST_AT_ONCE`` messages are taken from a new entity at the most."""


def _ignore(*_: Any) -> None:
    """Stand for the callback of an entity that is no longer looked after."""


def _keep_request(request: Any, _: Any) -> Any:
    """Stand for a service's callback: the request itself is what is "sent" as its response."""
    return request


class StandIn:
    """
    What all stand-ins have.

    ``live`` is cleared when the entity is looked after no more, ``key`` is its id.
    """

    __slots__ = ('handle', 'key', 'live', 'take', '_on_error')

    def __init__(self, kind: str, entity: Any, handle: Any, receiver: Receiver) -> None:
        self.handle: Any = handle
        self.key = id(entity)
        self.live = True
        self.take = take_function(kind, entity, receiver)
        self._on_error = receiver.on_intake_error
        self.handle.__enter__()

    def drain(self) -> None:
        """Take what is there."""
        try:
            for _ in range(DRAIN_TURNS if self.live else 0):
                if not self._take():
                    return
        except InvalidHandle:
            pass
        except Exception as error:
            self._on_error(error)

    def _take(self) -> int:
        return self.take()

    def withdraw(self) -> None:
        """Hand over nothing any more."""
        self.live = False

    def let_go(self) -> None:
        """Allow the entity to be destroyed."""
        self.handle.__exit__(None, None, None)


class SubscriptionStandIn(StandIn):
    """Stand in for a subscription."""

    __slots__ = ('msg_type', 'raw', 'callback', '_callback_type', '_deliver')

    CallbackType = Subscription.CallbackType

    def __init__(self, subscription: Subscription, receiver: Receiver) -> None:
        super().__init__('subscription', subscription, subscription.handle, receiver)
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


class ServiceStandIn(StandIn):
    """Stand in for a service."""

    __slots__ = ('srv_type', 'callback', '_service', '_on_request')

    def __init__(self, service: Service, receiver: Receiver) -> None:
        super().__init__('service', service, service.handle, receiver)
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


class ClientStandIn(StandIn):
    """Stand in for a client, and for the future of each of its requests."""

    __slots__ = ('srv_type', '_client', '_on_response', '_sequence')

    def __init__(self, client: Client, receiver: Receiver) -> None:
        super().__init__('client', client, client.handle, receiver)
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


class _Capture:
    """Stand in for a wait set, to get at the handle of a QoS event, which has no other access."""

    handle: Any = None

    def add_event(self, handle: Any) -> int:
        """Note the handle; return its index."""
        self.handle = handle
        return 0


class EventStandIn(StandIn):
    """
    Stand in for a QoS event, as the waitable that the native executor takes it for.

    It makes a task of what ``execute`` returns; that one does nothing.

    A status can be taken at any time, and it has news when it tells of a change since it was taken
    last, or when its counts are others than then: registering a callback with the middleware can
    use up the change. So ``drain`` comes before that.
    """

    __slots__ = ('_event', '_on_waitable', '_counts')

    _futures = ()

    def __init__(self, event: EventHandler, receiver: Receiver) -> None:
        capture = _Capture()
        event.add_to_wait_set(capture)
        super().__init__('waitable', event, capture.handle, receiver)
        self._event = event
        self._counts: list[int] | None = None
        self._on_waitable = receiver.on_waitable

    def __enter__(self) -> None:
        """Do nothing: the handle is held anyway, and this must not fail."""

    def __exit__(self, *_: Any) -> None:
        """Do nothing."""

    def get_num_entities(self) -> NumberOfEntities:
        """Return that it is one event."""
        return NumberOfEntities(num_events=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Add the event (so does the native executor learn what there is to call it)."""
        wait_set.add_event(self.handle)

    def is_ready(self, _: Any) -> bool:
        """Return True: it is asked only then."""
        return True

    def take_data(self) -> None:
        """Take the event's status and hand it over, if it has any news."""
        if self.live:
            self.drain()

    def _take(self) -> int:
        with self.handle:
            data = self.handle.take_event()
        if data is None:
            return 0
        counts = [getattr(data, name) for name in dir(data) if name.endswith('_count')]
        changes = [getattr(data, name) for name in dir(data) if name.endswith('_change')]
        known, self._counts = self._counts, counts
        if any(changes) or (known is not None and counts != known):
            try:
                self._on_waitable(self._event, data)
            except Exception as error:
                self._on_error(error)
        return 0

    def execute(self, _: Any) -> Callable[..., None]:
        """Return what is run as a task."""
        return _ignore


STAND_INS: dict[str, Callable[..., Any]] = {
    'subscriptions': SubscriptionStandIn,
    'services': ServiceStandIn,
    'clients': ClientStandIn,
    'events': EventStandIn,
}

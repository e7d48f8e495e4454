# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What is taken from each kind of entity, and what is to be called for it.

A new kind of entity is a class here, a row in ``SOURCES`` and a list of ``EntitySet``. Timers are
the exception: see ``timers``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
import time
from typing import Any, ClassVar

from mddag_executor.live import compat
from mddag_executor.live.intake.arrivals import Receiver
from mddag_executor.live.intake.entities import EntitySet
from mddag_executor.live.work import Work
from rclpy.exceptions import InvalidHandle
from rclpy.qos import HistoryPolicy

MOST_AT_ONCE = 64
"""So many are taken from one entity before the others have their turn."""

_SERVICE_DEPTH = 10
_SENDER_LOOKS, _SENDER_LOOK_S = 500, 0.001


class Source:
    """
    An entity that the intake takes from.

    :ivar kind: what a wait set calls it.
    :ivar handle: entered (``with handle``), it keeps the entity from being destroyed.
    """

    __slots__ = ('entity', 'handle', 'most', '_receiver', '_take')

    kind: ClassVar[str]
    # takes one and hands it over; returns whether there was one
    take_one: Callable[[], bool]
    # hands over what something else has taken
    arrived: Callable[..., None]

    def __init__(self, entity: Any, receiver: Receiver) -> None:
        self.entity = entity
        self.handle: Any = entity.handle
        self.most = 1
        self._receiver = receiver

    def take(self) -> int:
        """
        Take what is there and hand it over; return how many it were.

        Some may be left: see ``MOST_AT_ONCE``.

        :raises InvalidHandle: when the entity has been destroyed.
        """
        count = 0
        with self.handle:
            while count < self.most and self.take_one():
                count += 1
        return count


class SubscriptionSource(Source):
    """
    A subscription.

    :ivar take_next: takes a message, and returns it with its info; None if there is none.
    """

    __slots__ = ('take_next',)

    kind = 'subscription'

    def __init__(self, subscription: Any, receiver: Receiver) -> None:
        super().__init__(subscription, receiver)
        self.take_next = compat.message_taker(subscription)
        qos = subscription.qos_profile
        # More than the depth would keep the others waiting.
        self.most = MOST_AT_ONCE
        if qos.history == HistoryPolicy.KEEP_LAST and qos.depth > 0:
            self.most = min(qos.depth, MOST_AT_ONCE)

    def take_one(self) -> bool:
        """Take a message and hand it over; return whether there was one."""
        taken = self.take_next()
        if taken is not None:
            self.arrived(taken)
        return taken is not None

    def arrived(self, taken: tuple[Any, dict[str, Any]]) -> None:
        """Hand over a message that has been taken."""
        self._receiver.take(self.arrival(taken))

    def arrival(self, taken: tuple[Any, dict[str, Any]]) -> Work:
        """Return what a message that has been taken is handed over as."""
        subscription = self.entity
        args = taken if compat.callback_type(subscription) is compat.WITH_INFO else taken[:1]
        return Work(subscription, subscription.callback, args, None, taken[1])


class ServiceSource(Source):
    """A service."""

    __slots__ = ()

    kind = 'service'

    def __init__(self, service: Any, receiver: Receiver) -> None:
        super().__init__(service, receiver)
        self._take = compat.request_taker(service)
        self.most = _SERVICE_DEPTH

    def take_one(self) -> bool:
        """Take a request and hand it over; return whether there was one."""
        request, header = self._take()
        if header is not None:
            self.arrived(request, header)
        return header is not None

    def arrived(self, request: Any, header: Any) -> None:
        """Hand over a request that has been taken."""
        service = self.entity
        self._receiver.take(Work(
            service, service.callback, (request, service.srv_type.Response()),
            partial(service.send_response, header=header)))


class ClientSource(Source):
    """
    A client.

    A response only completes a future. So that is done at once: a callback that waits for it may
    hold the last worker.
    """

    __slots__ = ()

    kind = 'client'

    def __init__(self, client: Any, receiver: Receiver) -> None:
        super().__init__(client, receiver)
        self._take = compat.response_taker(client)
        self.most = _SERVICE_DEPTH

    def take_one(self) -> bool:
        """Take a response and complete its future; return whether there was one."""
        header, response = self._take()
        if header is not None:
            self.arrived(header.request_id.sequence_number, response)
        return header is not None

    def arrived(self, number: int, response: Any) -> None:
        """Complete the future of a request by its number."""
        compat.complete_request(self.entity, number, response, self._receiver.executor)


class GuardSource(Source):
    """A node's guard condition that was triggered (once or more often)."""

    __slots__ = ()

    kind = 'guard_condition'

    def take_one(self) -> bool:
        """Hand it over."""
        guard = self.entity
        if guard.callback is not None:
            self._receiver.take(Work(guard, guard.callback))
        return True


class WaitableSource(Source):
    """
    A waitable: an action, a QoS event, or one of a user's own.

    An action client forgets the callback of a goal's feedback when the goal's result has come. So
    each feedback is handed over by itself, with the callback that it is for.
    """

    __slots__ = ()

    kind = 'waitable'

    def __init__(self, waitable: Any, receiver: Receiver) -> None:
        self.entity = self.handle = waitable
        self.most = 1
        self._receiver = receiver

    def take_one(self) -> bool:
        """Take what is there and hand it over."""
        waitable = self.entity
        data = waitable.take_data()
        compat.attach_futures(waitable, self._receiver.executor)
        feedback = compat.feedback_taken(waitable, data, MOST_AT_ONCE)
        arrivals = [Work(waitable, callback, (message,)) for callback, message in feedback]
        if data or not arrivals:
            behind = compat.sender_is_behind(waitable, data)
            execute = partial(_execute_late, waitable) if behind else waitable.execute
            arrivals.append(Work(waitable, execute, (data,)))
        self._receiver.take_in(arrivals)
        return True


def _execute_late(client: Any, data: Any) -> Any:
    """Execute an action client's work once the thread that has sent the request has noted it."""
    for _ in range(_SENDER_LOOKS):
        if not compat.sender_is_behind(client, data):
            break
        time.sleep(_SENDER_LOOK_S)
    return client.execute(data)


SOURCES: dict[str, type[Source]] = {
    'subscriptions': SubscriptionSource,
    'services': ServiceSource,
    'clients': ClientSource,
    'guards': GuardSource,
    'waitables': WaitableSource,
    'events': WaitableSource,
    'logged_events': WaitableSource,
}


def sources(entities: EntitySet, kinds: Iterable[str], receiver: Receiver) -> Iterator[Source]:
    """
    Yield a source for each entity of these kinds (of ``SOURCES``) that has not been destroyed.

    Timers are left out.
    """
    for kind in kinds:
        if kind not in SOURCES:
            continue
        for entity in getattr(entities, kind):
            try:
                yield SOURCES[kind](entity, receiver)
            except InvalidHandle:
                pass

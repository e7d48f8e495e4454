# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Functions that take what is there from an rclpy entity and hand it over."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.live.entities import Receiver
from rclpy.qos import HistoryPolicy

MOST_AT_ONCE = 64
"""So many are taken from one entity before the others have their turn."""

_SERVICE_DEPTH = 10


def take_function(kind: str, entity: Any, receiver: Receiver) -> Callable[[], int]:
    """
    Return a function that takes from an entity, hands over, and returns how many it were.

    It raises InvalidHandle for a destroyed entity, and whatever the take raises; an exception of
    the receiver goes to ``receiver.on_intake_error``. Some may be left, see ``MOST_AT_ONCE``.

    :param kind: ``subscription``, ``service``, ``client``, ``guard`` or ``waitable``.
    """
    return _MAKERS[kind](entity, receiver)


def _subscription(subscription: Any, receiver: Receiver) -> Callable[[], int]:
    handle = subscription.handle
    take = handle.take_message
    msg_type, raw = subscription.msg_type, subscription.raw
    on_message, on_error = receiver.on_message, receiver.on_intake_error
    qos = subscription.qos_profile
    most = MOST_AT_ONCE
    if qos.history == HistoryPolicy.KEEP_LAST and qos.depth > 0:
        most = min(qos.depth, most)
    turns = range(most)

    def take_messages() -> int:
        count = 0
        with handle:
            for _ in turns:
                taken = take(msg_type, raw)
                if taken is None:
                    break
                count += 1
                try:
                    on_message(subscription, taken[0], taken[1])
                except Exception as error:
                    on_error(error)
        return count

    return take_messages


def _service(service: Any, receiver: Receiver) -> Callable[[], int]:
    handle = service.handle
    take = handle.service_take_request
    request_type = service.srv_type.Request
    on_request, on_error = receiver.on_request, receiver.on_intake_error
    turns = range(_SERVICE_DEPTH)

    def take_requests() -> int:
        count = 0
        with handle:
            for _ in turns:
                request, header = take(request_type)
                if header is None:
                    break
                count += 1
                try:
                    on_request(service, request, header)
                except Exception as error:
                    on_error(error)
        return count

    return take_requests


def _client(client: Any, receiver: Receiver) -> Callable[[], int]:
    handle = client.handle
    take = handle.take_response
    response_type = client.srv_type.Response
    on_response, on_error = receiver.on_response, receiver.on_intake_error
    turns = range(_SERVICE_DEPTH)

    def take_responses() -> int:
        count = 0
        with handle:
            for _ in turns:
                header, response = take(response_type)
                if header is None:
                    break
                count += 1
                try:
                    on_response(client, header.request_id.sequence_number, header, response)
                except Exception as error:
                    on_error(error)
        return count

    return take_responses


def _guard(guard: Any, receiver: Receiver) -> Callable[[], int]:
    handle = guard.handle
    on_guard, on_error = receiver.on_guard, receiver.on_intake_error

    def take_trigger() -> int:
        with handle:
            try:
                on_guard(guard)
            except Exception as error:
                on_error(error)
        return 1

    return take_trigger


def _waitable(waitable: Any, receiver: Receiver) -> Callable[[], int]:
    take = waitable.take_data
    on_waitable, on_error = receiver.on_waitable, receiver.on_intake_error

    def take_data() -> int:
        with waitable:
            data = take()
            try:
                on_waitable(waitable, data)
            except Exception as error:
                on_error(error)
        return 1

    return take_data


_MAKERS: dict[str, Callable[[Any, Receiver], Callable[[], int]]] = {
    'subscription': _subscription,
    'service': _service,
    'client': _client,
    'guard': _guard,
    'waitable': _waitable,
}

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Services between nodes of the run: requests and responses without a middleware.

A request goes to the service of its name when the callback that sends it ends or waits; its
response goes back when the service's callback ends. Both are copied, as if they had been sent.
A request to a service that no node of the run offers is never answered, and a warning says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import copy
from functools import partial
import itertools
from typing import Any

from mddag_executor.executor.compat import complete_request, service_name
from mddag_executor.executor.entity import Entity, SERVICE
from mddag_executor.executor.work import Work
from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.compat import new_request
from mddag_executor.rerun.loop import Loop
from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.service import Service
from rclpy.task import Future

Header = tuple[Any, int]
"""What a request's header is to a server: the client that has sent it, and its number."""


class Services:
    """
    Carries requests and responses.

    :param executor: runs the callbacks of futures.
    """

    def __init__(self, loop: Loop, executor: Any, warn: Callable[[str], None]) -> None:
        self._loop = loop
        self._executor = executor
        self._warn = warn
        self._offered: dict[str, Entity] = {}
        self._numbers = itertools.count(1)

    def refresh(self, entities: Iterable[Entity]) -> None:
        """Update which services there are."""
        self._offered = {e.label: e for e in entities if e.kind == SERVICE}

    def install(self, replacements: Replacements) -> None:
        """Have clients and services use this."""
        replace = replacements.replace
        replace(Client, 'call_async', instead(self.call_async))
        replace(Client, 'call', instead(self.call))
        replace(Client, 'service_is_ready', instead(self.is_offered))
        replace(Client, 'wait_for_service', instead(self.wait_for_service))
        replace(Service, 'send_response', instead(self.send_response))

    def is_offered(self, client: Client) -> bool:
        """Return whether a node of the run offers a client's service."""
        entity = self._offered.get(service_name(client))
        return entity is not None and not entity.removed

    def wait_for_service(self, client: Client, timeout_sec: float | None = None) -> bool:
        """Wait until a client's service is offered."""
        return self._loop.wait(
            lambda: self.is_offered(client), self._loop.deadline_after(timeout_sec),
            f'for service {service_name(client)}')

    def call_async(self, client: Any, request: Any) -> Future:
        """Send a request; return the future of its response."""
        if not isinstance(request, client.srv_type.Request):
            raise TypeError()
        with client.handle:  # else it has been destroyed
            pass
        number = next(self._numbers)
        future = new_request(client, number)
        self._loop.call_at_end(partial(self._ask, client, number, copy.deepcopy(request)))
        return future

    def call(
        self, client: Client, request: Any, timeout_sec: float | None = None
    ) -> Any:
        """Send a request and wait for its response; None if it does not come in time."""
        future = self.call_async(client, request)
        if not self._loop.wait(
                future.done, self._loop.deadline_after(timeout_sec),
                f'for service {service_name(client)}', lends=True):
            client.remove_pending_request(future)
        error = future.exception()
        if error is not None:
            raise error
        return future.result()

    def _ask(self, client: Client, number: int, request: Any) -> None:
        name = service_name(client)
        entity = self._offered.get(name)
        if entity is None or entity.removed:
            self._warn(f'{name}: it is called, and no node of the run offers this service')
            return
        service = entity.rclpy
        work = Work(
            entity, service.callback, (request, service.srv_type.Response()),
            partial(service.send_response, header=(client, number)))
        engine, now = self._loop.engine, self._loop.now
        if entity.source >= 0:
            engine.arrived(work, None, now, -1, now)
        else:
            engine.ready(work, now)

    def send_response(self, service: Any, response: Any, header: Header) -> None:
        """Send a response."""
        if not isinstance(response, service.srv_type.Response):
            raise TypeError()
        self._loop.call_at_end(partial(self._answer, *header, copy.deepcopy(response)))

    def _answer(self, client: Client, number: int, response: Any) -> None:
        try:
            with client.handle:
                pass
        except InvalidHandle:
            return  # destroyed meanwhile
        complete_request(client, number, response, self._executor)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Services and actions between nodes of the run, without a middleware.

Theory of operation
-------------------
What a client or server sends is copied, and goes to the other side when the callback that sends it
ends or waits. A request to a service or action that no node of the run offers is never answered,
and a warning says so.

rclpy's action clients and servers do all by themselves but for sending (methods of their handles)
and taking: they get what they would have taken. Goals are known by the middleware's own
bookkeeping, which stays in use; results expire in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable
import copy
from functools import partial
from inspect import signature
import itertools
from typing import Any

from mddag_executor.executor.compat import (
    action_handle,
    alive,
    attach_futures,
    CLIENT_HANDLE,
    complete_request,
    feedback_taken,
    goal_states,
    has_result,
    HERITAGE,
    new_request,
    SERVER_HANDLE,
    service_name,
)
from mddag_executor.executor.registry import Registry
from mddag_executor.executor.sent_requests import Heritage
from mddag_executor.executor.sources import ServiceEntity
from mddag_executor.executor.work import Work
from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.loop import Loop, TIMER
from rclpy.client import Client
from rclpy.service import Service
from rclpy.task import Future

Header = tuple[Any, int]
"""What a request's header is to a server: the client that has sent it, and its number."""


class Requests:
    """Carries what clients and servers of services and actions send."""

    def __init__(self, loop: Loop, executor: Any, registry: Registry) -> None:
        self._loop = loop
        self._executor = executor
        self._registry = registry
        self._numbers = itertools.count(1)
        # clients and servers of actions with their names, by the id of their handles
        self._actions: dict[int, tuple[str, Any]] = {}
        self._result_timeout_ns: dict[int, int] = {}  # by the id of a server's handle
        # by the number of a request to an action: what its response inherits
        self._heritages: dict[int, Heritage] = {}

    def install(self, replacements: Replacements) -> None:
        """Have clients and servers use this."""
        from rclpy.action.client import ActionClient  # late: it loads much
        from rclpy.action.server import ActionServer
        replace = replacements.replace
        replace(Client, 'call_async', instead(self.call_async))
        replace(Client, 'call', instead(self.call))
        replace(Client, 'service_is_ready', instead(
            lambda client: self._service(service_name(client)) is not None))
        # rclpy's own poll each 250 ms
        replace(Client, 'wait_for_service', instead(self._wait_for_service))
        replace(ActionClient, 'wait_for_server', instead(self._wait_for_server))
        replace(Service, 'send_response', instead(self.send_response))
        replace(ActionClient, '__init__', self._action_init)
        replace(ActionServer, '__init__', self._action_init)
        replace(CLIENT_HANDLE, 'is_action_server_available',
                instead(lambda handle: bool(self._peers(handle))))
        replace(SERVER_HANDLE, 'publish_feedback', instead(self._feedback))
        replace(SERVER_HANDLE, 'publish_status', instead(self._status))
        replace(SERVER_HANDLE, 'notify_goal_done', instead(self._goal_done))
        for kind in ('goal', 'cancel', 'result'):
            replace(CLIENT_HANDLE, f'send_{kind}_request',
                    instead(partial(self._ask_action, kind)))
            replace(SERVER_HANDLE, f'send_{kind}_response',
                    instead(partial(self._answer_action, kind)))

    def _send(self, content: Any, deliver: Callable[[Any], None]) -> None:
        """Deliver a copy of something when the callback that runs ends, or else at once."""
        copied = copy.deepcopy(content)
        self._loop.send(lambda *_: deliver(copied))

    # --- services --------------------------------------------------------------------------------

    def _service(self, name: str) -> ServiceEntity | None:
        return next((entity for entity in self._registry.of_kind(ServiceEntity)
                     if entity.label == name), None)

    def _wait_for_service(self, client: Client, timeout_sec: float | None = None) -> bool:
        name = service_name(client)
        self._loop.wait(lambda: self._service(name) is not None or not alive(client),
                        timeout_sec, f'for service {name}')
        return client.service_is_ready()

    def call_async(self, client: Any, request: Any) -> Future:
        """Send a request; return the future of its response."""
        if not isinstance(request, client.srv_type.Request):
            raise TypeError()
        with client.handle:  # else it has been destroyed
            name = service_name(client)
        number = next(self._numbers)
        future = new_request(client, number)
        heritage = self._loop.heritage()
        if heritage is not None:
            setattr(future, HERITAGE, heritage)
        self._send(request, partial(self._ask, name, client, number, heritage))
        return future

    def call(self, client: Client, request: Any, timeout_sec: float | None = None) -> Any:
        """Send a request and wait for its response; None if it does not come in time."""
        future = self.call_async(client, request)
        if not self._loop.wait(
                future.done, timeout_sec, f'for service {service_name(client)}', lends=True):
            client.remove_pending_request(future)
        error = future.exception()
        if error is not None:
            raise error
        return future.result()

    def _ask(
        self, name: str, client: Client, number: int, heritage: Heritage | None, request: Any
    ) -> None:
        entity = self._service(name)
        if entity is None:
            self._loop.warn(f'{name}: it is called, and no node of the run offers this service')
            return
        service = entity.rclpy_object
        work = Work(
            entity, service.callback, (request, service.srv_type.Response()),
            partial(service.send_response, header=(client, number)))
        engine, now = self._loop.engine, self._loop.now
        if entity.source >= 0:
            engine.arrived(work, None, now, -1, now)
        else:
            work.heritage = heritage
            engine.posted(work, now)

    def send_response(self, service: Any, response: Any, header: Header) -> None:
        """Send a response."""
        if not isinstance(response, service.srv_type.Response):
            raise TypeError()
        self._send(response, partial(self._answer, *header))

    def _answer(self, client: Client, number: int, response: Any) -> None:
        if alive(client):
            complete_request(client, number, response, self._executor)
            self._loop.on_ended(client)

    # --- actions ---------------------------------------------------------------------------------

    def _action_init(self, original: Callable[..., None]) -> Callable[..., None]:
        """Return a constructor that keeps by which name an action is known."""
        timeout = signature(original).parameters.get('result_timeout')  # of servers only

        def construct(
            waitable: Any, node: Any, action_type: Any, action_name: str, *args: Any, **more: Any
        ) -> None:
            original(waitable, node, action_type, action_name, *args, **more)
            name = node.resolve_service_name(f'{action_name}/_action/send_goal')
            handle = id(action_handle(waitable))
            self._actions[handle] = name.removesuffix('/_action/send_goal'), waitable
            if timeout is not None:
                self._result_timeout_ns[handle] = round(
                    more.get('result_timeout', timeout.default) * 1e9)

        return construct

    def knows(self, waitable: Any) -> bool:
        """Return whether a waitable is an action client or server."""
        return any(each is waitable for _, each in self._actions.values())

    def _peers(self, handle: Any) -> list[Any]:
        """Return the clients of an action server, or the servers of an action client."""
        name, _ = self._actions[id(handle)]
        return [each for known, each in self._actions.values()
                if known == name and id(each) in self._registry.by_id
                and type(action_handle(each)) is not type(handle)]

    def _wait_for_server(self, client: Any, timeout_sec: float | None = None) -> bool:
        handle = action_handle(client)
        return self._loop.wait(lambda: bool(self._peers(handle)), timeout_sec,
                               f'for action {self._actions[id(handle)][0]}')

    def _ask_action(self, kind: str, handle: Any, request: Any) -> int:
        number = next(self._numbers)
        name, client = self._actions[id(handle)]
        heritage = self._loop.heritage()
        if heritage is not None:
            self._heritages[number] = heritage

        def deliver(request: Any) -> None:
            servers = self._peers(handle)
            if servers:
                self._take(servers[0], {kind: ((client, number), request)}, heritage)
            else:
                self._loop.warn(
                    f'{name}: it is called, and no node of the run offers this action')

        self._send(request, deliver)
        return number

    def _answer_action(self, kind: str, handle: Any, header: Header, response: Any) -> None:
        client, number = header
        heritage = self._heritages.pop(number, None)
        self._send(response, lambda response: self._take(
            client, {kind: (number, response)}, heritage))

    def _feedback(self, handle: Any, message: Any) -> None:
        def deliver(message: Any) -> None:
            for client in self._peers(handle):
                for callback, _ in feedback_taken(client, {'feedback': message}, 1):
                    self._ready(client, callback, copy.deepcopy(message))

        self._send(message, deliver)

    def _status(self, handle: Any) -> None:
        from action_msgs.msg import GoalStatus, GoalStatusArray
        _, server = self._actions[id(handle)]
        # made here, so that it needs no copy, which takes long for many goals
        message = GoalStatusArray(status_list=[
            GoalStatus(goal_info=info, status=status) for info, status in goal_states(server)])

        def deliver(*_: Any) -> None:
            for client in self._peers(handle):
                self._take(client, {'status': message})

        self._loop.send(deliver)

    def _goal_done(self, handle: Any) -> None:
        """Have the results of goals that have ended expire after the server's timeout."""
        from action_msgs.msg import GoalStatus
        _, server = self._actions[id(handle)]
        timeout_ns = self._result_timeout_ns[id(handle)]
        at = self._loop.now + timeout_ns
        if timeout_ns >= 0 and at < self._loop.end:
            ended = [info for info, status in goal_states(server)
                     if status > GoalStatus.STATUS_CANCELING]
            # those whose results are left then: others have expired before
            self._loop.at(at, TIMER, self._ready, server, lambda ended: server.execute(
                {'expired': [info for info in ended if has_result(server, info)]}), ended)

    def _take(
        self, waitable: Any, data: dict[str, Any], heritage: Heritage | None = None
    ) -> None:
        attach_futures(waitable, self._executor)
        self._ready(waitable, waitable.execute, data, heritage)

    def _ready(
        self, waitable: Any, function: Callable[[Any], Any], argument: Any,
        heritage: Heritage | None = None,
    ) -> None:
        entity = self._registry.by_id.get(id(waitable))
        if entity is not None and not entity.removed:
            work = Work(entity, function, (argument,))
            work.heritage = heritage
            self._loop.engine.posted(work, self._loop.now)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Actions between nodes of the run: goals, results, feedback and status without a middleware.

rclpy's action clients and servers do all by themselves but for sending and taking. What they send
(methods of their handles) is kept, and goes, when the callback that sends it ends or waits, to the
other side as what it would have taken. Goals are known by the middleware's own bookkeeping, which
stays in use; results do not expire.
"""

from __future__ import annotations

from collections.abc import Callable
import copy
from functools import partial
import itertools
from typing import Any

from mddag_executor.executor.compat import attach_futures
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.work import Work
from mddag_executor.replacements import instead, Replacements
from mddag_executor.rerun.compat import (
    action_handle,
    CLIENT_HANDLE,
    feedback_callback,
    goal_states,
    SERVER_HANDLE,
)
from mddag_executor.rerun.loop import Loop
from mddag_executor.rerun.services import Header

_KINDS = ('goal', 'cancel', 'result')


class Actions:
    """
    Carries what action clients and servers send.

    :param executor: runs the callbacks of futures.
    :param entities: what the run keeps for each entity, by the ``id`` of that.
    """

    def __init__(
        self, loop: Loop, executor: Any, entities: Callable[[], dict[int, Entity]],
        warn: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._executor = executor
        self._entities = entities
        self._warn = warn
        self._clients: dict[int, tuple[str, Any]] = {}
        self._servers: dict[int, tuple[str, Any]] = {}
        self._numbers = itertools.count(1)

    def install(self, replacements: Replacements) -> None:
        """Have action clients and servers use this."""
        from rclpy.action.client import ActionClient  # late: it loads much
        from rclpy.action.server import ActionServer
        replace = replacements.replace
        replace(ActionClient, '__init__', partial(self._made, self._clients))
        replace(ActionServer, '__init__', partial(self._made, self._servers))
        replace(ActionClient, 'wait_for_server', instead(self.wait_for_server))
        replace(CLIENT_HANDLE, 'is_action_server_available', instead(self._is_offered))
        for kind in _KINDS:
            replace(CLIENT_HANDLE, f'send_{kind}_request', instead(partial(self._ask, kind)))
            replace(SERVER_HANDLE, f'send_{kind}_response', instead(partial(self._answer, kind)))
        replace(SERVER_HANDLE, 'publish_feedback', instead(self._feedback))
        replace(SERVER_HANDLE, 'publish_status', instead(self._status))

    def _made(
        self, known: dict[int, tuple[str, Any]], original: Callable[..., None]
    ) -> Callable[..., None]:
        """Return a constructor that keeps by which name an action is known."""
        def construct(
            waitable: Any, node: Any, action_type: Any, action_name: str, *args: Any, **more: Any
        ) -> None:
            original(waitable, node, action_type, action_name, *args, **more)
            name = node.resolve_service_name(f'{action_name}/_action/send_goal')
            known[id(action_handle(waitable))] = name.removesuffix('/_action/send_goal'), waitable

        return construct

    def knows(self, waitable: Any) -> bool:
        """Return whether a waitable is an action client or server."""
        return any(each is waitable for known in (self._clients, self._servers)
                   for _, each in known.values())

    # --- what clients send -----------------------------------------------------------------------

    def _server(self, name: str) -> Any:
        return next((server for known, server in self._servers.values()
                     if known == name and id(server) in self._entities()), None)

    def _is_offered(self, handle: Any) -> bool:
        name, _ = self._clients[id(handle)]
        return self._server(name) is not None

    def wait_for_server(self, client: Any, timeout_sec: float | None = None) -> bool:
        """Wait until a client's action is offered."""
        handle = action_handle(client)
        return self._loop.wait(
            lambda: self._is_offered(handle), self._loop.deadline_after(timeout_sec),
            f'for action {self._clients[id(handle)][0]}')

    def _ask(self, kind: str, handle: Any, request: Any) -> int:
        number = next(self._numbers)
        name, client = self._clients[id(handle)]
        asked = copy.deepcopy(request)

        def leave() -> None:
            server = self._server(name)
            if server is None:
                self._warn(f'{name}: it is called, and no node of the run offers this action')
            else:
                self._take(server, {kind: ((client, number), asked)})

        self._loop.call_at_end(leave)
        return number

    # --- what servers send -----------------------------------------------------------------------

    def _answer(self, kind: str, handle: Any, header: Header, response: Any) -> None:
        client, number = header
        answered = copy.deepcopy(response)
        self._loop.call_at_end(lambda: self._take(client, {kind: (number, answered)}))

    def _clients_of(self, handle: Any) -> list[Any]:
        name, _ = self._servers[id(handle)]
        return [client for known, client in self._clients.values() if known == name]

    def _feedback(self, handle: Any, message: Any) -> None:
        sent = copy.deepcopy(message)

        def leave() -> None:
            for client in self._clients_of(handle):
                callback = feedback_callback(client, sent)
                if callback is not None:
                    self._ready(client, callback, copy.deepcopy(sent))

        self._loop.call_at_end(leave)

    def _status(self, handle: Any) -> None:
        from action_msgs.msg import GoalStatus, GoalStatusArray
        _, server = self._servers[id(handle)]
        message = GoalStatusArray(status_list=[
            GoalStatus(goal_info=info, status=status) for info, status in goal_states(server)])

        def leave() -> None:
            for client in self._clients_of(handle):
                self._take(client, {'status': message})

        self._loop.call_at_end(leave)

    # --- what arrives ----------------------------------------------------------------------------

    def _take(self, waitable: Any, data: dict[str, Any]) -> None:
        attach_futures(waitable, self._executor)
        self._ready(waitable, waitable.execute, data)

    def _ready(self, waitable: Any, function: Callable[[Any], Any], argument: Any) -> None:
        entity = self._entities().get(id(waitable))
        if entity is not None and not entity.removed:
            engine = self._loop.engine
            engine.ready(Work(entity, function, (argument,)), self._loop.now)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What a rerun uses of rclpy beyond its documented interface, to send requests without a middleware.

``mddag_executor.executor.compat`` has the rest, and says which versions are meant.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.task import Future

CLIENT_HANDLE: Any = _rclpy.ActionClient
"""The class of an action client's handle: its methods send requests."""
SERVER_HANDLE: Any = _rclpy.ActionServer
"""That of an action server's: its methods send responses, feedback and status."""


def new_request(client: Any, number: int) -> Future:
    """Return the future of a request with a number, as ``Client.call_async`` makes it."""
    future = Future()
    with client._lock:
        client._pending_requests[number] = future
    future.add_done_callback(client.remove_pending_request)
    return future


def action_handle(waitable: Any) -> Any:
    """Return the handle of an action client or server."""
    return waitable._client_handle if hasattr(waitable, '_client_handle') else waitable._handle


def goal_states(server: Any) -> Iterator[tuple[Any, int]]:
    """Yield the goals (``GoalInfo``) that an action server knows, with their status."""
    for goal in list(server._goal_handles.values()):
        handle = goal._goal_handle
        if handle is not None:  # not by its property: that takes a lock that may be locked here
            yield goal._goal_info, handle.get_status()


def has_result(server: Any, info: Any) -> bool:
    """Return whether an action server keeps the result of a goal (``GoalInfo``)."""
    future = server._result_futures.get(bytes(info.goal_id.uuid))
    return future is not None and future.done()

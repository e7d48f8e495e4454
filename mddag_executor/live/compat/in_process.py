# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a rerun uses of rclpy beyond its documented interface: requests without a middleware."""

from __future__ import annotations

from typing import Any

from rclpy.task import Future


def new_request(client: Any, number: int) -> Future:
    """Return the future of a request with a number, as ``Client.call_async`` makes it."""
    future = Future()
    with client._lock:
        client._pending_requests[number] = future
    future.add_done_callback(client.remove_pending_request)
    return future

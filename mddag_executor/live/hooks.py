# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Two places in rclpy where the executor must know what a callback does.

``Publisher.publish``: a message's job is found by when its predecessor published it, and a trace
holds publications.  ``Client.call``: a callback that waits for a service lends its worker's place
to a spare thread.  Both are wrapped once for the process, when the first executor is made; outside
of this executor's callbacks they do what they always did.
"""

from __future__ import annotations

import threading
from time import time_ns
from typing import Any, Protocol

from mddag_executor.live.attribution import PublisherState
from rclpy.client import Client
from rclpy.publisher import Publisher


class Running(Protocol):
    """What runs in a thread, as far as the hooks need it."""

    def publish(self, send: Any, publisher: Any, msg: Any, state: PublisherState) -> None:
        """Send a message on behalf of the running callback."""

    def ends_soon(self, dispatcher: Any) -> bool:
        """
        Return whether this callback has ended soon after it published, the last times.

        And is of this dispatcher.
        """

    def waits(self) -> Any:
        """Return a context manager that lends the worker's place while it is entered."""


class _Thread(threading.local):
    running: Running | None = None


current = _Thread()
"""``current.running``: the execution whose callback runs in the calling thread, or None."""

_STATE = '_mddag_publisher_state'
_installed = threading.Lock()
_done = False


def publisher_state(publisher: Any) -> PublisherState:
    """Return what is kept for a publisher."""
    state: PublisherState | None = publisher.__dict__.get(_STATE)
    if state is None:
        state = publisher.__dict__.setdefault(_STATE, PublisherState(publisher.topic_name))
    return state


def install() -> None:
    """Wrap rclpy's two methods; further calls change nothing."""
    global _done
    with _installed:
        if _done:
            return
        _done = True
    send = Publisher.publish
    call = Client.call

    def publish(self: Any, msg: Any) -> None:
        state = publisher_state(self)
        begin = time_ns()
        with state.lock:
            state.count += 1
            running = current.running
            if running is None:
                send(self, msg)
            else:
                running.publish(send, self, msg, state)
        for takes in state.takes:  # looked up after it is sent: see ``direct``
            takes.take(begin)

    def call_and_wait(self: Any, request: Any, *args: Any, **kwargs: Any) -> Any:
        running = current.running
        if running is None:
            return call(self, request, *args, **kwargs)
        with running.waits():
            return call(self, request, *args, **kwargs)

    publish.__doc__ = send.__doc__
    call_and_wait.__doc__ = call.__doc__
    Publisher.publish = publish  # type: ignore[method-assign]
    Client.call = call_and_wait  # type: ignore[method-assign]

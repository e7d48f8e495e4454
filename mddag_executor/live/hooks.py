# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Two places in rclpy where the executor must know what a callback does.

``Publisher.publish``: a message's job is found by when its predecessor published it, and a trace
holds publications.  ``Client.call``: a callback that waits for a service lends its worker's place
to a spare thread.  Both are wrapped once for the process, when the first executor is made; outside
of this executor's callbacks they do what they always did.

A signal's handler may publish, in the main thread, which may hold any lock just then: of a
publisher, of a subscription, of the engine.  So a publisher's lock is reentrant, and publications
of the main thread are delivered by another one (see ``inline``).
"""

from __future__ import annotations

import threading
from time import time_ns
from typing import Any

from mddag_executor.live.jobs import PublisherState
from mddag_executor.live.seat import current
from rclpy.client import Client
from rclpy.publisher import Publisher

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
        with state.lock:
            state.count += 1
            begin = time_ns()
            running = current.running
            try:
                if running is None:
                    send(self, msg)
                else:
                    running.publish(send, self, msg, state, begin)
            except BaseException:
                state.count -= 1  # the middleware has not counted it
                raise
        for deliver in state.deliver:  # looked up after it is sent: see ``inline``
            deliver(begin)

    def call_and_wait(self: Any, request: Any, *args: Any, **kwargs: Any) -> Any:
        running = current.running
        if running is None:
            return call(self, request, *args, **kwargs)
        with running.lend():
            return call(self, request, *args, **kwargs)

    publish.__doc__ = send.__doc__
    call_and_wait.__doc__ = call.__doc__
    Publisher.publish = publish  # type: ignore[method-assign]
    Client.call = call_and_wait  # type: ignore[method-assign]

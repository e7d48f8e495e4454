# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The epoll, and who waits in it: nobody is forgotten, whatever is removed or fails."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from mddag_executor.executor.loop import ALWAYS, EventLoop
import pytest
from std_msgs.msg import Header

from .conftest import Spinning, wait_for


def test_a_worker_that_fails_where_it_waits_is_replaced(make_executor, make_node):
    node, got = make_node(), []
    node.create_subscription(Header, '/a', got.append, 10)
    publisher = node.create_publisher(Header, '/a', 10)
    executor = make_executor(num_workers=2, nodes=[node])
    loop = executor._pool.loop
    wait, fails = loop.wait, [OSError('no more')]

    def failing(timeout_s: float = -1) -> Any:
        if timeout_s < 0 and fails:
            raise fails.pop()
        return wait(timeout_s)

    loop.wait = failing
    with pytest.raises(OSError, match='no more'):
        executor.spin()
    with Spinning(executor):
        publisher.publish(Header())
        assert wait_for(lambda: got)


class Gone:
    """A source that is removed while it is held, and whose descriptor another one has got."""

    urgency = ALWAYS

    def __init__(self, fd: int) -> None:
        self._fds = [-1, fd]

    @property
    def fd(self) -> int:
        return self._fds.pop() if len(self._fds) > 1 else self._fds[0]


def test_a_source_that_is_held_when_it_is_removed_holds_nobody_else():
    loop = EventLoop()
    source = SimpleNamespace(fd=-1, urgency=ALWAYS, asks_others=False)
    loop.add(source)
    loop.wait(0)
    loop.hold([Gone(source.fd)])
    loop.announce(source)
    assert loop.sources(loop.wait(0)) == ([source], [], False)
    loop.remove(source)
    loop.close()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Workers are less nice the more urgent what they run is, where the user may."""

from __future__ import annotations

import os
import threading
from typing import Any

from mddag_executor.live import executor as module
from mddag_executor.live.cpu_order import CLASSES, why_not
from msg_graph import loads
import pytest
from std_msgs.msg import Header

from .conftest import Spinning, wait_for

GRAPH = """
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: urgent, subscription: /urgent, period: 1ms, dag: a, deadline: 1us}
      - {name: relaxed, subscription: /relaxed, period: 1ms, dag: b, deadline: 100s}
"""


def levels(make_executor: Any, make_node: Any) -> dict[str, set[int]]:
    """Return the nice levels that callbacks ran at, turn and turn about on one worker."""
    executor = make_executor(loads(GRAPH), num_workers=1, cpu_order=True)
    node = make_node('n')
    found: dict[str, set[int]] = {}
    ran: list[str] = []

    def note(name: str) -> None:
        if threading.current_thread().name.startswith('mddag-worker'):
            found.setdefault(name, set()).add(os.getpriority(os.PRIO_PROCESS, 0))
        ran.append(name)

    names = ('urgent', 'relaxed', 'other')
    for name in names:
        node.create_subscription(Header, f'/{name}', lambda message, name=name: note(name), 10)
    publishers = {name: node.create_publisher(Header, f'/{name}', 10) for name in names}
    executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: all(p.get_subscription_count() for p in publishers.values()))
        for number, name in enumerate(names * 4, 1):
            publishers[name].publish(Header())
            assert wait_for(lambda number=number: len(ran) == number)  # type: ignore[misc]
    return found


@pytest.mark.skipif(why_not() is not None, reason='threads may not be made less nice here')
def test_workers_are_as_nice_as_what_they_run_is_urgent(
        make_executor: Any, make_node: Any) -> None:
    base = os.getpriority(os.PRIO_PROCESS, 0)
    found = levels(make_executor, make_node)
    assert found['urgent'] == {max(-20, base - CLASSES[0][1])}
    assert found['relaxed'] == found['other'] == {base}
    assert os.getpriority(os.PRIO_PROCESS, 0) == base


def test_it_is_off_where_the_user_may_not(
        make_executor: Any, make_node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, 'why_not', lambda: 'not permitted')
    base = os.getpriority(os.PRIO_PROCESS, 0)
    assert all(each == {base} for each in levels(make_executor, make_node).values())

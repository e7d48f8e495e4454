# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Deadlines by critical path."""

from __future__ import annotations

from mddag_executor.laboratory.assign_deadlines import proportional
from msg_graph import loads
import pytest

GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 20ms, publishes: [/a, /b], dag: one, execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 5ms, execution_time: 1ms}
      - name: y
        subscription: /b
        deadline: 50ms
        execution_time: {quantiles_us: [1000, 3000, 9000], percent: [0, 50, 100]}
      - {name: z, timer: 10ms, deadline: 10ms, dag: two, execution_time: 1ms}
"""


def test_proportional() -> None:
    task_set = loads(GRAPH)
    # To x it is 2 ms, to y 1 ms + 9 ms.
    assert proportional(task_set, 'max') == {
        '/n:x': 4_000_000, '/n:y': 20_000_000, '/n:z': 10_000_000}
    assert proportional(task_set, 'mean')['/n:x'] == 8_000_000
    with pytest.raises(Exception, match='no such budget'):
        proportional(task_set, 'median')


def test_a_callback_that_is_several_sinks() -> None:
    task_set = loads("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 20ms, publishes: [/a], dag: one, execution_time: 3ms}
      - {name: b, timer: 40ms, publishes: [/a], dag: two, execution_time: 1ms}
      - {name: s, subscription: /a, deadline: 5ms, execution_time: 1ms}
""")
    assert proportional(task_set, 'max') == {'/n:s': 20_000_000}

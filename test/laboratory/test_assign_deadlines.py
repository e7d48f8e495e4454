# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Deadlines by critical path and by search."""

from dataclasses import replace

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.acceptance import wilson
from mddag_executor.laboratory.assign_deadlines import (
    measure,
    PRECISION,
    proportional,
    scaled,
    search,
)
from mddag_executor.laboratory.evaluate import Experiment
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
#: /n:s is a sink of both DAGs.
SHARED = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 20ms, publishes: [/a], dag: one, execution_time: 3ms}
      - {name: b, timer: 40ms, publishes: [/a], dag: two, execution_time: 1ms}
      - {name: s, subscription: /a, deadline: 5ms, execution_time: 1ms}
"""


def experiment(**changes):
    return replace(Experiment(
        loads(GRAPH), ('rad',), workers=1, duration_ns=200_000_000), **changes)


def test_proportional_and_scaled():
    # To x it is 2 ms, to y 1 ms + 9 ms.
    assert proportional(loads(GRAPH), 'max') == {
        '/n:x': 4_000_000, '/n:y': 20_000_000, '/n:z': 10_000_000}
    assert proportional(loads(GRAPH), 'mean')['/n:x'] == 8_000_000
    with pytest.raises(UsageError, match="budget 'median': there is no such budget"):
        proportional(loads(GRAPH), 'median')
    assert proportional(loads(SHARED), 'max') == {'/n:s': 20_000_000}
    assert scaled(loads(GRAPH), 'max', 1.5) == {
        '/n:x': 3_000_000, '/n:y': 15_000_000, '/n:z': 1_500_000}
    assert scaled(loads(GRAPH), 'max', 1e-9)['/n:x'] == 1_000
    assert scaled(loads(SHARED), 'max', 2.0) == {'/n:s': 8_000_000}


def test_search_finds_the_tightest_scale():
    """The scale is good, one that is 1 % smaller is not; what is reported had no part in it."""
    found = search(experiment(seed=3), 0.9, 'mean', runs=200)
    assert found.deadlines == scaled(loads(GRAPH), 'mean', found.scale)
    tried = dict(found.tried)
    assert tried[found.scale].ratio < 1.0  # acceptance grows bit by bit
    assert wilson(tried[found.scale].accepted, 200)[0] >= 0.9
    below = max(scale for scale in tried if scale < found.scale)
    assert found.scale <= below * (1 + PRECISION)
    assert tried[below].interval[0] < 0.9
    assert {each.seed for each in tried.values()} == {3}
    again = measure(experiment(seed=4), found.deadlines, 200)
    assert (found.check, found.check.seed) == (again, 4)
    low, high = found.check.interval
    assert low <= found.check.ratio <= high


@pytest.mark.parametrize(('others', 'scale'), [
    ('', 1.0),  # just its critical path is enough, and nothing less
    ('- {name: u, timer: 20ms, dag: u, deadline: 9ms, execution_time: 1ms}', 1.5)])
def test_scale_by_hand(others, scale):
    """One callback takes always 2 ms, alone or next to one that is more urgent."""
    task_set = loads(f"""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {{name: s, timer: 20ms, dag: s, deadline: 9ms, execution_time: 2ms}}
      {others}
""")
    found = search(experiment(task_set=task_set), 0.5, runs=10)
    assert scale <= found.scale <= scale * (1 + PRECISION)
    assert found.deadlines['/n:s'] == pytest.approx(scale * 2_000_000, rel=PRECISION)

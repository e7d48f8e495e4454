# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Deadlines by critical path and by search."""

from dataclasses import replace

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.acceptance import wilson
from mddag_executor.laboratory.assign_deadlines import (
    least_runs,
    measure,
    PRECISION,
    scaled,
    search,
)
from mddag_executor.laboratory.evaluate import Experiment
from msg_graph import loads
import pytest

from .graphs import GRAPH, SHARED


def experiment(**changes):
    return replace(Experiment(
        loads(GRAPH), ('rad',), workers=1, duration_ns=200_000_000), **changes)


def test_scaled():
    assert scaled(loads(GRAPH), 'max', 1.5) == {
        '/n:x': 3_000_000, '/n:y': 15_000_000, '/n:z': 1_500_000}
    assert scaled(loads(GRAPH), 'max', 1e-9)['/n:x'] == 1_000


def test_a_callback_that_is_several_sinks():
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


def test_scale_by_hand():
    """
    One callback alone, always 2 ms: just its critical path is enough, and nothing less.

    Beside it runs what is more urgent and takes 1 ms: then it takes 1.5 of its path.
    """
    alone = loads("""\
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: s, timer: 20ms, deadline: 9ms, execution_time: 2ms}]}
""")
    base = Experiment(alone, ('rad',), workers=1, duration_ns=200_000_000)
    found = search(base, 0.5, runs=10)
    assert 1.0 <= found.scale <= 1.0 + PRECISION
    assert found.deadlines['/n:s'] == pytest.approx(2_000_000, rel=PRECISION)
    both = loads("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: s, timer: 20ms, dag: s, deadline: 9ms, execution_time: 2ms}
      - {name: u, timer: 20ms, dag: u, deadline: 9ms, execution_time: 1ms}
""")
    found = search(replace(base, task_set=both), 0.5, runs=10)
    assert 1.5 <= found.scale <= 1.5 * (1 + PRECISION)


def test_overload_reaches_nothing():
    busy = loads(GRAPH.replace('timer: 10ms', 'timer: 1ms'))
    with pytest.raises(UsageError, match='no scale with deadlines up to half of a run '):
        search(experiment(task_set=busy), 0.9, runs=50)


@pytest.mark.parametrize('target', [0.001, 0.5, 0.9, 0.95, 0.99, 0.999])
def test_least_runs(target):
    runs = least_runs(target)
    assert wilson(runs, runs)[0] >= target
    assert runs == 1 or wilson(runs - 1, runs - 1)[0] < target


def test_targets_that_cannot_be_shown():
    with pytest.raises(UsageError, match='0.99: 50 runs cannot show it: give --runs 381'):
        search(experiment(), 0.99, runs=50)
    for target in (0.0, 1.0, 1.5, float('nan')):
        with pytest.raises(UsageError, match='it is out of range'):
            search(experiment(), target)

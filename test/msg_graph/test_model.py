# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Execution times, look-ups, and that nothing can be changed."""

from __future__ import annotations

import copy
from dataclasses import fields, FrozenInstanceError
import pickle

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import ExecutionTime, GraphError, TaskSet
import pytest

from .helpers import graph

TWO = """
- node: /a
  callbacks:
    - {name: t, timer: 10ms, publishes: [/x], dag: first}
- node: /b
  callbacks:
    - {name: t, timer: 20ms, publishes: [/x]}
- node: /c
  callbacks:
    - {name: s, subscription: /x, deadline: 5ms}
"""


def distribution(ns: list[int], percent: list[float]) -> ExecutionTime:
    return ExecutionTime(tuple(ns), tuple(percent))


def test_draws_between_the_quantiles() -> None:
    time = distribution([100, 200, 400], [0.0, 50.0, 100.0])
    assert [time.draw(u) for u in (0.0, 0.25, 0.5, 0.75, 1.0)] == [100, 150, 200, 300, 400]
    assert time.mean_ns == 225


def test_is_flat_beyond_the_outer_quantiles() -> None:
    time = distribution([100, 200], [25.0, 75.0])
    assert [time.draw(u) for u in (0.0, 0.25, 0.5, 0.75, 1.0)] == [100, 100, 150, 200, 200]
    assert time.mean_ns == 150


@pytest.mark.parametrize('u', [-0.1, 1.1, float('nan'), float('inf')])
def test_draws_only_from_shares(u: float) -> None:
    with pytest.raises(ValueError):
        distribution([1, 2], [0.0, 100.0]).draw(u)


@given(
    st.lists(st.tuples(st.integers(0, 10 ** 9), st.floats(0, 100)), min_size=1, max_size=9,
             unique_by=lambda pair: pair[1]))
def test_mean_is_that_of_the_draws(pairs: list[tuple[int, float]]) -> None:
    percent = sorted(share for _, share in pairs)
    time = distribution(sorted(ns for ns, _ in pairs), percent)
    steps = 2_000
    drawn = [time.draw((i + 0.5) / steps) for i in range(steps)]
    assert drawn == sorted(drawn)
    assert all(time.quantiles_ns[0] <= ns <= time.quantiles_ns[-1] for ns in drawn)
    spread = time.quantiles_ns[-1] - time.quantiles_ns[0]
    assert abs(sum(drawn) / steps - time.mean_ns) <= 1 + spread * len(pairs) / steps


def test_looks_up_by_name() -> None:
    tasks = graph(TWO)
    assert tasks.dag('first').index == 0
    assert tasks.dag('/b').index == 1
    assert tasks.vertex('/a:t').dag == 0
    assert tasks.vertex('/c:s@first').dag == 0
    assert tasks.vertex('/c:s@/b').dag == 1
    assert tasks.callback('/c:s').deadline_ns == 5_000_000
    assert [vertex.name for vertex in tasks.vertices] == [
        '/a:t', '/c:s@first', '/b:t', '/c:s@/b']
    for lookup in (tasks.dag, tasks.vertex, tasks.callback):
        with pytest.raises(KeyError):
            lookup('/c:t')


def test_nothing_can_be_changed() -> None:
    tasks = graph(TWO)
    for thing in (
        tasks, tasks.dags[0], tasks.vertices[0], tasks.callbacks[0],
        distribution([1], [50.0]),
    ):
        for field in fields(thing):
            with pytest.raises(FrozenInstanceError):
                setattr(thing, field.name, None)
        hash(thing)


@pytest.mark.parametrize('clone', [copy.copy, copy.deepcopy, lambda x: pickle.loads(
    pickle.dumps(x))])
def test_copies_are_equal_and_work(clone) -> None:  # type: ignore[no-untyped-def]
    tasks = graph(TWO)
    other: TaskSet = clone(tasks)
    assert other == tasks
    assert other.vertex('/a:t') == tasks.vertex('/a:t')


def test_error_survives_pickling() -> None:
    error = GraphError('f.yaml', 3, 'what', 'do')
    other = pickle.loads(pickle.dumps(error))
    assert str(other) == 'f.yaml:3: what: do'
    assert (other.file, other.line, other.problem, other.remedy) == ('f.yaml', 3, 'what', 'do')

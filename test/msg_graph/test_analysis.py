# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Topological order, longest paths and load."""

from __future__ import annotations

from itertools import permutations

from hypothesis import given
from hypothesis import strategies as st
from msg_graph import Dag, loads, model

from .helpers import graph

DIAMOND = graph("""
- node: /n
  callbacks:
    - {name: end, sync: [/c, /d], deadline: 9ms, execution_time: 1ms}
    - {name: c, subscription: /a, publishes: [/c], execution_time: 5ms}
    - {name: t, timer: 10ms, publishes: [/a], execution_time: {quantiles_us: [1000, 3000]}}
    - {name: d, subscription: /a, publishes: [/d], execution_time: 4ms}
    - {name: other, subscription: /a, deadline: 9ms, execution_time: 7ms}
""").dags[0]


def test_diamond() -> None:
    order = model.topological_order(DIAMOND)
    assert sorted(order) == [0, 1, 2, 3, 4]
    assert all(order.index(a) < order.index(b) for a, b in DIAMOND.edges)
    means = model.mean_execution_times(DIAMOND)
    assert means == [1_000_000, 5_000_000, 2_000_000, 4_000_000, 7_000_000]
    assert model.path_lengths(DIAMOND, means) == [
        8_000_000, 7_000_000, 2_000_000, 6_000_000, 9_000_000]
    assert model.load_of(DIAMOND) == 1.9


def test_unknown_where_an_execution_time_is_missing() -> None:
    dag = graph("""
        - node: /n
          callbacks:
            - {name: t, timer: 10ms, publishes: [/a], execution_time: 1ms}
            - {name: s, subscription: /a, deadline: 1ms}
    """).dags[0]
    assert model.mean_execution_times(dag) is None
    assert model.load_of(dag) is None


@st.composite
def weighted(draw: st.DrawFn) -> tuple[Dag, list[int]]:
    """Draw a DAG of up to seven vertices, in a random file order, with weights."""
    count = draw(st.integers(1, 7))
    order = draw(st.permutations(range(count)))
    before = {i: draw(st.sets(st.integers(0, i - 1), min_size=1)) for i in range(1, count)}
    lines = ['mddag: 1', 'nodes:', '- node: /n', '  callbacks:']
    for i in order:
        start = 'timer: 10ms'
        if i:
            topics = [f'/t{b}' for b in sorted(before[i])]
            start = (f'sync: [{", ".join(topics)}]' if len(topics) > 1
                     else f'subscription: {topics[0]}')
        sink = not any(i in each for each in before.values())
        lines.append(
            f'  - {{name: c{i}, {start}, publishes: [/t{i}]{", deadline: 1ms" * sink}}}')
    weights = draw(st.lists(st.integers(0, 9), min_size=count, max_size=count))
    return loads('\n'.join(lines)).dags[0], weights


@given(weighted())
def test_path_lengths_are_those_of_all_paths(case: tuple[Dag, list[int]]) -> None:
    dag, weights = case
    best = 0
    for length in range(len(dag.vertices)):
        for rest in permutations(range(len(dag.vertices)), length + 1):
            if all(step in dag.edges for step in zip(rest, rest[1:])):
                best = max(best, sum(weights[i] for i in rest))
    assert max(model.path_lengths(dag, weights)) == best

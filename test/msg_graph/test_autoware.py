# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The workloads that ship: the paper's, and the same with unequal deadlines.

The facts are those of the public evaluation repository 2024_RTSS_WiP_Evaluation of Yano and Azumi
(RTSS 2024 work in progress).
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from msg_graph import load, model
from msg_graph.edit import with_deadlines, without_lines
import pytest

CONFIG = Path(__file__).resolve().parents[2] / 'config'
MS = 1_000_000


@pytest.fixture(scope='module')
def autoware():
    return load(CONFIG / 'autoware.yaml')


def test_the_graph_is_that_of_the_facts(autoware):
    assert [dag.name for dag in autoware.dags] == list(DAGS)
    assert (len(autoware.vertices), len(autoware.callbacks), autoware.workers) == (86, 84, 7)
    for dag, facts in zip(autoware.dags, DAGS.values()):
        listed = [tuple(map(int, edge.split('-'))) for edge in facts.edges.split()]
        assert (dag.period_ns, dag.edges) == (facts.period * MS, tuple(sorted(listed)))
        assert {i: dag.vertices[i].deadline_ns for i in dag.sinks} == {
            i: deadline * MS for i, deadline in facts.deadlines.items()}
        assert (dag.source, dag.vertices[0].callback.kind) == (0, 'timer')
        for vertex in dag.vertices:
            assert vertex.successors == tuple(b for a, b in listed if a == vertex.index)
            assert (vertex.callback.kind == 'sync') == (len(vertex.predecessors) > 1)
        times = [v.callback.execution_time for v in dag.vertices if v.callback.execution_time]
        assert {len(time.percent) for time in times} == {29}
        assert facts.times_ns == tuple(
            sum(time.quantiles_ns[place] for time in times) for place in (0, 14, 23, 28))
    # On seven cores the mean load is about that of the paper's most frequent runs, 0.7.
    shares = [model.load_of(dag) for dag in autoware.dags]
    assert sum(share for share in shares if share) / 7 == pytest.approx(0.729, abs=0.001)


def test_only_deadlines_differ(autoware):
    multi = load(CONFIG / 'autoware_multi.yaml')
    assert without_lines(multi) == replace(without_lines(with_deadlines(autoware, {
        callback.key: callback.deadline_ns for callback in multi.callbacks
        if callback.deadline_ns is not None})), file=multi.file)
    assert {dag.name for one, dag in zip(autoware.dags, multi.dags)
            if [v.deadline_ns for v in one.vertices] != [v.deadline_ns for v in dag.vertices]
            } == {'control', 'imu', 'perception', 'vehicle'}


def test_the_reference_system_as_described():
    task_set = load(CONFIG / 'reference_system.yaml')
    callbacks = task_set.callbacks
    assert len({callback.node for callback in callbacks}) == 24
    assert sorted(c.timer_period_ns // MS for c in callbacks if c.kind == 'timer') == [
        25, 60, 100, 100, 100, 100, 120]
    planner = [c.kind for c in callbacks if c.node == '/BehaviorPlanner']
    assert sorted(planner) == ['subscription'] * 6 + ['timer']
    busy = {c.key: c.execution_time.mean_ns for c in callbacks if c.execution_time is not None}
    path, = task_set.paths
    assert set(busy.values()) == {10 * MS} and len(busy.keys() & set(path.callbacks)) == 7


class Facts(NamedTuple):
    """A DAG: times in ms, edges as `before-after`, sums of execution times over its vertices."""

    period: int
    deadlines: dict[int, int]
    edges: str
    times_ns: tuple[int, int, int, int]     # the least, median, 95 % and largest ones


LIDAR = '0-1 1-2 2-3 3-4 4-5'
DAGS = {
    'control': Facts(
        30, {1: 30, 4: 30}, '0-1 0-2 2-3 3-4', (807903, 2920638, 5747682, 39062613)),
    'ekf_localizer': Facts(
        20, {1: 20, 3: 20}, '0-1 0-2 2-3', (423658, 1835160, 4495333, 72194902)),
    'gnss': Facts(1000, {1: 1000}, '0-1', (357721, 528364, 1664455, 7632621)),
    'imu': Facts(33, {2: 33, 3: 33}, '0-1 1-2 1-3', (112438, 284140, 443487, 11996958)),
    'left_lidar': Facts(100, {5: 50}, LIDAR, (1144142, 2292181, 17157469, 111459736)),
    'perception': Facts(
        100, {15: 300, 29: 300, 30: 300, 33: 300},
        '0-1 1-2 0-3 0-4 0-5 2-9 2-12 3-8 9-8 8-12 4-6 5-7 7-13 13-14 14-15 6-10 12-7 12-27 '
        '27-30 7-11 11-10 11-31 11-26 26-25 31-23 25-23 23-18 23-24 18-32 32-19 24-22 22-18 '
        '18-17 17-16 10-16 16-19 19-20 20-21 21-28 28-33 28-29',
        (16458702, 227287426, 566723492, 1774635385)),
    'planning': Facts(
        100, {8: 300}, '0-1 1-2 2-3 3-4 4-5 5-6 6-7 7-8',
        (5803639, 107104443, 234927906, 766971240)),
    'rear_lidar': Facts(100, {5: 50}, LIDAR, (320769, 620889, 11191586, 83748921)),
    'right_lidar': Facts(100, {5: 50}, LIDAR, (1229037, 2347447, 19887237, 107568512)),
    'top_lidar': Facts(100, {5: 100}, LIDAR, (31166006, 74348754, 140170156, 479285918)),
    'vehicle': Facts(33, {2: 33, 3: 33}, '0-1 1-2 1-3', (107797, 248618, 409208, 16251888)),
}

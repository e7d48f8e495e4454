# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The workloads that ship: the paper's, and the same with unequal deadlines.

The facts are those of the public evaluation repository 2024_RTSS_WiP_Evaluation of Yano and Azumi
(RTSS 2024 work in progress).
"""

from pathlib import Path
from typing import NamedTuple

from msg_graph import load, model
import pytest

CONFIG = Path(__file__).resolve().parents[2] / 'config'
UNEQUAL = ('control', 'imu', 'perception', 'vehicle')
MS = 1_000_000


@pytest.fixture(scope='module')
def autoware():
    return load(CONFIG / 'autoware.yaml')


@pytest.fixture(scope='module')
def multi():
    return load(CONFIG / 'autoware_multi.yaml')


def test_the_graph_is_that_of_the_facts(autoware):
    tasks = autoware
    assert [dag.name for dag in tasks.dags] == list(DAGS)
    assert (len(tasks.dags), len(tasks.vertices), len(tasks.callbacks)) == (11, 86, 84)
    assert tasks.workers == 7
    for dag, facts in zip(tasks.dags, DAGS.values()):
        assert dag.period_ns == facts.period * MS
        assert ' '.join(f'{a}-{b}' for a, b in dag.edges) == ' '.join(
            sorted(facts.edges.split(), key=lambda edge: [int(i) for i in edge.split('-')]))
        listed = [edge.split('-') for edge in facts.edges.split()]
        for vertex in dag.vertices:
            assert vertex.successors == tuple(
                int(after) for before, after in listed if int(before) == vertex.index)
        assert dag.sinks == tuple(facts.deadlines)
        assert [dag.vertices[i].deadline_ns for i in dag.sinks] == [
            deadline * MS for deadline in facts.deadlines.values()]
        assert dag.source == 0
        assert dag.vertices[0].callback.kind == 'timer'
        for vertex in dag.vertices:
            assert (vertex.callback.kind == 'sync') == (len(vertex.predecessors) > 1)
        times = [v.callback.execution_time for v in dag.vertices]
        for place, total in zip((0, 14, 23, 28), facts.times_ns):
            assert sum(time.quantiles_ns[place] for time in times if time) == total
        assert {len(time.percent) for time in times if time} == {29}


def test_load_is_that_of_the_paper(autoware):
    """On seven cores the mean load is about that of the paper's most frequent runs, 0.7."""
    shares = [model.load_of(dag) for dag in autoware.dags]
    assert sum(share for share in shares if share) / 7 == pytest.approx(0.729, abs=0.001)


def test_only_deadlines_differ(autoware, multi):
    assert multi.queue_edges == autoware.queue_edges
    assert multi.paths == autoware.paths
    for one, other in zip(autoware.dags, multi.dags):
        same = [v.deadline_ns for v in one.vertices] == [v.deadline_ns for v in other.vertices]
        assert same == (one.name not in UNEQUAL)
        for v, w in zip(one.vertices, other.vertices):
            assert (v.name, v.predecessors, v.callback.execution_time) == (
                w.name, w.predecessors, w.callback.execution_time)


def test_the_reference_system_as_described():
    task_set = load(CONFIG / 'reference_system.yaml')
    callbacks = task_set.callbacks
    assert len({callback.node for callback in callbacks}) == 24
    timers = {c.node: c.timer_period_ns for c in callbacks if c.kind == 'timer'}
    assert sorted(timers.values()) == [ms * MS for ms in (25, 60, 100, 100, 100, 100, 120)]
    planner = [c for c in callbacks if c.node == '/BehaviorPlanner']
    assert sorted(c.kind for c in planner) == ['subscription'] * 6 + ['timer']
    busy = [c for c in callbacks if c.execution_time is not None]
    assert {c.execution_time.mean_ns for c in busy if c.execution_time} == {10 * MS}
    path, = task_set.paths
    assert len([key for key in path.callbacks if key in {c.key for c in busy}]) == 7


class Facts(NamedTuple):
    """A DAG: times in ms, edges as `before-after`."""

    period: int
    deadlines: dict[int, int]
    edges: str
    times_ns: tuple[int, int, int, int]
    """Sums over the vertices of the least, median, 95 % and largest execution time."""


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

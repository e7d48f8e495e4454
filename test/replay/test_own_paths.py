# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""End-to-end paths in traces of this executor: simulated and live ones."""

from __future__ import annotations

from pathlib import Path

from mddag_executor.cli import main as program
from mddag_executor.replay import replay
from msg_graph import load, loads
import pytest

from .recorded import BEGIN, Recorded

TOP = Path(__file__).resolve().parent.parent.parent
DEMO = TOP / 'bags' / 'demo_short.mcap'
MS = 1_000_000

GRAPH = """\
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: send, timer: 100ms, publishes: [/t], execution_time: 1ms}]
  - node: /b
    callbacks:
      - {name: keep, subscription: /t, deadline: 90ms, execution_time: 2ms}
      - {name: use, timer: 50ms, reads: [keep], deadline: 20ms, execution_time: 1ms}
paths:
  - {name: kept, callbacks: ['/a:send', '/b:keep', '/b:use']}
"""


@pytest.fixture
def simulated(tmp_path: Path) -> Path:
    graph = tmp_path / 'graph.yaml'
    graph.write_text(GRAPH)
    trace = tmp_path / 'run.mcap'
    assert program.main(['simulate', str(graph), '--policy', 'rad', '--workers', '4',
                         '--duration', '500ms', '--trace', str(trace)]) == 0
    return trace


def test_a_simulated_trace(simulated: Path) -> None:
    path = replay(simulated).result()['paths']['kept']
    assert path['hops'] == ['trigger', 'variable']
    # sent 1 ms after each 100 ms, used with 50 and 100 ms after it; what is sent last is not used
    # a second time within the 500 ms
    assert (path['flows'], path['arrived']) == (9, 9)
    assert path['data_age'] == {
        'count': 9, 'min': 49 * MS, 'mean': round((5 * 49 + 4 * 99) * MS / 9),
        'median': 49 * MS, 'p99': 99 * MS, 'max': 99 * MS}
    assert path['reaction_time'] == {
        'count': 3, 'min': 149 * MS, 'mean': 149 * MS, 'median': 149 * MS, 'p99': 149 * MS,
        'max': 149 * MS}
    # from the start of the sender to the end of its user
    assert path['whole']['data_age']['min'] == 51 * MS


def test_another_graph_may_bring_paths(simulated: Path) -> None:
    without = loads(GRAPH[:GRAPH.index('paths:')], 'without.yaml')
    assert replay(simulated, without).result()['paths'] == {}
    path = replay(simulated, loads(GRAPH, 'with.yaml')).result()['paths']['kept']
    assert path['arrived'] == 9


def test_a_live_trace_along_one_dag() -> None:
    """Along trigger edges alone a path is the chain of each job."""
    text = (TOP / 'config' / 'autoware.yaml').read_text(encoding='utf-8')
    dag = load(TOP / 'config' / 'autoware.yaml').dag('right_lidar')
    keys = ', '.join(f"'{vertex.callback.key}'" for vertex in dag.vertices)
    graph = loads(text[:text.index('\npaths:')]
                  + f'\npaths:\n  - {{name: lidar, callbacks: [{keys}]}}\n', 'paths.yaml')
    result = replay(DEMO, graph).result()
    path = result['paths']['lidar']
    sinks = result['dags']['right_lidar']['sinks']
    (sink,) = sinks.values()
    assert set(path['hops']) == {'trigger'}
    assert path['arrived'] == path['flows'] == sink['completed']
    assert path['flows'] == result['dags']['right_lidar']['jobs'] - 1   # one is open at the end
    # the first output does not count: what came before its input is not known
    whole = path['whole']['response_time']
    assert whole['all']['count'] == sink['completed'] - 1
    assert whole['all'] == whole['best'] == whole['worst']
    lag = sink['breakdown']['worst']['release_lag_ns'] + 3 * MS
    assert sink['response_ns']['min'] - lag < whole['all']['min'] <= sink['response_ns']['max']
    assert whole['all']['max'] <= sink['response_ns']['max']
    # a period more for what comes right after an input
    external = path['whole']['reaction_time']
    assert external['min'] > whole['all']['min'] + 50 * MS


def test_a_coroutine_is_one_execution(tmp_path: Path) -> None:
    r = Recorded(tmp_path / 'coroutine.mcap')
    r.add('mddag:task_set', 0, 1, GRAPH, 'g.yaml', 'rad', 2, 100 * MS, 0, False)
    r.node(1, '/a')
    r.publisher(100, 1, '/t')
    r.add('mddag:job_release', 10, 1, 0, 0, BEGIN + 10)
    for start in (20, 40):          # suspended in between
        r.add('mddag:dispatch', start, 1, 5, 0, 0, 0, 0, BEGIN + 10, 0)
        r.run(5, 1, start, start + 10)
    r.add('ros2:rclcpp_publish', 45, 1, 100, 0x50, 0)
    r.add('mddag:complete', 51, 1, 5, 0, 0, 0, True, BEGIN + 50, 0)
    r.add('mddag:dispatch', 60, 1, 6, 0, 1, 0, 0, BEGIN + 55, 0)
    r.run(6, 1, 60, 70)
    r.add('mddag:dispatch', 80, 1, 7, 1, 0, 0, 0, BEGIN + 75, 0)
    r.run(7, 1, 80, 90)
    path = replay(r.write()).result()['paths']['kept']
    assert path['data_age']['max'] == 80 - 45
    assert path['whole']['data_age']['max'] == 90 - 20

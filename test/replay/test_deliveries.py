# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The overheads measured in a recording, and that a reschedule has them again."""

from mddag_executor.replay import reschedule
from mddag_executor.trace import TraceFile
from msg_graph import loads
import pytest

from .helpers import add_execution, Chances, MS, SMALL, START_TIME, VirtualRun


def record(path, delay, wake, ready_early=0):
    """Record three jobs of a chain of three, with these overheads, ns."""
    text = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 100ms, publishes: [/x], dag: a}
      - {name: b, subscription: /x, publishes: [/y]}
      - {name: c, subscription: /y, deadline: 90ms}
"""
    with TraceFile(path) as file:
        file.add('task_set', START_TIME, 1, 1, text, 'g.yaml', 'rad', 2, 100 * MS, 64, False)
        for job in range(3):
            release = START_TIME + job * 100 * MS
            file.add('job_release', release + 10_000, 1, 1, 0, job, release)
            ready = release + 10_000
            for vertex in range(3 if job < 2 else 2):      # the last one is cut off
                start = ready + wake
                end = start + 5 * MS
                worker = vertex % 2
                add_execution(file, start, end, 0, vertex, job, worker, ready=ready,
                              thread=10 + worker, address=9 + vertex)
                ready = end + delay - ready_early
        file.add('shutdown', START_TIME + 300 * MS, 1, 1, START_TIME + 300 * MS)


@pytest.mark.parametrize(('delay', 'wake', 'early'), [
    (0, 0, 0), (700_000, 0, 0), (0, 300_000, 0), (700_000, 300_000, 0),
    # published 3 ms before the end: the next one runs at the same time, on the other worker
    (700_000, 300_000, 3 * MS)])
def test_overheads_are_measured_and_reproduced(tmp_path, delay, wake, early):
    path = tmp_path / 'a.mcap'
    record(path, delay, wake, early)
    outcome = reschedule(path)
    result = outcome.result()
    sink = result['dags']['a']['sinks']['/n:c']
    expected = 10_000 + 15 * MS + 2 * (delay - early) + 3 * wake
    assert sink['response_ns']['max'] == sink['response_ns']['min'] == expected
    assert sink['completed'] == 3       # medians stand in for what is not recorded
    recorded = result['recorded']['dags']['a']['sinks']['/n:c']
    assert recorded['response_ns']['max'] == expected
    assert result['overheads'] == {
        'included': True, 'added_ns': 0, 'dispatch_median_ns': wake,
        'transport_median_ns': delay - early}
    ideal = reschedule(path, overheads=False).result()
    assert ideal['dags']['a']['sinks']['/n:c']['response_ns']['max'] == 15 * MS
    added = reschedule(path, overheads=False, dispatch_overhead=MS).result()
    assert added['dags']['a']['sinks']['/n:c']['response_ns']['max'] == 18 * MS


@pytest.mark.parametrize('seed', range(4))
def test_the_prediction_of_a_virtual_run(tmp_path, seed):
    """One DAG, workers enough, nothing lost: the same response times."""
    path = tmp_path / 'a.mcap'
    alone = loads(SMALL[:SMALL.index('  - node: /imu')], 'alone.yaml')
    VirtualRun(path, alone, seed, workers=8, duration=500 * MS, longest=3 * MS,
               chances=Chances(0, 0, 0, 0, 0, 0.3))
    result = reschedule(path).result()
    for name, dag in result['dags'].items():
        for sink_name, sink in dag['sinks'].items():
            recorded = result['recorded']['dags'][name]['sinks'][sink_name]['response_ns']
            # of two long legs of a sync callback at the same time the longer one counts twice
            for key, tolerance in (('median', 0.02), ('p99', 0.001), ('max', 0.001)):
                assert sink['response_ns'][key] == pytest.approx(recorded[key], rel=tolerance)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Each benchmark once, as short as can be: it works, and its figures add up."""

import json
import os
from pathlib import Path
import subprocess
import sys

import pytest

TOP = Path(__file__).resolve().parent.parent.parent
pytestmark = pytest.mark.skipif(
    not (TOP / 'benchmarks').is_dir(), reason='only a checkout has benchmarks')

GRAPH = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: s, timer: 50ms, publishes: [/a, /b], execution_time: 2ms}
      - {name: x, subscription: /a, publishes: [/x], execution_time: 1ms}
      - {name: join, sync: [/x, /b], deadline: 9ms, execution_time: 1ms}
"""


def run_benchmark(*arguments):
    """Run a benchmark, not compiled, and without the checks for debugging."""
    return subprocess.run(
        [sys.executable, '-m', 'benchmarks', *map(str, arguments)], cwd=TOP,
        capture_output=True, text=True, check=False, timeout=150,
        env={**os.environ, 'MDDAG_PLAIN': '1', 'MDDAG_DEBUG': ''})


def result_of(*arguments):
    done = run_benchmark(*arguments, '--json', '-')
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_live():
    results = result_of(
        'live', '--load', 'topics', '--topics', 4, '--rate', 50, '--seconds', 0.5, '--executors',
        'rad:fifo,events')
    assert [each['executor'] for each in results] == ['rad:fifo', 'events']
    for each in results:
        assert each['crashed'] == 0 and each['cpu_us_per_callback'] > 0
        assert each['published'] == each['received'] + each['lost'] > 0
        latency = each['dispatch_latency_us']
        assert 0 < latency['p50'] <= latency['p99'] <= latency['max']


def test_live_with_declared_nodes(graph):
    results = result_of(
        'live', '--load', 'autoware', '--graph', graph, '--seconds', 0.5, '--utilisation', 0.02,
        '--executors', 'rad,multi,none')
    assert [each['executor'] for each in results] == ['rad', 'multi', 'none']
    for each in results:
        assert each['utilisation'] == pytest.approx(0.02)
        assert each['on_time'] + each['late'] + each['missing'] == each['sink_jobs_due'] > 0
        assert each['runs'][0]['attribution'] == {'wrong': 0, 'none': 0}


def test_core(graph):
    row, = result_of('core', '--graph', graph, '--duration', '1s', '--policies', 'rad',
                     '--repeat', 1)['core']
    # 20 jobs of three vertices, each with a start and an end; 20 releases; nothing preempts.
    assert (row['vertex_jobs'], row['events']) == (60, 140)
    assert row['us_per_vertex_job'] == pytest.approx(row['us_per_event'] * 140 / 60)
    assert row['live_us_per_vertex_job'] > 0


def test_replay(graph):
    result = result_of('replay', '--graph', graph, '--events', 2000, '--repeat', 1, '--others', 9)
    readers = result['readers']
    assert readers['read and linked']['events'] == result['events'] >= 2000
    assert readers['mcap, undecoded']['events'] == 9
    run, = result_of(
        'replay', '--accuracy', '--graph', graph, '--repeat', 1, '--seconds', 1, '--utilisation',
        0.02, '--workers', 3)['runs']
    assert run['sinks'][0]['jobs'] > 0


def test_evaluate(graph):
    result = result_of('evaluate', '--graph', graph, '--runs', 50, '--policies', 'rad,wc',
                       '--jobs', 1, '--vertices', 10, '--repeat', 1)
    for run in result['runs']:
        assert run['ms'] == pytest.approx(1000 * run['s'] / run['runs'] / 2)
    assert all(row['ns'] > 0 for row in result['vertex_jobs'])


def test_a_wrong_command_line_is_one_line():
    done = run_benchmark('live', '--load', 'topics', '--executors', 'rad-events')
    assert done.returncode == 2
    assert done.stderr == (
        "error: --executors: 'rad-events' is unknown: give some of rad, single, multi, events, "
        'none\n')

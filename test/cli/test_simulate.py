# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""`mddag simulate`: results, tables, traces, exit status, and one line for whatever is wrong."""

import errno
import json
import os
import resource

import pytest

GRAPH = """\
mddag: 1
workers: 2
nodes:
  - node: /sensing/driver
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/points], dag: lidar, execution_time: 2ms}
  - node: /filter
    callbacks:
      - {name: near, subscription: /points, deadline: 5ms, execution_time: 1ms}
      - {name: far, subscription: /points, deadline: 12ms, execution_time: 8ms}
"""
TIMES = {'lidar': {'/sensing/driver:tick': 2000, '/filter:near': 3500.5, '/filter:far': 1}}


@pytest.fixture
def times(tmp_path):
    path = tmp_path / 'times.json'
    path.write_text(json.dumps(TIMES), encoding='utf-8')
    return path


@pytest.fixture
def result_of(call):
    """Give a function that simulates, without a warning, and returns what is written as JSON."""
    def simulate(*arguments):
        done = call('simulate', *arguments, '--json', '-')
        assert not done.stderr
        return done.result
    return simulate


def test_execution_times_from_a_file(result_of, graph, times):
    result = result_of(graph, '--duration', '10ms', '--execution-times', times)
    assert result['seed'] is None
    assert result['utilisation'] == pytest.approx((2000 + 3500.5 + 1) / 10_000 / 2)
    assert result['first_miss'] == {
        'dag': 'lidar', 'vertex': '/filter:near', 'job': 0, 'deadline_ns': 5_000_000,
        'completed_ns': 5_500_500}
    assert result['dags']['lidar']['sinks']['/filter:far']['response_ns']['max'] == 2_001_000


@pytest.mark.parametrize('on_late', ['continue', 'demote', 'abort'])
def test_late_jobs_are_rescheduled_as_they_were_treated(call, result_of, graph, tmp_path, on_late):
    trace = tmp_path / 'run.mcap'
    simulated = result_of(graph, '--workers', 1, '--duration', '200ms', '--on-late', on_late,
                          '--trace', trace)
    again = call('replay', trace, '--reschedule', '--json', '-').result
    assert again['on_late'] == on_late
    for name in ('/filter:near', '/filter:far'):
        sinks = [each['dags']['lidar']['sinks'][name] for each in (simulated, again)]
        assert sinks[0]['late'] == sinks[1]['late'] and sinks[0]['completed'] == sinks[1][
            'completed']


def test_what_is_asked_for_is_done(result_of, graph):
    # One worker, 11 ms of work each 10 ms. Job k: tick from 11k, near done at 11k + 3, far at
    # 11k + 11. Late: near from job 3 on (36 ms), far from job 2 on (33 ms).
    plain = result_of(graph, '--workers', 1, '--duration', '100ms')
    assert (plain['workers'], plain['preemptive']) == (1, False)
    near = plain['dags']['lidar']['sinks']['/filter:near']
    assert (near['completed'], near['late'], near['overdue']) == (9, 7, 1)
    judged = result_of(
        graph, '--workers', 1, '--duration', '100ms', '--judge', 'completions')
    near = judged['dags']['lidar']['sinks']['/filter:near']
    assert (near['completed'], near['late'], near['overdue']) == (9, 6, 0)
    # With more time for far the next tick goes before it: late are the jobs 3 to 7 only; with
    # preemption near does not wait.
    graph.write_text(GRAPH.replace('12ms', '60ms'), encoding='utf-8')
    for option, late in (([], 5), (['--preemptive'], 0)):
        result = result_of(graph, '--workers', 1, '--duration', '100ms', *option)
        assert result['preemptive'] is bool(option)
        assert result['dags']['lidar']['sinks']['/filter:near']['late'] == late
    graph.write_text(GRAPH, encoding='utf-8')
    stopped = result_of(graph, '--workers', 1, '--stop-at-first-miss')
    assert stopped['ended_ns'] == stopped['first_miss']['completed_ns'] == 33_000_000
    assert stopped['deadline_missed'] is True


def test_a_disk_that_gets_full_leaves_nothing_and_promises_nothing(graph, mddag):
    done = mddag(
        'simulate', graph, '--duration', '20s', '--trace', 'out.mcap', preexec_fn=lambda:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)))
    assert done.returncode == 2
    assert done.stderr == (
        f'error: out.mcap: writing failed ({os.strerror(errno.EFBIG)}): free space, then try '
        'again\n')
    assert not [path for path in graph.parent.iterdir() if path != graph]


@pytest.mark.parametrize('command', [
    'export run.mcap -o tables/', 'export run.mcap -o out.csv', 'generate --sets 3 -o sets'])
def test_a_disk_that_gets_full_is_one_line(graph, call, mddag, command):
    if 'tables' in command:
        pytest.importorskip('pyarrow', reason='pyarrow is not installed')
    assert call('simulate', graph, '--duration', '2s', '--trace', 'run.mcap').returncode == 0
    before = sorted(graph.parent.iterdir())
    done = mddag(*command.split(), preexec_fn=lambda: resource.setrlimit(
        resource.RLIMIT_FSIZE, (1_000, 1_000)))
    assert done.returncode == 2
    assert done.stderr.startswith(f'error: {command.split()[-1]}: ')
    assert done.stderr.count('\n') == 1 and 'ile too large' in done.stderr
    assert sorted(graph.parent.iterdir()) == before

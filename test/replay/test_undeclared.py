# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Traces that were recorded without a declaration, judged by one that is given later."""

from pathlib import Path

from mddag_executor.trace import EVENTS, TraceFile, TraceReader
import pytest

from ..replay.helpers import begin_trace, end_trace, MS, START_TIME, US

DEMO = Path(__file__).parents[2] / 'bags' / 'demo_short.mcap'
GRAPH = """\
mddag: 1
nodes:
  - node: /camera
    callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]
  - node: /radar
    callbacks: [{name: scan, timer: 100ms, publishes: [/image]}]
  - node: /detect
    callbacks: [{name: run, subscription: /image, deadline: 40ms}]
"""
GRAB, SCAN, RUN = 11, 12, 13
_OF_JOBS = {f'mddag:{name}' for name in (
    'job_release', 'complete', 'deadline', 'fail', 'expire', 'abort', 'hosted', 'judge_from')}


class Run:
    """The trace of a run of three nodes; times are ns since the start."""

    def __init__(self, folder, call):
        self._call = call
        self.path = folder / 'run.mcap'
        self.graph = folder / 'graph.yaml'
        self.graph.write_text(GRAPH)
        self.file = begin_trace(self.path, '', workers=2)
        for node, name in enumerate(('camera', 'radar', 'detect'), 1):
            self.add('rcl_node_init', 0, 1, node, node, name, '/')
        for timer, node in ((GRAB, 1), (SCAN, 2)):
            self.add('rcl_publisher_init', 0, 1, 100 + node, node, 100 + node, '/image', 10)
            self.add('rcl_timer_init', 0, 1, 20 + node, 100 * MS)
            self.add('rclcpp_timer_callback_added', 0, 1, 20 + node, timer)
            self.add('rclcpp_timer_link_node', 0, 1, 20 + node, node)
        self.add('rcl_subscription_init', 0, 1, 30, 3, 30, '/image', 10)
        self.add('rclcpp_subscription_init', 0, 1, 30, 30)
        self.add('rclcpp_subscription_callback_added', 0, 1, 30, RUN)

    def add(self, name, time, thread, *fields):
        self.file.add(name, START_TIME + time, 1, thread, *fields)

    def runs(self, callback, ready, start, end, *published, thread=0):
        """Run a callback, which publishes at some times."""
        thread = thread or callback
        self.add('dispatch', start, thread, callback, -1, -1, -1, 0, START_TIME + ready, 0)
        self.add('callback_start', start, thread, callback, False)
        for time in published:
            publisher = 101 if callback == GRAB else 102
            self.add('rclcpp_publish', time, thread, publisher, 0, 0)
            self.add('rcl_publish', time, thread, publisher, 0)
        self.add('callback_end', end, thread, callback)

    def takes(self, stamp, time):
        """Take a message for /detect."""
        self.add('rmw_take', time, 1, 30, 0, START_TIME + stamp, True)

    def detects(self, stamp, taken, took=5 * MS):
        """Take a message and run /detect for it."""
        self.takes(stamp, taken)
        self.runs(RUN, taken + US, taken + 2 * US, taken + 2 * US + took)

    def result(self, until=None):
        """End the run and return what `mddag replay --json` says of it."""
        if until is None:
            self.file.finish()
        else:
            end_trace(self.file, START_TIME + until)
        return self._call('replay', self.path, self.graph, '--json', '-').result


@pytest.fixture
def run(tmp_path, call):
    return Run(tmp_path, call)


def undeclared(source, target):
    """Write a trace as if it had been recorded without its declaration, and return that."""
    text = ''
    with TraceFile(target) as file:
        for name, *fields in TraceReader(source).events(set(EVENTS), sorted=True):
            if name == 'mddag:task_set':
                text, fields[3:5] = fields[3] or text, ['', '']
            elif name in ('mddag:dispatch', 'mddag:drop'):
                fields[4:7] = -1, -1, -1
            if name not in _OF_JOBS:
                file.add(name, *fields)
    return text


def test_the_same_run_gets_the_same_verdicts(tmp_path, call):
    trace, graph = tmp_path / 'run.mcap', tmp_path / 'graph.yaml'
    graph.write_text(undeclared(DEMO, trace))
    declared = call('replay', DEMO, '--json', '-').result
    done = call('replay', trace, graph, '--json', '-')
    found = done.result
    assert not done.stderr
    assert found['first_miss']['job'] == declared['first_miss']['job']
    assert (found['policy'], found['workers']) == (declared['policy'], declared['workers'])
    assert found['callbacks'].keys() == declared['callbacks'].keys()
    for key, use in found['callbacks'].items():
        assert use['executions'] == declared['callbacks'][key]['executions']
    for name, dag in declared['dags'].items():
        assert found['dags'][name]['unjudged'] == 0
        assert found['dags'][name]['ends'] == dag['ends']
        for sink, expected in dag['sinks'].items():
            got = found['dags'][name]['sinks'][sink]
            for key in ('completed', 'late', 'overdue', 'expired', 'failed', 'aborted'):
                assert got[key] == expected[key], (sink, key)
            if expected['breakdown'] is not None:
                mean, wanted = (each['breakdown']['mean'] for each in (got, expected))
                for key in ('waiting_ns', 'executing_ns', 'transport_ns', 'suspended_ns'):
                    assert mean[key] == wanted[key], (sink, key)
                # the timer's grid is known as well as the executor noticed its releases
                assert abs(mean['release_lag_ns'] - wanted['release_lag_ns']) < MS


def test_other_verbs_take_it(run, call):
    for job in range(5):
        at = job * 100 * MS
        run.runs(GRAB, at, at, at + 2 * MS, at + MS)
        run.detects(at + MS + 9 * US, at + MS + 99 * US, (60 if job == 3 else 5) * MS)
    assert run.result(500 * MS)['warnings'] == []
    assert call('slack', run.path, run.graph).returncode == 0
    assert call('diff', run.path, run.path, run.graph).returncode == 0
    causes = call('explain', run.path, run.graph, '--json', '-').result['causes']
    assert {cause: n for cause, n in causes.items() if n} == {'ran long': 1}
    result = call('replay', run.path, run.graph, '--reschedule', '--json', '-').result
    sink = result['dags']['/camera']['sinks']['/detect:run@/camera']
    assert (sink['completed'], sink['late']) == (5, 1)


def test_messages_of_others_are_of_no_job(run):
    # another process publishes while nothing of this one is being sent, or while /camera still
    # runs: its own message has been taken then
    for job in range(4):
        at = job * 100 * MS
        run.runs(GRAB, at, at, at + 20 * MS, at + MS)
        run.detects(at + MS + 9 * US, at + MS + 99 * US)
        run.detects(at + 10 * MS, at + 10 * MS + 99 * US)
        run.detects(at + 50 * MS, at + 50 * MS + 99 * US)
    result = run.result(400 * MS)
    sink = result['dags']['/camera']['sinks']['/detect:run@/camera']
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (
        4, 0, 6 * MS + 101 * US)
    assert result['callbacks']['/detect:run']['executions'] == 4
    assert result['undeclared']['executions'] == 8
    warning, = result['warnings']
    assert '8 executions for a message whose publication is not known' in warning


@pytest.mark.parametrize('in_order', [True, False])
def test_who_published_is_never_guessed(in_order, run):
    # both publish on one topic while both run; messages are taken later
    for job in range(3):
        at = job * 100 * MS
        run.runs(GRAB, at, at, at + 20 * MS, at + MS)
        run.runs(SCAN, at, at, at + 20 * MS, at + 2 * MS)
        first = at + (MS if in_order else 2 * MS) + 9 * US
        run.takes(first, at + 30 * MS)
        run.takes(at + 2 * MS + 10 * US, at + 31 * MS)
        run.runs(RUN, at + 30 * MS + US, at + 30 * MS + US, at + 32 * MS)
        run.runs(RUN, at + 31 * MS + US, at + 33 * MS, at + 35 * MS)
    result = run.result(300 * MS)
    sinks = [dag['sinks'][f'/detect:run@{name}'] for name, dag in result['dags'].items()]
    if in_order:
        assert [sink['response_ns']['max'] for sink in sinks] == [32 * MS, 35 * MS]
        assert [sink['completed'] for sink in sinks] == [3, 3]
        assert result['warnings'] == []
    else:
        assert [sink['completed'] + sink['late'] + sink['expired'] for sink in sinks] == [0, 0]
        assert [dag['unjudged'] for dag in result['dags'].values()] == [3, 3]
        assert '6 jobs' in ' '.join(result['warnings'])


def test_the_pieces_of_a_coroutine_are_one_execution(run):
    # /detect awaits something for 30 ms, in every second job for 50 ms
    for job in range(4):
        at, rest = job * 100 * MS, (50 if job % 2 else 30) * MS
        run.runs(GRAB, at, at, at + 2 * MS, at + MS)
        run.takes(at + MS + 9 * US, at + MS + 99 * US)
        ready = at + MS + 100 * US
        run.runs(RUN, ready, at + 2 * MS, at + 3 * MS)
        run.runs(RUN, ready, at + 3 * MS + rest, at + 4 * MS + rest, thread=99)
    result = run.result(400 * MS)
    sink = result['dags']['/camera']['sinks']['/detect:run@/camera']
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (4, 2, 54 * MS)
    mean = sink['breakdown']['mean']
    assert (mean['executing_ns'], mean['suspended_ns']) == (3 * MS + 100 * US, 40 * MS)
    assert result['callbacks']['/detect:run']['executions'] == 4
    assert result['callbacks']['/detect:run']['busy_ns'] == 8 * MS
    assert result['warnings'] == []


def test_a_request_is_released_when_it_was_ready_also_for_a_coroutine(run):
    run.graph.write_text(GRAPH + """\
  - node: /detect
    callbacks: [{name: ask, service: /ask, period: 1s, deadline: 20ms}]
""")
    run.add('rcl_service_init', 0, 1, 40, 3, 40, '/ask')
    run.add('rclcpp_service_callback_added', 0, 1, 40, 14)
    run.runs(14, 100 * MS, 103 * MS, 104 * MS)
    run.runs(14, 100 * MS, 120 * MS, 121 * MS)      # resumed
    run.runs(14, 200 * MS, 201 * MS, 202 * MS)
    sink = run.result()['dags']['/detect']['sinks']['/detect:ask']
    assert (sink['completed'], sink['late']) == (2, 1)
    assert (sink['response_ns']['min'], sink['response_ns']['max']) == (2 * MS, 21 * MS)


def test_timers_are_released_on_their_grid_if_they_keep_to_one(run):
    # /camera's timer is noticed 30 ms late once; /radar's is reset all the time
    for job in range(6):
        at, late = job * 100 * MS, 30 * MS * (job == 2)
        run.runs(GRAB, at + late, at + late, at + late + 2 * MS, at + late + MS)
        run.detects(at + late + MS + 9 * US, at + late + MS + 99 * US, 7 * MS)
        at += 50 * MS + 37 * job * job % 41 * MS
        run.runs(SCAN, at, at, at + 2 * MS, at + MS)
        run.detects(at + MS + 9 * US, at + MS + 99 * US, 7 * MS)
    result = run.result(700 * MS)
    camera, radar = (result['dags'][name]['sinks'][f'/detect:run@{name}']['breakdown']['worst']
                     for name in ('/camera', '/radar'))
    assert (camera['job'], camera['release_lag_ns']) == (2, 30 * MS)
    assert radar['release_lag_ns'] == 0
    warning, = result['warnings']
    assert '6 executions of timers off the grid' in warning and '/radar timer' in warning


@pytest.mark.parametrize('ready', [-2 ** 63, 2 ** 63 - 1])
def test_a_damaged_ready_time_affects_its_execution_only(ready, run):
    for start in range(0, 500 * MS, 100 * MS):
        run.runs(GRAB, ready - START_TIME if start == 200 * MS else start, start,
                 start + 2 * MS, start + MS)
        run.detects(start + MS + 9 * US, start + MS + 99 * US)
    sink = run.result(500 * MS)['dags']['/camera']['sinks']['/detect:run@/camera']
    assert sink['completed'] == 5
    assert sink['late'] == (ready < 0)


def test_a_job_that_is_open_at_the_end_is_judged_by_that(run):
    run.runs(GRAB, 0, 0, 2 * MS, MS)
    run.add('drop', 3 * MS, 1, RUN, -1, -1, -1, 'qos_depth')
    result = run.result(80 * MS)
    sink = result['dags']['/camera']['sinks']['/detect:run@/camera']
    assert (sink['completed'], sink['late'], sink['overdue']) == (0, 1, 1)
    assert result['dropped'] == {'qos_depth': 1}

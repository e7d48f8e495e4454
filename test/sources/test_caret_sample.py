# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A real CARET recording, next to CARET's own results: equal to the nanosecond."""

import csv

from mddag_executor import replay, reschedule
from mddag_executor.analysis.paths import Paths
from mddag_executor.sources.open import open_recording
from mddag_executor.trace import import_ctf
from msg_graph import loads
import pytest

from ..analysis.flows import flows, slow_cases
from .caret import CARET

SESSION = CARET / 'end_to_end_sample'
pytestmark = pytest.mark.skipif(not SESSION.is_dir(), reason='the recording is not there')

GRAPH = """\
mddag: 1
nodes:
  - {node: /actuator_dummy_node, callbacks: [
      {name: callback_0, subscription: /topic4, deadline: 100ms}]}
  - {node: /drive_node, callbacks: [{name: callback_0, timer: 100ms, publishes: [/drive]}]}
  - {node: /filter_node, callbacks: [
      {name: callback_0, subscription: /topic1, publishes: [/topic2]}]}
  - node: /message_driven_node
    callbacks:
      - {name: callback_0, subscription: /topic2, deadline: 100ms}
      - {name: callback_1, subscription: /drive, publishes: [/topic3], reads: [callback_0]}
  - {node: /sensor_dummy_node, callbacks: [
      {name: callback_0, timer: 100ms, publishes: [/topic1]}]}
  - node: /timer_driven_node
    callbacks:
      - {name: callback_0, timer: 100ms, publishes: [/topic4], reads: [callback_1]}
      - {name: callback_1, subscription: /topic3, deadline: 100ms}
paths:
  - name: target
    callbacks:
      - /sensor_dummy_node:callback_0
      - /filter_node:callback_0
      - /message_driven_node:callback_0
      - /message_driven_node:callback_1
      - /timer_driven_node:callback_1
      - /timer_driven_node:callback_0
      - /actuator_dummy_node:callback_0
"""


@pytest.fixture(scope='module')
def trace(tmp_path_factory):
    path = tmp_path_factory.mktemp('caret') / 'sample.mcap'
    imported = import_ctf(SESSION, path)
    assert (imported.events, imported.warnings) == (2880, [])
    return path


@pytest.fixture(scope='module')
def graph():
    return loads(GRAPH, 'sample.yaml')


def rows(name):
    with open(CARET / name, encoding='utf-8') as stream:
        lines = csv.reader(stream)
        next(lines)
        for line in lines:
            yield tuple(int(cell) if cell else None for cell in line)


def test_flows_and_times_are_those_of_caret(trace, graph):
    columns = [flow.columns for flow in flows(Paths(open_recording(trace, graph)))]
    found = [(c[0][0], c[1][1], c[1][0], c[2][1], c[3][0], c[4][1], c[5][0], c[6][1])
             for c in columns]
    # of the three times of each publication the first
    expected = [tuple(row[i] for i in (0, 3, 4, 7, 8, 11, 12, 15))
                for row in rows('demo_target_path.csv')]

    def order(row):
        return [time or 0 for time in row]

    assert sorted(found, key=order) == sorted(expected, key=order)
    outcome = replay(trace, graph)
    assert outcome.warnings == []
    result = outcome.result()
    response = slow_cases([(row[0] or 0, row[-1]) for row in expected])
    target = result['paths']['target']
    for case, times in target['response_time'].items():
        of_case = sorted(time for _, time in response[case])
        assert (times['count'], times['min'], times['max'], times['mean']) == (
            len(of_case), of_case[0], of_case[-1], round(sum(of_case) / len(of_case))), case
    assert target['reaction_time'] == target['response_time']['worst_with_external_latency']
    assert (target['flows'], target['arrived']) == (56, 47)
    assert result['callbacks']['/filter_node:callback_0']['executions'] == 49
    assert {name: dag['jobs'] for name, dag in result['dags'].items()} == {
        '/drive_node': 49, '/sensor_dummy_node': 49, '/timer_driven_node': 49}
    again = reschedule(trace, graph, policy='rad', workers=12).result()
    medians = [each['dags']['/timer_driven_node']['sinks']['/actuator_dummy_node:callback_0'][
        'response_ns']['median'] for each in (again, result)]
    assert medians[0] == pytest.approx(medians[1], rel=0.05)


def test_without_a_graph(trace):
    result = replay(trace).result()
    assert (result['dags'], result['paths'], result['warnings']) == ({}, {}, [])
    assert sum(use['executions'] for use in result['recorded_callbacks'].values()) == 480
    assert result['undeclared']['executions'] == 480
    topic1 = next(each for each in result['communications'] if each['topic'] == '/topic1')
    latencies = sorted((row[4] or 0) - (row[0] or 0) for row in rows('comm_topic1.csv'))
    assert (topic1['sent'], topic1['arrived']) == (49, 49)
    assert (topic1['latency_ns']['min'], topic1['latency_ns']['max']) == (
        latencies[0], latencies[-1])

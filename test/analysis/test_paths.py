# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""End-to-end flows and response times: by hand, against slow ones, in traces of this executor."""

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor import replay
from mddag_executor.analysis.paths import figures
from mddag_executor.analysis.spread import spread
from mddag_executor.core import quantile
import numpy as np

from ..sources.helpers import MS, Written
from ..sources.recorded import BEGIN
from .flows import flows, slow_cases
from .told import Told

GRAPH = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: send, timer: 100ms, publishes: [/t]}]}
  - node: /b
    callbacks:
      - {name: keep, subscription: /t, deadline: 1s}
      - {name: use, timer: 50ms, reads: [keep], publishes: [/u], deadline: 1s}
  - node: /c
    callbacks:
      - {name: take, timer: 30ms, dag: c, reads: [/u], publishes: [/v]}
      - {name: other, timer: 40ms, publishes: [/w]}
  - {node: /d, callbacks: [{name: end, subscription: /v, deadline: 1s}]}
  - {node: /e, callbacks: [{name: end, subscription: /w, deadline: 1s}]}
paths:
  - {name: all, callbacks: ['/a:send', '/b:keep', '/b:use', '/c:take', '/d:end']}
"""


def test_a_flow_over_trigger_variable_and_topic(tmp_path):
    told = Told(tmp_path / 'a.mcap', GRAPH)
    told.ran('/a:send', 10, 12, sends=[(11, '/t')])
    told.ran('/b:use', 13, 15, sends=[(14, '/u')])              # nothing is kept so far
    told.ran('/b:keep', 16, 20, 11, '/t')
    told.ran('/b:use', 17, 19, sends=[(18, '/u')])              # still the older value
    for start in (21, 30):                                      # reads it twice
        told.ran('/b:use', start, start + 2, sends=[(start + 1, '/u')])
    told.ran('/c:take', 40, 42, sends=[(41, '/v')])
    told.ran('/d:end', 43, 44, 41, '/v')
    assert told.starts() == [[11, 16, 21, None, None], [11, 16, 30, 40, 43]]
    paths = told.paths()
    assert [hop.kind for hop in paths.hops[0]] == ['trigger', 'variable', 'topic', 'trigger']
    whole = flows(paths)[1]
    assert (whole.begin, whole.end) == (BEGIN + 10 * MS, BEGIN + 44 * MS)


def test_a_recorded_take_says_more_than_the_latest(tmp_path):
    told = Told(tmp_path / 'a.mcap', GRAPH)
    told.subscription(900, 3, '/u')
    for at in (100, 200):
        told.ran('/a:send', at, at + 2, sends=[(at + 1, '/t')])
        told.ran('/b:keep', at + 2, at + 3, at + 1, '/t')
        told.ran('/b:use', at + 4, at + 6, sends=[(at + 5, '/u')])
    tid = told.ran('/c:take', 300, 305)
    told.add('ros2:rmw_take', 301 * MS, tid, 30_900, 0x99, BEGIN + 105 * MS, True)  # the older one
    assert told.starts() == [[101, 102, 104, 300, None], [201, 202, 204, None, None]]


SYNC = """\
mddag: 1
nodes:
  - node: /s
    callbacks:
      - {name: left, subscription: /in, publishes: [/l]}
      - {name: right, subscription: /in, publishes: [/r]}
      - {name: source, timer: 100ms, publishes: [/in]}
      - {name: join, sync: [/l, /r], publishes: [/out]}
      - {name: end, subscription: /out, deadline: 100ms}
paths:
  - {name: left, callbacks: ['/s:left', '/s:join', '/s:end']}
"""


def test_publications_by_other_legs_and_outside_of_executions(tmp_path):
    told = Told(tmp_path / 'a.mcap', SYNC)
    told.ran('/s:left', 10, 15, topic='/in', sends=[(11, '/l')])
    told.ran('/s:join', 12, 13, 11, '/l')
    told.ran('/s:join', 15, 17, topic='/r', sends=[(16, '/out')])       # made it whole
    told.ran('/s:end', 17, 18, 16, '/out')
    told.ran('/s:left', 20, 21, topic='/in')
    told.sent('/s:left', 99, (23, '/l'))        # by a thread of the node
    told.ran('/s:join', 24, 25, 23, '/l')
    assert told.starts() == [[11, 12, 17], [23, 24, None]]


RECORDS, LONG = (
    st.lists(st.tuples(st.integers(0, start), st.none() | st.integers(0, end)), max_size=size)
    for start, end, size in ((15, 25, 14), (60, 80, 50)))


def statistics(times):
    if not times:
        return None
    ordered = sorted(times)
    return {'count': len(ordered), 'min': ordered[0],
            'mean': round(sum(ordered) / len(ordered)), 'median': quantile(ordered, 0.5),
            'p99': quantile(ordered, 0.99), 'max': ordered[-1]}


def told(records):
    return figures(
        np.array([start for start, _ in records], dtype=np.int64),
        np.array([-1 if end is None else end for _, end in records], dtype=np.int64))


@given(st.one_of(RECORDS, LONG))
def test_cases(records):
    found = told(records)
    every = {**found['response_time'], 'data_age': found['data_age']}
    expected = {case: [time for _, time in responses]
                for case, responses in slow_cases(records).items()}
    arrived = [(start, end) for start, end in records if end is not None and end >= start]
    expected['data_age'] = [
        end - max(first for first, output in arrived if output == end)
        for end in {end for _, end in arrived}]
    for case, times in every.items():
        assert times == statistics(expected[case]), case
    assert found['reaction_time'] == found['response_time']['worst_with_external_latency']


@given(st.lists(st.integers(-2**62, 2**62) | st.integers(-5000, 5000), max_size=60))
def test_a_spread(times):
    assert spread(np.array(times, dtype=np.int64)) == statistics(times)


GRAPH_OWN = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: send, timer: 100ms, publishes: [/t], execution_time: 1ms}]}
  - node: /b
    callbacks:
      - {name: keep, subscription: /t, deadline: 90ms, execution_time: 2ms}
      - {name: use, timer: 50ms, reads: [keep], deadline: 20ms, execution_time: 1ms}
paths:
  - {name: kept, callbacks: ['/a:send', '/b:keep', '/b:use']}
"""


def test_a_coroutine_is_one_execution(tmp_path):
    trace = Written(tmp_path / 'a.mcap', GRAPH_OWN, 2)
    trace.add('rcl_node_init', 0, 1, 1, 'a', '/')
    trace.add('rcl_publisher_init', 0, 100, 1, 100, '/t', 10)
    trace.release(0, 0, 10)
    trace.piece(0, 0, 0, 20, 30, ready=10)      # suspended in between
    trace.add('rclcpp_publish', 45, 100, 0x50, 0, thread=10)
    trace.run(0, 0, 0, 40, 50, ready=10)
    trace.run(0, 1, 0, 60, 70)
    trace.release(1, 0, 75)
    trace.run(1, 0, 0, 80, 90)
    path = replay(trace.end(100)).result()['paths']['kept']
    assert path['data_age']['max'] == (80 - 45) * MS
    assert path['whole']['data_age']['max'] == (90 - 20) * MS


def test_a_path_without_executions(tmp_path):
    path = replay(Written(tmp_path / 'a.mcap', GRAPH_OWN).end(100)).result()['paths']['kept']
    assert (path['flows'], path['data_age']) == (0, None)

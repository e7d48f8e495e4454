# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""End-to-end flows and response times: by hand, against slow ones, in traces of this executor."""

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import quantile
from mddag_executor.recording import tables
from mddag_executor.recording.entities import Entities, Node, Publisher
from mddag_executor.recording.head import Head
from mddag_executor.recording.tables import Recording, Rows
from mddag_executor.replay import replay
from mddag_executor.replay.paths import figures, Paths
from mddag_executor.replay.spread import spread
from msg_graph import loads
import numpy as np
import pytest

from .cases_by_hand import slow_cases
from .flows import flows
from .recorded import BEGIN, Recorded

GRAPH = """\
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: send, timer: 100ms, publishes: [/t]}]
  - node: /b
    callbacks:
      - {name: keep, subscription: /t, deadline: 1s}
      - {name: use, timer: 50ms, reads: [keep], publishes: [/u], deadline: 1s}
  - node: /c
    callbacks:
      - {name: take, timer: 30ms, dag: c, reads: [/u], publishes: [/v]}
      - {name: other, timer: 40ms, publishes: [/w]}
  - node: /d
    callbacks: [{name: end, subscription: /v, deadline: 1s}]
  - node: /e
    callbacks: [{name: end, subscription: /w, deadline: 1s}]
paths:
  - name: all
    callbacks: ['/a:send', '/b:keep', '/b:use', '/c:take', '/d:end']
"""

NONE = -1


class Driver:
    """Makes a recording of what happens, by names; times are any, ascending."""

    def __init__(self, text=GRAPH):
        self.task_set = loads(text, 'graph.yaml')
        self.places = self.task_set.places()
        vertices = self.task_set.places_of_vertices()
        self.vertex = {key: vertices.index(place) for key, place in self.places.items()}
        self.who = Entities()
        self._subscriptions = {}
        self._executions = Rows(
            tables.EXECUTIONS, 'callback', 'vertex', 'start', 'began', 'end', 'message')
        self._sent = Rows(tables.PUBLICATIONS, 'publisher', 'execution', 'vertex', 'time')
        self._took = Rows(tables.TAKES, 'execution', 'message')

    def _callback(self, key, topic):
        """Return the number of the subscription with which a callback takes a topic."""
        number = self._subscriptions.get((key, topic))
        if number is None:
            number = self._subscriptions[key, topic] = len(self._subscriptions) + 1
            for name, fields in (
                    ('rcl_subscription_init', {
                        'subscription_handle': number, 'node_handle': 0,
                        'rmw_subscription_handle': number, 'topic_name': topic}),
                    ('rclcpp_subscription_init', {
                        'subscription_handle': number, 'subscription': number}),
                    ('rclcpp_subscription_callback_added', {
                        'subscription': number, 'callback': number})):
                self.who.note(f'ros2:{name}', {'_timestamp': 0, '_vpid': 0, **fields})
        return number

    def run(self, key, start, message=NONE, topic=''):
        """Begin an execution; return its number."""
        return self._executions.add(
            self._callback(key, topic), self.vertex[key], start, start, NONE, message)

    def send(self, key, run, topic, time, node=''):
        """Publish; return the message's number."""
        node = node or (key or '').partition(':')[0]
        number = len(self.who.every_publisher) + 1
        self.who.every_publisher[number] = Publisher(number, Node(0, node, 0), topic)
        return self._sent.add(number, run, NONE if key is None else self.vertex[key], time)

    def end(self, key, run, time):
        """End an execution."""
        self._executions.columns['end'][run] = time

    def took(self, key, run, message):
        """Let a running callback take a message."""
        self._took.add(run, message)

    @property
    def paths(self):
        return Paths(Recording(
            'by hand', Head(0, '', '', 'rad', 1, 0, 0, False), self.task_set, self.task_set,
            self.who, declared=False, executions=self._executions.table(), links=True,
            publications=self._sent.table(), takes=self._took.table()))

    def starts(self):
        """Return for each flow its first publication and the start of each later callback."""
        return [[flow.columns[0][0], *(c[1] for c in flow.columns[1:])]
                for flow in flows(self.paths)]


def test_a_flow_over_trigger_variable_and_topic():
    d = Driver()
    assert [hop.kind for hop in d.paths.hops[0]] == ['trigger', 'variable', 'topic', 'trigger']
    a = d.run('/a:send', 0)
    m = d.send('/a:send', a, '/t', 1)
    d.end('/a:send', a, 2)
    early = d.run('/b:use', 3)              # nothing is kept so far
    d.send('/b:use', early, '/u', 4)
    d.end('/b:use', early, 5)
    keep = d.run('/b:keep', 6, m, '/t')
    during = d.run('/b:use', 7)             # still the older value
    d.send('/b:use', during, '/u', 8)
    d.end('/b:keep', keep, 9)
    for start in (10, 20):                  # reads it twice
        use = d.run('/b:use', start)
        d.send('/b:use', use, '/u', start + 1)
        d.end('/b:use', use, start + 2)
    take = d.run('/c:take', 30)
    v = d.send('/c:take', take, '/v', 31)
    end = d.run('/d:end', 32, v, '/v')
    d.end('/d:end', end, 33)
    assert d.starts() == [[1, 6, 10, None, None], [1, 6, 20, 30, 32]]
    whole = flows(d.paths)[1]
    assert (whole.begin, whole.end) == (0, 33)


def test_a_recorded_take_says_more_than_the_latest():
    d = Driver()
    messages = []
    for k in range(2):
        a = d.run('/a:send', 100 * k)
        m = d.send('/a:send', a, '/t', 100 * k + 1)
        keep = d.run('/b:keep', 100 * k + 2, m, '/t')
        d.end('/b:keep', keep, 100 * k + 3)
        use = d.run('/b:use', 100 * k + 4)
        messages.append(d.send('/b:use', use, '/u', 100 * k + 5))
        d.end('/b:use', use, 100 * k + 6)
    take = d.run('/c:take', 200)
    d.took('/c:take', take, messages[0])       # its queue held the older one
    assert d.starts() == [[1, 2, 4, 200, None], [101, 102, 104, None, None]]


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


def test_the_other_leg_of_a_sync_may_publish():
    d = Driver(SYNC)
    left = d.run('/s:left', 0)
    l_message = d.send('/s:left', left, '/l', 1)
    d.run('/s:join', 2, l_message, '/l')
    right_leg = d.run('/s:join', 5, NONE, '/r')       # made it whole
    out = d.send('/s:join', right_leg, '/out', 6)
    d.run('/s:end', 7, out, '/out')
    assert d.starts() == [[1, 2, 7]]


def test_publications_outside_of_executions():
    d = Driver(SYNC)
    left = d.run('/s:left', 0)
    d.end('/s:left', left, 1)
    message = d.send(None, NONE, '/l', 3, '/s')     # by a thread of the node
    d.run('/s:join', 4, message, '/l')
    assert d.starts() == [[3, 4, None]]


RECORDS = st.lists(st.tuples(
    st.integers(0, 15), st.one_of(st.none(), st.integers(0, 25))), max_size=14)
LONG = st.lists(st.tuples(
    st.integers(0, 60), st.one_of(st.none(), st.integers(0, 80))), max_size=50)


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


def test_response_times_of_some_flows():
    # 10 -> 30; 20 is overtaken; 40 -> 70; 50 is lost; 60 -> 90, and 60 -> 120 again
    found = told([(10, 30), (20, None), (40, 70), (50, None), (60, 90), (60, 120)])
    cases = found['response_time']
    assert cases['all'] == {
        'count': 4, 'min': 30, 'mean': 38, 'median': 30, 'p99': 50, 'max': 50}
    assert cases['best'] == statistics([30, 30])
    assert cases['worst'] == statistics([50, 40])
    assert cases['worst_with_external_latency'] == statistics([50, 50])
    assert found['data_age'] == statistics([20, 30, 30, 60])


@given(st.lists(st.integers(-2**62, 2**62) | st.integers(-5000, 5000), max_size=60))
def test_a_spread(times):
    assert spread(np.array(times, dtype=np.int64)) == statistics(times)


MS = 1_000_000

GRAPH_OWN = """\
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
def simulated(tmp_path, call):
    graph = tmp_path / 'graph.yaml'
    graph.write_text(GRAPH_OWN)
    trace = tmp_path / 'run.mcap'
    call('simulate', graph, '--policy', 'rad', '--workers', 4, '--duration', '500ms',
         '--trace', trace)
    return trace


def test_a_simulated_trace(simulated):
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


def test_a_coroutine_is_one_execution(tmp_path):
    r = Recorded(tmp_path / 'coroutine.mcap')
    r.add('mddag:task_set', 0, 1, GRAPH_OWN, 'g.yaml', 'rad', 2, 100 * MS, 0, False)
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

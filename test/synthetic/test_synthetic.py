# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Synthetic nodes: what they draw and do, and what is measured of them."""

from concurrent.futures import ThreadPoolExecutor
import time

from mddag_executor.executor import current_job
from mddag_executor.executor.executor import MultiDeadlineExecutor
from mddag_executor.executor.session import Session
from mddag_executor.synthetic.bodies import spin
from mddag_executor.synthetic.measure import ExecutionPlan, Ledger, measure, Reading
from mddag_executor.synthetic.workload import SyntheticWorkload
from msg_graph import loads
import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

from ..hosting.conftest import TWO_PROCESSES

MS = 1_000_000

# AND (join; both of one publisher), OR (/sink belongs to fast and slow), a source that is a
# subscription and one that is a service, a group, a queue edge.
GRAPH = """
mddag: 1
nodes:
  - node: /sensor/a
    callbacks:
      - {name: tick, timer: 40ms, dag: fast, publishes: [/left, /right], execution_time: 2ms}
  - node: /sensor/b
    callbacks:
      - {name: tick, timer: 50ms, dag: slow, publishes: [/joined], execution_time: 1ms}
  - node: /filter/left
    callbacks:
      - {name: cb, subscription: /left, publishes: [/left_out, /debug], execution_time: 3ms,
         group: one}
      - {name: again, subscription: /left, publishes: [/debug], deadline: 400ms,
         execution_time: 1ms, group: one}
  - node: /filter/right
    callbacks:
      - {name: cb, subscription: /right, publishes: [/right_out], reads: [/seen]}
  - node: /join
    callbacks:
      - {name: cb, sync: [/left_out, /right_out], publishes: [/joined], execution_time: 2ms}
  - node: /both
    callbacks:
      - {name: cb, sync: [/left, /right], deadline: 400ms}
  - node: /sink
    callbacks:
      - {name: cb, subscription: /joined, deadline: 400ms, execution_time: 1ms}
  - node: /camera
    callbacks:
      - {name: cb, subscription: /image, period: 50ms, dag: camera, publishes: [/seen]}
  - node: /tracker
    callbacks:
      - {name: cb, subscription: /seen, deadline: 400ms, execution_time: 1ms}
  - node: /gate
    callbacks:
      - {name: cb, service: /gate/reset, period: 80ms, dag: gate, deadline: 400ms}
"""


@pytest.fixture
def task_set():
    return loads(GRAPH, 'graph.yaml')


def test_the_critical_path_tells_what_is_infeasible():
    text = """
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: a, timer: 100ms, publishes: [/x], execution_time: 10ms}]
  - node: /b
    callbacks: [{name: b, subscription: /x, publishes: [/y], execution_time: 20ms}]
  - node: /c
    callbacks: [{name: c, subscription: /x, deadline: 30ms, execution_time: 20ms}]
  - node: /d
    callbacks: [{name: d, sync: [/x, /y], deadline: 30ms, execution_time: 1ms}]
"""
    found, = ExecutionPlan(loads(text), 0).infeasible()  # /c takes exactly 30 ms: it is in time
    assert (found.vertex, found.critical_path_ns, found.deadline_ns) == ('/d:d', 31 * MS, 30 * MS)


def test_spinning_takes_cpu_of_its_own_thread_only():
    def measured(_):
        start = time.thread_time_ns()
        spin(30 * MS)
        return time.thread_time_ns() - start

    with ThreadPoolExecutor(3) as pool:
        assert min(pool.map(measured, range(3))) >= 30 * MS


def test_nodes_have_exactly_what_is_declared(task_set, ros_context):
    workload = SyntheticWorkload(task_set, ExecutionPlan(task_set), context=ros_context)
    nodes = {node.get_fully_qualified_name(): node for node in workload.nodes}
    assert set(nodes) == {c.node for c in task_set.callbacks}
    for name, node in nodes.items():
        callbacks = [c for c in task_set.callbacks if c.node == name]
        assert [
            [t.timer_period_ns for t in node.timers], [s.topic_name for s in node.subscriptions],
            [s.srv_name for s in node.services], sorted(p.topic_name for p in node.publishers),
        ] == [
            [c.timer_period_ns for c in callbacks if c.kind == 'timer'],
            [topic for c in callbacks for topic in c.topics],  # without what it only reads
            [c.service for c in callbacks if c.service],
            sorted({'/parameter_events', *(t for c in callbacks for t in c.publishes)})]
    assert all(t.is_canceled() for node in nodes.values() for t in node.timers)
    first, second = nodes['/filter/left'].subscriptions
    assert isinstance(first.callback_group, MutuallyExclusiveCallbackGroup)
    assert first.callback_group is second.callback_group
    assert isinstance(next(iter(nodes['/sink'].subscriptions)).callback_group,
                      ReentrantCallbackGroup)
    workload.destroy()


def test_a_process_prepares_only_what_it_runs(ros_context, monkeypatch):
    task_set = loads(TWO_PROCESSES)
    plan = next(plan for seed in range(99) if [
        (plan := ExecutionPlan(task_set, seed, mode='mixed')).body(vertex)
        for vertex in task_set.vertices] == ['spin', 'native'])
    monkeypatch.delattr('mddag_executor.synthetic.workload.native')  # its speed takes time
    SyntheticWorkload(task_set, plan, context=ros_context, process='one').destroy()


def test_every_release_reaches_every_sink(task_set, ros_context, monkeypatch):
    """And the ledger of a long run is bounded."""
    monkeypatch.setattr('mddag_executor.synthetic.workload.MOST_MEASURED_S', 0.8)
    executor = MultiDeadlineExecutor(task_set, context=ros_context)
    workload = SyntheticWorkload(
        task_set, ExecutionPlan(task_set), context=ros_context, current_job=current_job)
    for node in workload.nodes:
        executor.add_node(node)
    ledger, sizes = workload.ledger, []

    def tick(passed):
        sizes.append([len(each) for lists in (ledger.durations, ledger.completions, ledger.delays)
                      for each in lists.values()])

    with Session(executor) as session:
        assert workload.run(session, 2.3, tick)
    assert session.error is None and session.clean
    assert sizes[-1] == sizes[-2] and max(sizes[0]) > 5
    result = measure(ledger, workload.plan)
    assert 0.8e9 < result['window_ns'] < 2e9
    names = {n for dag in result['dags'].values() for n in dag['sinks']}
    assert names == {'/both:cb', '/filter/left:again', '/sink:cb@fast', '/sink:cb@slow',
                     '/tracker:cb', '/gate:cb'}
    for dag in task_set.dags:
        for name, sink in result['dags'][dag.name]['sinks'].items():
            assert abs(sink['due'] - result['window_ns'] / dag.period_ns) <= 1, name
            assert sink['response_ns']['min'] > -1 * MS     # see _EARLY_NS
            # A busy machine may skip releases and make jobs late, but what began is not lost;
            # some are open at the end, many on a busy machine.
            ran = len(ledger.durations[dag.vertices[dag.source].name])
            releases = {release for release, _ in ledger.completions[name]}
            assert ran / 2 <= len(releases) == len(ledger.completions[name]) <= ran
            # Each sink knows the release of its job exactly: they are on the nominal grid.
            if dag.vertices[dag.source].callback.kind == 'timer':
                for release in sorted(releases)[1:]:    # the first one if the timer was known
                    late = (release - ledger.first_release[dag.name] + 5 * MS) % dag.period_ns
                    assert 0 < late < 10 * MS  # the system clock is adjusted meanwhile
    assert result['attribution'] == {'wrong': 0, 'none': 0}
    workload.destroy()


def test_every_nominal_release_whose_deadline_lies_in_the_window_is_due():
    task_set = loads(
        'mddag: 1\nnodes:\n  - node: /a\n    callbacks: '
        '[{name: a, timer: 100ms, deadline: 150ms, execution_time: 10ms}]\n')
    ledger = Ledger(task_set)
    first = 1_700_000_000 * 1000 * MS
    ledger.first_release['/a'] = first
    # Jobs 0 to 9, deadlines at first + 150, 250, … ms.  The window holds jobs 1 to 8: it begins
    # at the deadline of job 0 and ends at that of job 8.
    for job, response in {0: 10, 1: 150, 2: 151, 3: 20, 5: 250, 6: 30, 8: 40, 9: 50}.items():
        release = first + job * 100 * MS
        ledger.completions['/a:a'].append((release, release + response * MS))
    ledger.window = Reading(first + 150 * MS, 0, (0,)), Reading(first + 950 * MS, 0, (0,))
    result = measure(ledger, ExecutionPlan(task_set))
    sink = result['dags']['/a']['sinks']['/a:a']
    assert {k: sink[k] for k in ('due', 'on_time', 'late', 'missing')} == {
        'due': 8, 'on_time': 4, 'late': 2, 'missing': 2}
    assert sink['response_ns'] == {
        'min': 20 * MS, 'median': 40 * MS, 'p99': 250 * MS, 'max': 250 * MS}
    assert (result['sink_jobs_due'], result['on_time_ratio']) == (8, 0.5)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The executor under misuse: a clear exception, no hang, and everything as it was before."""

import os
import re

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.errors import MddagError
import msg_graph
import pytest
import rclpy
from rclpy.duration import Duration

GRAPH = """
mddag: 1
nodes: [{node: /n, callbacks: [{name: tick, timer: 10ms, deadline: 10ms, dag: d}]}]
"""

WRONG = {
    'graph': (42, {'mddag': 1}), 'num_workers': ('7', 0, -1, 2.5, 4097), 'num_threads': ('7', 0),
    'policy': (None, 'x', [], 'ros2'), 'max_active_jobs': (0,), 'worker_priority': (5,),
    'default_deadline': (None, 1.5, 0, 10**30, Duration(seconds=-1), 'soon', '', '5', '1 parsec'),
    'worker_policy': (5, '__class__', 'sched_yield'),
    'worker_cpus': ('0', {'a'}, set(), {10**6}, 3), 'on_deadline_miss': (3, 'print'),
    'thresholds': (3, {'window': 3}),
    'diagnostics_period': (-5, 1.5, Duration(nanoseconds=1), 'soon', '', '5', '1 parsec'),
}


@pytest.mark.parametrize('name', WRONG)
def test_a_wrong_argument_is_named_in_one_line(ros_context, tmp_path, name):
    trace = tmp_path / 'trace.mcap'
    for value in WRONG[name]:
        with pytest.raises((MddagError, ValueError)) as caught:
            MultiDeadlineExecutor(**{
                'context': ros_context, 'trace': str(trace),
                'worker_cpus': os.sched_getaffinity(0), name: value})
        assert name in str(caught.value) and '\n' not in str(caught.value), value
        assert re.search(': (give|choose|write|add) ', str(caught.value)), value
    # Nothing was begun: no file, and (as ros_context looks) no thread.
    assert not trace.exists()


@pytest.mark.parametrize(('policy', 'priority', 'line'), [
    ('SCHED_FIFO', None, 'worker_priority: SCHED_FIFO needs one: give 1 to 99'),
    ('SCHED_OTHER', 5, 'worker_priority: SCHED_OTHER has none: leave it out')])
def test_a_priority_that_does_not_fit_its_policy(ros_context, policy, priority, line):
    with pytest.raises(MddagError, match=f'^{line}$'):
        MultiDeadlineExecutor(
            context=ros_context, worker_policy=policy, worker_priority=priority)


def test_a_path_that_leads_nowhere(ros_context):
    for graph in ('', 'no/such.yaml', '/', 'a\0b'):
        with pytest.raises(msg_graph.GraphError) as caught:
            MultiDeadlineExecutor(graph, context=ros_context)
        assert str(caught.value).isprintable()


@pytest.fixture
def executor(ros_context):
    made = MultiDeadlineExecutor(msg_graph.loads(GRAPH), 2, context=ros_context)
    yield made
    assert made.shutdown(5.0)


@pytest.fixture
def node(ros_context):
    made = rclpy.create_node('n', context=ros_context, start_parameter_services=False)
    yield made
    made.destroy_node()


def test_what_is_no_node_and_no_timeout(executor):
    for wrong in (None, 5, 'node', object()):
        with pytest.raises(TypeError, match='is not a node'):
            executor.add_node(wrong)
    for wrong in ('x', [], {}, 1j):
        with pytest.raises(TypeError):
            executor.spin_once(wrong)
        with pytest.raises(TypeError):
            executor.spin_until_future_complete(rclpy.Future(), wrong)
    assert executor.get_nodes() == []
    executor.spin_once(0.0)  # would say that it spins already


def test_after_shutdown(executor, node):
    executor.add_node(node)
    assert executor.shutdown(5.0) and executor.shutdown(5.0)
    executor.spin()  # and the others return at once
    executor.spin_once()
    executor.spin_until_future_complete(rclpy.Future())
    executor.spin_once_until_future_complete(rclpy.Future())
    executor.wake()
    assert not executor.create_task(lambda: 1).done()
    executor.remove_node(node)
    with pytest.raises(RuntimeError, match='shut down'):
        executor.add_node(node)
    assert executor.statistics()['dags']['d']['jobs'] == 0

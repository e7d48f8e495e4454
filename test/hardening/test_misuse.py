# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The executor under misuse: a clear exception, no hang, and everything as it was before."""

import threading
import time

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

WRONG = [
    *(('graph', value) for value in (42, {'mddag': 1})),
    *(('num_workers', value) for value in ('7', 0, -1, 2.5, 10**9)),
    *(('num_threads', value) for value in ('7', 0)),
    *(('policy', value) for value in (None, 'x', [])),
    *(('default_deadline', value) for value in (None, 1.5, 0, 10**30, Duration(seconds=-1))),
    ('max_active_jobs', 0),
    *(('worker_policy', value) for value in (5, '__class__', 'sched_yield')),
    ('worker_priority', 5),
    *(('worker_cpus', value) for value in ('0', {'a'}, set(), {10**6})),
    *(('diagnostics_period', value) for value in (-5, 1.5, Duration(nanoseconds=1))),
]


@pytest.mark.parametrize(('name', 'value'), WRONG)
def test_a_wrong_argument_is_named_in_one_line(ros_context, tmp_path, name, value):
    trace = tmp_path / 'trace.mcap'
    arguments = {'context': ros_context, 'trace': str(trace), name: value}
    with pytest.raises(MddagError) as caught:
        MultiDeadlineExecutor(**arguments)
    assert name in str(caught.value) and '\n' not in str(caught.value)
    # Nothing was begun: no file, and (as ros_context looks) no thread.
    assert not trace.exists()


@pytest.mark.parametrize('period', ['soon', '', '5', '1 parsec'])
def test_a_wrong_time_is_a_graph_error(ros_context, period):
    for name in ('default_deadline', 'diagnostics_period'):
        with pytest.raises(ValueError, match=f'^{name}: .*(is not a time|unit|time)'):
            MultiDeadlineExecutor(context=ros_context, **{name: period})


@pytest.mark.parametrize('graph', ['', 'no/such.yaml', '/', 'a\0b'])
def test_a_path_that_leads_nowhere(ros_context, graph):
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


@pytest.mark.parametrize('wrong', [None, 5, 'node', object()])
def test_what_is_no_node(executor, wrong):
    with pytest.raises(TypeError, match='is no node'):
        executor.add_node(wrong)
    assert executor.get_nodes() == []
    executor.spin_once(0.0)


@pytest.mark.parametrize('wrong', ['x', [], {}, 1j])
def test_a_wrong_timeout_leaves_the_executor_as_it_was(executor, wrong):
    with pytest.raises(TypeError):
        executor.spin_once(wrong)
    with pytest.raises(TypeError):
        executor.spin_until_future_complete(rclpy.Future(), wrong)
    executor.spin_once(0.0)  # would say that it spins already


def test_after_shutdown(executor, node):
    executor.add_node(node)
    assert executor.shutdown(5.0) and executor.shutdown(5.0)
    begin = time.monotonic()
    executor.spin()
    executor.spin_once()
    executor.spin_until_future_complete(rclpy.Future())
    executor.spin_once_until_future_complete(rclpy.Future())
    executor.wake()
    assert not executor.create_task(lambda: 1).done()
    executor.remove_node(node)
    with pytest.raises(RuntimeError, match='shut down'):
        executor.add_node(node)
    assert executor.statistics()['dags']['d']['jobs'] == 0
    assert time.monotonic() - begin < 5.0


def test_everything_from_many_threads_at_once(executor, ros_context):
    """Whatever threads do to an executor that spins, it goes on and ends."""
    errors = []
    stop = threading.Event()
    ran = []

    def disturb(index):
        try:
            while not stop.is_set():
                mine = rclpy.create_node(
                    f'n{index}', context=ros_context, start_parameter_services=False,
                    enable_rosout=False)
                mine.create_timer(0.002, lambda: ran.append(index))
                executor.add_node(mine)
                executor.create_task(ran.append, index)
                executor.statistics()
                stop.wait(0.02)
                executor.wake()
                executor.remove_node(mine)
                mine.destroy_node()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=disturb, args=(i,)) for i in range(4)]
    spinning = threading.Thread(target=executor.spin)
    for thread in (spinning, *threads):
        thread.start()
    end = time.monotonic() + 30.0
    while set(ran) != {0, 1, 2, 3} and time.monotonic() < end:
        time.sleep(1.0)
    stop.set()
    for thread in threads:
        thread.join(10.0)
    assert spinning.is_alive() and errors == []
    assert set(ran) == {0, 1, 2, 3}
    assert executor.shutdown(5.0)
    spinning.join(5.0)
    assert not any(thread.is_alive() for thread in (spinning, *threads))

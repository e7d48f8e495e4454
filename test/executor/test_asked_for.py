# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What users have asked rclpy and rclcpp for, by issue, as far as no other test here has it.

Overruns of timers, exceptions of tasks, shutdown from a callback.
"""

import time

from mddag_executor.executor import current_job
from msg_graph import loads
import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from .conftest import Spinning, wait_for

MS = 1_000_000


def test_an_overrun_gives_no_burst_and_the_phase_is_kept(make_executor, make_node):
    """Missed periods are skipped or dropped, and releases stay on the grid (rclcpp#2771)."""
    graph = loads("""
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 20ms, dag: alone, deadline: 20ms}]
""")
    node = make_node('source')
    releases = []

    def tick():
        job = current_job()
        releases.append(job.release_ns)
        if len(releases) == 3:
            time.sleep(0.13)

    node.create_timer(0.02, tick)
    executor = make_executor(graph, num_workers=2, nodes=[node])
    with Spinning(executor):
        assert wait_for(lambda: len(releases) >= 10)
    # (the first may have been due before the executor began to look after the timer)
    for release in releases[1:]:
        assert abs((release - releases[1] + 10 * MS) % (20 * MS) - 10 * MS) < 2 * MS, releases
    counts = executor.statistics()['callbacks']['/source:tick']
    assert counts['skipped'] + counts['dropped'] >= 4
    jobs = round((releases[-1] - releases[0]) / (20 * MS)) + 1
    assert executor.statistics()['dags']['alone']['jobs'] >= jobs


def fails():
    raise KeyError('handled')


async def fails_later():
    fails()


@pytest.mark.parametrize('kind', [fails, fails_later])
@pytest.mark.parametrize('late', [False, True])
def test_an_exception_that_is_handled_does_not_end_the_executor(make_executor, kind, late):
    """Whether the task fails before its maker awaits it or after (rclpy#1215, #1098)."""
    executor = make_executor()

    async def handle():
        handled = 0
        for _ in range(10):
            task = executor.create_task(kind)
            if late:
                assert wait_for(task.done)
            try:
                await task
            except KeyError:
                handled += 1
        return handled

    def look():  # with rclpy's example, in a function
        task = executor.create_task(kind)
        assert wait_for(task.done)
        try:
            task.result()
        except KeyError as error:
            return str(error)
        return ''

    tasks = [executor.create_task(work) for work in (handle, look)]
    with Spinning(executor) as spinning:
        assert wait_for(lambda: all(task.done() for task in tasks))
        time.sleep(0.15)  # exceptions are checked every 100 ms
    assert spinning.error is None
    assert [task.result() for task in tasks] == [10, "'handled'"]


@pytest.mark.parametrize('what', ['context', 'executor', 'executor, waiting'])
def test_shutdown_from_inside_a_callback(make_executor, make_node, ros_context, what):
    """It hangs in rclpy: rclpy#944, and #1646 of an executor's own shutdown."""
    node = make_node()
    executor = make_executor(nodes=[node])
    calls = []

    def end():
        calls.append(1)
        if what == 'context':
            rclpy.shutdown(context=ros_context)
        else:
            executor.shutdown(None if 'waiting' in what else 0)

    node.create_timer(0.01, end, MutuallyExclusiveCallbackGroup())
    node.create_timer(0.001, lambda: time.sleep(0.002))
    spinning = Spinning(executor)
    with spinning:
        spinning.join()
    assert calls == [1]
    assert spinning.error is None

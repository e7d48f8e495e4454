# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

import time

from mddag_executor.executor.jobs import header_stamp
from msg_graph import loads
import pytest
from std_msgs.msg import Header

from .conftest import is_idle, Spinning, wait_for
from .declared import Declared

CHAIN = """
mddag: 1
nodes:
  - node: /sensor
    callbacks: [{name: tick, timer: 20ms, publishes: [/raw], dag: chain,
                 release_from: header_stamp}]
  - node: /first
    callbacks: [{name: first, subscription: /raw, publishes: [/half]}]
  - node: /second
    callbacks: [{name: second, subscription: /half, publishes: [/whole]}]
  - node: /last
    callbacks: [{name: sink, subscription: /whole, deadline: 100ms}]
"""
MS = 1_000_000


# --- stamps --------------------------------------------------------------------------------------


class Thing:
    """A message of an odd kind."""

    def __init__(self, **fields):
        self.__dict__.update(fields)


@pytest.mark.parametrize('message', [
    b'raw', Thing(), Thing(header=None), Thing(stamp=3.5), Thing(header=Thing(stamp='x')),
    Header(), Thing(stamp=Thing(sec=None, nanosec=1))])
def test_no_stamp(message):
    assert header_stamp(message) == -1


def test_stamps_of_a_header_and_of_a_message_that_has_one():
    header = Header()
    header.stamp.sec, header.stamp.nanosec = 3, 7
    assert header_stamp(header) == header_stamp(Thing(header=header)) == 3_000_000_007


# --- two executors are as two processes ----------------------------------------------------------


def in_two(make_executor, make_node, text, elsewhere=('second', 'last')):
    """Run 20 jobs of the chain, some of its nodes in a second executor; return both."""
    nodes = Declared(make_node, text, reentrant=False)
    here, there = make_executor(loads(text)), make_executor(loads(text))
    for name, node in nodes.nodes.items():
        (there if name in elsewhere else here).add_node(node)
    with Spinning(here), Spinning(there):
        nodes.start(here, there)
        assert wait_for(lambda: len(nodes.ran['sink']) >= 20)
        nodes.cancel()
        assert wait_for(lambda: len(nodes.ran['sink']) == len(nodes.ran['tick'])
                        and is_idle(here) and is_idle(there))
    return nodes, here, there


def ends(executor):
    return executor.statistics()['dags']['chain']['ends']


def test_a_job_goes_on_in_another_executor_with_its_stamp_as_release(make_executor, make_node):
    nodes, up, down = in_two(make_executor, make_node, CHAIN.replace('100ms', '60s'))
    n = len(nodes.ran['tick'])
    for name in ('second', 'sink'):
        assert [each.job.job for each in nodes.ran[name]] == list(range(n))
        for each in nodes.ran[name]:
            assert abs(each.job.release_ns - each.stamp) < 2 * MS
    assert nodes.jobs_of_numbers('first') == nodes.jobs_of_numbers('tick')
    skipped = up.statistics()['callbacks']['/sensor:tick']['skipped']  # on a busy machine
    for executor, expired in ((up, skipped), (down, 0)):
        statistics = executor.statistics()
        assert statistics['undeclared'] == 0 and statistics['never_ran'] == []
        assert ends(executor) == {
            'completed': n, 'late': 0, 'aborted': 0, 'expired': expired, 'failed': 0, 'dropped': 0}
    assert up.statistics()['dags']['chain']['sinks'] == {}
    sink = down.statistics()['dags']['chain']['sinks']['/last:sink']
    assert (sink['completed'], sink['late']) == (n, 0)
    assert not up.statistics()['deadline_missed']


def test_a_dag_leaves_and_comes_back_to_the_same_job(make_executor, make_node):
    # nothing is late on a busy machine
    nodes, outer, inner = in_two(
        make_executor, make_node, CHAIN.replace('100ms', '60s'), elsewhere=('second',))
    n = len(nodes.ran['tick'])
    # at home the release is the timer's due time, not the stamp
    assert nodes.jobs('sink') == nodes.jobs('first')
    assert {(b.release_ns - a.release_ns) % (20 * MS) for a, b in zip(
        nodes.jobs('sink')[1:], nodes.jobs('sink')[2:])} == {0}
    skipped = outer.statistics()['callbacks']['/sensor:tick']['skipped']
    assert outer.statistics()['dags']['chain']['jobs'] == n + skipped
    assert ends(outer)['completed'] == ends(inner)['completed'] == n
    assert outer.statistics()['undeclared'] == inner.statistics()['undeclared'] == 0


@pytest.fixture
def lone(make_executor, make_node):
    """Give a spinning executor that has the last two nodes, a publisher on /half, and jobs."""
    nodes = Declared(make_node, CHAIN)
    executor = make_executor(loads(CHAIN))
    for name in ('second', 'last'):
        executor.add_node(nodes.nodes[name])
    half = make_node('elsewhere').create_publisher(Header, '/half', 50)
    with Spinning(executor):
        assert wait_for(lambda: half.get_subscription_count() == 1)
        assert wait_for(nodes.connected)
        yield executor, half, nodes


def stamped(nanoseconds):
    message = Header()
    message.stamp.sec, message.stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
    return message


def test_a_message_without_a_stamp_is_undeclared(lone):
    executor, half, nodes = lone
    half.publish(Header())
    assert wait_for(lambda: len(nodes.ran['sink']) == 1)
    assert nodes.jobs('second') == nodes.jobs('sink') == [None]
    assert executor.statistics()['callbacks']['/second:second']['unattributed'] == 1


def test_a_second_message_of_a_job_that_has_ended_is_undeclared(lone):
    executor, half, nodes = lone
    stamp = time.time_ns()
    half.publish(stamped(stamp))
    assert wait_for(lambda: sum(ends(executor).values()) == 1)
    half.publish(stamped(stamp))
    assert wait_for(lambda: len(nodes.ran['sink']) == 2)
    assert [job is None for job in nodes.jobs('second')] == [False, True]
    assert executor.statistics()['dags']['chain']['jobs'] == 1


def test_a_stamp_of_the_future_is_no_release_before_now(lone):
    executor, half, nodes = lone
    before = time.time_ns()
    half.publish(stamped(before + 10_000 * MS))
    assert wait_for(lambda: len(nodes.ran['sink']) == 1)
    assert abs(nodes.jobs('sink')[0].release_ns - before) < 1000 * MS

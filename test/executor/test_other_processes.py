# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from collections.abc import Callable, Sequence
import time
from typing import Any

from mddag_executor.executor import current_job
from mddag_executor.executor.jobs import header_stamp
from msg_graph import loads
import pytest
from std_msgs.msg import Header

from .conftest import is_idle, Spinning, wait_for

CHAIN = """
mddag: 1
nodes:
  - node: /sensor
    callbacks: [{name: tick, timer: 20ms, publishes: [/raw], dag: chain,
                 release_from: header_stamp}]
  - node: /first
    callbacks: [{name: relay, subscription: /raw, publishes: [/half]}]
  - node: /second
    callbacks: [{name: relay, subscription: /half, publishes: [/whole]}]
  - node: /last
    callbacks: [{name: sink, subscription: /whole, deadline: 100ms}]
"""
MS = 1_000_000


# --- stamps --------------------------------------------------------------------------------------


class Thing:
    """A message of an odd kind."""

    def __init__(self, **fields: Any) -> None:
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


class Nodes:
    """The nodes of CHAIN; jobs by node, each as (job, release, stamp)."""

    def __init__(self, make_node: Any) -> None:
        self.jobs: dict[str, list[Any]] = {}
        self.stamps: list[int] = []
        self.nodes = {n: make_node(n) for n in ('sensor', 'first', 'second', 'last')}
        self.raw = self.nodes['sensor'].create_publisher(Header, '/raw', 50)
        self.publishers = [self.raw]
        for name, topic, to in (
            ('first', '/raw', '/half'), ('second', '/half', '/whole'), ('last', '/whole', None),
        ):
            publisher = self.nodes[name].create_publisher(Header, to, 50) if to else None
            self.nodes[name].create_subscription(
                Header, topic, self._relay(name, publisher), 50)
            if publisher is not None:
                self.publishers.append(publisher)
        self.timer = self.nodes['sensor'].create_timer(0.02, self._tick, autostart=False)

    def _tick(self) -> None:
        message = Header(stamp=self.nodes['sensor'].get_clock().now().to_msg())
        self.stamps.append(header_stamp(message))
        self.jobs.setdefault('sensor', []).append((current_job(), self.stamps[-1]))
        self.raw.publish(message)

    def _relay(self, name: str, publisher: Any) -> Callable[[Any], None]:
        def relay(message):
            self.jobs.setdefault(name, []).append((current_job(), header_stamp(message)))
            if publisher is not None:
                publisher.publish(message)
        return relay

    def connected(self) -> bool:
        """Tell whether all topics have met their subscriptions."""
        return all(p.get_subscription_count() == 1 for p in self.publishers)

    def run(self, *executors: Any) -> None:
        """Start the timer when all are connected; return when all have run for 20 jobs."""
        assert wait_for(self.connected)
        self.timer.reset()
        for executor in executors:
            executor.wake()
        assert wait_for(lambda: len(self.jobs.get('last', ())) >= 20)
        self.timer.cancel()
        assert wait_for(lambda: len(self.jobs['last']) == len(self.stamps)
                        and all(map(is_idle, executors)))


def in_two(
    make_executor: Any, make_node: Any, text: str,
    elsewhere: Sequence[str] = ('second', 'last'),
) -> tuple[Nodes, Any, Any]:
    """Run the chain's nodes, some of them in a second executor; return both."""
    nodes = Nodes(make_node)
    here, there = make_executor(loads(text)), make_executor(loads(text))
    for name, node in nodes.nodes.items():
        (there if name in elsewhere else here).add_node(node)
    with Spinning(here), Spinning(there):
        nodes.run(here, there)
    return nodes, here, there


def ends(executor: Any) -> dict[str, int]:
    return executor.statistics()['dags']['chain']['ends']


def test_a_job_goes_on_in_another_executor_with_its_stamp_as_release(make_executor, make_node):
    nodes, up, down = in_two(make_executor, make_node, CHAIN.replace('100ms', '60s'))
    n = len(nodes.stamps)
    for name in ('second', 'last'):
        assert [job.job for job, _ in nodes.jobs[name]] == list(range(n))
        for job, stamp in nodes.jobs[name]:
            assert abs(job.release_ns - stamp) < 2 * MS
    assert [job.job for job, _ in nodes.jobs['first']] == [
        job.job for job, _ in nodes.jobs['sensor']]
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
    n = len(nodes.stamps)
    # at home the release is the timer's due time, not the stamp
    assert [job for job, _ in nodes.jobs['last']] == [job for job, _ in nodes.jobs['first']]
    assert {(b.release_ns - a.release_ns) % (20 * MS) for (a, _), (b, _) in zip(
        nodes.jobs['last'][1:], nodes.jobs['last'][2:])} == {0}
    skipped = outer.statistics()['callbacks']['/sensor:tick']['skipped']
    assert outer.statistics()['dags']['chain']['jobs'] == n + skipped
    assert ends(outer)['completed'] == ends(inner)['completed'] == n
    assert outer.statistics()['undeclared'] == inner.statistics()['undeclared'] == 0


@pytest.fixture
def lone(make_executor, make_node):
    """Give a spinning executor that has the last two nodes, a publisher on /half, and jobs."""
    nodes = Nodes(make_node)
    executor = make_executor(loads(CHAIN))
    for name in ('second', 'last'):
        executor.add_node(nodes.nodes[name])
    half = make_node('elsewhere').create_publisher(Header, '/half', 50)
    with Spinning(executor):
        assert wait_for(lambda: half.get_subscription_count() == 1)
        assert wait_for(lambda: nodes.publishers[-1].get_subscription_count() == 1)
        yield executor, half, nodes


def stamped(nanoseconds: int) -> Header:
    message = Header()
    message.stamp.sec, message.stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
    return message


def test_a_message_without_a_stamp_is_undeclared(lone):
    executor, half, nodes = lone
    half.publish(Header())
    assert wait_for(lambda: len(nodes.jobs.get('last', ())) == 1)
    assert nodes.jobs['second'][0][0] is nodes.jobs['last'][0][0] is None
    assert executor.statistics()['callbacks']['/second:relay']['unattributed'] == 1


def test_a_second_message_of_a_job_that_has_ended_is_undeclared(lone):
    executor, half, nodes = lone
    stamp = time.time_ns()
    half.publish(stamped(stamp))
    assert wait_for(lambda: sum(ends(executor).values()) == 1)
    half.publish(stamped(stamp))
    assert wait_for(lambda: len(nodes.jobs.get('last', ())) == 2)
    assert nodes.jobs['second'][0][0] is not None
    assert nodes.jobs['second'][1][0] is None
    assert executor.statistics()['dags']['chain']['jobs'] == 1


def test_a_stamp_of_the_future_is_no_release_before_now(lone):
    executor, half, nodes = lone
    before = time.time_ns()
    half.publish(stamped(before + 10_000 * MS))
    assert wait_for(lambda: len(nodes.jobs.get('last', ())) == 1)
    assert abs(nodes.jobs['last'][0][0].release_ns - before) < 1000 * MS

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declared DAGs on real rclpy nodes: which job, in which order, judged how, recorded how."""

from __future__ import annotations

from collections import Counter
import subprocess
import sys
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from mddag_executor import DeadlineMiss
from mddag_executor.executor import current_job
from mddag_executor.executor.work import Work
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import is_idle, Spinning, wait_for

CHAIN = """
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 20ms, publishes: [/a], dag: chain}]
  - node: /middle
    callbacks:
      - {name: relay, subscription: /a, publishes: [/b]}
      - {name: early, subscription: /a, deadline: 10ms}
  - node: /sink
    callbacks: [{name: last, subscription: /b, deadline: 50ms}]
"""


class Chain:
    """CHAIN's nodes; bodies may be replaced; keeps the jobs, and those not of the message."""

    def __init__(self, make_node: Any, bodies: dict[str, Any] | None = None) -> None:
        bodies = bodies or {}
        self.jobs: dict[str, list[Any]] = {n: [] for n in ('tick', 'relay', 'early', 'last')}
        self.wrong: list[Any] = []
        self.group = ReentrantCallbackGroup()
        self.nodes = {n: make_node(n) for n in ('source', 'middle', 'sink')}
        self.a = self.nodes['source'].create_publisher(Header, '/a', 10)
        self.b = self.nodes['middle'].create_publisher(Header, '/b', 10)

        def body(name, publisher=None):
            def run(message=None):
                job = current_job()
                self.jobs[name].append(job)
                if message is None:
                    message = Header(stamp=Time(sec=job.job))
                elif job is not None and job.job != message.stamp.sec:
                    self.wrong.append((name, job, message))
                bodies.get(name, lambda: None)()
                if publisher is not None:
                    publisher.publish(message)
            return run
        self.timer = self.nodes['source'].create_timer(
            0.02, body('tick', self.a), self.group, autostart=False)
        for node, name, topic, publisher in (
            ('middle', 'relay', '/a', self.b), ('middle', 'early', '/a', None),
            ('sink', 'last', '/b', None),
        ):
            self.nodes[node].create_subscription(
                Header, topic, body(name, publisher), 10, callback_group=self.group)

    def start(self, executor: Any) -> None:
        """Add the nodes; start when all are connected."""
        for node in self.nodes.values():
            executor.add_node(node)
        assert wait_for(lambda: self.a.get_subscription_count() == 2
                        and self.b.get_subscription_count() == 1)
        self.timer.reset()
        executor.wake()


def sinks(executor: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for dag in executor.statistics()['dags'].values():
        found.update(dag['sinks'])
    return found


def test_each_callback_runs_for_the_job_that_its_message_belongs_to(make_executor, make_node):
    chain = Chain(make_node)
    executor = make_executor(loads(CHAIN))
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(chain.jobs['last']) >= 20)
        chain.timer.cancel()
        assert wait_for(lambda: len(chain.jobs['last']) == len(chain.jobs['tick']))
    # They may overlap, so the lists need not be in their order.
    ran = sorted(j.job for j in chain.jobs['tick'])
    count = len(ran)
    assert chain.wrong == []
    for jobs in chain.jobs.values():
        assert sorted(j.job for j in jobs) == ran
        assert {j.dag for j in jobs} == {'chain'}
    releases = sorted((j.release_ns, j.job) for j in chain.jobs['last'])
    assert all(after - before == (job - job_before) * 20_000_000 for (before, job_before),
               (after, job) in zip(releases[1:], releases[2:]))  # the first was due earlier
    statistics = executor.statistics()
    missed = statistics['dags']['chain']['ends']['expired']  # periods, on a busy machine
    assert ran[-1] + 1 <= count + missed <= ran[-1] + 4  # or after the last that ran
    assert statistics['undeclared'] == 0
    assert statistics['unattributed'] == {'unknown': 0, 'doubtful': 0}
    assert statistics['dags']['chain']['jobs'] == count + missed
    assert sinks(executor)['/sink:last']['completed'] == count
    assert statistics['never_ran'] == []


def test_jobs_that_overlap_and_overtake_are_told_apart(make_executor, make_node):
    """Odd jobs' relays take longer than a period, so messages on /b are out of order."""
    def dawdle():
        job = current_job()
        assert job is not None
        time.sleep(0.045 if job.job % 2 else 0.001)

    chain = Chain(make_node, {'relay': dawdle})
    executor = make_executor(loads(CHAIN))
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(chain.jobs['last']) >= 20)
        chain.timer.cancel()
        assert wait_for(lambda: len(chain.jobs['last']) == len(chain.jobs['tick']))
    order = [j.job for j in chain.jobs['last']]
    assert order != sorted(order) and sorted(order) == [j.job for j in chain.jobs['tick']]
    assert chain.wrong == []
    assert sinks(executor)['/sink:last']['completed'] == len(order)


def test_unequal_deadlines_are_judged_apart_and_misses_are_told(make_executor, make_node):
    misses: list[DeadlineMiss] = []
    chain = Chain(make_node, {'early': lambda: time.sleep(0.015)})
    graph = CHAIN.replace('50ms', '60s')
    executor = make_executor(loads(graph), on_deadline_miss=misses.append)
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(misses) >= 5)
        chain.timer.cancel()
        assert wait_for(lambda: len(chain.jobs['last']) == len(chain.jobs['tick'])
                        and is_idle(executor))
    found = sinks(executor)
    ran = {job.job for job in chain.jobs['early']}  # a busy machine skips periods, too
    assert found['/middle:early']['late'] == found['/middle:early']['completed'] == len(ran)
    assert found['/sink:last']['late'] == 0
    assert executor.statistics()['dags']['chain']['ends']['late'] == len(ran)
    late = {miss.job: miss for miss in misses if miss.kind in ('late', 'overdue')}
    assert ran <= set(late)
    miss = late[0]
    assert (miss.dag, miss.vertex) == ('chain', '/middle:early')
    assert miss.deadline_ns == miss.release_ns + 10_000_000


FOREIGN = """
import time, rclpy
from std_msgs.msg import Header
rclpy.init()
publisher = rclpy.create_node('foreign').create_publisher(Header, '/a', 10)
while True:
    publisher.publish(Header(frame_id='foreign'))
    time.sleep(0.0001)
"""
SHARED = """
mddag: 1
nodes:
  - node: /own
    callbacks:
      - {name: tick, timer: 5ms, publishes: [/a], dag: own}
      - {name: sink, subscription: /a, deadline: 1s}
"""


def test_messages_of_another_process_in_the_same_microseconds_are_told_apart(
        make_executor, make_node):
    """Many of them lie in the window of a publication here, and have other numbers."""
    counts = Counter[str]()
    node = make_node('own')
    publisher = node.create_publisher(Header, '/a', 10)

    def sink(message):
        job = 'no job' if current_job() is None else 'a job'
        counts[f'{message.frame_id or "own"}: {job}'] += 1

    group = ReentrantCallbackGroup()
    timer = node.create_timer(
        0.005, lambda: publisher.publish(Header()), group, autostart=False)
    node.create_subscription(Header, '/a', sink, 1000, callback_group=group)
    # On a busy machine there are too many foreign ones: they have time, and no job ends before.
    executor = make_executor(
        loads(SHARED), num_workers=2, nodes=[node], default_deadline='10s', max_active_jobs=1000)
    foreign = subprocess.Popen([sys.executable, '-c', FOREIGN])
    try:
        with Spinning(executor):
            # its numbers are larger from then on
            assert wait_for(lambda: counts['foreign: no job'] >= 500)
            timer.reset()
            executor.wake()
            assert wait_for(lambda: counts['own: a job'] + counts['own: no job'] >= 150)
    finally:
        foreign.kill()
        foreign.wait()
    assert counts['foreign: a job'] == counts['own: no job'] == 0, counts


TWO_TO_ONE = """
mddag: 1
nodes:
  - node: /left
    callbacks: [{name: tick, timer: 20ms, publishes: [/a, /left], dag: fork}]
  - node: /worker
    callbacks:
      - {name: one, subscription: /left, publishes: [/x]}
      - {name: two, subscription: /left, publishes: [/y]}
  - node: /join
    callbacks:
      - {name: both, sync: [/x, /y], deadline: 50ms}
      - {name: any, subscription: /a, deadline: 50ms}
  - node: /right
    callbacks: [{name: tick, timer: 30ms, publishes: [/a], dag: other}]
"""


def test_sync_completes_with_the_last_leg_and_or_tells_publishers_apart(make_executor, make_node):
    group = ReentrantCallbackGroup()
    left, worker, join, right = (make_node(n) for n in ('left', 'worker', 'join', 'right'))
    legs: list[Any] = []
    anys: list[Any] = []
    a1, fork = (left.create_publisher(Header, t, 10) for t in ('/a', '/left'))
    a2 = right.create_publisher(Header, '/a', 10)
    x, y = (worker.create_publisher(Header, t, 10) for t in ('/x', '/y'))

    def tick():
        a1.publish(Header())
        fork.publish(Header())

    timers = [left.create_timer(0.02, tick, group, autostart=False),
              right.create_timer(0.03, lambda: a2.publish(Header()), group, autostart=False)]
    worker.create_subscription(
        Header, '/left', lambda m: x.publish(Header()), 10, callback_group=group)
    worker.create_subscription(
        Header, '/left', lambda m: (time.sleep(0.005), y.publish(Header())), 10,
        callback_group=group)
    for topic in ('/x', '/y'):
        join.create_subscription(
            Header, topic, lambda m, t=topic: legs.append((current_job().job, t)), 10,
            callback_group=group)
    join.create_subscription(
        Header, '/a', lambda m: anys.append((current_job().dag, current_job().job)), 10,
        callback_group=group)
    executor = make_executor(loads(TWO_TO_ONE))
    with Spinning(executor):
        for node in (left, worker, join, right):
            executor.add_node(node)
        assert wait_for(lambda: a1.get_subscription_count() == a2.get_subscription_count() == 1
                        and fork.get_subscription_count() == 2
                        and x.get_subscription_count() == y.get_subscription_count() == 1)
        for timer in timers:
            timer.reset()
        executor.wake()
        assert wait_for(lambda: len(legs) >= 20 and len(anys) >= 20)
        for timer in timers:
            timer.cancel()
        assert wait_for(lambda: len(legs) == 2 * len({job for job, _ in legs})
                        and is_idle(executor))
    statistics = executor.statistics()
    # Where the machine is slow, periods are missed: those jobs expire, and nothing of them runs.
    forks, others = (statistics['dags'][n]['jobs'] - statistics['dags'][n]['ends']['expired']
                     for n in ('fork', 'other'))
    ran = sorted({job for job, _ in legs})
    assert len(ran) == forks and forks >= 10
    assert sorted(legs) == sorted((j, t) for j in ran for t in ('/x', '/y'))
    assert sorted(job for dag, job in anys if dag == 'fork') == ran
    assert len({job for dag, job in anys if dag == 'other'}) == others == len(anys) - forks
    found = sinks(executor)
    assert found['/join:both']['completed'] == forks
    assert found['/join:both']['response_ns']['min'] >= 5_000_000
    assert found['/join:any@fork']['completed'] == forks
    assert found['/join:any@other']['completed'] == others
    assert statistics['undeclared'] == 0


ORDER = """
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 10s, publishes: [/c, /a, /b], dag: race}]
  - node: /racer
    callbacks:
      - {name: c, subscription: /c, deadline: 300ms}
      - {name: a, subscription: /a, deadline: 100ms}
      - {name: b, subscription: /b, deadline: 200ms}
"""


@pytest.mark.parametrize('policy, expected', [('rad', 'abc'), ('gedf', 'cab')])
def test_ready_callbacks_run_in_the_policys_order(make_executor, make_node, policy, expected):
    """One worker is kept busy until all three are ready; gedf knows but one deadline a DAG."""
    source, racer = make_node('source'), make_node('racer')
    ran: list[str] = []
    group = ReentrantCallbackGroup()
    publishers = [source.create_publisher(Header, f'/{name}', 10) for name in 'cab']

    def tick():
        for ready, publisher in enumerate(publishers, 1):  # they become ready one after the other
            publisher.publish(Header())
            assert wait_for(lambda n=ready: executor.statistics()['queue'] == n)

    timer = source.create_timer(10.0, tick, group)
    for name in 'cab':
        racer.create_subscription(
            Header, f'/{name}', lambda m, n=name: ran.append(n), 10, callback_group=group)
    executor = make_executor(loads(ORDER), num_workers=1, policy=policy, nodes=[source, racer])
    with Spinning(executor):
        assert wait_for(lambda: all(p.get_subscription_count() == 1 for p in publishers))
        timer.timer_period_ns = 10_000_000_000
        executor.create_task(tick_as_timer, executor, timer, tick)
        assert wait_for(lambda: len(ran) == 3)
    assert ''.join(ran) == expected


def tick_as_timer(executor: Any, timer: Any, tick: Any) -> None:
    """Have the engine told that the timer is due, instead of waiting ten seconds."""
    entity = executor._registry.by_id[id(timer)]
    executor._pool.report(
        lambda now: executor._engine.timer_due(Work(entity, timer.callback), now, now))


def test_a_lost_message_expires_its_job(make_executor, make_node):
    """Nobody runs the relay: its jobs cannot complete, expire, and free their places."""
    chain = Chain(make_node)
    chain.nodes['middle'].destroy_subscription(next(iter(chain.nodes['middle'].subscriptions)))
    executor = make_executor(loads(CHAIN.replace('dag: chain', 'dag: chain, max_active_jobs: 3')))
    with Spinning(executor):
        for node in chain.nodes.values():
            executor.add_node(node)
        chain.timer.reset()
        assert wait_for(lambda: len(chain.jobs['tick']) >= 10)
    found = sinks(executor)['/sink:last']
    dag = executor.statistics()['dags']['chain']
    assert found['completed'] == 0
    # Three are open, or less behind releases that a busy machine skipped.
    assert dag['jobs'] - 3 <= dag['ends']['expired'] == found['expired']


def test_what_completes_after_the_end_is_not_counted(make_executor, make_node, ros_context):
    """The run was judged by then, and its trace, which must agree, is closed."""
    begun, judged, ended = threading.Event(), threading.Event(), threading.Event()

    def long():
        begun.set()
        judged.wait(60.0)
        ended.set()

    chain = Chain(make_node, {'early': long})
    executor = make_executor(loads(CHAIN))
    with Spinning(executor) as spinning:
        chain.start(executor)
        assert begun.wait(30.0)
        time.sleep(0.02)    # its deadline is over, and it still runs
        ros_context.shutdown()
        spinning.join()
        counts = sinks(executor)
        judged.set()
        assert counts['/middle:early']['overdue'] > 0
        assert ended.wait(30.0)
    assert sinks(executor) == counts

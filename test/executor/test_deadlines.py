# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declared DAGs on real rclpy nodes: which job, in which order, judged how, recorded how."""

from collections import Counter
import subprocess
import sys
import threading
import time

from mddag_executor.executor import current_job
from mddag_executor.executor.work import Work
from msg_graph import loads
import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import is_idle, Spinning, wait_for
from .declared import Declared

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


def sinks(executor):
    found = {}
    for dag in executor.statistics()['dags'].values():
        found.update(dag['sinks'])
    return found


def test_each_callback_runs_for_the_job_that_its_message_belongs_to(make_executor, make_node):
    chain = Declared(make_node, CHAIN)
    executor = make_executor(loads(CHAIN))
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(chain.ran['last']) >= 20)
        chain.cancel()
        assert wait_for(lambda: len(chain.ran['last']) == len(chain.ran['tick']))
    # They may overlap, so the lists need not be in their order.
    jobs = chain.jobs_of_numbers('tick')
    assert all(chain.jobs_of_numbers(name) == jobs for name in chain.ran)
    assert {job.dag for job in jobs.values()} == {'chain'}
    ran = sorted(job.job for job in jobs.values())
    count = len(ran)
    releases = sorted((job.release_ns, job.job) for job in jobs.values())
    assert all(after - before == (job - job_before) * 20_000_000 for (before, job_before),
               (after, job) in zip(releases[1:], releases[2:]))  # the first was due earlier
    statistics = executor.statistics()
    ends = statistics['dags']['chain']['ends']
    missed = ends['expired'] + ends['dropped']  # periods, on a busy machine
    assert ran[-1] + 1 <= count + missed <= ran[-1] + 4  # or after the last that ran
    assert statistics['undeclared'] == 0
    assert statistics['unattributed'] == {'unknown': 0, 'doubtful': 0}
    assert statistics['dags']['chain']['jobs'] == count + missed
    assert sinks(executor)['/sink:last']['completed'] == count
    assert statistics['never_ran'] == []


def test_jobs_that_overlap_and_overtake_are_told_apart(make_executor, make_node):
    """Odd jobs' relays take longer than a period, so messages on /b are out of order."""
    chain = Declared(make_node, CHAIN, {
        'relay': lambda: time.sleep(0.045 if current_job().job % 2 else 0.001)})
    executor = make_executor(loads(CHAIN))
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(chain.ran['last']) >= 20)
        chain.cancel()
        assert wait_for(lambda: len(chain.ran['last']) == len(chain.ran['tick']))
    order = [each.number for each in chain.ran['last']]
    assert order != sorted(order)
    assert all(chain.jobs_of_numbers(name) == chain.jobs_of_numbers('tick') for name in chain.ran)
    assert sinks(executor)['/sink:last']['completed'] == len(order)


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
    callbacks: [{name: fork, timer: 20ms, publishes: [/a, /left], dag: fork}]
  - node: /worker
    callbacks:
      - {name: one, subscription: /left, publishes: [/x]}
      - {name: two, subscription: /left, publishes: [/y]}
  - node: /join
    callbacks:
      - {name: both, sync: [/x, /y], deadline: 50ms}
      - {name: any, subscription: /a, deadline: 50ms}
  - node: /right
    callbacks: [{name: other, timer: 30ms, publishes: [/a], dag: other}]
"""


def test_sync_completes_with_the_last_leg_and_or_tells_publishers_apart(make_executor, make_node):
    nodes = Declared(make_node, TWO_TO_ONE, {'two': lambda: time.sleep(0.005)})
    executor = make_executor(loads(TWO_TO_ONE))
    legs, anys = nodes.ran['both'], nodes.ran['any']
    with Spinning(executor):
        nodes.start(executor)
        assert wait_for(lambda: len(legs) >= 20 and len(anys) >= 20)
        nodes.cancel()
        assert wait_for(lambda: len(legs) == 2 * len(nodes.ran['fork']) and is_idle(executor))
    statistics = executor.statistics()
    # Where the machine is slow, periods are missed: nothing of those jobs runs.
    forks, others = (
        statistics['dags'][n]['jobs'] - ends['expired'] - ends['dropped']
        for n in ('fork', 'other') for ends in [statistics['dags'][n]['ends']])
    ran = sorted(job.job for job in nodes.jobs('fork'))
    assert len(ran) == forks and forks >= 10
    assert sorted((each.job.job, each.topic) for each in legs) == sorted(
        (job, topic) for job in ran for topic in ('/x', '/y'))
    assert sorted(job.job for job in nodes.jobs('any') if job.dag == 'fork') == ran
    assert len({job.job for job in nodes.jobs('any') if job.dag == 'other'}) == others
    assert others == len(anys) - forks
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
    ran = []
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


def tick_as_timer(executor, timer, tick):
    """Have the engine told that the timer is due, instead of waiting ten seconds."""
    entity = executor._registry.by_id[id(timer)]
    executor._pool.report(
        lambda now: executor._engine.timer_due(Work(entity, timer.callback), now, now))


def test_a_lost_message_expires_its_job(make_executor, make_node):
    """Nobody runs the relay: its jobs cannot complete, expire, and free their places."""
    chain = Declared(make_node, CHAIN)
    chain.nodes['middle'].destroy_subscription(next(iter(chain.nodes['middle'].subscriptions)))
    executor = make_executor(
        loads(CHAIN.replace('dag: chain', 'dag: chain, max_active_jobs: 3')),
        nodes=chain.nodes.values())
    with Spinning(executor):
        for timer in chain.timers:
            timer.reset()
        assert wait_for(lambda: len(chain.ran['tick']) >= 10)
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

    chain = Declared(make_node, CHAIN, {'early': long})
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

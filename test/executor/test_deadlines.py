# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declared DAGs on real rclpy nodes: which job, in which order, judged how; what fails."""

from functools import partial
import threading
import time

from mddag_executor import replay, reschedule
from mddag_executor.executor import current_job
from msg_graph import loads
import pytest
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Header

from .conftest import is_idle, matched, Spinning, wait_for
from .declared import CHAIN, Declared, graph


def sinks(executor):
    found = {}
    for dag in executor.statistics()['dags'].values():
        found.update(dag['sinks'])
    return found


def test_each_callback_runs_for_the_job_that_its_message_belongs_to(make_executor, make_node):
    """
    Odd jobs' relays take longer than a period, so jobs overlap, and messages on /b overtake.

    After an overrun of its callback, the timer skips or drops what it missed: there is no burst,
    and releases stay on the grid (rclcpp#2771).
    """
    def tick():
        if len(chain.ran['tick']) == 3:
            time.sleep(0.15)

    chain = Declared(make_node, CHAIN, {
        'tick': tick, 'relay': lambda: time.sleep(0.045 if current_job().job % 2 else 0.001)})
    executor = make_executor(loads(CHAIN))
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(chain.ran['last']) >= 20)
        chain.cancel()
        assert wait_for(lambda: len(chain.ran['last']) == len(chain.ran['tick']))
    order = [each.number for each in chain.ran['last']]
    assert order != sorted(order)
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
    missed = ends['expired'] + ends['dropped']
    assert missed >= 4
    # each of the others is missed, and also a job that has expired on a busy machine
    assert ran[-1] < statistics['dags']['chain']['jobs'] <= count + missed
    assert statistics['undeclared'] == 0
    assert statistics['unattributed'] == {'unknown': 0, 'doubtful': 0}
    assert statistics['dags']['chain']['jobs'] == count + missed
    assert sinks(executor)['/sink:last']['completed'] == count
    assert statistics['never_ran'] == []


def test_messages_after_a_publication_that_failed_have_their_jobs(make_executor, make_node):
    """The middleware has not counted it."""
    def fail():
        publisher, = (each for each in chain.nodes['source'].publishers if each.topic == '/a')
        with pytest.raises(TypeError):
            publisher.publish('no message')

    chain = Declared(make_node, CHAIN, {'tick': fail})
    executor = make_executor(loads(CHAIN))
    with Spinning(executor):
        chain.start(executor)
        assert wait_for(lambda: len(chain.ran['last']) >= 6)
        chain.cancel()
        assert wait_for(lambda: len(chain.ran['last']) == len(chain.ran['tick']))
    assert executor.statistics()['unattributed'] == {'unknown': 0, 'doubtful': 0}
    assert None not in chain.jobs('last')


TWO_TO_ONE = graph(
    left='name: fork, timer: 20ms, publishes: [/a, /left], dag: fork',
    worker="""
        name: one, subscription: /left, publishes: [/x]
        name: two, subscription: /left, publishes: [/y]""",
    join="""
        name: both, sync: [/x, /y], deadline: 50ms
        name: any, subscription: /a, deadline: 50ms""",
    right='name: other, timer: 30ms, publishes: [/a], dag: other')


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


ORDER = graph(
    source='name: begin, subscription: /start, period: 10s, publishes: [/c, /a, /b], dag: race',
    racer="""
        name: c, subscription: /c, deadline: 30s
        name: a, subscription: /a, deadline: 10s
        name: b, subscription: /b, deadline: 20s""")


@pytest.mark.parametrize('policy, expected', [('rad', 'abc'), ('gedf', 'cab')])
def test_ready_callbacks_run_in_the_policys_order(make_executor, make_node, policy, expected):
    """The only worker publishes for all three; gedf knows but one deadline a DAG."""
    ran = []
    nodes = Declared(make_node, ORDER, {name: partial(ran.append, name) for name in 'abc'})
    start = make_node('other').create_publisher(Header, '/start', 10)
    with Spinning(make_executor(
            loads(ORDER), num_workers=1, policy=policy, nodes=nodes.nodes.values())):
        matched(start)
        assert wait_for(nodes.connected)
        start.publish(Header())
        assert wait_for(lambda: len(ran) == 3)
    assert ''.join(ran) == expected


def test_a_lost_message_expires_its_job(make_executor, make_node):
    """The relay does not run: its jobs cannot complete, expire, and free their places."""
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
    # Three are open, or less behind releases that a busy machine skipped or dropped.
    assert dag['jobs'] - 3 <= sum(dag['ends'].values())
    assert dag['ends']['expired'] == found['expired'] > 3
    assert not dag['ends']['completed'] and not dag['ends']['late']


def test_what_completes_after_the_end_is_not_counted(make_executor, make_node, ros_context):
    """The run was judged by then, and its trace, which must agree, is closed."""
    begun, judged, ended = threading.Event(), threading.Event(), threading.Event()

    def long():
        begun.set()
        judged.wait(60.0)
        ended.set()

    chain = Declared(make_node, CHAIN, {'early': long})
    executor = make_executor(loads(CHAIN))
    with Spinning(executor, raises=ExternalShutdownException) as spinning:
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


# --- callbacks that raise ------------------------------------------------------------------------


class Wrong(Exception):
    """What the callbacks of these tests raise."""


def spin_until(executor, condition):
    """Spin until something is true; return the jobs of which spin raised an exception."""
    caught = []

    def look():
        try:
            executor.spin_once(timeout_sec=0.002)
        except Wrong as error:
            caught.append(error.args[0])
        return bool(condition())

    assert wait_for(look, 10.0)
    return caught


def agrees(trace, statistics):
    """Compare the verdicts of the executor with those of its trace, also rescheduled."""
    recorded = replay(trace)
    assert recorded.warnings == []
    result = recorded.result()
    again = reschedule(trace).result()
    for name, dag in statistics['dags'].items():
        assert result['dags'][name]['ends'] == dag['ends']
        # Rescheduled, skipped releases run as well, and the last ones may not get to an end.
        assert 0 < again['dags'][name]['ends']['failed'] <= dag['ends']['failed']
        for sink, counts in dag['sinks'].items():
            found = result['dags'][name]['sinks'][sink]
            assert {key: found.get(key, 0) for key in counts if key != 'response_ns'} == {
                key: value for key, value in counts.items() if key != 'response_ns'}


def test_the_job_of_a_callback_that_raises_has_failed(make_executor, make_node, tmp_path):
    """What it had published before, and what follows its failure, runs and is not judged."""
    misses = []

    async def relay():
        job = current_job().job
        if job % 2:
            [*chain.nodes['middle'].publishers][-1].publish(Header())
            await executor.create_task(lambda: None)
            raise Wrong(job)

    chain = Declared(make_node, CHAIN, {'relay': relay})
    trace = tmp_path / 'run.mcap'
    graph = CHAIN.replace('50ms', '5s').replace('10ms', '5s')
    executor = make_executor(loads(graph), trace=trace, on_deadline_miss=misses.append)
    chain.start(executor)
    caught = spin_until(executor, lambda: sum(j.job % 2 for j in chain.jobs('relay')) >= 5)
    chain.cancel()
    caught += spin_until(executor, lambda: {len(ran) for ran in chain.ran.values()} == {
        len(chain.ran['tick'])} and executor.statistics()['queue'] == 0)
    ran = [job.job for job in chain.jobs('relay')]
    odd = sorted(job for job in ran if job % 2)
    assert sorted(caught) == odd
    executor.shutdown(5.0)
    statistics = executor.statistics()
    assert statistics['dags']['chain']['ends']['failed'] == len(odd) >= 5
    last = sinks(executor)['/sink:last']
    assert (last['failed'], last['completed']) == (len(odd), len(ran) - len(odd))
    assert statistics['callbacks']['/middle:relay']['failed'] == len(odd)
    assert statistics['callbacks']['/middle:early']['failed'] == 0
    early = sinks(executor)['/middle:early']
    assert early['completed'] + early['failed'] == len(ran)
    assert sorted(m.job for m in misses if m.vertex == '/sink:last' and m.kind == 'failed') == odd
    assert statistics['deadline_missed'] is True
    agrees(trace, statistics)


def test_a_listener_may_handle_exceptions_of_callbacks(make_executor, make_node):
    node, ended = make_node(), []
    numbers = iter(range(1000))

    def tick():
        if next(numbers) % 2:
            raise ValueError('odd')

    async def coroutine():
        pass

    def note(entity, error, outer):
        ended.append((entity, str(error)))
        return error is not None

    timers = [node.create_timer(0.01, tick), node.create_timer(0.01, coroutine)]
    executor = make_executor(nodes=[node])
    executor.on_callback_ended(note)
    with Spinning(executor):
        assert wait_for(lambda: len(ended) > 10)
    assert set(ended) == {
        (timers[0], 'None'), (timers[0], 'odd'), (timers[1], 'None')}

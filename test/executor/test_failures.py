# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Callbacks that raise did not deliver: their jobs end as failed, live and in every replay."""

from mddag_executor.executor import current_job
from mddag_executor.replay import replay, reschedule
from msg_graph import loads
from std_msgs.msg import Header

from .conftest import Spinning, wait_for
from .declared import Declared
from .test_deadlines import CHAIN, sinks


class Wrong(Exception):
    """What the callbacks of these tests raise."""


def odd_jobs_raise():
    job = current_job()
    if job.job % 2:
        raise Wrong(job.job)


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
        # Rescheduled, skipped releases run, too, and the last ones may not get to an end.
        assert 0 < again['dags'][name]['ends']['failed'] <= dag['ends']['failed']
        for sink, counts in dag['sinks'].items():
            found = result['dags'][name]['sinks'][sink]
            assert {key: found.get(key, 0) for key in counts if key != 'response_ns'} == {
                key: value for key, value in counts.items() if key != 'response_ns'}


def test_the_job_of_a_callback_that_raises_has_failed(make_executor, make_node, tmp_path):
    misses = []
    chain = Declared(make_node, CHAIN, {'relay': odd_jobs_raise})
    trace = tmp_path / 'run.mcap'
    graph = CHAIN.replace('50ms', '5s').replace('10ms', '5s')
    executor = make_executor(loads(graph), trace=trace, on_deadline_miss=misses.append)
    chain.start(executor)
    caught = spin_until(executor, lambda: sum(j.job % 2 for j in chain.jobs('relay')) >= 5)
    chain.cancel()
    caught += spin_until(executor, lambda: len(chain.ran['relay']) == len(chain.ran['tick'])
                         == len(chain.ran['early']) and executor.statistics()['queue'] == 0)
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
    # what ran of a failed job after its failure has no verdict of its own
    early = sinks(executor)['/middle:early']
    assert early['completed'] + early['failed'] == len(ran)
    assert sorted(m.job for m in misses if m.vertex == '/sink:last' and m.kind == 'failed') == odd
    assert statistics['deadline_missed'] is True
    agrees(trace, statistics)


def test_what_had_been_published_before_still_runs(make_executor, make_node, tmp_path):
    """The source raises after it has published: its messages are received, and not judged."""
    node, sink = make_node('source'), make_node('sink')
    publisher = node.create_publisher(Header, '/a', 10)
    came = []

    def tick():
        job = current_job()
        publisher.publish(Header())
        raise Wrong(job.job)

    timer = node.create_timer(0.02, tick, autostart=False)
    sink.create_subscription(Header, '/a', lambda message: came.append(1), 10)
    trace = tmp_path / 'run.mcap'
    executor = make_executor(loads("""
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 20ms, publishes: [/a], dag: chain}]
  - node: /sink
    callbacks: [{name: last, subscription: /a, deadline: 5s, execution_time: 1ms}]
"""), num_workers=1, trace=trace, nodes=[node, sink])
    assert wait_for(lambda: publisher.get_subscription_count() == 1)
    timer.reset()
    caught = spin_until(executor, lambda: len(came) >= 5)
    timer.cancel()
    caught += spin_until(executor, lambda: len(came) == len(caught))
    executor.shutdown(5.0)
    statistics = executor.statistics()
    assert statistics['dags']['chain']['ends']['failed'] == len(caught)
    assert sinks(executor)['/sink:last']['failed'] == len(caught)
    assert sinks(executor)['/sink:last']['completed'] == 0
    agrees(trace, statistics)


def test_a_listener_may_handle_exceptions_of_callbacks(make_executor, make_node):
    node, ended = make_node(), []
    numbers = iter(range(1000))

    def tick():
        if next(numbers) % 2:
            raise ValueError('odd')

    async def coroutine():
        pass

    def note(entity, error):
        ended.append((entity, str(error)))
        return error is not None

    timers = [node.create_timer(0.01, tick), node.create_timer(0.01, coroutine)]
    executor = make_executor(nodes=[node])
    executor.on_callback_ended(note)
    with Spinning(executor) as spinning:
        assert wait_for(lambda: len(ended) > 10)
    assert spinning.error is None
    assert set(ended) == {
        (timers[0], 'None'), (timers[0], 'odd'), (timers[1], 'None')}


def test_a_coroutine_that_raises_after_it_has_waited(make_executor, make_node):
    node = make_node('source')
    ran = []

    async def tick():
        job = current_job()
        future = executor.create_task(lambda: None)
        await future
        ran.append(job.job)
        raise Wrong(job.job)

    node.create_timer(0.02, tick)
    executor = make_executor(loads("""
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 20ms, deadline: 5s, dag: chain}]
"""), nodes=[node])
    caught = spin_until(executor, lambda: len(ran) >= 3)
    executor.shutdown(5.0)
    ends = executor.statistics()['dags']['chain']['ends']
    assert ends['failed'] == len(ran) >= len(caught) >= 2
    assert ends['completed'] == ends['late'] == 0

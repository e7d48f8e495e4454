# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Rescheduled: the recorded load through the core, with the same and with other settings."""

import json

from mddag_executor.core import PolicyError
from mddag_executor.core.tally import counts
from mddag_executor.errors import UsageError
from mddag_executor.replay import replay, ReplayError, reschedule
from mddag_executor.replay.run_writer import write_trace
from mddag_executor.simulate import periodic_load, PREEMPT, Settings, simulate, START
from mddag_executor.simulate.load import Load
from mddag_executor.trace import TraceFile
from msg_graph import loads
import pytest

from ..replay.helpers import add_execution, begin_trace, end_trace, MS, START_TIME, VPID
from ..simulate.test_run import executions


def starts(log):
    """Return ms since the first one, worker, vertex and job of each start in a log."""
    return [((time - log[0][0]) // MS, worker, vertex, job)
            for time, kind, worker, _, vertex, job in log if kind == START]


TWO = """\
mddag: 1
nodes:
  - node: /slow
    callbacks: [{name: cb, timer: 100ms, deadline: 90ms}]
  - node: /fast
    callbacks: [{name: cb, timer: 10ms, deadline: 4ms}]
"""


def write_two(path):
    """Record a run of 20 ms with a slow job from 0 to 12 and fast ones at 5 and 15 ms."""
    load = Load([0, 5 * MS, 15 * MS], [0, 1, 1], [0, 0, 1], [12 * MS, 2 * MS, 2 * MS], [0, 1],
                [1, 1])
    task_set = loads(TWO, 'two.yaml')
    write_trace(path, task_set, load, simulate(
        task_set, load, Settings(workers=2, duration_ns=20 * MS), log=True))


def test_policy_workers_and_preemption_are_those_asked_for(tmp_path):
    path = tmp_path / 'a.mcap'
    write_two(path)
    same = reschedule(path)
    assert starts(same.log) == [(0, 0, 0, 0), (5, 1, 1, 0), (15, 0, 1, 1)]
    alone = reschedule(path, workers=1)
    assert starts(alone.log) == [(0, 0, 0, 0), (12, 0, 1, 0), (15, 0, 1, 1)]
    assert alone.tally.first_miss['completed_ns'] == 14 * MS
    preemptive = reschedule(path, workers=1, preemptive=True)
    assert starts(preemptive.log) == [(0, 0, 0, 0), (5, 0, 1, 0), (7, 0, 0, 0), (15, 0, 1, 1)]
    assert [e[0] for e in preemptive.log if e[1] == PREEMPT] == [5 * MS]
    assert preemptive.busy == [16 * MS]
    assert not preemptive.tally.missed
    fifo = reschedule(path, workers=1, policy='fifo', preemptive=True).result()
    assert (fifo['policy'], fifo['workers'], fifo['preemptive']) == ('fifo', 1, True)
    assert fifo['deadline_missed']
    assert fifo['utilisation'] == pytest.approx(16 / 20)


def test_another_declaration_schedules_again(tmp_path):
    """Deadlines, order of DAGs and callback groups are those of the declaration given."""
    path = tmp_path / 'a.mcap'
    write_two(path)
    relaxed = TWO.replace('deadline: 4ms', 'deadline: 9ms')
    assert not reschedule(path, loads(relaxed, 'relaxed.yaml'), workers=1).tally.missed
    one_group = """\
mddag: 1
nodes:
  - node: /fast
    callbacks: [{name: cb, timer: 10ms, deadline: 4ms, group: g}]
  - node: /slow
    callbacks: [{name: cb, timer: 100ms, deadline: 90ms}]
"""
    outcome = reschedule(path, loads(one_group, 'g.yaml'))
    assert outcome.warnings == []
    assert starts(outcome.log) == [(0, 0, 1, 0), (5, 1, 0, 0), (15, 0, 0, 1)]
    assert outcome.tables.group[:2] == [0, -1]


def write_with_groups(path, text, *shared):
    """Record two overlapping jobs of two callbacks, and the callback groups that they had."""
    kind = 'mutually_exclusive' if shared else 'reentrant'
    with TraceFile(path, overwrite=True) as file:
        def add(name, ms, *fields, vtid=5):
            file.add(name, START_TIME + ms * MS, VPID, vtid, *fields)

        add('task_set', -1, text, 'g.yaml', 'rad', 2, 100 * MS, 64, False)
        add('add_callback_group', -1, 1, 70, kind)
        add('rcl_timer_init', -1, 11, 100 * MS)
        add('rclcpp_timer_callback_added', -1, 11, 1000)
        add('callback_group_add_timer', -1, 70, 11)
        add('rcl_subscription_init', -1, 12, 2, 12, '/x', 1)
        add('rclcpp_subscription_init', -1, 12, 120)
        add('rclcpp_subscription_callback_added', -1, 120, 1001)
        add('callback_group_add_subscription', -1, 70, 12)
        for vertex, address in ((0, 1000), (1, 1001)):
            add('job_release', 0, vertex, 0, START_TIME)
            add('dispatch', 0, address, vertex, 0, 0, vertex, START_TIME, 0, vtid=vertex)
            add('callback_start', 0, address, False, vtid=vertex)
        for vertex, address in ((0, 1000), (1, 1001)):
            add('callback_end', 5, address, vtid=vertex)
            add('complete', 5, address, vertex, 0, 0, True, START_TIME + 5 * MS, 0, vtid=vertex)
        add('shutdown', 20, START_TIME + 20 * MS)


TIMER_AND_MESSAGE = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 100ms, deadline: 90ms, dag: a}
      - {name: b, service: /s, period: 100ms, deadline: 80ms, dag: b}
"""


def test_recorded_callback_groups_are_kept(tmp_path):
    write_with_groups(tmp_path / 'a.mcap', TIMER_AND_MESSAGE, 'shared')
    apart = reschedule(tmp_path / 'a.mcap')
    assert starts(apart.log) == [(0, 0, 1, 0), (5, 0, 0, 0)]
    write_with_groups(tmp_path / 'b.mcap', TIMER_AND_MESSAGE)
    together = reschedule(tmp_path / 'b.mcap')
    assert starts(together.log) == [(0, 0, 1, 0), (0, 1, 0, 0)]
    # a group of another declaration goes before the recorded one
    declared = TIMER_AND_MESSAGE.replace('dag: a', 'dag: a, group: own').replace('90ms', '91ms')
    parted = reschedule(tmp_path / 'a.mcap', loads(declared, 'd.yaml'))
    assert starts(parted.log) == [(0, 0, 1, 0), (0, 1, 0, 0)]


def test_what_was_not_recorded_takes_the_median_then_the_declared_mean(tmp_path):
    path = tmp_path / 'a.mcap'
    text = TWO.replace('timer: 100ms,', 'timer: 100ms, execution_time: 7ms,')
    with TraceFile(path, overwrite=True) as file:
        file.add('task_set', START_TIME, VPID, 1, text, 'g.yaml', 'rad', 2, 100 * MS, 64, False)
        for job, took in enumerate((1, 3, 2, 0)):
            release = START_TIME + job * 10 * MS
            file.add('job_release', release, VPID, 1, 1, job, release)
            if took:
                end = release + took * MS
                add_execution(file, release, end, 1, 0, job, vpid=VPID, thread=8)
        file.add('job_release', START_TIME + 40 * MS, VPID, 1, 0, 0, START_TIME + 40 * MS)
        file.add('shutdown', START_TIME + 60 * MS, VPID, 1, START_TIME + 60 * MS)
    outcome = reschedule(path)
    took = {(vertex, job): time - start for start, (time, _, _, _, vertex, job)
            in executions(outcome.log)}
    assert took == {(1, 0): MS, (1, 1): 3 * MS, (1, 2): 2 * MS, (1, 3): 2 * MS, (0, 0): 7 * MS}
    result = outcome.result()
    assert (result['executions'], result['estimated_executions']) == (5, 2)
    with pytest.raises(ReplayError, match=(
            'a.mcap: 1 callback did not complete in it, and no execution_time is declared: '
            '/slow:cb: give a GRAPH')):
        reschedule(path, loads(TWO, 'g.yaml'))


def test_pieces_are_added_up_and_legs_are_not(tmp_path):
    """A coroutine's pauses are no execution; a leg that completes nothing loads the workers."""
    text = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 100ms, publishes: [/x, /y], dag: a}
      - {name: b, sync: [/x, /y], deadline: 90ms}
"""
    path = tmp_path / 'a.mcap'
    with TraceFile(path, overwrite=True) as file:
        def piece(vertex, ready, start, end):
            file.add('dispatch', START_TIME + start * MS, VPID, 8, 9, 0, vertex, 0, 0,
                     START_TIME + ready * MS, 0)
            file.add('callback_start', START_TIME + start * MS, VPID, 8, 9, False)
            file.add('callback_end', START_TIME + end * MS, VPID, 8, 9)

        def complete(vertex, end, whole, leg):
            file.add('complete', START_TIME + end * MS, VPID, 8, 9, 0, vertex, 0, whole,
                     START_TIME + end * MS, leg)

        file.add('task_set', START_TIME, VPID, 1, text, 'g.yaml', 'rad', 2, 100 * MS, 64, False)
        file.add('job_release', START_TIME, VPID, 1, 0, 0, START_TIME)
        piece(0, 0, 0, 2)
        piece(0, 0, 20, 23)
        complete(0, 23, True, 0)
        piece(1, 25, 25, 26)
        complete(1, 26, False, 1)
        piece(1, 30, 30, 36)
        complete(1, 36, True, 0)
        file.add('shutdown', START_TIME + 90 * MS, VPID, 1, START_TIME + 90 * MS)
    found = [[(start - START_TIME, entry[0] - START_TIME) for start, entry
              in executions(reschedule(path, overheads=overheads).log)]
             for overheads in (False, True)]
    assert found[0] == [(0, 5 * MS), (5 * MS, 11 * MS), (25 * MS, 26 * MS)]
    # the message is there 7 ms after the end of its publisher
    assert found[1] == [(0, 5 * MS), (12 * MS, 18 * MS), (25 * MS, 26 * MS)]
    callbacks = replay(path).result()['callbacks']
    assert callbacks['/n:a'] == {'executions': 1, 'busy_ns': 5 * MS, 'longest_ns': 5 * MS,
                                 'waiting_ns': 0, 'longest_wait_ns': 0, 'waiting_group_ns': 0}
    breakdown = replay(path).result()['dags']['a']['sinks']['/n:b']['breakdown']['worst']
    assert (breakdown['suspended_ns'], breakdown['executing_ns']) == (18 * MS, 5 * MS + 6 * MS)
    assert reschedule(path).warnings == [
        f'{path}: the time in which coroutines waited is left out: /n:a']


def test_settings_that_can_not_be(tmp_path):
    path = tmp_path / 'a.mcap'
    write_two(path)
    with pytest.raises(PolicyError, match="policy 'best'"):
        reschedule(path, policy='best')
    for workers in (0, -1, 10**9):
        with pytest.raises(UsageError, match='give 1 to'):
            reschedule(path, workers=workers)
    for policy, workers, says in (('newest', 2, "policy 'newest'.*give --policy"),
                                  ('rad', 2**31 - 1, '2147483647 workers: give --workers'),
                                  ('rad', -3, '-3 workers')):
        with TraceFile(path, overwrite=True) as file:
            file.add('task_set', START_TIME, VPID, 1, TWO, 'g.yaml', policy, workers, 100 * MS,
                     64, False)
        with pytest.raises(ReplayError, match=says):
            reschedule(path)
        replay(path).result()


def test_a_preemptive_run_stays_one(tmp_path):
    text = """\
mddag: 1
workers: 1
nodes:
  - node: /slow
    callbacks: [{name: long, timer: 100ms, deadline: 100ms, execution_time: 40ms}]
  - node: /fast
    callbacks: [{name: short, timer: 20ms, deadline: 5ms, execution_time: 1ms}]
"""
    task_set = loads(text, 'g.yaml')
    load = periodic_load(task_set, [[40 * MS], [MS]], 200 * MS)
    outcome = simulate(
        task_set, load, Settings(workers=1, duration_ns=200 * MS, preemptive=True), log=True)
    write_trace(tmp_path / 'a.mcap', task_set, load, outcome)
    hows = [
        ({}, False), ({'preemptive': False}, True), ({'policy': 'ros2'}, True)]
    for how, late in hows:
        result = reschedule(tmp_path / 'a.mcap', **how).result()
        assert result['deadline_missed'] == late
        assert result['preemptive'] != late


def of_python(path, jobs, cpus=2):
    """
    Record jobs of DAGs of one timer callback each, as they ran on a worker each.

    :param jobs: DAG, start, end and CPU time (ms), and whether it held the interpreter.
    """
    callbacks = ', '.join(
        f'{{name: d{dag}, timer: 100ms, deadline: {deadline}ms, dag: d{dag}}}'
        for dag, deadline in enumerate((20, 50, 90)))
    text = f'mddag: 1\nnodes: [{{node: /n, callbacks: [{callbacks}]}}]'
    seen = []
    ends = []
    for dag, start, end, cpu, held in jobs:
        ends.append((end, dag, seen.count(dag), start, cpu, held))
        seen.append(dag)
    ends.sort()
    with TraceFile(path, overwrite=True) as file:
        file.add('task_set', START_TIME, 1, 1, text, 'g.yaml', 'rad', 3, 100 * MS, 64, False, cpus)
        for _, dag, job, start, *_ in sorted(ends, key=lambda each: each[3]):
            now = START_TIME + start * MS
            file.add('job_release', now, 1, 1, dag, job, now)
        for end, dag, job, start, cpu, held in ends:
            now, end = START_TIME + start * MS, START_TIME + end * MS
            add_execution(file, now, end, dag, 0, job, dag, thread=10 + dag, address=9 + dag,
                          computed=(cpu * MS, held))
        file.add('shutdown', START_TIME + 200 * MS, 1, 1, START_TIME + 200 * MS)


def responses(path, **how):
    """Return the response times of the DAGs, rescheduled, ms."""
    dags = reschedule(path, overheads=False, **how).result()['dags']
    return [sink['response_ns']['max'] / MS for dag in dags.values()
            for sink in dag['sinks'].values() if sink['response_ns'] is not None]


def test_what_computes_without_the_interpreter_shares_the_cpus(tmp_path):
    path = tmp_path / 'a.mcap'
    of_python(path, [(0, 0, 12, 12, False), (1, 0, 12, 12, False)])
    assert responses(path) == [12, 12]
    assert sorted(responses(path, cpus=1)) == [21, 24]
    assert responses(path, workers=1) == [12, 24]
    # what holds the interpreter waited for other threads of the executor
    of_python(path, [(0, 0, 20, 10, True)])
    assert (responses(path), responses(path, workers=1)) == ([20], [10])
    # recorded with one CPU they took turns
    of_python(path, [(0, 0, 21, 12, False), (1, 0, 24, 12, False)], cpus=1)
    assert responses(path, cpus=2) == [12, 12]


def test_what_is_declared_counts_more_than_what_was_recorded(tmp_path):
    path = tmp_path / 'a.mcap'
    of_python(path, [(0, 0, 10, 10, False), (1, 0, 10, 10, False)])
    recorded = replay(path).task_set.text
    declared = loads(recorded.replace('dag: d', 'holds_interpreter: true, dag: d'), 'g.yaml')
    assert responses(path) == [10, 10]
    assert responses(path, task_set=declared) == [10, 20]


SELDOM = """\
mddag: 1
workers: 2
nodes:
  - node: /camera
    callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]
  - node: /detect
    callbacks: [{name: run, subscription: /image, publishes: [/object]}]
  - node: /brake
    callbacks: [{name: act, subscription: /object, deadline: 50ms}]
  - node: /other
    callbacks: [{name: tick, timer: 100ms, deadline: 90ms}]
"""


@pytest.mark.parametrize('options', [
    [], ['--workers', '1'], ['--preemptive'], ['--cpus', '1'], ['--overheads', 'none'],
    ['--processes', '2']])
@pytest.mark.parametrize('computes', [False, True])
def test_what_was_not_published_is_not_published_again(options, computes, tmp_path, call):
    # /detect finds an object in every third image; the other jobs expire
    path, jobs = tmp_path / 'run.mcap', 40
    with begin_trace(path, SELDOM, workers=2) as file:
        def ran(start, end, dag, vertex, **more):
            computed = (end - start, True) if computes else ()
            add_execution(file, start, end, dag, vertex, job, computed=computed, **more)

        for publisher, topic in ((51, '/image'), (52, '/object')):
            file.add('rcl_publisher_init', START_TIME, 1, 1, publisher, 1, publisher, topic, 10)
        for job in range(jobs):
            at = START_TIME + job * 100 * MS
            if job > 10 and (job - 11) % 3:
                file.add('expire', at, 1, 1, 0, job - 11)
            for dag in (0, 1):
                file.add('job_release', at, 1, 1, dag, job, at)
            ran(at, at + 2 * MS, 0, 0, address=7)
            file.add('rclcpp_publish', at + MS, 1, 10, 51, 0, 0)
            ran(at + 2 * MS, at + 5 * MS, 0, 1, address=8)
            if job % 3 == 0:
                file.add('rclcpp_publish', at + 4 * MS, 1, 10, 52, 0, 0)
                ran(at + 5 * MS, at + 6 * MS, 0, 2, address=9)
            ran(at + 10 * MS, at + 12 * MS, 1, 0, ready=at, address=6, thread=11, worker=1)
        end_trace(file, START_TIME + jobs * 100 * MS)
    found = []
    for more in ([], ['--reschedule', *options]):
        found.append(json.loads(call('replay', path, *more, '--json', '-').stdout))
    recorded, again = (each['dags']['/camera']['sinks']['/brake:act'] for each in found)
    for verdict in ('completed', 'late', 'overdue', 'expired'):
        assert again[verdict] == recorded[verdict], verdict
    assert (again['completed'], again['expired']) == (14, 19)
    assert found[1]['estimated_executions'] == 0
    # 8 ms in each of 40 jobs, but 1 ms less in those without an object
    assert found[1]['utilisation'] * found[1]['workers'] * found[1]['duration_ns'] == \
        pytest.approx((40 * 7 + 14) * MS)


def test_what_would_have_been_with_demote(tmp_path, call):
    """The recorded execution times say what is too much; nothing is declared."""
    graph, trace, times = (tmp_path / name for name in ('g.yaml', 'run.mcap', 'times.json'))
    graph.write_text("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: main, timer: 30ms, deadline: 30ms, importance: high, dag: main}
      - {name: rest, timer: 20ms, deadline: 20ms, dag: rest}
""")
    times.write_text('{"main": {"/n:main": 20000}, "rest": {"/n:rest": 10000}}')
    call('simulate', graph, '--workers', 1, '--preemptive', '--duration', '3s',
         '--execution-times', times, '--trace', trace)
    in_time = {}
    for on_late in ('continue', 'demote'):
        sink = reschedule(trace, on_late=on_late).result()['dags']['main']['sinks']['/n:main']
        in_time[on_late] = counts(sink).in_time
    assert in_time['continue'] < 20 and in_time['demote'] >= 99


def test_timers_that_were_noticed_late_because_no_worker_was_idle_are_noticed_with_more(tmp_path):
    graph = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: long, timer: 100ms, dag: long, deadline: 100ms, group: a}
      - {name: short, timer: 50ms, dag: short, deadline: 50ms, group: b}
"""
    file = begin_trace(tmp_path / 'a.mcap', graph)
    at = START_TIME
    for job in range(10):
        begin = at + job * 100 * MS
        file.add('job_release', begin, 1, 10, 0, job, begin)
        add_execution(file, begin, begin + 80 * MS, 0, 0, job, ready=begin)
        # due during the long callback, and noticed after it
        file.add('job_release', begin + 80 * MS, 1, 10, 1, job, begin + 10 * MS)
        add_execution(file, begin + 80 * MS, begin + 81 * MS, 1, 0, job, ready=begin + 80 * MS)
    end_trace(file, at + 1000 * MS)
    medians = [reschedule(tmp_path / 'a.mcap', workers=workers).result()['dags']['short']['sinks'][
        '/n:short']['response_ns']['median'] for workers in (1, 2)]
    assert medians == [71 * MS, MS]

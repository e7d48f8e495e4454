# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Rescheduled: the recorded load through the core, with the same and with other settings."""

from types import SimpleNamespace

from mddag_executor import Replay, replay, ReplayError, reschedule
from mddag_executor.core import NEVER, PolicyError
from mddag_executor.errors import UsageError
from mddag_executor.recording.columns import rows
from mddag_executor.recording.tables import EXECUTIONS
from mddag_executor.simulate import PREEMPT, Settings, simulate, START
from mddag_executor.simulate.deliveries import DELAY_NS
from mddag_executor.simulate.workload import Workload
from mddag_executor.sources.open import open_recording
from mddag_executor.trace.schema import GOES_ON
from mddag_executor.whatif import agreement
from mddag_executor.whatif.agreement import disagreement
from mddag_executor.whatif.reschedule import Changes, Observed
from mddag_executor.whatif.run_writer import write_trace
from msg_graph import loads, Process
import pytest

from ..simulate.helpers import executions
from ..sources.helpers import MS, ns, SMALL, Written

TWO = """\
mddag: 1
nodes:
  - {node: /slow, callbacks: [{name: cb, timer: 100ms, deadline: 90ms}]}
  - {node: /fast, callbacks: [{name: cb, timer: 10ms, deadline: 4ms}]}
"""


def starts(log):
    """Return ms since the first one, worker, vertex and job of each start in a log."""
    return [((time - log[0][0]) // MS, worker, vertex, job)
            for time, kind, worker, _, vertex, job in log if kind == START]


def write_two(path, **settings):
    """Record a run of 20 ms with a slow job from 0 to 12 and fast ones at 5 and 15 ms."""
    load = Workload([0, 5 * MS, 15 * MS], [0, 1, 1], [0, 0, 1], [12 * MS, 2 * MS, 2 * MS], [0, 1],
                [1, 1])
    task_set = loads(TWO, 'two.yaml')
    settings = Settings(**{'pools': (2,), 'duration_ns': 20 * MS, **settings})
    write_trace(path, task_set, load, simulate(task_set, load, settings, log=True))
    return path


def test_policy_workers_and_preemption_are_those_asked_for(tmp_path):
    path = write_two(tmp_path / 'a.mcap')
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
    # a preemptive run stays one
    path = write_two(tmp_path / 'b.mcap', pools=(1,), preemptive=True)
    for how, late in (({}, False), ({'preemptive': False}, True), ({'policy': 'ros2'}, True)):
        result = reschedule(path, **how).result()
        assert result['deadline_missed'] == late
        assert result['preemptive'] != late


def test_another_declaration_schedules_again(tmp_path):
    """Deadlines, order of DAGs and callback groups are those of the declaration given."""
    path = write_two(tmp_path / 'a.mcap')
    relaxed = TWO.replace('deadline: 4ms', 'deadline: 9ms')
    assert not reschedule(path, loads(relaxed, 'relaxed.yaml'), workers=1).tally.missed
    outcome = reschedule(path, loads("""\
mddag: 1
nodes:
  - {node: /fast, callbacks: [{name: cb, timer: 10ms, deadline: 4ms, group: g}]}
  - {node: /slow, callbacks: [{name: cb, timer: 100ms, deadline: 90ms}]}
""", 'g.yaml'))
    assert outcome.warnings == []
    assert starts(outcome.log) == [(0, 0, 1, 0), (5, 1, 0, 0), (15, 0, 0, 1)]
    assert outcome.tables.group[:2] == [0, -1]


TWO_TIMERS = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 100ms, deadline: 90ms, dag: a}
      - {name: b, timer: 100ms, deadline: 80ms, dag: b}
"""


def test_recorded_callback_groups_are_kept(tmp_path):
    apart, together = [(0, 0, 1, 0), (5, 0, 0, 0)], [(0, 0, 1, 0), (0, 1, 0, 0)]
    for kind, expected in (('reentrant', together), ('mutually_exclusive', apart)):
        trace = Written(tmp_path / f'{kind}.mcap', TWO_TIMERS, 2)
        trace.group(kind, 1000, 1100)
        for dag in (0, 1):
            trace.release(dag, 0, 0)
            trace.run(dag, 0, 0, 0, 5, worker=dag)
        assert starts(reschedule(trace.end(20)).log) == expected
    # a group of another declaration goes before the recorded one
    declared = TWO_TIMERS.replace('dag: a', 'dag: a, group: own').replace('90ms', '91ms')
    assert starts(reschedule(trace.path, loads(declared, 'd.yaml')).log) == together


def test_what_was_not_recorded_takes_the_median_then_the_declared_mean(tmp_path):
    text = TWO.replace('timer: 100ms,', 'timer: 100ms, execution_time: 7ms,')
    trace = Written(tmp_path / 'a.mcap', text, 2)
    for job, took in enumerate((1, 3, 2, 0)):
        trace.release(1, job, job * 10)
        if took:
            trace.run(1, 0, job, job * 10, job * 10 + took)
    trace.release(0, 0, 40)
    outcome = reschedule(trace.end(60))
    took = {(vertex, job): time - start for start, (time, _, _, _, vertex, job)
            in executions(outcome.log)}
    assert took == {(1, 0): MS, (1, 1): 3 * MS, (1, 2): 2 * MS, (1, 3): 2 * MS, (0, 0): 7 * MS}
    result = outcome.result()
    assert (result['executions'], result['estimated_executions']) == (5, 2)


FORKED = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: cb, timer: 10ms, publishes: [/x], dag: chain}]}
  - {node: /b, callbacks: [{name: cb, subscription: /x, publishes: [/y]}]}
  - {node: /c, callbacks: [{name: cb, subscription: /y, deadline: 5ms}]}
  - {node: /d, callbacks: [{name: cb, subscription: /x, deadline: 5ms}]}
  - {node: /e, callbacks: [{name: cb, timer: 20ms, deadline: 9ms, dag: other}]}
"""


def test_what_never_ran_does_not_run(tmp_path, call):
    """The rest is scheduled: `/d` has its results, `/c` has none, as in the recording."""
    trace = Written(tmp_path / 'a.mcap', FORKED, 2)
    for job in range(4):
        trace.release(0, job, job * 10)
        trace.run(0, 0, job, job * 10, job * 10 + 1)
        trace.run(0, 3, job, job * 10 + 1, job * 10 + 3)
    trace.release(1, 0, 0)
    path = trace.end(60)
    outcome = reschedule(path)
    assert {vertex for _, (_, _, _, _, vertex, _) in executions(outcome.log)} == {0, 3}
    dags = outcome.result()['dags']
    assert dags['other']['ends']['expired'] == 1
    assert outcome.result()['skipped_jobs'] == 1
    counts = {name: sink['completed'] for name, sink in dags['chain']['sinks'].items()}
    assert counts == {'/c:cb': 0, '/d:cb': 4}
    assert (f'{path}: 3 callbacks never ran in it, and no execution_time is declared, so '
            'what-ifs leave out: /b:cb, /c:cb, /e:cb') in outcome.warnings
    result = call('slack', path, '--json', '-').result
    assert result['left_out'] == ['/c:cb', '/e:cb']
    assert [*result['callbacks']] == ['/a:cb', '/d:cb']
    assert 1.99 <= result['callbacks']['/d:cb']['factor'] <= 2      # 2 of 4 ms


def test_what_ran_where_nothing_was_recorded_takes_no_time(tmp_path):
    """The trace is that of one process of a run: the second callback of a chain is in another."""
    trace = Written(tmp_path / 'a.mcap', FORKED, 2)
    for job in range(4):
        trace.release(0, job, job * 20)
        trace.run(0, 0, job, job * 20, job * 20 + 1)
        trace.run(0, 2, job, job * 20 + 8, job * 20 + 10)
    path = trace.end(90)
    outcome = reschedule(path)
    ran = [(time // MS - start // MS, start // MS, vertex) for start, (time, _, _, _, vertex, _)
           in executions(outcome.log)]
    first = ran[0][1]
    assert [(took, start - first) for took, start, vertex in ran if vertex == 2] == [
        (2, job * 20 + 8) for job in range(4)]
    assert {took for took, _, vertex in ran if vertex == 1} == {0}
    assert (f'{path}: 1 callback ran where nothing was recorded, so in what-ifs they take no '
            'time: /b:cb') in outcome.warnings


def test_what_did_not_complete_takes_as_long_as_it_ran_or_longer(tmp_path):
    """A callback hangs, another one only failed, and the last execution of a third is open."""
    trace = Written(tmp_path / 'a.mcap', FORKED, 4)
    for job, took in enumerate((1, 1, 1, 0)):
        trace.release(0, job, job * 10)
        if took:
            trace.run(0, 0, job, job * 10, job * 10 + took)
    trace.add('dispatch', 30, 1000, 0, 0, 3, 0, ns(30), 0, thread=10)
    trace.add('callback_start', 30, 1000, False, thread=10)
    trace.add('dispatch', 5, 1001, 0, 1, 0, 1, ns(1), 0, thread=11)
    trace.add('callback_start', 5, 1001, False, thread=11)
    trace.piece(0, 3, 0, 1, 5, worker=2)
    trace.add('fail', 5, 0, 3, 0)
    outcome = reschedule(trace.end(70))
    load = outcome.work.load
    first = load.cost_base[0]
    took = [[cost // MS for cost in load.costs[first + job * 4:first + job * 4 + 4]]
            for job in range(4)]
    assert [row[0] for row in took] == [1, 1, 1, 40]
    assert [row[1] for row in took] == [65] * 4
    assert not [line for line in outcome.warnings if '/b:cb' in line]


def test_pieces_are_added_up_and_legs_are_not(tmp_path):
    """A coroutine's pauses do not count; a leg that completes nothing loads the workers."""
    trace = Written(tmp_path / 'a.mcap', """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 100ms, publishes: [/x, /y], dag: a}
      - {name: b, sync: [/x, /y], deadline: 90ms}
""", 2)
    trace.release(0, 0, 0)
    trace.piece(0, 0, 0, 0, 2)
    trace.run(0, 0, 0, 20, 23, ready=0)
    trace.run(0, 1, 0, 25, 26, leg=1, whole=False)
    trace.run(0, 1, 0, 30, 36)
    for job, start in ((GOES_ON, 50), (-1, 70)):    # an undeclared coroutine
        trace.piece(-1, -1, job, start, start + 1, ready=49)
    path = trace.end(90)
    found = [[((start - ns(0)) / MS, (entry[0] - ns(0)) / MS) for start, entry
              in executions(reschedule(path, overheads=overheads).log)]
             for overheads in (False, True)]
    assert found[0] == [(0, 5), (5, 11), (25, 26), (49, 50), (70, 71)]
    # the message is there 7 ms after the end of its publisher
    assert found[1] == [(0, 5), (12, 18), (25, 26), (49, 51), (70, 71)]
    result = replay(path).result()
    assert result['callbacks']['/n:a'] == {
        'executions': 1, 'busy_ns': 5 * MS, 'longest_ns': 5 * MS, 'waiting_ns': 0,
        'longest_wait_ns': 0, 'waiting_group_ns': 0, 'waiting_program_ns': 0}
    worst = result['dags']['a']['sinks']['/n:b']['breakdown']['worst']
    assert (worst['suspended_ns'], worst['executing_ns']) == (18 * MS, 5 * MS + 6 * MS)
    assert reschedule(path).warnings == [
        f'{path}: the time in which coroutines waited is left out: /n:a']


@pytest.mark.parametrize(('gap', 'is_long'), [(40, True), (1, False)])
def test_what_a_program_did_between_its_spins_is_left_out_with_a_warning(tmp_path, gap, is_long):
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 50ms, publishes: [/x]}
      - {name: b, subscription: /x, deadline: 20ms}
""", 1)
    trace.program(3, 1001)
    for job in range(10):
        at = 50 * job
        trace.release(0, job, at)
        trace.run(0, 0, job, at, at + 1)
        trace.add('spin_gap', at + 1 + gap * (job == 5), 3, ns(at + 1), ns(
            at + 1 + gap * (job == 5)))
        trace.run(0, 1, job, at + 1 + gap * (job == 5), at + 2 + gap * (job == 5), ready=at + 1)
    found = [each for each in reschedule(trace.end(500)).warnings if 'spin' in each]
    assert found == [
        f'{trace.path}: the time in which programs did not spin is left out, as if they ran '
        'callbacks all the time: /n:b'] * is_long


@pytest.mark.parametrize(('pause', 'is_long'), [(0, False), (10, True)])
def test_a_program_that_spins_once_for_each_callback_only_pauses_between_them(
        tmp_path, pause, is_long):
    """Its gaps begin when a callback starts; b waits for a, which is the same in a what-if."""
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: a, timer: 50ms, dag: a, deadline: 40ms}]}
  - {node: /m, callbacks: [{name: b, timer: 50ms, dag: b, deadline: 40ms}]}
""", 2)
    trace.program(3, 1000, 1100)
    for job in range(10):
        at, then = 50 * job, 50 * job + 20 + pause
        for dag, start in enumerate((at, then)):
            trace.release(dag, job, at)
            trace.run(dag, 0, job, start, start + 20, ready=at)
        trace.add('spin_gap', then, 3, ns(at), ns(then))
    found = [each for each in reschedule(trace.end(500)).warnings if 'did not spin' in each]
    assert [each.endswith(': /m:b') for each in found] == [True] * is_long


def test_the_messages_of_a_simulated_sync_took_no_time(tmp_path, call):
    """It ran once, when the later message was there: that of its first leg."""
    graph, path = tmp_path / 'g.yaml', tmp_path / 'a.mcap'
    graph.write_text(SMALL.replace('[/boxes, /flat]', '[/flat, /boxes]'))
    call('simulate', graph, '--workers', 4, '--duration', '100ms', '--trace', path)
    assert not reschedule(path).work.load.delays.any()


def test_settings_that_can_not_be(tmp_path):
    path = write_two(tmp_path / 'a.mcap')
    with pytest.raises(PolicyError, match="policy 'best'"):
        reschedule(path, policy='best')
    for name, value, says in (('workers', 0, 'give 1 to'), ('workers', 10**9, 'give 1 to'),
                              ('cpus', 0, 'give at least 1'),
                              ('dispatch_overhead', -1, 'give 0 or more')):
        with pytest.raises(UsageError, match=says):
            reschedule(path, **{name: value})
    for policy, workers, says in (('newest', 2, "policy 'newest'.*give --policy"),
                                  ('rad', 2**31 - 1, '2147483647 workers: give --workers'),
                                  ('rad', -3, '-3 workers')):
        Written(path, TWO, workers, policy).end(1)
        with pytest.raises(ReplayError, match=says):
            reschedule(path)
        replay(path).result()


# --- the CPU and the interpreter -----------------------------------------------------------------

def of_python(path, jobs, cpus=2):
    """
    Record jobs of DAGs of one timer callback each, as they ran from 0 on a worker each.

    :param jobs: end, CPU time (ms) and whether it held the interpreter, if that is recorded.
    """
    callbacks = ', '.join(
        f'{{name: d{dag}, timer: 100ms, deadline: {deadline}ms, dag: d{dag}}}'
        for dag, deadline in enumerate((20, 50)))
    trace = Written(
        path, f'mddag: 1\nnodes: [{{node: /n, callbacks: [{callbacks}]}}]', 3, cpus=cpus)
    for dag, _ in enumerate(jobs):
        trace.release(dag, 0, 0)
        trace.release(dag, 1, 100)
    for dag, (end, *computed) in enumerate(jobs):
        trace.run(dag, 0, 0, 0, end, worker=dag, computed=[
            computed[0] * MS, computed[1]] if computed else ())
    return trace.end(200)


def responses(path, **how):
    """Return the response times of the DAGs, rescheduled, ms."""
    dags = reschedule(path, overheads=False, **how).result()['dags']
    return [sink['response_ns']['max'] / MS for dag in dags.values()
            for sink in dag['sinks'].values() if sink['response_ns'] is not None]


def test_what_computes_without_the_interpreter_shares_the_cpus(tmp_path):
    path = of_python(tmp_path / 'a.mcap', [(12, 12, False), (12, 12, False)])
    assert responses(path) == [12, 12]
    assert sorted(responses(path, cpus=1)) == [21, 24]
    assert responses(path, workers=1) == [12, 24]
    # the declaration counts more than the recording
    declared = replay(path).task_set.text.replace('dag: d', 'holds_interpreter: true, dag: d')
    assert responses(path, task_set=loads(declared, 'g.yaml')) == [12, 24]
    # what holds the interpreter waited for other threads of the executor
    of_python(path, [(20, 10, True)])
    assert (responses(path), responses(path, workers=1)) == ([20], [10])
    # recorded with one CPU they took turns
    of_python(path, [(21, 12, False), (24, 12, False)], cpus=1)
    assert responses(path, cpus=2) == [12, 12]
    # what computed a little waited for something else
    assert responses(of_python(path, [(20, 4, False)])) == [20]
    # of two that held the interpreter at the same time each waited for the other
    assert sorted(responses(of_python(path, [(20, 10, True), (20, 10, True)]))) == [10, 20]
    # what did not run is like the others, of which half of the time was CPU time
    load = reschedule(of_python(path, [(10, 5, True)])).work.load
    assert (load.costs[1], load.computed[1], load.holds[1]) == (10 * MS, 5 * MS, 1)
    # what is declared to hold the interpreter computes, though another CPU time is not recorded
    of_python(path, [(12,), (12, 12, False)])
    declared = declared.replace('holds_interpreter: true, dag: d1', 'dag: d1')
    assert sorted(responses(path, task_set=loads(declared, 'g.yaml'), cpus=1)) == [22, 24]


SELDOM = """\
mddag: 1
workers: 2
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
  - {node: /detect, callbacks: [{name: run, subscription: /image, publishes: [/object]}]}
  - {node: /brake, callbacks: [{name: act, subscription: /object, deadline: 50ms}]}
  - {node: /other, callbacks: [{name: tick, timer: 100ms, deadline: 90ms}]}
"""


@pytest.mark.parametrize('computes', [False, True])
def test_what_was_not_published_is_not_published_again(computes, tmp_path, call):
    # /detect finds an object in every third image; the other jobs expire
    trace, jobs = Written(tmp_path / 'run.mcap', SELDOM, 2), 40

    def ran(start, end, dag, vertex, **more):
        trace.run(dag, vertex, job, at + start, at + end,
                  computed=((end - start) * MS, True) if computes else (), **more)

    for publisher, topic in ((51, '/image'), (52, '/object')):
        trace.add('rcl_publisher_init', 0, publisher, 1, publisher, topic, 10)
    for job in range(jobs):
        at = job * 100
        if job > 10 and (job - 11) % 3:
            trace.add('expire', at, 0, job - 11)
        for dag in (0, 1):
            trace.release(dag, job, at)
        ran(0, 2, 0, 0)
        trace.add('rclcpp_publish', at + 1, 51, 0, 0, thread=10)
        ran(2, 5, 0, 1)
        if job % 3 == 0:
            trace.add('rclcpp_publish', at + 4, 52, 0, 0, thread=10)
            ran(5, 6, 0, 2)
        ran(10, 12, 1, 0, ready=at, worker=1)
    path = trace.end(jobs * 100)
    recorded = call('replay', path, '--json', '-').result
    for options in ([], ['--workers', '1'], ['--preemptive'], ['--cpus', '1'],
                    ['--overheads', 'none'], ['--processes', '2']):
        again = call('replay', path, '--reschedule', *options, '--json', '-').result
        sinks = [each['dags']['/camera']['sinks']['/brake:act'] for each in (recorded, again)]
        for verdict in ('completed', 'late', 'overdue', 'expired'):
            assert sinks[1][verdict] == sinks[0][verdict], (options, verdict)
        assert (sinks[1]['completed'], sinks[1]['expired']) == (14, 19)
        assert again['estimated_executions'] == 0
        # 8 ms in each of 40 jobs, but 1 ms less in those without an object
        assert again['utilisation'] * again['workers'] * again['duration_ns'] == \
            pytest.approx((40 * 7 + 14) * MS)
    # a message that crosses processes only then takes the usual time
    apart = Process('p', ('/camera', '/other')), Process('q', ('/detect', '/brake'))
    delays = reschedule(path, processes=lambda *of: apart).work.load.delays
    assert (set(delays[::2]), set(delays[1::2])) == ({DELAY_NS}, {0, NEVER})


def test_a_run_without_jobs_is_rescheduled(tmp_path):
    result = reschedule(Written(tmp_path / 'run.mcap', TWO, 2).end(20)).result()
    assert (result['utilisation'], result['executions']) == (None, 0)


SOMETIMES = SELDOM.replace('/image, publishes', '/image, may_publish')


def test_a_simulated_run_and_its_trace_publish_each_time(tmp_path, call):
    graph = tmp_path / 'seldom.yaml'
    graph.write_text(SOMETIMES.replace('{name: ', '{execution_time: 3ms, name: '))
    path = tmp_path / 'run.mcap'
    simulated = call('simulate', graph, '--workers', '2', '--duration', '1s', '--trace', path,
                     '--json', '-').result['dags']
    replayed = call('replay', path, '--json', '-').result['dags']
    for dags in (simulated, replayed):
        sink = dags['/camera']['sinks']['/brake:act']
        assert (sink['completed'], sink.get('not_due', 0)) == (10, 0)


def published_sometimes(path, is_heard):
    """Return the trace of ten jobs; in each third one `/object` is published, and heard or not."""
    trace = Written(path, SOMETIMES, 2)
    for publisher, topic in ((51, '/image'), (52, '/object')):
        trace.add('rcl_publisher_init', 0, publisher, 1, publisher, topic, 10)
    for job, at in enumerate(range(0, 1000, 100)):
        trace.release(0, job, at)
        trace.run(0, 0, job, at, at + 2)
        trace.run(0, 1, job, at + 2, at + 5)
        if job % 3 == 0:
            trace.add('rclcpp_publish', at + 4, 52, 0, 0, thread=10)
            if is_heard:
                trace.run(0, 2, job, at + 5, at + 6)
    return trace.end(1000)


def test_computed_tables_know_messages_that_were_not_published(tmp_path):
    outcome = reschedule(published_sometimes(tmp_path / 'run.mcap', True))
    computed = Replay(outcome.computed().recording(2)).tally.result()['dags']
    assert computed == outcome.tally.result()['dags']
    sink = computed['/camera']['sinks']['/brake:act']
    assert (sink['completed'], sink['not_due']) == (4, 6)


@pytest.mark.parametrize('options', [{}, {'workers': 1}, {'overheads': False}])
def test_a_message_that_is_published_sometimes_is_missed_if_its_callback_never_ran(
        tmp_path, options):
    """As in the recording, its result is due in the jobs in which it was published."""
    outcome = reschedule(published_sometimes(tmp_path / 'run.mcap', False), **options)
    computed = Replay(outcome.computed().recording(2))
    for of in outcome.recorded.tally, outcome.tally, computed.tally:
        sink = of.result()['dags']['/camera']['sinks']['/brake:act']
        assert (sink['completed'], sink['overdue'], sink['not_due']) == (0, 4, 6)


def test_paths_know_messages_that_arrived_before_their_callback_ended(tmp_path, call):
    """With two workers the next callback starts while the one that has published still runs."""
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 50ms, publishes: [/image]}]}
  - {node: /detect, callbacks: [{name: run, subscription: /image, deadline: 30ms}]}
  - {node: /arm, callbacks: [{name: move, timer: 50ms, reads: [/image], deadline: 50ms}]}
paths:
  - {name: started, callbacks: ['/camera:grab', '/detect:run'], reaction: 90ms, age: 25ms}
  - {name: read, callbacks: ['/camera:grab', '/arm:move'], reaction: 120ms, age: 70ms}
""", 2)
    trace.add('rcl_publisher_init', 0, 51, 1, 51, '/image', 10)
    for job, at in enumerate(range(0, 1000, 50)):
        trace.release(0, job, at)
        trace.release(1, job, at + 4)
        trace.add('rclcpp_publish', at + 2, 51, 0, 0, thread=10)
        trace.run(0, 0, job, at, at + 8)
        trace.run(0, 1, job, at + 3, at + 20, ready=at + 3, worker=1)
        trace.run(1, 0, job, at + 8, at + 9, ready=at + 4)
    path = trace.end(1000)
    results = [call('replay', path, *options, '--json', '-').result['requirements']
               for options in ([], ['--reschedule'], ['--reschedule', '--workers', '3'])]
    figures = [{(name, what): (each['completed'], each['late'], each['response_ns']['median'])
                for name, of in result.items() for what, each in of.items()}
               for result in results]
    assert figures[0] == figures[1] == {
        ('started', 'reaction'): (19, 0, 70 * MS), ('started', 'age'): (20, 0, 20 * MS),
        ('read', 'reaction'): (19, 0, 59 * MS), ('read', 'age'): (20, 0, 9 * MS)}
    assert figures[2]['read', 'age'] == (20, 0, 5 * MS)     # a worker was free at 4 ms


def test_results_of_a_what_if_are_tables(tmp_path):
    """As those of a replay, which has them of the same run if nothing is changed."""
    path = write_two(tmp_path / 'a.mcap')
    for outcome in replay(path), reschedule(path):
        verdicts = outcome.table('verdicts')
        assert ((verdicts['completed'] - verdicts['release']) // MS).tolist() == [2, 12, 2]
    late = reschedule(path, workers=1).table('causes')
    assert (len(late), late['late'].tolist()) == (1, [5 * MS])
    pytest.importorskip('pyarrow', reason='pyarrow is not installed')
    alone = reschedule(path, workers=1)
    assert alone.to_arrow('causes').column('behind').to_pylist() == ['/slow:cb']
    pytest.importorskip('pandas', reason='pandas is not installed')
    assert alone.to_pandas('causes').behind.tolist() == ['/slow:cb']


# --- overheads -----------------------------------------------------------------------------------

def test_timers_that_were_noticed_late_because_no_worker_was_idle_are_noticed_with_more(tmp_path):
    trace = Written(tmp_path / 'a.mcap', """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: long, timer: 100ms, dag: long, deadline: 100ms, group: a}
      - {name: short, timer: 50ms, dag: short, deadline: 50ms, group: b}
""")
    for job in range(10):
        at = job * 100
        trace.release(0, job, at)
        trace.run(0, 0, job, at, at + 80)
        # due during the long callback, and noticed after it
        trace.release(1, job, at + 10, noticed=at + 80)
        trace.run(1, 0, job, at + 80, at + 81)
    trace.end(1000)
    medians = [reschedule(trace.path, workers=workers).result()['dags']['short']['sinks'][
        '/n:short']['response_ns']['median'] for workers in (1, 2)]
    assert medians == [71 * MS, MS]
    # the only worker notices nothing while another callback runs, which another one had noticed
    trace = Written(trace.path, replay(trace.path).task_set.text, 2)
    trace.release(0, 0, 0)
    trace.release(1, 0, 10, noticed=30)
    trace.run(1, 0, 0, 31, 32, ready=30, worker=1)
    trace.run(0, 0, 0, 0, 80)
    trace.end(100)
    for workers, ready in ((1, 10), (2, 30)):
        load = reschedule(trace.path, workers=workers).work.load
        assert load.times.tolist() == [ns(0), ns(ready)]


CHAIN = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 100ms, publishes: [/x], dag: a}
      - {name: b, subscription: /x, publishes: [/y]}
      - {name: c, subscription: /y, deadline: 90ms}
"""


@pytest.mark.parametrize(('delay', 'wake', 'early'), [
    (0, 0, 0), (0.7, 0.3, 0),
    # published 3 ms before the end: the next one runs at the same time, on the other worker
    (0.7, 0.3, 3)])
def test_overheads_are_measured_and_reproduced(tmp_path, delay, wake, early):
    trace = Written(tmp_path / 'a.mcap', CHAIN, 2)
    for job in range(3):
        ready = job * 100 + 0.01
        trace.release(0, job, job * 100, noticed=ready)
        for vertex in range(3 if job < 2 else 2):      # the last one is cut off
            start = ready + wake
            trace.run(0, vertex, job, start, start + 5, worker=vertex % 2, ready=ready)
            ready = start + 5 + delay - early
    path = trace.end(300)
    result = reschedule(path).result()
    sink = result['dags']['a']['sinks']['/n:c']
    expected = round((0.01 + 15 + 2 * (delay - early) + 3 * wake) * MS)
    assert sink['response_ns']['max'] == sink['response_ns']['min'] == expected
    assert sink['completed'] == 3       # executions that were not recorded have the median
    recorded = result['recorded']['dags']['a']['sinks']['/n:c']
    assert recorded['response_ns']['max'] == expected
    assert result['overheads'] == {
        'included': True, 'added_ns': 0, 'dispatch_median_ns': round(wake * MS),
        'transport_median_ns': round((delay - early) * MS)}
    for more, longest in (({}, 15), ({'dispatch_overhead': MS}, 18)):
        ideal = reschedule(path, overheads=False, **more).result()['dags']['a']['sinks']['/n:c']
        assert ideal['response_ns']['max'] == longest * MS


def verdicts(in_time, late):
    """Return the part of a replay or schedule that has its verdicts."""
    dags = {'d': {'sinks': {'/n:t': {
        'completed': in_time + late, 'late': late, 'overdue': 0, 'expired': 0}}}}
    return SimpleNamespace(result=lambda: {'dags': dags})


@pytest.mark.parametrize(('predicted', 'recorded', 'text', 'declared'), [
    ((96, 4), (92, 8), None, True),
    ((9, 0), (0, 9), None, True),     # too few
    ((80, 20), (40, 60), '80.0 % of the results in time, but 40.0 % were: predictions for other '
     'pools are off by as much, or more: they do not include other load of the machine and waits '
     "for Python's lock (callbacks that compute ran on a CPU for 25 % of their time)", True),
    ((40, 60), (80, 20), '40.0 % of the results in time, but 80.0 % were: predictions for other '
     'pools are off by as much, or more', True),
    ((80, 20), (40, 60), '80.0 % of the results in time, but 40.0 % were: predictions for other '
     'pools are off by as much, or more: the recorded run had no declaration, so its callbacks '
     'did not run in the order of their deadlines: record it with the declaration', False)])
def test_a_prediction_is_compared_with_what_the_recorded_pool_did(
        predicted, recorded, text, declared):
    executions = rows(EXECUTIONS, 3, holds_gil=(True, True, False), cpu=(10, 15, 1),
                      busy=(50, 50, 900))
    found = disagreement(SimpleNamespace(tally=verdicts(*predicted), recorded=SimpleNamespace(
        tally=verdicts(*recorded), recording=SimpleNamespace(
            run=SimpleNamespace(name='run.mcap', declared=declared, imported=False),
            executions=executions))))
    assert found == (None if text is None else
                     f'run.mcap: with the recorded pool the prediction has {text}')


def test_a_contradicted_prediction_is_warned_of_with_any_pool(tmp_path, call, monkeypatch):
    path = tmp_path / 'run.mcap'
    trace = Written(path, """\
mddag: 1
nodes: [{node: /n, callbacks: [{name: t, timer: 100ms, deadline: 90ms}]}]
""", workers=1)
    for job in range(60):
        trace.release(0, job, job * 100)
        trace.run(0, 0, job, job * 100, job * 100 + 8, computed=(4 * MS, True))
    trace.end(6000)
    for points, options in ((5, ()), (-1, ()), (-1, ('--workers', '2'))):
        monkeypatch.setattr(agreement, 'POINTS', points)
        done = call('replay', path, '--reschedule', *options)
        assert done.returncode == 0
        assert ('with the recorded pool' in done.stderr) == (points < 0)


def test_several_schedules_of_one_recording_are_as_if_each_were_the_only_one(tmp_path):
    """A single worker takes the CPU time of a callback, and two take its whole time."""
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
nodes: [{node: /n, callbacks: [{name: a, timer: 100ms, deadline: 6ms}]}]
""", workers=2)
    for job in range(60):
        trace.release(0, job, job * 100)
        trace.run(0, 0, job, job * 100, job * 100 + 8, computed=(4 * MS, True))
    path = trace.end(6000)
    observed = Observed(open_recording(path))
    for changes, misses in (({'workers': 1}, False), ({}, True), ({'overheads': False}, True),
                            ({'dispatch_overhead': 3 * MS, 'workers': 1}, True), ({}, True)):
        outcome = observed.reschedule(Changes(**changes), again=True)
        assert outcome.tally.missed == misses
        assert outcome.result() == reschedule(path, **changes).result()
    assert observed.reschedule(Changes()).result() == reschedule(path).result()


def test_each_computed_process_has_a_pool_of_its_own(tmp_path):
    """With one worker each, /a's short callback waits for the long one, and never for /b's."""
    text = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: long, timer: 100ms, deadline: 90ms}
      - {name: short, timer: 100ms, deadline: 10ms}
  - {node: /b, callbacks: [{name: other, timer: 100ms, deadline: 90ms}]}
processes: {up: [/a], down: [/b]}
"""
    run = Written(tmp_path / 'a.mcap', text, workers=4)
    for job in range(3):
        at = 100 * job
        for dag, begin, took in ((0, at, 30), (1, at + 1, 2), (2, at, 20)):
            run.release(dag, job, begin)
            run.run(dag, 0, job, begin, begin + took, worker=dag)
    outcome = reschedule(
        run.end(400), workers=1, policy='fifo', processes=lambda declared, _: declared.processes)
    processes = outcome.table('processes')
    assert (processes['name'].tolist(), processes['executions'].tolist()) == (
        ['up', 'down'], [6, 3])
    assert set(outcome.table('behind')['callback'].tolist()) == {'/a:long'}
    for name in ('releases', 'executions'):
        table, declared = outcome.table(name), outcome.task_set.dags
        nodes = [declared[dag].vertices[0].callback.node for dag in table['dag'].tolist()]
        assert [('/a', '/b')[each] for each in table['process'].tolist()] == nodes

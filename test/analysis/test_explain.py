# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Runs in which deadlines are missed for one known reason, and what `explain` says about them."""

from hypothesis import example, given
from hypothesis import strategies as st
from mddag_executor import open_recording, Replay, replay, reschedule
from mddag_executor.analysis.causes import CAUSES, REMEDIES
from mddag_executor.core.tally import counts, total
import pytest

from ..conftest import examples
from ..sources.helpers import Chances, MS, ns, small, VirtualRun, Written
from .graphs import TWO_RATES

VICTIM = """\
mddag: 1
nodes:
  - {node: /sensor, callbacks: [{name: tick, timer: 50ms, publishes: [/data]}]}
  - {node: /victim, callbacks: [{name: use, subscription: /data, deadline: 12ms}]}
  - node: /heavy
    callbacks:
      - {name: first, dag: first, timer: 100ms, deadline: 90ms}
      - {name: second, dag: second, timer: 100ms, deadline: 90ms}
"""
SYNC = """\
mddag: 1
nodes:
  - {node: /sensor, callbacks: [{name: tick, timer: 50ms, publishes: [/data, /more]}]}
  - {node: /victim, callbacks: [{name: use, sync: [/data, /image], deadline: 22ms}]}
  - {node: /camera, callbacks: [{name: take, subscription: /more, publishes: [/image]}]}
"""
TICK, USE, TAKE = range(3)
JOBS = 100
# What is unlike the others in every fifth job: see `record`.
PLANS = {
    'ran long': {'took': 20},
    'waited': {'wait': 25, 'others': 2},
    'group': {'wait': 25, 'others': 2, 'workers': 6, 'grouped': True},
    'program': {'wait': 25, 'took': 1, 'others': 2, 'workers': 6, 'holds': True,
                'in_program': True},
    # a loop of `spin_once` does something else: the program, the executor; a timer meanwhile
    'program, loop': {'wait': 25, 'gap': 3, 'in_program': True},
    'program, executor': {'wait': 25, 'gap': -1},
    'program, timer': {'lag': 25, 'gap': -1},
    'interpreter': {'wait': 25, 'others': 1, 'workers': 6, 'holds': True},
    'released late': {'lag': 15},
    # the message that comes first is only kept
    'released late, sync': {'lag': 8},
    'transport': {'way': 15},
    'machine': {'wait': 25, 'others': 2, 'stops': True},
    'lost': {'ends': 'expire', 'lag': 30},
    'failed': {'ends': 'fail'},
    # what takes longer has no more CPU time: others compute, or nothing does
    'interpreter, computing': {'took': 20, 'cpu': 2, 'others': 1, 'holds': True},
    'machine, computing': {'took': 20, 'cpu': 2},
    'ran long, computing': {'took': 20, 'cpu': 20}}


def record(trace, job, lag=0, way=0, wait=0, took=2, cpu=None, others=0, holds=False, stops=False,
           ends=None, gap=None):
    """
    Record a job of the victim, in ms.

    It is noticed late by `lag`, its message is under way for `way`, its callback waits and takes
    so long, of which `cpu` is CPU time; meanwhile others run, or nothing does; `ends` is its end.
    The program `gap` does not spin while it is waited for.
    """
    at = job * 50
    trace.release(0, job, at, noticed=at + lag)
    trace.run(0, TICK, job, at + lag, at + lag + 1)
    ready = at + lag + 1 + way
    start, end = ready + wait, ready + wait + took
    for dag in range(1, 1 + others):
        trace.release(dag, job, at)
        trace.run(dag, 0, job, ready, max(start, end - 1), worker=dag - 1,
                  computed=(25 * MS, holds))
    if gap is not None:
        begin, until = (ready, start) if wait else (at, at + lag)
        trace.add('spin_gap', until, gap, ns(begin), ns(until))
    if stops:
        trace.add('stop', start, ns(ready), ns(start))
    if ends == 'expire':
        trace.add('expire', at + 45, 0, job)
        return
    if ends == 'fail':
        trace.add('fail', end, 0, USE, job)
    trace.run(0, USE, job, start, end, ready=ready,
              computed=() if cpu is None else (cpu * MS, True))


def record_sync(trace, job, lag=0):
    at = job * 50 + lag
    trace.release(0, job, job * 50, noticed=at)
    trace.run(0, TICK, job, at, at + 1)
    trace.run(0, USE, job, at + 1, at + 1.01, whole=False)
    trace.run(0, TAKE, job, at + 1, at + 2, worker=1)
    trace.run(0, USE, job, at + 2, at + 17, leg=1)


def explained(path):
    found = replay(path)
    result = found.explanation.result()
    assert len(result['jobs']) == result['missed'] == sum(result['causes'].values())
    assert result['missed'] == total(found.tally.result()['dags']).missed
    return result


@pytest.mark.parametrize('cause', PLANS)
def test_the_right_cause_is_told(cause, tmp_path):
    plan = {**PLANS[cause]}
    cause, _, special = cause.partition(', ')
    trace = Written(tmp_path / 'run.mcap', SYNC if special == 'sync' else VICTIM,
                    plan.pop('workers', 2))
    if plan.pop('grouped', False):
        trace.group('mutually_exclusive', 1001, 1100)       # of /victim:use and /heavy:first
    if plan.pop('in_program', False):
        trace.program(3, 1001, 1100)
        # the executor no longer spins at the end, when nothing waits
        trace.add('spin_gap', 50 * JOBS, -1, ns(50 * JOBS - 1), ns(50 * JOBS))
    for job in range(JOBS):
        if special == 'sync':
            record_sync(trace, job, **plan if job % 5 == 4 else {})
        else:
            record(trace, job, **plan if job % 5 == 4 else (
                {'cpu': 2} if special else {}))
    result = explained(trace.end(50 * JOBS))
    assert result['causes'][cause] == result['missed'] == JOBS // 5
    assert [stall['misses'] for stall in result['stalls']] == [1] * (
        JOBS // 5 if 'stops' in plan else 0)
    for job in result['jobs']:
        if job['verdict'] == 'late':
            assert sum(part['ns'] for part in job['parts']) == job['until_ns'] - job['release_ns']
            assert cause in [part['cause'] for part in job['parts']]
    if cause in ('group', 'program'):   # the tables of response times say the same
        outcome = replay(trace.path)
        usage = outcome.usage.callbacks()['/victim:use']
        worst = outcome.result()['dags']['/sensor']['sinks']['/victim:use']['breakdown']['worst']
        for name in ('group', 'program'):
            expected = 25 * MS if name == cause and special != 'timer' else 0
            assert (usage[f'waiting_{name}_ns'], worst[f'waiting_{name}_ns']) == (
                expected * JOBS // 5, expected)
    if cause in ('waited', 'group', 'program', 'interpreter') and not special:
        behind = {each['callback'] for job in result['jobs'] for part in job['parts']
                  if part['cause'] == cause for each in part['behind'] if each['ns'] > 5 * MS}
        assert behind == {'/heavy:first', '/heavy:second'}.difference(
            () if cause == 'waited' else ['/heavy:second'])


def test_a_callback_waits_for_its_program_and_then_for_the_executor(tmp_path):
    """Another one of the program ran until 11 ms, and nothing spun from 8 to 20 ms."""
    trace = Written(tmp_path / 'run.mcap', VICTIM, 6)
    trace.program(3, 1001, 1100)
    for job in range(JOBS):
        at = 50 * job
        record(trace, job, wait=19, others=0)
        trace.release(1, job, at)
        trace.run(1, 0, job, at + 1, at + 11, worker=1)
        trace.add('spin_gap', at + 20, -1, ns(at + 8), ns(at + 20))
    outcome = replay(trace.end(50 * JOBS))
    usage = outcome.usage.callbacks()['/victim:use']
    assert (usage['waiting_ns'], usage['waiting_program_ns']) == (19 * MS * JOBS, 19 * MS * JOBS)
    times = {part['cause']: part['ns'] for part in outcome.explanation.worst()['parts']}
    assert times['program'] == 19 * MS


@pytest.mark.parametrize('lets_others_run', [False, True])
def test_callbacks_of_a_program_exclude_each_other_also_in_a_what_if(lets_others_run, tmp_path):
    """Unless one of them waited in a call or a spin, so that others ran meanwhile."""
    trace = Written(tmp_path / 'run.mcap', VICTIM, 6)
    trace.program(3, 1100, 1200)    # both callbacks of /heavy
    for job in range(10):
        at, begin = 100 * job, 100 * job + (10 if lets_others_run else 30)
        for dag in (1, 2):
            trace.release(dag, job, at)
        trace.run(1, 0, job, at, at + 30)
        trace.run(2, 0, job, begin, begin + 10, ready=at, worker=1)
    path = trace.end(1000)
    recording = open_recording(path)
    assert [len(runs) for runs in recording.runs_of_programs().values()] == [
        10 if lets_others_run else 20]
    sinks = reschedule(path).result()['dags']
    slowest = sinks['second']['sinks']['/heavy:second']['response_ns']['max']
    assert (slowest < 40 * MS) == lets_others_run


@examples(8)
@example(903, 2)    # the release after that of a job that failed was skipped
@given(st.integers(0, 10 ** 6), st.sampled_from([1, 2, 4]))
def test_all_misses_of_any_run_are_explained(tmp_path, seed, workers):
    path = tmp_path / 'run.mcap'
    run = VirtualRun(path, small(), seed, workers, duration=400 * MS,
                     chances=Chances(undeclared=1))
    result = explained(path)
    assert result['missed'] == total(run.tally.result()['dags']).missed
    assert {job['cause'] for job in result['jobs']} <= set(CAUSES)
    for job in result['jobs']:
        assert (job['cause'] == 'failed') == (job['verdict'] == 'failed')
        for part in job['parts']:
            assert part['ns'] > 0
            for each in part['behind']:
                assert each['ns'] <= workers * (job['until_ns'] - job['release_ns'])


TWO = """\
mddag: 1
workers: 1
nodes:
  - {node: /a, callbacks: [{name: asks, dag: a, timer: 1s, deadline: 990ms}]}
  - {node: /x, callbacks: [{name: late, dag: x, timer: 1s, deadline: 15ms}]}
"""


@pytest.mark.parametrize(('worker', 'cause'), [(-1, 'machine'), (0, 'waited')])
def test_a_callback_that_has_lent_its_worker_keeps_none_busy(worker, cause, tmp_path):
    # the one waits for the answer to a service call; the other starts 300 ms after it is ready
    trace = Written(tmp_path / 'run.mcap', TWO)
    for job in range(5):
        release = job * 1000
        trace.release(0, job, release)
        trace.run(0, 0, job, release, release + 390, worker=worker, thread=10)
        trace.release(1, job, release + 100)
        trace.run(1, 0, job, release + 400, release + 401, ready=release + 100, thread=11)
    result = explained(trace.end(5000))
    assert result['causes'][cause] == result['missed'] == 5
    mostly, = replay(trace.path).explanation.mostly()
    assert (mostly['cause'], mostly['missed'], mostly['vertex'], mostly['behind']) == (
        cause, 5, '/x:late', '/a:asks' if cause == 'waited' else None)
    assert mostly['ns'] == (290 if cause == 'waited' else 300) * MS
    behind = [{'callback': '/a:asks', 'ns': 290 * MS}] if cause == 'waited' else []
    assert all(job['parts'][0]['behind'] == behind for job in result['jobs'])


@pytest.mark.parametrize('aborted', [False, True])
def test_an_undeclared_callback_may_hold_the_interpreter(aborted, tmp_path, call):
    # one of two workers runs it: the other worker's callback cannot begin before it ends; its next
    # release is skipped; or it never begins, and is aborted
    trace = Written(tmp_path / 'run.mcap', TWO, 2)
    for job in range(5):
        release = job * 1000
        start = release + (25 if aborted else 50)
        trace.piece(-1, -1, -1, release, start)
        trace.release(1, 2 * job, release)
        trace.release(1, 2 * job + 1, release + 20, noticed=release + 25)
        trace.add('expire', release + 25, 1, 2 * job + 1)
        if aborted:
            trace.add('abort', start, 1, 2 * job)
            trace.add('drop', start, 8, 1, 0, 2 * job, 'aborted')
        else:
            trace.run(1, 0, 2 * job, start, start + 1, worker=1, ready=release,
                      computed=(MS, True))
    path = trace.end(5000)
    result = explained(path)
    assert result['causes']['interpreter'] == result['missed'] == 10
    for job in result['jobs']:
        if job['job'] % 2:
            skipped, = job['parts']
            assert (skipped['cause'], skipped['waiting_job']) == ('skipped', job['job'] - 1)
        elif not aborted:
            assert [each['ns'] for each in job['parts'][0]['behind']] == [50 * MS]
    if not aborted:
        assert 'skipped: job 2 had not started' in call('explain', path, '--job', '3').stdout
        assert 'no job 10: choose one from 0 to 9' in call('explain', path, '--job', '10').stderr
        # the miss of the earliest deadline is the first one, though another was known before
        assert 'first miss: /x:late, job 0, 36 ms late' in call('replay', path).stdout
        assert '5 jobs whose first callback did not run in the recording: skipped' in call(
            'replay', path, '--reschedule').stdout


@pytest.mark.parametrize(('computed', 'cause'), [
    ((), 'interpreter'), ((49 * MS, True), 'interpreter'), ((0, False), 'machine')])
def test_a_trace_says_whether_an_undeclared_callback_held_the_interpreter(
        computed, cause, tmp_path, call):
    """Older ones do not: then it is assumed, and a line says so."""
    trace = Written(tmp_path / 'run.mcap', TWO, 2)
    for job in range(5):
        at = job * 1000
        trace.piece(-1, -1, -1, at, at + 50, computed=computed)
        trace.release(1, job, at)
        trace.run(1, 0, job, at + 50, at + 51, worker=1, ready=at, computed=(MS, True))
    path = trace.end(5000)
    result = explained(path)
    assert result['causes'][cause] == result['missed'] == 5
    assert result.get('interpreter_assumed', 0) == (0 if computed else 5)
    text = call('explain', path).stdout
    assert ('5 of 5 misses by the interpreter are assumed' in text) == (not computed)
    table = open_recording(path).executions
    assert {*table['cpu'][table['vertex'] < 0].tolist()} == {computed[0] if computed else -1}


def test_a_release_is_skipped_for_what_the_one_before_waited_for(tmp_path):
    # whose result was not due, so that it has no cause of its own; one of two workers is free
    trace = Written(tmp_path / 'run.mcap', VICTIM.replace('publishes', 'may_publish'), 2)
    trace.add('rcl_node_init', 0, 5, 5, 'sensor', '/')
    trace.add('rcl_publisher_init', 0, 7, 5, 7, '/data', 10)
    for job in range(10):
        release = job * 1000
        trace.piece(-1, -1, -1, release, release + 50)
        trace.release(0, 2 * job, release)
        trace.release(0, 2 * job + 1, release + 20, noticed=release + 35)
        trace.add('expire', release + 35, 0, 2 * job + 1)
        trace.run(0, TICK, 2 * job, release + 50, release + 51, ready=release, worker=1)
    path = trace.end(10000)
    result = explained(path)
    assert result['causes']['interpreter'] == result['missed'] == 10
    mostly, = replay(path).explanation.mostly()
    assert mostly == {**mostly, 'vertex': '/sensor:tick', 'ns': 15 * MS}
    assert mostly['behind'] is not None


@pytest.mark.parametrize('killed', [False, True])
def test_what_a_callback_that_never_ends_keeps_waiting(killed, tmp_path, call):
    """A process that is killed does not record what waits then: messages, and a timer."""
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
nodes:
  - {node: /sensor, callbacks: [{name: tick, timer: 50ms, publishes: [/data]}]}
  - node: /victim
    callbacks:
      - {name: use, subscription: /data, deadline: 12ms}
      - {name: own, dag: own, timer: 50ms, deadline: 20ms}
""", 2)
    trace.group('mutually_exclusive', 1001, 1100)
    waiting = []
    for job in range(60):
        at = job * 50
        for dag in (0, 1):
            trace.release(dag, job, at)
        trace.run(0, TICK, job, at, at + 1)
        if job < 10:
            trace.run(0, USE, job, at + 1, at + 2, worker=1)
            trace.run(1, 0, job, at + 2, at + 3, ready=at, worker=1)
            continue
        if job > 10:
            waiting.append((1001, 0, USE, job, -1, ns(at + 1), 0))
        if job == 10:
            waiting.append((1100, 1, 0, job, -1, ns(at), 0))
        else:
            trace.add('expire', at, 1, job)     # skipped
    trace.add('unfinished', 3000, 1001, 0, USE, 10, 1, ns(501), ns(501), 'at victim.py:3',
              thread=11)
    if killed:
        trace.file.finish()
    else:
        for each in waiting:
            trace.add('dispatch', 3000, *each)
        trace.end(3000)
    result = explained(trace.path)
    assert result['causes']['never ended'] == result['missed'] == 100
    assert '100 misses: 100 never ended\n' in call('explain', trace.path).stdout


FOLLOWED = SYNC.replace('deadline: 22ms', 'publishes: [/out]') + """\
  - {node: /after, callbacks: [{name: act, subscription: /out, deadline: 22ms}]}
"""


@pytest.mark.parametrize('graph', [SYNC, FOLLOWED], ids=['sink', 'followed'])
def test_a_sync_that_lacks_a_message_did_not_run_long(graph, tmp_path, call):
    # /image has another name in the node
    trace = Written(tmp_path / 'run.mcap', graph)
    for job in range(20):
        at = job * 50
        trace.release(0, job, at)
        for place, vertex in enumerate((TICK, 2)):
            trace.run(0, vertex, job, at + place, at + place + 1)
        trace.piece(0, USE, job, at + 2, at + 2.25)     # suspended in between
        trace.run(0, USE, job, at + 2.5, at + 3, ready=at + 2, whole=False)
        trace.add('expire', at + 32, 0, job)
    path = trace.end(2000)
    result = explained(path)
    assert result['causes']['lost'] == result['missed'] == 20
    assert result['jobs'][0]['parts'][-1] == {
        'vertex': '/victim:use', 'cause': 'lost', 'ns': 29 * MS, 'behind': [],
        'topics': ['/image']}
    assert 'lost: /image' in call('explain', path, '--job', '3').stdout


@pytest.mark.parametrize(('cause', 'drop', 'published'), [
    ('dropped', 'qos_depth', True), ('dropped', 'newer', True), ('destroyed', 'destroyed', True),
    ('not published', None, False), ('lost', None, True)])
def test_a_callback_that_never_ran_has_the_cause_that_is_recorded(
        cause, drop, published, tmp_path, call):
    # every second message of the sensor starts nothing
    trace = Written(tmp_path / 'run.mcap', VICTIM, 2)
    trace.add('rcl_node_init', 0, 5, 5, 'sensor', '/')
    trace.add('rcl_publisher_init', 0, 7, 5, 7, '/data', 10)
    trace.add('rcl_publisher_init', 0, 8, 5, 8, '/other', 10)
    for job in range(20):
        at = job * 50
        trace.release(0, job, at)
        trace.add('rclcpp_publish', at + 0.25, 8, 0, 0, thread=10)
        if published or job % 2:
            trace.add('rclcpp_publish', at + 0.5, 7, 0, 0, thread=10)
        trace.run(0, TICK, job, at, at + 1)
        for dag in (1, 2):
            trace.release(dag, job, at + 1)
            trace.run(dag, 0, job, at + 1, at + 30, worker=dag - 1)
        if job % 2:
            trace.run(0, USE, job, at + 2, at + 3, worker=1)
            continue
        if drop is not None:
            trace.add('drop', at + 31, 1001, 0, USE, job, drop)
        trace.add('expire', at + 45, 0, job)
    path = trace.end(1000)
    result = explained(path)
    assert result['causes'][cause] == result['missed'] == 10
    part = result['jobs'][0]['parts'][-1]
    assert (part['vertex'], part['cause'], part['topics']) == ('/victim:use', cause, ['/data'])
    assert {each['callback'] for each in part['behind']} == (
        {'/heavy:first', '/heavy:second'} if cause == 'dropped' else set())
    text = call('explain', path).stdout
    assert f'{cause}: /data' in text and f'10 misses: 10 {cause}\n' in text
    assert REMEDIES[cause] in text


def test_a_timer_that_was_reset_while_it_waited_is_withdrawn(tmp_path, call):
    """Nothing of messages or queues explains or mends that."""
    text = """\
mddag: 1
nodes:
  - node: /dog
    callbacks: [{name: bark, timer: 50ms, sporadic: true, deadline: 20ms}]
"""
    trace = Written(tmp_path / 'run.mcap', text, 1)
    for job in range(20):
        at = job * 50
        trace.release(0, job, at)
        if job % 2:
            trace.run(0, 0, job, at, at + 1)
            continue
        trace.add('drop', at + 10, 1000, 0, 0, job, 'withdrawn')
        trace.add('expire', at + 10, 0, job)
    path = trace.end(1000)
    result = explained(path)
    assert result['causes']['withdrawn'] == result['missed'] == 10
    part = result['jobs'][0]['parts'][-1]
    assert (part['vertex'], part['cause'], part['behind'], part['topics']) == (
        '/dog:bark', 'withdrawn', [], [])
    lines = call('explain', path).stdout.splitlines()
    line = next(each for each in lines if REMEDIES['withdrawn'] in each)
    assert 'QoS' not in line and '10 misses: 10 withdrawn' in lines


@pytest.mark.parametrize(('importance', 'second'), [
    ('high', 'less important'), ('normal', 'demoted')])
def test_lateness_is_told_from_importance(importance, second, tmp_path):
    # both sinks are demoted and start after 80 ms: the one when its deadline was out of reach,
    # the other one at once, for the more important one, if there is one
    trace = Written(tmp_path / 'run.mcap', f"""\
mddag: 1
workers: 1
nodes:
  - node: /a
    callbacks:
      - {{name: main, dag: a, timer: 1s, deadline: 90ms, importance: {importance}}}
  - {{node: /b, callbacks: [{{name: late, dag: b, timer: 1s, deadline: 20ms}}]}}
  - {{node: /c, callbacks: [{{name: less, dag: c, timer: 1s, deadline: 20ms}}]}}
""")
    for job in range(10):
        at = job * 1000
        for dag in (0, 1, 2) if job % 2 else (1, 2):
            trace.release(dag, job, at)
        if job % 2:
            trace.run(0, 0, job, at, at + 80)
            trace.add('demote', at + 1, 2, 0, job)
            trace.add('demote', at + 16, 1, 0, job)
        start = at + (80 if job % 2 else 1)
        trace.run(1, 0, job, start, start + 5, ready=at)
        trace.run(2, 0, job, start + 5, start + 10, ready=at)
    result = explained(trace.end(10000))
    assert result['sinks'] == {name: {**dict.fromkeys(CAUSES, 0), cause: 5} for name, cause in (
        ('/b:late', 'demoted'), ('/c:less', second))}
    assert all(part['behind'][0]['callback'] == '/a:main' for job in result['jobs']
               for part in job['parts'] if part['cause'] in ('demoted', 'less important'))


def test_only_misses_in_stops_are_said_to_be_in_them(tmp_path, call):
    # each job's callback starts 20 ms after it was ready, with an idle worker; the machine stood
    # still twice in that of one job, and once in that of another
    trace = Written(tmp_path / 'run.mcap', TWO)
    trace.add('stop', 0, ns(0), ns(0))      # stops are recorded
    for job in range(9):
        release = job * 1000
        trace.release(1, job, release)
        start = release + 20
        if job in (3, 5):
            start += 60
            for first, last in ((10, 35), (40, 70))[job // 5:]:
                trace.add('stop', release + last, ns(release + first), ns(release + last))
        trace.run(1, 0, job, start, start + 1, ready=release)
    path = trace.end(9000)
    assert len(open_recording(path).stops) == 3    # without the empty one
    result = explained(path)
    assert result['causes']['machine'] == result['missed'] == 9
    # each from the last event before it, if that is near
    stalls = [(stall['at_ns'] - ns(0), stall['length_ns']) for stall in result['stalls']]
    assert stalls == [(each[0] * MS, each[1] * MS) for each in (
        (3000, 35), (3040, 30), (5040, 30))]
    assert sum(stall['misses'] for stall in result['stalls']) == 2
    for verb in ('explain', 'replay'):
        assert '9 misses: 9 machine\n' in call(verb, path).stdout


def test_what_an_overload_takes_from_less_important_sinks(tmp_path, call):
    graph, trace = tmp_path / 'g.yaml', tmp_path / 'run.mcap'
    graph.write_text("""\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: main, timer: 30ms, deadline: 30ms, execution_time: 20ms, importance: high, dag: a}
      - {name: rest, dag: b, timer: 20ms, deadline: 20ms, execution_time: 10ms}
""")
    call('simulate', graph, '--workers', 1, '--preemptive', '--duration', '3s',
         '--on-late', 'demote', '--trace', trace)
    run = replay(trace)
    sinks = {name: next(iter(dag['sinks'].values()))
             for name, dag in run.result()['dags'].items()}
    assert 'demoted' not in sinks['a'] and sinks['b']['demoted'] > 70
    none = call('replay', trace, '--from', '100s')
    assert (none.returncode, none.stderr) == (
        2, f'error: {trace}: it ends 3.000 s after its first release: give an earlier time\n')
    rescheduled = call('replay', trace, '--reschedule', '--from', '100s')
    assert 'left out: jobs released in the first 100 s, so all of them: the run has only 3 s' \
        in rescheduled.stdout.splitlines()
    assert '0 results due, 0 in time (-), 0 late, 0 expired' in rescheduled.stdout
    assert 'no job was due at any sink' in rescheduled.stderr and rescheduled.returncode == 2
    explained = call('explain', trace, '--json', '-').result
    # all there is no time for
    assert explained['missed'] == explained['causes']['less important'] >= 50
    behind = {each['callback'] for job in explained['jobs'] for part in job['parts']
              for each in part['behind']}
    assert '/n:main' in behind
    # the recorded execution times say what is too much, whatever it was recorded with
    in_time = [counts(reschedule(trace, on_late=on_late).result()['dags']['a']['sinks'][
        '/n:main']).in_time for on_late in ('continue', 'demote')]
    assert in_time[0] < 20 and in_time[1] >= 99


def test_what_is_usual_in_the_whole_recording_is_usual_in_a_part(tmp_path):
    trace = Written(tmp_path / 'a.mcap', 'mddag: 1\nnodes:\n  - {node: /a, callbacks: '
                    '[{name: tick, timer: 100ms, deadline: 30ms}]}\n')
    for job in range(30):
        at = 100 * job
        trace.release(0, job, at, at + 5)       # noticed 5 ms late, always
        trace.run(0, 0, job, at + 5, at + (45 if job >= 24 else 10))
    path = trace.end(3000)
    whole, part, again = (open_recording(path), open_recording(path).cut(2400 * MS, 3000 * MS),
                          open_recording(path).cut(1500 * MS, 3000 * MS).cut(900 * MS, 1500 * MS))
    parts = [Replay(each).explanation.result(job=29)['jobs'][0]['parts']
             for each in (whole, part, again)]
    assert parts[1] == parts[2] == parts[0]
    assert [each['cause'] for each in parts[0]] == ['released late', 'ran long', 'ran']


def test_a_scan_that_the_program_skips_loses_no_message(tmp_path):
    """The answer to a later scan completes it; or it waits for boxes that never come."""
    trace = Written(tmp_path / 'run.mcap', TWO_RATES)
    for job, at in enumerate((0, 100, 1000)):
        trace.release(0, job, at)
        trace.run(0, 0, job, at, at + 2)
        trace.run(0, 1, job, at + 3, at + 4, whole=False)
    trace.release(1, 0, 140)
    trace.run(1, 0, 0, 140, 142)
    trace.run(0, 1, 1, 143, 150)        # with boxes it fuses the second scan
    trace.release(1, 1, 150)
    trace.run(1, 0, 1, 150, 900)    # and keeps the only worker
    for job, at in ((0, 600), (1, 700), (2, 2150)):
        trace.add('expire', at, 0, job)
    trace.run(0, 2, 1, 900, 902, ready=150)
    explained = replay(trace.end(2300)).explanation.result()
    causes = {job['job']: (job['verdict'], job['cause']) for job in explained['jobs']
              if job['sink'] == '/brake:stop'}
    assert causes == {0: ('expired', 'waited'), 1: ('expired', 'waited'),
                      2: ('expired', 'other topic')}
    parts = {(job['job'], part['vertex'], part['cause']): part['ns'] // MS
             for job in explained['jobs'] for part in job['parts']}
    assert parts[0, '/brake:stop', 'waited'] == 450
    assert parts[2, '/fusion:fuse', 'other topic'] == 1146

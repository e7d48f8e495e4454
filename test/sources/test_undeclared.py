# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Traces that were recorded without a declaration, judged by one that is given later."""

import bisect
import itertools
import json
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor import open_recording, replay
from mddag_executor.sources import stamps_without_numbers
from mddag_executor.sources.stamps import find_stamps, Sent
from mddag_executor.trace import EVENTS, EventType, TraceFile, TraceReader
from msg_graph import loads
import numpy as np
import pytest

from .helpers import MS, ns, Written

DEMO = Path(__file__).parents[2] / 'bags' / 'demo_short.mcap'
GRAPH = """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
  - {node: /radar, callbacks: [{name: scan, timer: 100ms, publishes: [/image]}]}
  - {node: /detect, callbacks: [{name: run, subscription: /image, deadline: 40ms}]}
"""
GRAB, SCAN, RUN = 11, 12, 13
_OF_JOBS = {f'mddag:{name}' for name in (
    'job_release', 'complete', 'deadline', 'fail', 'expire', 'abort', 'hosted', 'judge_from')}


class Run(Written):
    """The trace of a run of three nodes; times are ms since the start."""

    def __init__(self, folder, graph, call):
        super().__init__(folder / 'run.mcap', '', 2)
        self.call, self.graph = call, graph
        for node, name in enumerate(('camera', 'radar', 'detect'), 1):
            self.add('rcl_node_init', 0, node, node, name, '/')
        for timer, node in ((GRAB, 1), (SCAN, 2)):
            self.add('rcl_publisher_init', 0, 100 + node, node, 100 + node, '/image', 10)
            self.add('rcl_timer_init', 0, 20 + node, 100 * MS)
            self.add('rclcpp_timer_callback_added', 0, 20 + node, timer)
            self.add('rclcpp_timer_link_node', 0, 20 + node, node)
        self.add('rcl_subscription_init', 0, 30, 3, 30, '/image', 10)
        self.add('rclcpp_subscription_init', 0, 30, 30)
        self.add('rclcpp_subscription_callback_added', 0, 30, RUN)

    def runs(self, callback, start, end, sent=None, ready=None, thread=0, due=None):
        thread = thread or callback
        self.add('dispatch', start, callback, -1, -1, -1, 0, ns(
            start if ready is None else ready), 0, *([] if due is None else [ns(due)]),
            thread=thread)
        self.add('callback_start', start, callback, False, thread=thread)
        if sent is not None:
            publisher = 101 if callback == GRAB else 102
            self.add('rclcpp_publish', sent, publisher, 0, 0, thread=thread)
            self.add('rcl_publish', sent, publisher, 0, thread=thread)
        self.add('callback_end', end, callback, thread=thread)

    def takes(self, stamp, time):
        self.add('rmw_take', time, 30, 0, ns(stamp), True)

    def detects(self, sent, took=5):
        """Take a message soon after it was sent, and run /detect for it."""
        self.takes(sent + 0.009, sent + 0.099)
        self.runs(RUN, sent + 0.101, sent + 0.101 + took, ready=sent + 0.1)

    def result(self, until=None, status=0):
        """End the run and return what `mddag replay --json` says of it."""
        if until is None:
            self.file.finish()
        else:
            self.end(until)
        done = self.call('replay', self.path, self.graph, '--json', '-')
        assert done.returncode == status, done.stderr
        return json.loads(done.stdout)


@pytest.fixture
def run(tmp_path, graph, call):
    return Run(tmp_path, graph, call)


def of_camera(result, dag='/camera'):
    return result['dags'][dag]['sinks'][f'/detect:run@{dag}']


def undeclared(source, target):
    """Write a trace as if it had been recorded without its declaration, and return that."""
    text = ''
    with TraceFile(target) as file:
        for name, *fields in TraceReader(source).events(set(EVENTS), sorted=True):
            if name == 'mddag:task_set':
                text, fields[3:5] = fields[3] or text, ['', '']
            elif name in ('mddag:dispatch', 'mddag:drop'):
                fields[4:7] = -1, -1, -1
            if name not in _OF_JOBS:
                file.add(name, *fields)
    return text


@pytest.mark.parametrize('steps', [{3: 5_000}, {3: -250}, {3: 5_000, 6: -7_000}, {3: -0.5}],
                         ids=['forward', 'back', 'both', 'little'])
def test_messages_are_joined_though_the_system_clock_was_set(run, steps):
    """Source timestamps are by that clock; the trace has its own."""
    ahead = 0
    for job in range(10):
        at = 100 * job
        if job in steps:
            ahead += steps[job]
            run.add('clock_step', at - 2, round(steps[job] * MS))
        run.runs(GRAB, at, at + 2, at + 1, due=at)
        run.takes(at + 1.009 + ahead, at + 1.099)
        run.runs(RUN, at + 1.101, at + 6, ready=at + 1.1)
    result = run.result(1000)
    assert of_camera(result)['completed'] == 10
    assert of_camera(result)['response_ns']['max'] == 6 * MS


def test_with_an_idle_worker_a_callback_waits_for_the_interpreter(run):
    # the trace does not say whether the other one held it, so it may have
    for job in range(3):
        at = 100 * job
        run.runs(SCAN, at, at + 50, due=at)
        run.runs(GRAB, at + 50, at + 51, at + 50.5, ready=at + 0.1, due=at, thread=SCAN)
        run.detects(at + 50.5)
    causes = run.result(300)['misses']['causes']
    assert (causes['interpreter'], causes['waited']) == (3, 0)


def test_without_a_declaration_its_callbacks_and_messages_are_shown(tmp_path, call):
    trace = tmp_path / 'run.mcap'
    undeclared(DEMO, trace)
    declared = call('replay', DEMO, '--json', '-').result
    page, file = tmp_path / 'page.html', tmp_path / 'result.json'
    done = call('replay', trace, '--json', file, '--report', page)
    assert (done.returncode, done.stderr) == (0, '')
    assert 'no declaration was given, so no deadline was judged' in done.stdout
    assert 'policy rad, 7 workers' in done.stdout
    result = json.loads(file.read_text())
    assert sum(each['executions'] for each in result['recorded_callbacks'].values()) == sum(
        each['executions'] for each in (*declared['callbacks'].values(), declared['undeclared']))
    assert sum(each['arrived'] for each in result['communications']) > 100
    for topic in {each['topic'] for each in result['communications']}:
        assert topic in done.stdout and topic in page.read_text()
    for verb in (['explain'], ['slack'], ['replay', '--reschedule'], ['diff', trace]):
        done = call(*verb, trace)
        assert done.returncode == 2
        assert 'it was recorded without a declaration, so there are no jobs' in done.stderr


def test_the_same_run_gets_the_same_verdicts(tmp_path, call):
    trace, graph = tmp_path / 'run.mcap', tmp_path / 'graph.yaml'
    graph.write_text(undeclared(DEMO, trace))
    declared = call('replay', DEMO, '--json', '-').result
    done = call('replay', trace, graph, '--json', '-')
    found = done.result
    assert not done.stderr
    assert found['first_miss']['job'] == declared['first_miss']['job']
    assert (found['policy'], found['workers']) == (declared['policy'], declared['workers'])
    assert found['callbacks'].keys() == declared['callbacks'].keys()
    for key, use in found['callbacks'].items():
        assert use['executions'] == declared['callbacks'][key]['executions']
    for name, dag in declared['dags'].items():
        assert found['dags'][name]['unjudged'] == 0
        assert found['dags'][name]['ends'] == dag['ends']
        for sink, expected in dag['sinks'].items():
            got = found['dags'][name]['sinks'][sink]
            for key in ('completed', 'late', 'overdue', 'expired', 'failed'):
                assert got[key] == expected[key], (sink, key)
            if expected['breakdown'] is not None:
                mean, wanted = (each['breakdown']['mean'] for each in (got, expected))
                for key in ('waiting_ns', 'executing_ns', 'transport_ns', 'suspended_ns'):
                    assert mean[key] == wanted[key], (sink, key)
                # the timer's grid is known as well as the executor noticed its releases
                assert abs(mean['release_lag_ns'] - wanted['release_lag_ns']) < MS


def test_dropped_messages_and_callbacks_of_actions_are_no_damage(run):
    """Only the name of the callback of an action, a client or a task is recorded."""
    run.add('rclcpp_callback_register', 0, 77, '/arm: ActionServer (waitable)')
    for job in range(3):
        run.runs(GRAB, 100 * job, 100 * job + 2, 100 * job + 1)
        run.detects(100 * job + 1)
        run.runs(77, 100 * job + 50, 100 * job + 51)
    run.add('drop', 250, RUN, -1, -1, -1, 'qos_depth')
    result = run.result(300)
    assert not any('initialisation' in line for line in result['warnings'])
    assert (of_camera(result)['completed'], result['dropped']) == (3, {'qos_depth': 1})


def test_messages_of_others_are_of_no_job(run):
    # another process publishes while nothing of this one is being sent, or while /camera still
    # runs: its own message has been taken then
    for job in range(4):
        at = job * 100
        run.runs(GRAB, at, at + 20, at + 1)
        for sent in (1, 10, 50):
            run.detects(at + sent)
    result = run.result(400)
    sink = of_camera(result)
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (4, 0, 6_101_000)
    assert result['callbacks']['/detect:run']['executions'] == 4
    assert result['undeclared']['executions'] == 8
    warning, = result['warnings']
    assert '8 executions for a message whose publication is not known' in warning
    again = run.call('replay', run.path, run.graph, '--reschedule', '--json', '-').result
    assert (of_camera(again)['completed'], of_camera(again)['late']) == (4, 0)


def test_messages_of_a_source_may_be_of_anyone(run):
    # a latched map, for instance, which its node published when it was made
    run.graph.write_text(GRAPH.split('  - {node: /detect')[0].replace(
        'publishes: [/image]', 'deadline: 90ms') + """\
  - node: /detect
    callbacks: [{name: run, subscription: /image, period: 1s, sporadic: true, deadline: 40ms}]
""")
    for job in range(3):
        run.runs(GRAB, 100 * job, 100 * job + 1)
    run.detects(50)
    result = run.result(300)
    assert result['dags']['/detect']['sinks']['/detect:run']['completed'] == 1
    assert result['warnings'] == []


@pytest.mark.parametrize('in_order', [True, False])
def test_who_published_is_never_guessed(in_order, run):
    # both publish on one topic while both run; messages are taken later
    for job in range(3):
        at = job * 100
        run.runs(GRAB, at, at + 20, at + 1)
        run.runs(SCAN, at, at + 20, at + 2)
        run.takes(at + (1 if in_order else 2) + 0.009, at + 30)
        run.takes(at + 2.01, at + 31)
        run.runs(RUN, at + 30.001, at + 32)
        run.runs(RUN, at + 33, at + 35, ready=at + 31.001)
    result = run.result(300, status=0 if in_order else 2)
    sinks = [of_camera(result, dag) for dag in result['dags']]
    if in_order:
        assert [sink['response_ns']['max'] for sink in sinks] == [32 * MS, 35 * MS]
        assert [sink['completed'] for sink in sinks] == [3, 3]
        assert result['warnings'] == []
    else:
        assert [sink['completed'] + sink['late'] + sink['expired'] for sink in sinks] == [0, 0]
        assert [dag['unjudged'] for dag in result['dags'].values()] == [3, 3]
        assert '6 jobs' in ' '.join(result['warnings'])


def test_the_pieces_of_a_coroutine_are_one_execution(run):
    # /detect awaits something for 30 ms, in every second job for 50 ms
    for job in range(4):
        at, rest = job * 100, 50 if job % 2 else 30
        run.runs(GRAB, at, at + 2, at + 1)
        run.takes(at + 1.009, at + 1.099)
        run.runs(RUN, at + 2, at + 3, ready=at + 1.1)
        run.runs(RUN, at + 3 + rest, at + 4 + rest, ready=at + 1.1, thread=99)
    result = run.result(400)
    sink = of_camera(result)
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (4, 2, 54 * MS)
    mean = sink['breakdown']['mean']
    assert (mean['executing_ns'], mean['suspended_ns']) == (3_100_000, 40 * MS)
    use = result['callbacks']['/detect:run']
    assert (use['executions'], use['busy_ns'], result['warnings']) == (4, 8 * MS, [])


def test_a_request_is_released_when_it_was_ready_also_for_a_coroutine(run):
    run.graph.write_text(GRAPH.replace('deadline: 40ms}', """deadline: 40ms},
      {name: ask, service: /ask, period: 1s, deadline: 20ms}"""))
    run.add('rcl_service_init', 0, 40, 3, 40, '/ask')
    run.add('rclcpp_service_callback_added', 0, 40, 14)
    run.runs(14, 103, 104, ready=100)
    run.runs(14, 120, 121, ready=100)      # resumed
    run.runs(14, 201, 202, ready=200)
    sink = run.result()['dags']['/detect']['sinks']['/detect:ask']
    assert (sink['completed'], sink['late']) == (2, 1)
    assert (sink['response_ns']['min'], sink['response_ns']['max']) == (2 * MS, 21 * MS)


def test_timers_are_released_on_their_grid_if_they_keep_to_one(run):
    # /camera's timer is noticed 30 ms late once; /radar's is reset all the time
    for job in range(6):
        for callback, at in ((GRAB, job * 100 + 30 * (job == 2)), (SCAN, 50 + job * 137)):
            run.runs(callback, at, at + 2, at + 1)
            run.detects(at + 1, 7)
    result = run.result(900)
    camera, radar = (of_camera(result, dag)['breakdown']['worst'] for dag in ('/camera', '/radar'))
    assert (camera['job'], camera['release_lag_ns']) == (2, 30 * MS)
    assert radar['release_lag_ns'] == 0
    warning, = result['warnings']
    assert '6 executions of timers whose due times are not recorded' in warning
    assert '/radar timer' in warning


def test_the_grid_of_a_timer_is_found_though_few_releases_were_noticed_soon(run):
    # all but two of 24 are late, by up to 97 ms of 100
    late = [(job * 37 + 11) % 83 + 15 for job in range(24)]
    late[5] = late[17] = 0
    for job, more in enumerate(late):
        at = job * 100 + more
        run.runs(GRAB, at, at + 2, at + 1)
        run.detects(at + 1, 1)
    result = run.result(2600)
    sink = of_camera(result)
    assert not result['warnings']
    assert [each['callback'] for each in result['drift']] == ['/radar:scan']   # it never ran
    assert sink['breakdown']['mean']['release_lag_ns'] == sum(late) * MS // len(late)
    assert sink['late'] == sum(more + 2.101 > 40 for more in late)


def test_a_recorded_due_time_is_the_release(run):
    # no grid: the timers are reset all the time, and noticed late
    due = [job * 120 + job * job % 7 for job in range(8)]
    for job, at in enumerate(due):
        run.runs(GRAB, at + 10 + job, at + 12 + job, at + 11 + job, due=at)
        run.detects(at + 11 + job, 7)
    result = run.result(1100)
    sink = of_camera(result)
    assert not result['warnings']
    assert sink['breakdown']['worst']['release_lag_ns'] == 17 * MS
    assert sink['breakdown']['mean']['release_lag_ns'] == 13.5 * MS


def test_skipped_releases_of_timers_expire_as_in_a_run_with_a_declaration(run):
    # the first execution is late by 2.5 periods; then the timer is cancelled for a while
    for due, start, ready in ((0, 250, 120), (300, 301, 300), (400, 401, 400), (1200, 1201, 1200)):
        run.runs(GRAB, start, start + 2, start + 1, due=due, ready=ready)
        run.detects(start + 1, 1)
    result = run.result(1300)
    sink = of_camera(result)
    assert (sink['completed'], sink['late'], sink['expired']) == (4, 1, 2)
    assert result['dags']['/camera']['jobs'] == 6
    assert not result['warnings']
    replayed = replay(run.path, loads(GRAPH))
    jobs = replayed.recording.jobs
    mine = jobs.of_dag(0)
    assert jobs.number[mine].tolist() == [*range(6)]
    assert ((jobs.release[mine] - ns(0)) // MS).tolist() == [0, 100, 200, 300, 400, 1200]
    # that of 100 ms was noticed with the one before, that of 200 ms when it was due
    assert ((jobs.noticed[mine] - ns(0)) // MS).tolist()[1:3] == [120, 200]
    assert [(each['job'], each['cause']) for each in replayed.explanation.result()['jobs']
            if each['job'] in (1, 2)] == [(1, 'machine'), (2, 'machine')]   # nothing ran
    assert [part['waiting_job'] for each in replayed.explanation.result(job=1)['jobs']
            for part in each['parts']] == [0]


def test_a_timer_that_was_due_once_has_skipped_nothing(run):
    """Its only execution may be in pieces, as that of a coroutine is."""
    run.runs(GRAB, 1, 2, 1.5, due=0, ready=0)
    run.takes(1.509, 1.599)
    run.runs(GRAB, 50, 51, due=0, ready=0)
    run.runs(RUN, 52, 53, ready=1.6)
    result = run.result(100)
    assert result['dags']['/camera']['jobs'] == 1
    assert not result['warnings']


def test_skipped_releases_of_undeclared_timers_are_counted(run):
    for due, start in ((0, 250), (300, 301), (400, 401)):
        run.runs(SCAN, start, start + 2, start + 1, due=due)
    run.graph.write_text(GRAPH.replace(
        '  - {node: /radar, callbacks: [{name: scan, timer: 100ms, publishes: [/image]}]}\n', ''))
    for job in range(4):
        run.runs(GRAB, job * 100, job * 100 + 2, job * 100 + 1, due=job * 100)
        run.detects(job * 100 + 1)
    warning, = run.result(500)['warnings']
    assert ': 2 releases of undeclared timers skipped, as the one before began later' in warning
    assert warning.endswith('/radar timer 100ms (2)')


def test_actions_and_dropped_messages_are_no_damage(run):
    run.add('rclcpp_callback_register', 0, 99, '/dock: ActionServer (waitable)')
    for job in range(4):
        run.runs(GRAB, job * 100, job * 100 + 2, job * 100 + 1)
        run.detects(job * 100 + 1)
        run.runs(99, job * 100 + 50, job * 100 + 51)
    run.add('drop', 301, RUN, -1, -1, -1, 'qos_depth')
    result = run.result(400)
    assert not result['warnings']
    assert result['dropped'] == {'qos_depth': 1}
    assert result['undeclared']['executions'] == 4


@pytest.mark.parametrize('ready', [-10.9e12, 7.4e12])      # almost the least and greatest int64
def test_a_damaged_ready_time_affects_its_execution_only(ready, run):
    for at in range(0, 500, 100):
        run.runs(GRAB, at, at + 2, at + 1, ready=ready if at == 200 else at)
        run.detects(at + 1)
    sink = of_camera(run.result(500))
    assert (sink['completed'], sink['late']) == (5, ready < 0)


@pytest.mark.parametrize(('reason', 'cause'), [
    ('qos_depth', 'dropped'), ('destroyed', 'destroyed')])
def test_a_job_that_is_open_at_the_end_is_judged_by_that(run, reason, cause):
    run.runs(GRAB, 0, 2, 1)
    run.add('drop', 3, RUN, -1, -1, -1, reason)
    result = run.result(80)
    sink = of_camera(result)
    assert (sink['completed'], sink['late'], sink['overdue']) == (0, 1, 1)
    assert result['dropped'] == {reason: 1}
    assert result['misses']['causes'][cause] == 1


class Counted(list):
    """A list that counts how often an item is read."""

    reads = 0

    def __getitem__(self, key):
        Counted.reads += 1
        return super().__getitem__(key)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 60)), max_size=40), st.data())
def test_publications_that_were_being_sent_are_found(sent, data):
    """As by comparing all of the last ones."""
    module = stamps_without_numbers
    rounding, most = module.ROUNDING_NS, module.UNSENT
    times = [rounding * each for each in itertools.accumulate(gap for gap, _ in sent)]
    ends = [time + rounding * took for time, (_, took) in zip(times, sent)]
    topic = module.BeingSent(times, ends)
    topic.stamps = data.draw(st.lists(st.sampled_from((0, 1)), min_size=len(sent),
                                      max_size=len(sent)))
    stamp = data.draw(st.integers(0, 400 * rounding))
    last = bisect.bisect_right(times, stamp + rounding)
    assert sorted(topic.being_sent(stamp)) == [
        place for place in range(max(0, last - most), last)
        if not topic.stamps[place] and stamp <= ends[place] + rounding]


def test_a_message_is_not_compared_with_all_publications():
    """Not even if one of them, of a thread that was killed, has no end."""
    times = [100_000 * n for n in range(1_000)]
    topic = stamps_without_numbers.BeingSent(times, Counted(
        [2 ** 62 if n == 500 else time + 50_000 for n, time in enumerate(times)]))
    Counted.reads = 0
    for place, time in enumerate(times):
        assert topic.being_sent(time + 20_000) == [place, *[500] * (500 < place < 756)]
    assert Counted.reads < 5 * len(times)


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 30), st.integers(0, 90),
                          st.integers(0, 3)), max_size=40), st.randoms(use_true_random=False))
def test_publications_of_numbered_messages_are_never_wrong(several, random):
    """Three publishers send at once, some messages are lost, and some are not recorded."""
    us, now, counts, rows = 1_000, 0, [0, 5, 900], []
    for publisher, gap, took, unseen in several:
        now += (1 + 3 * gap) * us
        counts[publisher] += 1 + unseen // 3        # outside callbacks
        rows.append((now, now + took * us, publisher, counts[publisher],
                     now + random.randint(0, took) * us))
    begins, ends, publishers, numbers, stamps = (
        np.array(each, dtype=np.int64) for each in (zip(*rows) if rows else [()] * 5))
    taken = [row for row in range(len(rows)) if random.random() < 0.9 and stamps[row] not in
             np.delete(stamps, row)]
    random.shuffle(taken)
    sent = Sent(begins, ends, publishers)
    found, unknown = find_stamps(sent, stamps[taken], numbers[taken])
    truth = np.where(np.isin(np.arange(len(rows)), taken), stamps, 0)
    open_then = [((begins <= each + us) & (ends >= each - us)).sum() for each in stamps[taken]]
    # a message is wrong only if that of the publication that was being sent then is lost
    lost = set(range(len(rows))) - set(taken)
    assert all(found[row] in (0, truth[row]) or row in lost for row in range(len(rows)))
    if max(open_then, default=0) <= 1:
        assert found.tolist() == truth.tolist() and unknown == []


def test_numbers_decide_between_publications_at_the_same_time():
    us = 1_000
    begins = np.arange(6) * 100 * us
    ends = begins + np.array([50, 50, 250, 50, 50, 50]) * us    # the third one overlaps the next
    sent = Sent(begins, ends, np.zeros(6, dtype=np.int64))
    stamps = begins + 10 * us
    for numbers, doubtful in ((np.arange(6) + 7, []), (np.zeros(6, dtype=np.int64), [3])):
        taken = np.array([3, 2, 0, 1, 4, 5])    # in another order
        found, unknown = find_stamps(sent, stamps[taken], numbers[taken])
        expected = [0 if row in doubtful else stamps[row] for row in range(6)]
        assert found.tolist() == expected and unknown == stamps[doubtful].tolist()


def test_a_gap_between_spins_may_have_more_fields(tmp_path):
    """As a later version may write them, in another order."""
    trace = Written(tmp_path / 'run.mcap', '', 2)
    kind = trace.file.define(EventType('mddag', 'spin_gap', (
        ('reason', 'int64'), ('end', 'int64'), ('begin', 'int64'), ('program', 'int64'))))
    trace.add('rcl_node_init', 0, 1, 1, 'n', '/')
    trace.add('rcl_timer_init', 0, 20, 100 * MS)
    trace.add('rclcpp_timer_callback_added', 0, 20, GRAB)
    trace.add('rclcpp_timer_link_node', 0, 20, 1)
    trace.add('dispatch', 10, GRAB, -1, -1, -1, 0, ns(10), 0)
    trace.add('callback_start', 10, GRAB, False)
    trace.add('callback_end', 11, GRAB)
    trace.add(kind, 40, 7, ns(40), ns(20), -1)
    gap, = open_recording(trace.end(50)).spin_gaps.records().tolist()
    assert gap[1:] == (-1, ns(20), ns(40))


def test_a_timer_that_was_destroyed_and_made_again_is_the_same_callback(tmp_path):
    trace = Written(tmp_path / 'run.mcap', '', 2)
    trace.add('rcl_node_init', 0, 1, 1, 'n', '/')
    for timer, first in ((20, 0), (30, 500)):
        trace.add('rcl_timer_init', first, timer, 100 * MS)
        trace.add('rclcpp_timer_callback_added', first, timer, timer + 1)
        trace.add('rclcpp_timer_link_node', first, timer, 1)
        for at in range(first + 100, first + 401, 100):
            trace.add('dispatch', at, timer + 1, -1, -1, -1, 0, ns(at), 0, ns(at))
            trace.add('callback_start', at, timer + 1, False)
            trace.add('callback_end', at + 1, timer + 1)
        trace.add('gone', first + 450, timer + 1)
    graph = loads('mddag: 1\nnodes: [{node: /n, callbacks: ['
                  '{name: a, timer: 100ms, deadline: 9ms}]}]')
    result = replay(trace.end(1000), graph).result()
    assert result['callbacks']['/n:a']['executions'] == 8

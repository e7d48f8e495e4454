# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""As recorded: what is counted and said of small runs (`test_deadlines.py`: of any run)."""

import re

from mddag_executor import replay, ReplayError, reschedule
from mddag_executor.analysis.drift import drift_of
from mddag_executor.recording.head import Head
from mddag_executor.recording.tables import ALL_LEGS, VERTEX
from mddag_executor.report.replays import times_tables
from mddag_executor.sources.head import declared
from mddag_executor.sources.open import open_recording
from mddag_executor.trace import EVENTS, EventType, reading, TraceFile, TraceReader
from mddag_executor.trace.schema import GOES_ON
from msg_graph import loads
import pytest

from ..sources.helpers import MS, ns, SMALL, small, START_TIME, VirtualRun, Written

ONE = 'mddag: 1\nnodes: [{node: /n, callbacks: [{name: a, timer: 10ms, deadline: 9ms}]}]'


@pytest.mark.parametrize('in_order', [False, True])
def test_executions_do_not_depend_on_where_batches_end(tmp_path, monkeypatch, in_order):
    """Threads take turns in the file, or each execution's events are adjacent (live)."""
    VirtualRun(tmp_path / 'whole.mcap', small(), 3, 3, duration=300 * MS)
    events = list(TraceReader(tmp_path / 'whole.mcap').events(sorted=in_order))
    for name, most in (('whole', len(events)), ('parts', 3)):
        with TraceFile(tmp_path / f'{name}.mcap', overwrite=True) as file:
            for place, event in enumerate(events):
                file.add(*event)
                if place % most == most - 1:
                    file.flush()
    whole = open_recording(tmp_path / 'whole.mcap')
    monkeypatch.setattr(reading, '_BATCH_BYTES', 1)
    parts = open_recording(tmp_path / 'parts.mcap')
    assert len(whole.executions) > 90
    assert sorted(parts.executions.tolist()) == sorted(whole.executions.tolist())
    assert parts.releases.tolist() == whole.releases.tolist()
    assert (parts.missing.lines(), whole.missing.lines()) == ([], [])


def job_of_the_camera(trace, job, at):
    """Record a whole job: vertices grab, detect, rectify, watch, join."""
    trace.release(0, job, at, noticed=at + 1)
    trace.run(0, 0, job, at + 2, at + 4, ready=at + 1)
    trace.run(0, 1, job, at + 5, at + 8)
    trace.run(0, 2, job, at + 6, at + 9, ready=at + 5, worker=1)
    trace.run(0, 4, job, at + 8, at + 9, whole=False)
    trace.run(0, 3, job, at + 9, at + 11, ready=at + 6)
    trace.run(0, 4, job, at + 12, at + 15, ready=at + 10, leg=1)


@pytest.fixture
def trace(tmp_path):
    return Written(tmp_path / 'a.mcap', SMALL, 2)


def chain_of(worst):
    return [step['vertex'] for step in worst['chain']]


def test_a_job_to_the_millisecond(trace):
    job_of_the_camera(trace, 0, 10)
    outcome = replay(trace.end(110))
    assert outcome.warnings == []
    result = outcome.result()
    assert result['duration_ns'] == 100 * MS
    assert result['utilisation'] == pytest.approx(14 / 200)
    camera = result['dags']['/camera']
    assert camera['jobs'] == 1
    assert {end: n for end, n in camera['ends'].items() if n} == {'completed': 1}
    join = camera['sinks']['/fuse:join']
    assert (join['completed'], join['late'], join['relative_deadline_ns']) == (1, 0, 18 * MS)
    assert join['response_ns'] == dict.fromkeys(('min', 'median', 'p99', 'max'), 15 * MS)
    worst = join['breakdown']['worst']
    assert chain_of(worst) == ['/camera:grab', '/right:rectify', '/fuse:join']
    assert {key: value // MS for key, value in worst.items() if key.endswith('_ns')} == {
        'release_ns': START_TIME // MS + 10, 'completed_ns': START_TIME // MS + 25,
        'release_lag_ns': 1, 'waiting_ns': 1 + 1 + 2, 'executing_ns': 2 + 3 + 3,
        'suspended_ns': 0, 'transport_ns': 1 + 1, 'unknown_ns': 0, 'waiting_group_ns': 0,
        'waiting_program_ns': 0}
    assert result['callbacks']['/fuse:join'] == {
        'executions': 2, 'busy_ns': 4 * MS, 'longest_ns': 3 * MS, 'waiting_ns': 2 * MS,
        'longest_wait_ns': 2 * MS, 'waiting_group_ns': 0, 'waiting_program_ns': 0}
    assert result['dags']['/imu']['jobs'] == 0


def test_the_chain_of_a_job_goes_through_what_it_waited_for(trace):
    # of the camera the leg that came last, though the vertex before it ended sooner
    trace.release(0, 0, 10)
    for vertex, start, end, more in (
            (0, 10, 12, {}), (1, 12, 14, {}), (2, 12, 15, {'worker': 1}),
            (4, 15, 16, {'leg': 1, 'whole': False, 'worker': 1}), (4, 18, 20, {})):
        trace.run(0, vertex, 0, start, end, **more)
    # the IMU's coroutine publishes early, and still runs when its successor has completed
    trace.release(1, 0, 30)
    trace.piece(1, 0, 0, 31, 32, ready=30)
    trace.run(1, 1, 0, 35, 36, ready=34, worker=1)
    trace.run(1, 0, 0, 33, 60, ready=30)
    dags = replay(trace.end(110)).result()['dags']
    worst = dags['/camera']['sinks']['/fuse:join']['breakdown']['worst']
    assert chain_of(worst) == ['/camera:grab', '/left:detect', '/fuse:join']
    assert (worst['transport_ns'], worst['executing_ns']) == (4 * MS, 6 * MS)
    use = dags['/imu']['sinks']['/imu:use']
    assert (use['completed'], use['late'], use['response_ns']['max']) == (1, 0, 6 * MS)
    assert {key: time for key, time in use['breakdown']['mean'].items() if time} == {
        'waiting_ns': 2 * MS, 'executing_ns': 3 * MS, 'suspended_ns': MS}


def test_a_chain_ends_where_no_publisher_had_started(trace):
    trace.release(1, 0, 30)
    trace.run(1, 1, 0, 34, 35, ready=33)
    trace.run(1, 0, 0, 36, 37)
    worst = replay(trace.end(110)).result()['dags']['/imu']['sinks']['/imu:use']['breakdown'][
        'worst']
    assert (chain_of(worst), worst['unknown_ns']) == (['/imu:use'], 3 * MS)


def test_what_ran_after_the_end_of_a_job_does_not_explain_its_miss(trace):
    trace.release(0, 0, 10)
    for vertex, start, end in ((0, 10, 12), (1, 12, 14), (2, 14, 17)):
        trace.run(0, vertex, 0, start, end, ready=min(start, 12))
    trace.piece(0, 4, 0, 18, 19)        # which message started it is not recorded
    trace.add('expire', 30, 0, 0)
    trace.piece(0, 4, 0, 40, 41)
    trace.release(1, 0, 30)
    trace.run(1, 0, 0, 52, 53)
    trace.add('shutdown', 60, ns(50))   # until then it was judged
    trace.file.finish()
    jobs = replay(trace.path).explanation.result()['jobs']
    assert {each['sink']: list(dict.fromkeys(part['vertex'] for part in each['parts']))
            for each in jobs} == {
        '/fuse:join': ['/camera:grab', '/right:rectify', '/fuse:join'],
        '/right:watch': ['/camera:grab', '/right:watch'], '/imu:use': ['/imu:tick']}
    assert [(each['sink'], part['cause']) for each in jobs for part in each['parts']
            if part['cause'] in ('lost', 'released late')] == [
        ('/right:watch', 'lost'), ('/imu:use', 'released late')]
    assert all(sum(part['ns'] for part in each['parts']) == each['until_ns'] - each['release_ns']
               for each in jobs)


def test_a_miss_of_a_run_in_which_nothing_ran(trace):
    trace.release(0, 0, 10)
    trace.add('expire', 40, 0, 0)
    jobs = replay(trace.end(60)).explanation.result()['jobs']
    assert [(part['cause'], part['ns']) for each in jobs for part in each['parts']] == [
        ('released late', 30 * MS)] * 2


def test_legs_that_complete_at_once_may_be_in_several_batches(trace, monkeypatch):
    monkeypatch.setattr(reading, '_BATCH_BYTES', 1)
    trace.piece(0, 4, 0, 10, 12)
    for leg in range(2):
        trace.add('complete', 12, 1004, 0, 4, 0, leg == 1, ns(12), leg, thread=10)
        trace.file.flush()
    table = open_recording(trace.end(110)).executions
    assert table[['leg', 'completes']].tolist() == [(ALL_LEGS, VERTEX)]


def test_the_first_end_of_the_dispatched_callback_ends_it(trace, monkeypatch):
    monkeypatch.setattr(reading, '_BATCH_BYTES', 1)
    trace.add('dispatch', 10, 1100, 1, 0, 0, 0, ns(10), 0, thread=10)
    for at, address in ((11, 7), (12, 1100), (15, 1100)):
        trace.add('callback_end', at, address, thread=10)
        trace.file.flush()
    outcome = replay(trace.end(110))
    assert outcome.recording.executions[['end', 'busy']].tolist() == [(ns(12), 2 * MS)]
    assert outcome.warnings[0].endswith(
        '2 events that make no sense, most often (2) ros2:callback_end of an execution that was '
        'not dispatched')


def test_vertices_are_found_by_name(tmp_path):
    """Another order of DAGs, vertices and legs changes no verdict."""
    head, *nodes = re.split('^  - ', SMALL, flags=re.MULTILINE)
    text = ''.join([head, *(f'  - {node}' for node in reversed(nodes))]).replace(
        '[/boxes, /flat]', '[/flat, /boxes]').replace('20ms,', '20ms, dag: video,')
    path = tmp_path / 'a.mcap'
    expected = VirtualRun(path, small(), 1).tally.result()['dags']
    outcome = replay(path, loads(text, 'reordered.yaml'))
    assert outcome.warnings == []
    dags = outcome.result()['dags']
    assert set(dags) == {'/imu', 'video'}
    for ours, theirs in (('/imu', '/imu'), ('video', '/camera')):
        assert dags[ours]['jobs'] == expected[theirs]['jobs']
        assert dags[ours]['ends'] == expected[theirs]['ends']
        for name, sink in dags[ours]['sinks'].items():
            assert sink.pop('breakdown')['mean']['unknown_ns'] == 0
            del sink['slack_ns']
            assert sink == expected[theirs]['sinks'][name]


def test_vertices_of_shared_callbacks_are_found(tmp_path):
    """A callback of two DAGs is called ``@dag``; with other DAG names, or one DAG, it is found."""
    text = """\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: cb, timer: 10ms, dag: one, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: cb, timer: 10ms, dag: two, publishes: [/x]}]}
  - {node: /c, callbacks: [{name: cb, subscription: /x, deadline: 5ms}]}
"""
    path = tmp_path / 'a.mcap'
    expected = VirtualRun(path, loads(text, 'g.yaml'), 3).tally.result()['dags']
    renamed = replay(path, loads(text.replace('one', 'uno'), 'renamed.yaml'))
    alone = replay(path, loads(
        text.replace('two, publishes: [/x]', 'two, deadline: 9ms'), 'alone.yaml'))
    assert renamed.warnings == alone.warnings == []
    completed = expected['one']['sinks']['/c:cb@one']['completed']
    assert completed > 0
    sink = renamed.result()['dags']['uno']['sinks']['/c:cb@uno']
    assert sink['completed'] == completed
    sinks = alone.result()['dags']
    assert sinks['one']['sinks']['/c:cb']['completed'] == completed
    assert sinks['two']['sinks']['/b:cb']['completed'] > 0
    assert alone.result()['undeclared']['executions'] > 0  # /c:cb of DAG two


def test_callbacks_that_the_trace_lacks(tmp_path):
    path = tmp_path / 'a.mcap'
    VirtualRun(path, small())
    more = SMALL + '  - {node: /radar, callbacks: [{name: scan, timer: 50ms, deadline: 5ms}]}\n'
    outcome = replay(path, loads(more, 'more.yaml'))
    assert outcome.warnings == [
        f'{path}: not in it: 1 of the 8 callbacks of more.yaml, so results that need them are '
        'missed, not judged or never due: /radar:scan',
        'more.yaml: 1 DAG without jobs, because the source is not a source in the recording: '
        '/radar']
    assert outcome.result()['dags']['/radar']['jobs'] == 0


def test_a_killed_run_is_judged_at_its_last_instant(trace):
    job_of_the_camera(trace, 0, 10)
    for dag, job, at in ((0, 1, 60), (1, 0, 70), (1, 1, 80)):
        trace.release(dag, job, at)
    trace.file.finish()
    outcome = replay(trace.path)
    assert [text.partition(' (')[0] for text in outcome.warnings] == [
        f'{trace.path}: the end of the run is not recorded']
    result = outcome.result()
    assert (result['recording']['shut_down'], result['duration_ns']) == (False, 70 * MS)
    # job 1 of the camera: 20 ms passed, deadlines of 12 and 18 ms; of the IMU: 10 and 0 ms
    assert [sink['overdue'] for dag in result['dags'].values()
            for sink in dag['sinks'].values()] == [1, 1, 1]


def test_a_run_killed_in_its_first_callback_which_had_published(trace):
    trace.add('rcl_publisher_init', 0, 100, 1, 100, '/image', 10)
    trace.release(0, 0, 10)
    trace.add('rclcpp_publish', 11, 100, 7, 0, thread=10)
    trace.file.finish()
    outcome = replay(trace.path)
    assert outcome.recording.publications[['execution', 'vertex']].tolist() == [(-1, -1)]
    assert outcome.result()['dags']['/camera']['jobs'] == 1


def test_undeclared_runs_that_were_ready_at_the_same_time_are_not_one(trace):
    """In virtual time a callback that publishes three times makes three such runs."""
    for start in (1, 2, 3):
        trace.piece(-1, -1, -1, start, start + 1, ready=1)
    trace.piece(-1, -1, GOES_ON, 11, 12, ready=11)      # a coroutine
    trace.piece(-1, -1, -1, 13, 14, ready=11)
    outcome = replay(trace.end(110))
    assert outcome.result()['undeclared']['executions'] == 4
    assert outcome.recording.executions['piece'].tolist() == [0, 0, 0, 0, 1]
    assert outcome.recording.executions['busy'].tolist() == [MS, MS, MS, MS, 2 * MS]


def test_a_worker_is_busy_at_most_all_of_the_time(tmp_path, call):
    """In a part, executions reach out of it; a callback in a blocking call has no worker."""
    trace = Written(tmp_path / 'a.mcap', ONE)
    for job in range(3):
        at = 10 * job
        trace.release(0, job, at)
        trace.run(0, 0, job, at, at + 9)
        trace.piece(-1, -1, -1, at, at + 8, worker=-1, thread=9)
    path = trace.end(30)
    whole, part = (replay(path, span=span).result() for span in (None, (4 * MS, 6 * MS)))
    assert (whole['utilisation'], part['utilisation']) == (0.9, 1.0)
    for result, busy, lent in ((whole, 27, 24), (part, 2, 2)):
        use = result['worker_use']
        assert use['use'] == result['utilisation']
        assert (use['busy_ns'], use['lent_ns']) == ({'0': busy * MS}, lent * MS)
        assert sum(use['over_time']['busy_ns']) == busy * MS
    assert ('(all callbacks: 0.900; 24 ms in callbacks that had lent their worker)'
            in call('replay', path).stdout)


def test_misses_that_are_not_those_recorded_are_said(trace):
    job_of_the_camera(trace, 0, 10)
    trace.add('deadline', 26, 0, 4, 0, START_TIME + 24 * MS, START_TIME + 25 * MS)
    path = trace.end(110)
    assert replay(path).warnings == [
        f'{path}: the replay does not find 1 of 1 recorded miss, and it finds 0 that were not '
        'recorded: the first is job 0 at /fuse:join']
    # under other deadlines there is nothing to compare
    assert replay(path, loads(SMALL.replace('12ms', '13ms'), 'g.yaml')).warnings == []


def test_a_completion_without_execution_is_said(tmp_path):
    trace = Written(tmp_path / 'a.mcap', ONE)
    trace.release(0, 0, 0)
    trace.add('complete', 1, 9, 0, 0, 0, True, START_TIME + MS, 0)
    result = replay(trace.end(1)).result()
    assert [text.partition(': ')[2] for text in result['warnings']] == [
        '1 completed execution whose start is not in it']
    assert any(re.search('unknown\n.* 1 ms\n', each) for each in times_tables(result['dags']))


def test_a_completion_at_an_impossible_time_is_left_out(tmp_path):
    """Before, it had a response time of minus fifty years, and there was no warning."""
    trace = Written(tmp_path / 'a.mcap', ONE)
    trace.release(0, 0, 0)
    trace.add('complete', 1, 9, 0, 0, 0, True, -1, 0)
    result = replay(trace.end(1)).result()
    sink, = (sink for dag in result['dags'].values() for sink in dag['sinks'].values())
    assert (sink['completed'], sink['response_ns']) == (0, None)
    assert [text.partition(': ')[2] for text in result['warnings']] == [
        'left out: 1 event that makes no sense, most often (1) mddag:complete at an impossible '
        'time']


def test_a_result_before_the_release_is_said(tmp_path):
    trace = Written(tmp_path / 'a.mcap', ONE)
    trace.release(0, 0, 10, noticed=12)
    _, address = trace.piece(0, 0, 0, 5, 8)
    trace.add('complete', 13, address, 0, 0, 0, True, ns(8), 0, thread=10)
    outcome = replay(trace.end(20))
    assert outcome.warnings == [
        f'{trace.path}: 1 result before the release of the job: clocks differ, or times are '
        'damaged']
    assert outcome.result()['dags']['/n']['sinks']['/n:a']['response_ns']['max'] == -2 * MS
    again = reschedule(trace.path)      # its callback is not ready before the release
    assert (again.work.load.times.tolist(), again.warnings) == ([ns(10)], outcome.warnings)


@pytest.mark.parametrize('vertices', ['7', 'x', '9' * 30, '9' * 5000])
def test_a_process_with_vertices_that_are_not_declared(trace, vertices):
    trace.add('hosted', 0, 0, vertices)
    assert replay(trace.end(110)).warnings[0].endswith(
        '1 event that makes no sense, most often (1) mddag:hosted of a vertex that is not '
        'declared')


def test_a_drop_may_have_numbers_of_other_widths(trace):
    fields = [(name, kind if kind == 'string' else 'uint64')
              for name, kind in EVENTS['mddag:drop'].fields]
    key = trace.file.define(EventType('mddag', 'drop', tuple(fields)))
    trace.file.add(key, ns(1), 1, 1, *([2 ** 64 - 1] * 4), 'aborted')
    drops = open_recording(trace.end(110)).drops
    assert drops[['callback', 'vertex', 'job']].tolist() == [(-1, -1, -1)]


def test_a_trace_without_a_usable_declaration(tmp_path):
    path = Written(tmp_path / 'a.mcap', 'nonsense').end(1)
    for name in (None, '<stdin>'):
        with pytest.raises(ReplayError, match=f'{name or path}: the declaration that it was '
                           r'recorded with is wrong \(g.yaml'):
            replay(path, name=name)


@pytest.mark.parametrize('key', ['on_miss:', '"on_miss":', "'on_miss' :"])
def test_a_recorded_declaration_may_have_the_key_of_version_1(key):
    def read(key):
        text = ONE.replace('deadline', f'{key} abort, deadline')
        return declared(Head(0, text, 'g.yaml', 'rad', 7, 100 * MS, 64, False), 'run.mcap').dags

    assert read(key) == read('on_late:')


@pytest.mark.parametrize(('how', 'declaration'), [
    (2, ONE), (0, ONE.replace('deadline', 'on_late: abort, deadline'))])
def test_jobs_that_version_2_aborted_are_counted_and_rescheduled_as_demoted(
        tmp_path, how, declaration, call):
    """Job 0 is late, and job 1 is aborted behind it."""
    trace = Written(tmp_path / 'a.mcap', declaration, on_late=how)
    for job in range(3):
        trace.release(0, job, 10 * job)
    trace.run(0, 0, 0, 0, 20)
    trace.add('deadline', 20, 0, 0, 0, ns(9), ns(20))
    trace.add('deadline', 20, 0, 0, 1, ns(19), -1)
    trace.add('abort', 20, 0, 1)
    trace.add('drop', 20, 1000, 0, 0, 1, 'aborted')
    trace.run(0, 0, 2, 20, 22)
    path = trace.end(40)
    recorded = replay(path)
    assert recorded.warnings == []
    dag = recorded.result()['dags']['/n']
    sink = dag['sinks']['/n:a']
    assert (sink['completed'], sink['late'], sink['aborted']) == (2, 1, 1)
    assert dag['ends']['aborted'] == 1
    assert '1 aborted' in call('replay', path).stdout
    result = reschedule(path).result()
    assert 'aborted' not in result['dags']['/n']['sinks']['/n:a']
    if how:
        assert result['on_late'] == 'demote'
    else:
        assert reschedule(path).task_set.dags[0].on_late == 'demote'


@pytest.mark.parametrize('is_made_again', [False, True])
def test_a_timer_that_was_made_again_and_did_not_fire_is_not_destroyed(tmp_path, is_made_again):
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: a, timer: 100ms, deadline: 50ms}]}
""")

    def make(at, address):
        trace.add('rcl_timer_init', at, address, 100 * MS)
        trace.add('rclcpp_timer_callback_added', at, address, address)
        trace.add('rclcpp_timer_link_node', at, address, 1)

    trace.add('rcl_node_init', 0, 1, 1, 'n', '/')
    make(0, 1000)
    for job in range(10):
        trace.release(0, job, job * 100)
        trace.run(0, 0, job, job * 100, job * 100 + 1)
    trace.add('gone', 950, 1000)
    if is_made_again:
        make(960, 2000)
    found = [each.text for each in drift_of(open_recording(trace.end(4000)))]
    assert any('destroyed' in each for each in found) is not is_made_again, found

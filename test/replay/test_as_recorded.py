# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""As recorded: the replayer counts what the executor counted."""

from pathlib import Path
import re
import tempfile

from hypothesis import example, given
from hypothesis import strategies as st
from mddag_executor.core import NEVER
from mddag_executor.recording.head import declared, Head
from mddag_executor.replay import replay, ReplayError
from mddag_executor.replay.run import open_recording
from mddag_executor.report.replays import times_tables
from mddag_executor.trace import reading, TraceFile, TraceReader
from msg_graph import loads
import pytest

from ..conftest import examples
from ..replay.helpers import (
    begin_trace,
    declarations,
    end_trace,
    MS,
    SMALL,
    small,
    START_TIME,
    VirtualRun,
    VPID,
)


@given(declarations(), st.integers(0, 2**32), st.integers(1, 4),
       st.sampled_from(['rad', 'fifo', 'rm']), st.integers(1, 25))
@examples(80)
@example(SMALL, 1, 2, 'rad', 8)
def test_replay_counts_what_the_driver_counted(text, seed, workers, policy, longest):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'run.mcap')
        run = VirtualRun(path, loads(text, 'g.yaml'), seed, workers, policy,
                         longest=longest * MS)
        outcome = replay(path)
    assert outcome.warnings == []
    result = outcome.result()
    expected = run.tally.result()
    for dag in result['dags'].values():
        for sink in dag['sinks'].values():
            del sink['breakdown'], sink['slack_ns']
    assert {key: result[key] for key in expected} == expected
    assert (result['policy'], result['workers'], result['preemptive']) == (policy, workers, False)
    for key, use in result['callbacks'].items():
        assert use['executions'] == run.executions.get(key, 0)
        assert use['busy_ns'] == run.busy.get(key, 0)
        assert use['waiting_ns'] == run.waited.get(key, 0)
    assert sum(result['dropped'].values()) == run.drops
    assert result['worker_use']['use'] <= 1


@pytest.mark.parametrize('in_order', [False, True])
def test_executions_do_not_depend_on_where_batches_end(tmp_path, monkeypatch, in_order):
    """Threads take turns in the file, or each execution's events are adjacent (live)."""
    VirtualRun(tmp_path / 'whole.mcap', small(), 3, 3, duration=1000 * MS)
    events = list(TraceReader(tmp_path / 'whole.mcap').events(sorted=in_order))
    for name, most in (('whole', len(events)), ('parts', 3)):
        with TraceFile(tmp_path / f'{name}.mcap', overwrite=True) as file:
            for place, event in enumerate(events):
                file.add(event[0], *event[1:])
                if place % most == most - 1:
                    file.flush()
    whole = open_recording(tmp_path / 'whole.mcap')
    monkeypatch.setattr(reading, '_BATCH_BYTES', 1)
    parts = open_recording(tmp_path / 'parts.mcap')
    assert len(whole.executions) > 300
    assert sorted(parts.executions.tolist()) == sorted(whole.executions.tolist())
    assert parts.releases.tolist() == whole.releases.tolist()
    assert (parts.warnings, whole.warnings) == ([], [])


def test_breakdowns_add_up_to_the_response_times(tmp_path):
    run = VirtualRun(tmp_path / 'a.mcap', small(), 3, duration=1000 * MS)
    result = replay(tmp_path / 'a.mcap').result()
    total = 0
    for dag in result['dags'].values():
        for sink in dag['sinks'].values():
            parts = sink['breakdown']
            mean = sum(parts['mean'].values())
            total += sink['completed'] * mean
            worst = parts['worst']
            times = {k: v for k, v in worst.items()
                     if k not in ('job', 'release_ns', 'completed_ns', 'chain')}
            assert sum(times.values()) == worst['completed_ns'] - worst['release_ns']
            assert sum(times.values()) == sink['response_ns']['max']
            assert times['unknown_ns'] == 0
            assert worst['chain'][-1]['end_ns'] == worst['completed_ns']
            assert min(times[k] for k in ('waiting_ns', 'executing_ns', 'transport_ns')) >= 0
    assert total == pytest.approx(sum(run.responses), rel=1e-6)


def write(path, *events, text=SMALL, workers=2, policy='rad'):
    with TraceFile(path, overwrite=True) as file:
        file.add('task_set', START_TIME, VPID, 1, text, 'small.yaml', policy, workers, 100 * MS,
                 64, False)
        for name, time, vtid, *fields in events:
            file.add(str(name), START_TIME + int(str(time)) * MS, VPID, int(str(vtid)), *fields)
    return path


def one_execution(dag, vertex, job, ready, start, end, *, leg=0, whole=True, vtid=9):
    address = 100 * dag + vertex
    return [
        ('dispatch', start, vtid, address, dag, vertex, job, 0, START_TIME + ready * MS, 0),
        ('callback_start', start, vtid, address, False),
        ('callback_end', end, vtid, address),
        ('complete', end, vtid, address, dag, vertex, job, whole, START_TIME + end * MS, leg)]


def job_of_the_camera(job, at):
    """Return the events of a whole job: vertices grab, detect, rectify, watch, join."""
    return [
        ('job_release', at + 1, 2, 0, job, START_TIME + at * MS),
        *one_execution(0, 0, job, at + 1, at + 2, at + 4),
        *one_execution(0, 1, job, at + 5, at + 5, at + 8),
        *one_execution(0, 2, job, at + 5, at + 6, at + 9, vtid=10),
        *one_execution(0, 4, job, at + 8, at + 8, at + 9, leg=0, whole=False),
        *one_execution(0, 3, job, at + 6, at + 9, at + 11),
        *one_execution(0, 4, job, at + 10, at + 12, at + 15, leg=1),
    ]


def test_a_job_to_the_millisecond(tmp_path):
    """A run written by hand: verdicts, times and chain are those that can be read off."""
    path = write(tmp_path / 'a.mcap', *job_of_the_camera(0, 10),
                 ('shutdown', 110, 1, START_TIME + 110 * MS))
    outcome = replay(path)
    assert outcome.warnings == []
    result = outcome.result()
    assert result['duration_ns'] == 100 * MS
    assert result['utilisation'] == pytest.approx(14 / 200)
    camera = result['dags']['/camera']
    assert camera['jobs'] == 1
    assert camera['ends'] == {'completed': 1, 'late': 0, 'aborted': 0, 'expired': 0, 'failed': 0,
                              'dropped': 0}
    join = camera['sinks']['/fuse:join']
    assert (join['completed'], join['late'], join['relative_deadline_ns']) == (1, 0, 18 * MS)
    assert join['response_ns'] == dict.fromkeys(('min', 'median', 'p99', 'max'), 15 * MS)
    worst = join['breakdown']['worst']
    assert [step['vertex'] for step in worst['chain']] == [
        '/camera:grab', '/right:rectify', '/fuse:join']
    assert {key: value // MS for key, value in worst.items() if key.endswith('_ns')} == {
        'release_ns': START_TIME // MS + 10, 'completed_ns': START_TIME // MS + 25,
        'release_lag_ns': 1, 'waiting_ns': 1 + 1 + 2, 'executing_ns': 2 + 3 + 3,
        'suspended_ns': 0, 'transport_ns': 1 + 1, 'unknown_ns': 0, 'waiting_group_ns': 0}
    assert result['callbacks']['/fuse:join'] == {
        'executions': 2, 'busy_ns': 4 * MS, 'longest_ns': 3 * MS, 'waiting_ns': 2 * MS,
        'longest_wait_ns': 2 * MS, 'waiting_group_ns': 0}
    assert result['dags']['/imu']['jobs'] == 0


def test_the_chain_goes_through_the_leg_that_came_last(tmp_path):
    """It was waited for, also where the vertex before it ended sooner than the other's did."""
    path = write(
        tmp_path / 'a.mcap',
        ('job_release', 10, 2, 0, 0, START_TIME + 10 * MS),
        *one_execution(0, 0, 0, 10, 10, 12),
        *one_execution(0, 1, 0, 12, 12, 14),
        *one_execution(0, 2, 0, 12, 12, 15, vtid=10),
        *one_execution(0, 4, 0, 15, 15, 16, leg=1, whole=False, vtid=10),
        *one_execution(0, 4, 0, 18, 18, 20, leg=0),
        ('shutdown', 110, 1, START_TIME + 110 * MS))
    worst = replay(path).result()['dags']['/camera']['sinks']['/fuse:join']['breakdown']['worst']
    assert [step['vertex'] for step in worst['chain']] == [
        '/camera:grab', '/left:detect', '/fuse:join']
    assert worst['transport_ns'] == 4 * MS
    assert worst['executing_ns'] == 6 * MS


def test_a_sink_may_complete_before_what_started_it(tmp_path):
    """A callback that publishes early still runs when its successor has completed."""
    path = write(
        tmp_path / 'a.mcap',
        ('job_release', 10, 2, 1, 0, START_TIME + 10 * MS),
        *one_execution(1, 1, 0, 13, 14, 15, vtid=10),
        *one_execution(1, 0, 0, 10, 11, 40),
        ('shutdown', 110, 1, START_TIME + 110 * MS))
    sink = replay(path).result()['dags']['/imu']['sinks']['/imu:use']
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (1, 0, 5 * MS)
    parts = sink['breakdown']['mean']
    assert parts == {'release_lag_ns': 0, 'waiting_ns': 2 * MS, 'executing_ns': 3 * MS,
                     'suspended_ns': 0, 'transport_ns': 0, 'unknown_ns': 0,
                     'waiting_group_ns': 0}


REORDERED = """\
mddag: 1
nodes:
  - node: /imu
    callbacks:
      - {name: use, subscription: /twist, deadline: 8ms}
      - {name: tick, timer: 10ms, publishes: [/twist]}
  - node: /fuse
    callbacks:
      - {name: join, sync: [/flat, /boxes], deadline: 18ms}
  - node: /right
    callbacks:
      - {name: watch, subscription: /info, deadline: 12ms}
      - {name: rectify, subscription: /info, publishes: [/flat]}
  - node: /left
    callbacks:
      - {name: detect, subscription: /image, publishes: [/boxes]}
  - node: /camera
    callbacks:
      - {name: grab, timer: 20ms, publishes: [/info, /image], dag: video}
"""


@pytest.mark.parametrize('seed', range(5))
def test_vertices_are_found_by_name(tmp_path, seed):
    """Another order of DAGs, vertices and legs changes no verdict."""
    path = tmp_path / 'a.mcap'
    run = VirtualRun(path, small(), seed)
    outcome = replay(path, loads(REORDERED, 'reordered.yaml'))
    assert outcome.warnings == []
    expected = run.tally.result()['dags']
    dags = outcome.result()['dags']
    assert set(dags) == {'/imu', 'video'}
    for ours, theirs in (('/imu', '/imu'), ('video', '/camera')):
        assert dags[ours]['jobs'] == expected[theirs]['jobs']
        assert dags[ours]['ends'] == expected[theirs]['ends']
        for name, sink in dags[ours]['sinks'].items():
            breakdown = sink.pop('breakdown')
            del sink['slack_ns']
            assert sink == expected[theirs]['sinks'][name]
            assert breakdown['mean']['unknown_ns'] == 0


def test_vertices_of_shared_callbacks_are_found(tmp_path):
    """A callback of two DAGs is called ``@dag``; with other DAG names, or one DAG, it is found."""
    text = """\
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: cb, timer: 10ms, dag: one, publishes: [/x]}]
  - node: /b
    callbacks: [{name: cb, timer: 10ms, dag: two, publishes: [/x]}]
  - node: /c
    callbacks: [{name: cb, subscription: /x, deadline: 5ms}]
"""
    path = tmp_path / 'a.mcap'
    expected = VirtualRun(path, loads(text, 'g.yaml'), 3).tally.result()['dags']
    renamed = replay(path, loads(text.replace('one', 'uno'), 'renamed.yaml'))
    assert renamed.warnings == []
    sink = renamed.result()['dags']['uno']['sinks']['/c:cb@uno']
    assert sink['completed'] == expected['one']['sinks']['/c:cb@one']['completed'] > 0
    alone = replay(path, loads(text.replace(
        '[{name: cb, timer: 10ms, dag: two, publishes: [/x]}]',
        '[{name: cb, timer: 10ms, dag: two, deadline: 9ms}]'), 'alone.yaml'))
    assert alone.warnings == []
    sinks = alone.result()['dags']
    assert sinks['one']['sinks']['/c:cb']['completed'] == sink['completed']
    assert sinks['two']['sinks']['/b:cb']['completed'] > 0
    assert alone.result()['undeclared']['executions'] > 0  # /c:cb of DAG two


def test_callbacks_that_the_trace_lacks(tmp_path):
    path = tmp_path / 'a.mcap'
    VirtualRun(path, small())
    more = SMALL + """\
  - node: /radar
    callbacks: [{name: scan, timer: 50ms, deadline: 5ms}]
"""
    outcome = replay(path, loads(more, 'more.yaml'))
    assert outcome.warnings == [
        f'{path}: not in it: 1 of the 8 callbacks of more.yaml, which count as never completed: '
        '/radar:scan',
        'more.yaml: 1 DAG without jobs, because the source is no source in the recording: /radar']
    assert outcome.result()['dags']['/radar']['jobs'] == 0
    other = """\
mddag: 1
nodes:
  - node: /radar
    callbacks: [{name: scan, timer: 50ms, deadline: 5ms}]
"""
    with pytest.raises(ReplayError, match=(
            r'a\.mcap: none of the callbacks of other\.yaml is in it: it has /camera:grab, .*: '
            'give the graph')):
        replay(path, loads(other, 'other.yaml'))


def test_a_killed_run_is_judged_at_its_last_instant(tmp_path):
    path = write(tmp_path / 'a.mcap', *job_of_the_camera(0, 10),
                 ('job_release', 60, 2, 0, 1, START_TIME + 60 * MS),
                 ('job_release', 70, 2, 1, 0, START_TIME + 70 * MS),
                 ('job_release', 80, 2, 1, 1, START_TIME + 80 * MS))
    outcome = replay(path)
    assert outcome.warnings == [
        f'{path}: the end of the run is not recorded (the process was killed, or the trace is '
        'cut): what was open is judged at the last recorded instant']
    result = outcome.result()
    assert result['recording']['shut_down'] is False
    assert result['duration_ns'] == 70 * MS
    camera, imu = result['dags']['/camera']['sinks'], result['dags']['/imu']['sinks']
    # job 1 of the camera: 20 ms passed, deadlines of 12 and 18 ms; of the IMU: 10 and 0 ms
    assert [s['overdue'] for s in (*camera.values(), *imu.values())] == [1, 1, 1]


def test_misses_that_are_not_those_recorded_are_said(tmp_path):
    path = write(
        tmp_path / 'a.mcap', *job_of_the_camera(0, 10),
        ('deadline', 26, 2, 0, 4, 0, START_TIME + 24 * MS, START_TIME + 25 * MS),
        ('shutdown', 110, 1, START_TIME + 110 * MS))
    assert replay(path).warnings == [
        f'{path}: the replay does not find 1 of 1 recorded miss, and it finds 0 that were not '
        'recorded: the first is job 0 at /fuse:join']
    # under other deadlines there is nothing to compare
    assert replay(path, loads(SMALL.replace('12ms', '13ms'), 'g.yaml')).warnings == []


def test_a_completion_without_execution_is_said(tmp_path):
    text = 'mddag: 1\nnodes: [{node: /n, callbacks: [{name: a, timer: 10ms, deadline: 9ms}]}]'
    with begin_trace(tmp_path / 'a.mcap', text) as file:
        file.add('job_release', START_TIME, 1, 1, 0, 0, START_TIME)
        file.add('complete', START_TIME + MS, 1, 1, 9, 0, 0, 0, True, START_TIME + MS, 0)
        end_trace(file, START_TIME + MS)
    result = replay(tmp_path / 'a.mcap').result()
    assert [text.partition(': ')[2] for text in result['warnings']] == [
        '1 completed execution whose start is not in it']
    assert any(re.search('unknown\n.* 1 ms\n', each) for each in times_tables(result['dags']))


@pytest.mark.parametrize(('text', 'says'), [
    ('', 'it was recorded without a declaration'),
    ('nonsense', r'the declaration that it was recorded with is wrong \(small.yaml'),
])
def test_a_trace_without_a_usable_declaration(tmp_path, text, says):
    path = write(tmp_path / 'a.mcap', text=text)
    with pytest.raises(ReplayError, match=f'a.mcap: {says}'):
        replay(path)
    with pytest.raises(ReplayError, match='<stdin>: '):
        replay(path, name='<stdin>')


@pytest.mark.parametrize('skip', [0, 100 * MS])
def test_verdicts_begin_when_all_programs_have_started(tmp_path, skip):
    path = tmp_path / 'a.mcap'
    VirtualRun(path, small(), 4, duration=400 * MS)
    events = list(TraceReader(path).events(sorted=True))
    start = events[len(events) // 3][1]
    jobs = sum(name == 'mddag:job_release' and release >= start + skip
               for name, *_, release in events)
    with TraceFile(path, overwrite=True) as file:
        for i, (name, time, pid, thread, *fields) in enumerate(events):
            file.add(name, time, pid, thread, *fields)
            if i in (0, len(events) // 3):
                file.add('mddag:judge_from', time, pid, thread, start if i else NEVER)
    found = replay(path, skip=skip).result()['dags'].values()
    assert sum(dag['jobs'] for dag in found) == jobs > 0


SLOW = """\
mddag: 1
workers: 2
nodes:
  - node: /slow
    callbacks: [{name: plan, dag: slow, timer: 7200s, deadline: 3600s}]
  - node: /fast
    callbacks: [{name: tick, dag: fast, timer: 1s, deadline: 900ms}]
"""


@pytest.mark.parametrize('seconds', [50, 70, 4_000])
def test_a_callback_that_runs_for_minutes_is_counted_and_judged(seconds, tmp_path, call):
    path, second = tmp_path / 'run.mcap', 1_000 * MS
    with begin_trace(path, SLOW, workers=2) as file:
        file.add('job_release', START_TIME, 1, 1, 0, 0, START_TIME)
        for job in range(seconds + 30):
            if job == seconds:      # as live: an execution is recorded when it has ended
                over = START_TIME + seconds * second
                file.extend([('execution', START_TIME, 2, 7, 0, 0, 0, 0, START_TIME, 0, over,
                              over, True, 0, MS, False)], 1)
                if seconds > 3600:
                    file.add('deadline', over, 1, 2, 0, 0, 0, START_TIME + 3600 * second, over)
            time = START_TIME + job * second
            file.add('job_release', time, 1, 1, 1, job, time)
            file.extend([('execution', time, 3, 8, 1, 0, job, 1, time, 0, time + MS, time + MS,
                          True, 0, MS, False)], 1)
            if job % 20 == 0:
                file.flush()
        end_trace(file, START_TIME + (seconds + 30) * second)
    for more in ((), ('--reschedule',)):
        done = call('replay', path, *more, '--json', '-')
        result = done.result
        assert not done.stderr
        sink = result['dags']['slow']['sinks']['/slow:plan']
        assert sink['response_ns']['max'] == seconds * second
        assert (sink['completed'], sink['late']) == (1, int(seconds > 3600))
        if more:
            assert result['estimated_executions'] == 0
        else:
            use = result['callbacks']['/slow:plan']
            assert (use['executions'], use['busy_ns']) == (1, seconds * second)


DECLARATION = """mddag: 1
nodes:
  - node: /camera
    callbacks:
      - {{name: capture, timer: 10ms, publishes: [], deadline: 5ms, {key} abort}}
"""


@pytest.mark.parametrize('key', ['on_miss:', '"on_miss":', "'on_miss' :"])
def test_a_recorded_declaration_may_have_the_key_of_version_1(key):
    def read(text):
        return declared(
            Head(0, text, 'graph.yaml', 'rad', 7, 100_000_000, 64, False), 'run.mcap').dags

    now = read(DECLARATION.format(key='on_late:'))
    assert read(DECLARATION.format(key=key)) == now

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The traces of several processes as one run."""

import json
from pathlib import Path

from mddag_executor import open_recording, replay, ReplayError, reschedule, Traces
from mddag_executor.core import NEVER
from mddag_executor.core.state import SINK_ABORTED, SINK_DROPPED
from mddag_executor.core.tally import counts
from mddag_executor.errors import UsageError
from mddag_executor.recording.columns import rows
from mddag_executor.recording.recorded_jobs import Jobs
from mddag_executor.recording.tables import RELEASES
from mddag_executor.sources.clocks import offsets
from mddag_executor.trace import TraceFile
import numpy as np
import pytest

from ..report import runs
from .of_processes import ADDRESS, BASE, GRAPH, MS, STAMPED, Trace, TWO


def sink(result):
    return result['dags']['chain']['sinks']['/b:take']


def verdicts(result):
    """Return how many results were due, in time and late."""
    found = counts(sink(result))
    return found.due, found.in_time, found.late


def pair(folder, takes=(2,), boot='', **options):
    """Return the traces of two processes that ran jobs, 10 ms each: 1 ms, and what is given."""
    up, down = Trace(folder, 'up', 0, boot=boot), Trace(folder, 'down', 1, boot=boot, **options)
    for i, took in enumerate(takes):
        release = i * 10 * MS
        up.runs(release, release + MS)
        down.runs(release + 5, release + 3 * MS, took * MS)     # its clock was read again
    return up, down


@pytest.mark.parametrize(('late', 'boot'), [
    (0, ''), (7 * MS, ''), (3600_000 * MS, 'one')])     # one machine has one clock, however set
def test_a_job_goes_on_in_the_other_trace(tmp_path, late, boot):
    up, down = pair(tmp_path, (2, 2, 7), boot, late=late)
    outcome = replay([up.end(100 * MS), down.end(90 * MS)])
    result = outcome.result()
    assert result['warnings'] == []
    assert result['dags']['chain']['jobs'] == 3
    assert verdicts(result) == (3, 2, 1)
    assert sink(result)['response_ns'] == {
        'min': 5 * MS, 'median': 5 * MS, 'p99': 10 * MS, 'max': 10 * MS}
    breakdown = sink(result)['breakdown']
    assert breakdown['mean']['transport_ns'] == MS, breakdown
    assert result['workers'] == 4 and set(result['callbacks']) == {'/a:tick', '/b:take'}
    assert outcome.recording.names.workers == ['up 0', 'up 1', 'down 0', 'down 1']
    assert result['recording']['shut_down'] and result['recording']['end_ns'] == BASE + 100 * MS
    releases = {(row['dag'], row['job']) for row in outcome.recording.releases.records()}
    executions = outcome.recording.executions.records()
    assert len(releases) == len(outcome.recording.releases) == 3
    assert [(row['dag'], row['job']) in releases for row in executions] == [True] * 6


def test_traces_are_named_by_paths_of_any_kind(tmp_path):
    paths = [Path(each.end(100 * MS)) for each in pair(tmp_path)]
    for given in (paths, Traces(paths)):
        assert replay(given).result()['dags']['chain']['jobs'] == 1
    for none in ([], ()):
        with pytest.raises(UsageError, match='there is no path: give those of all processes'):
            replay(none)


@pytest.mark.parametrize(('where', 'cause'), [('down', 'interpreter'), ('up', 'machine')])
def test_a_callback_waits_for_what_runs_in_its_own_process(where, cause, tmp_path):
    # it starts 6 ms after it is ready, and one of two workers runs another callback meanwhile
    traces = {name: Trace(tmp_path, name, vertex) for vertex, name in enumerate(('up', 'down'))}
    for job in range(3):
        release = job * 20 * MS
        traces['up'].runs(release, release + MS)
        traces[where].runs_another(release + 3 * MS, release + 9 * MS)
        traces['down'].runs(release, release + 9 * MS, ready=release + 3 * MS)
    outcome = replay([trace.end(100 * MS) for trace in traces.values()])
    assert {name: n for name, n in outcome.explanation.summary()['causes'].items() if n} == {
        cause: 3}


@pytest.mark.parametrize('whose', ['up', 'down'])
def test_a_callback_waits_until_something_spins_in_its_own_process(tmp_path, whose):
    """It waited from 3 to 6 ms, and both processes began to spin later than they started."""
    traces = {name: Trace(tmp_path, name, vertex) for vertex, name in enumerate(('up', 'down'))}
    for job in range(3):
        at = (1 + job) * 20 * MS
        traces['up'].runs(at, at + MS)
        traces['down'].runs(at, at + 6 * MS, ready=at + 3 * MS)
        traces[whose].add('spin_gap', at + 6 * MS, -1, BASE + at + 3 * MS, BASE + at + 6 * MS)
    for trace in traces.values():
        trace.add('spin_gap', 5 * MS, -1, BASE, BASE + 5 * MS)
    outcome = reschedule([trace.end(100 * MS) for trace in traces.values()])
    assert ['did not spin' in each for each in outcome.warnings] == [True] * (whose == 'down')


def test_what_a_restarted_process_waited_for_before_counts(tmp_path):
    """Its timer was noticed 10 ms late in both runs of it, as nothing spun."""
    first = Trace(tmp_path, 'up', 0)
    again = Trace(tmp_path, 'up.2', 0, begin=60 * MS, judges_from=60 * MS)
    down = Trace(tmp_path, 'down', 1)
    for at, trace in ((20 * MS, first), (80 * MS, again)):
        trace.add('spin_gap', at + 10 * MS, -1, BASE + at, BASE + at + 10 * MS)
        trace.runs(at, at + 10 * MS)
        down.runs(at, at + 12 * MS)
    found = replay([first.end(50 * MS), again.end(120 * MS), down.end(120 * MS)])
    assert {name: n for name, n in found.explanation.summary()['causes'].items() if n} == {
        'program': 2}


@pytest.mark.parametrize('apart', [20_000, 0])
def test_the_messages_of_a_burst_keep_their_jobs(tmp_path, apart):
    up, down = Trace(tmp_path, 'up', 0), Trace(tmp_path, 'down', 1)
    for i in range(3):
        release = MS + i * apart
        up.runs(release, (1 + i) * MS + 100_000, ready=release)
        down.runs(release + 5, (3 + 3 * i) * MS, 3 * MS, ready=(3 + i) * MS)
    found = replay([up.end(90 * MS), down.end(90 * MS)]).judged.verdicts
    assert found['job'].tolist() == [0, 1, 2]
    assert (found['completed'] - found['release']).tolist() == [
        5 * MS, 8 * MS - apart, 11 * MS - 2 * apart]


@pytest.mark.parametrize(('key', 'reason', 'verdict'), [
    ('keep: newest', 'newer', SINK_DROPPED), ('on_late: abort', 'aborted', SINK_ABORTED)])
def test_drops_are_of_the_jobs_of_the_run(tmp_path, key, reason, verdict):
    """The second process starts later, so that its job 1 is job 4 of the run."""
    whose = 'timer: 10ms' if reason == 'aborted' else 'subscription: /x'
    graph = GRAPH.replace(whose, f'{whose}, {key}')
    up = Trace(tmp_path, 'up', 0, graph=graph)
    down = Trace(tmp_path, 'down', 1, graph=graph, begin=30 * MS, judges_from=30 * MS)
    for i in range(6):
        at = i * 10 * MS
        up.runs(at, at)
        if i == 4:
            down.add('job_release', at + 2 * MS, 0, 1, BASE + at)
            down.add('drop', at + 12 * MS, ADDRESS, 0, 1, 1, reason)
            if reason == 'aborted':
                down.add('abort', at + 12 * MS, 0, 1)
            down.job = 2
        elif i > 2:
            down.runs(at, at + 2 * MS)
    outcome = replay([up.end(90 * MS), down.end(90 * MS)])
    missed, = outcome.judged.missed
    assert (missed['job'], missed['kind']) == (4, verdict)
    recording = outcome.recording
    assert [recording.callback_name(each) for each in recording.drops['callback']] == ['/b:take']
    if reason == 'aborted':
        # it was ready, and nothing ran in its process
        assert outcome.explanation.worst()['parts'][-1]['cause'] == 'machine'


def two_machines(folder, late, back=True):
    up = Trace(folder, 'up', 0, graph=STAMPED, boot='one')
    down = Trace(folder, 'down', 1, late, STAMPED, boot='other')
    for trace in (up, down):
        trace.knows('/x', 1)
        trace.knows('/back', 2)
    for i, takes in enumerate((2, 2, 7)):
        release = i * 10 * MS
        up.runs(release, release + MS)
        ready = release + 3 * MS
        # the stamp, by the clock of its source, but no time to come
        down.runs(min(release + 1000 + late, ready), ready, takes * MS)
        up.sends(down, 1, release + 2 * MS, (i + 4) * MS // 10)
        if back:
            down.sends(up, 2, release + 4 * MS, (i + 2) * MS // 10)
    down.add('rcl_subscription_init', 0, 3, 1, 3, '/other', 10)
    down.add('rclcpp_subscription_init', 0, 3, 30)
    down.add('rclcpp_subscription_callback_added', 0, 30, ADDRESS + 5)
    down.add('gone', 90 * MS, ADDRESS + 5)
    down.add('spin_gap', 80 * MS, -1, BASE + 70 * MS - late, BASE + 80 * MS - late)
    return [up.end(100 * MS), down.end(100 * MS)]


@pytest.mark.parametrize('late', [0, 3 * MS, -40_000 * MS])
def test_messages_both_ways_tell_how_clocks_of_two_machines_differ(tmp_path, late, call):
    paths = two_machines(tmp_path, late)
    result = replay(paths).result()
    recording = open_recording(paths)   # all times are by one clock
    gone, = (each.gone for each in recording.names.callbacks if each.gone is not None)
    gap, = recording.spin_gaps.records().tolist()
    for time, ms in ((gone, 90), *zip(gap[2:], (70, 80))):
        assert abs(time - BASE - ms * MS) <= 300_000
    assert gap[:2] == (1, -1)
    warning, = result['warnings']
    # from up to down 0.4 ms at least, back 0.2 ms
    ahead = f'{abs(100_000 - late) / 1e6:.3f} ms ' + ('ahead' if late < 100_000 else 'behind')
    assert f'is taken to be {ahead}, within 0.300 ms, by the messages' in warning, warning
    assert verdicts(result) == (3, 2, 1)
    assert sink(result)['response_ns']['max'] == 10 * MS - 100_000

    run = call('replay', *paths, '--offset', f'down={-late}ns', '--json', '-')
    assert run.stderr == '' and '"max": 10000000' in run.stdout
    reversed_paths = replay(paths[::-1]).result()
    assert verdicts(reversed_paths) == (3, 2, 1)
    assert sink(reversed_paths)['response_ns']['max'] == 10 * MS - 100_000
    for late, says in ((0, 'is assumed to be synchronised'),
                       (5 * MS, 'come there 4.600 ms before they are sent')):
        warning, = replay(two_machines(tmp_path, late, back=False)).warnings
        assert f'{says}: give --offset down=TIME' in warning


def test_processes_that_are_killed_started_again_or_never_judge(tmp_path):
    up, down = Trace(tmp_path, 'up', 0), Trace(tmp_path, 'down', 1)
    again = Trace(tmp_path, 'down.2', 1, begin=30 * MS, judges_from=45 * MS)
    other = Trace(tmp_path, 'other', 1, judges_from=NEVER - BASE)
    for i in range(6):
        up.runs(i * 10 * MS, i * 10 * MS + MS)
        if i != 3:
            (down if i < 3 else again).runs(i * 10 * MS, i * 10 * MS + 3 * MS, completes=i != 2)
    paths = [up.end(90 * MS), down.end(None), again.end(90 * MS), other.end(None)]
    result = replay(paths).result()
    assert verdicts(result) == (6, 4, 2)
    warning, nothing = result['warnings']
    assert warning.startswith(f'{tmp_path}/run.down.mcap: its end is not recorded')
    assert warning.endswith('it ends 0.067 s before the run; 1 job ended with it: chain 2')
    assert nothing.endswith('no job was open in it')


def test_what_waits_when_its_process_ends_waits_until_the_end_of_the_run(tmp_path):
    up, down = Trace(tmp_path, 'up', 0), Trace(tmp_path, 'down', 1)
    up.runs(0, MS)
    down.add('job_release', 3 * MS, 0, 0, BASE)
    down.add('dispatch', 40 * MS, ADDRESS, 0, 1, 0, -1, BASE + 3 * MS, BASE + 8 * MS)
    explanation = replay([up.end(100 * MS), down.end(40 * MS)]).explanation
    assert explanation.summary()['causes']['waited'] == 1
    assert explanation.worst()['parts'][-1]['ns'] == 97 * MS



@pytest.fixture
def two(tmp_path):
    """Return the traces of two processes that compute for 5 ms at the same time."""
    paths = []
    for dag, name in enumerate(('up', 'down')):
        trace = Trace(tmp_path, name, 0, dag=dag, graph=TWO)
        for i in range(9):
            trace.runs(i * 12 * MS, i * 12 * MS, 5 * MS)
        paths.append(trace.end(120 * MS))
    return paths


def test_each_process_has_its_workers_and_interpreter_again(two, tmp_path, call):
    outcome = reschedule(two)
    assert [(p.name, p.nodes) for p in outcome.processes] == [('up', ('/a',)), ('down', ('/b',))]
    assert (outcome.workers, outcome.settings.pools) == (4, (2, 2)) and not outcome.tally.missed
    assert outcome.worker_names == ['up 0', 'up 1', 'down 0', 'down 1']
    assert reschedule(two, cpus=1).tally.missed
    slack = 'slack', *two, '--workers', 'up=3'
    assert call(*slack, '--json', '-').result['processes'] == [
        {'name': name, 'workers': {'given': given, 'least': 1, 'breaks': None}}
        for name, given in (('up', 3), ('down', 2))]
    lines = call(*slack).stdout
    assert '1 of 3 workers in up is enough\n1 of 2 workers in down is enough\n' in lines

    run = call('replay', *two, '--reschedule')
    assert '18 in time' in run.stdout and '4 workers in 2 processes' in run.stdout
    for given in ('processes: {p: [/a, /b]}', 'processes: {p: [/a], q: [/b]}'):
        (tmp_path / 'placed.yaml').write_text(given)
        late = '9 late' if 'q:' not in given else ' 0 late'
        run = call('replay', *two, '--reschedule', '--processes', tmp_path / 'placed.yaml')
        assert late in run.stdout, (given, run.stdout, run.stderr)
    (tmp_path / 'graph.yaml').write_text(TWO + 'processes: {p: [/a, /b]}')
    assert '9 late' in call('replay', *two, tmp_path / 'graph.yaml', '--reschedule').stdout


def test_each_process_has_the_number_of_workers_that_it_had(tmp_path, call):
    """Unless a number is given for it; of several that become one the largest counts."""
    paths = []
    for dag, (name, workers) in enumerate((('up', 1), ('down', 3))):
        trace = Trace(tmp_path, name, 0, dag=dag, graph=TWO, workers=workers)
        for i in range(9):
            trace.runs_another(i * 12 * MS, i * 12 * MS + 6 * MS)
            trace.runs(i * 12 * MS, i * 12 * MS + 6 * MS, 4 * MS, ready=i * 12 * MS)
        paths.append(trace.end(120 * MS))
    for given, expected in ((None, (1, 3)), (2, (2, 2)), ({'up': 2}, (2, 3)),
                            ({'down': 1, 'up': 4}, (4, 1))):
        outcome = reschedule(paths, workers=given)
        assert outcome.settings.pools == expected
        assert outcome.workers == sum(expected) == len(outcome.worker_names)
        assert [each['workers'] for each in outcome.result()['processes']] == [*expected]
    run = call('replay', *paths, '--reschedule', '--workers', 'down=2')
    assert '3 workers in 2 processes' in run.stdout
    one = tmp_path / 'one.yaml'
    one.write_text('processes: {p: [/a, /b]}')
    run = call('replay', *paths, '--reschedule', '--processes', one)
    assert 'policy rad, 3 workers, ' in run.stdout
    for given, says in (
            ('other=2', '--workers: there is no process other: name one of up, down'),
            ('up=0', "'0' is not an integer from 1 to 4096"),
            ('up=1,up=2', "'up=1,up=2' is not PROCESS=N,…")):
        assert says in call('replay', *paths, '--reschedule', '--workers', given).stderr
    assert '--workers: up: there is one process: give a number alone' in call(
        'replay', *paths, '--reschedule', '--processes', one, '--workers', 'up=1').stderr
    # both callbacks waited for 6 ms for another one, on the only worker, or on one of three
    causes = {each['sink']: each['cause'] for each in replay(paths).explanation.mostly()}
    assert causes == {'/a:t': 'waited', '/b:t': 'interpreter'}


def test_a_run_of_one_process_is_rescheduled_in_two(tmp_path, call):
    trace = Trace(tmp_path, 'whole', 0, graph=TWO)
    for i in range(9):
        for trace.dag in range(2):
            trace.job = i
            at = i * 12 * MS
            trace.runs(at, at + trace.dag * 5 * MS, 5 * MS, ready=at)
    path = trace.end(100 * MS)
    for more, in_time in (((), False), (('--processes', '2'), True)):
        assert (' 0 late' in call('replay', path, '--reschedule', *more).stdout) == in_time


def test_a_folder_is_the_run_of_all_traces_in_it(tmp_path, graph, call):
    graph.write_text(GRAPH.replace('8ms', '3ms'))
    for folder, takes in (('before', 2), ('after', 7)):
        (tmp_path / folder).mkdir()
        for trace in pair(tmp_path / folder, [takes] * 3):
            trace.end(100 * MS)
    before, after, out = tmp_path / 'before', tmp_path / 'after', tmp_path / 'out.csv'
    assert '3 in time' in call('replay', before).stdout
    assert '3 late' in call('explain', after).stdout
    assert '3 late' in call('replay', *before.iterdir(), graph).stdout
    assert call('export', before, '-o', out).returncode == 0
    assert [line.split(',')[2:4] for line in out.read_text().splitlines()[1:3]] == [
        ['/a:tick', '2'], ['/b:take', '0']]
    run = call('diff', before, after, '--fail-on-worse', '--json', '-')
    both = sink(json.loads(run.stdout))
    assert run.returncode == 1 and [both[side]['late'] for side in 'ab'] == [0, 3]
    Trace(before, 'other', 0, graph=TWO).end(MS)
    refused = call('diff', before, after)
    assert refused.returncode == 2 and 'another declaration' in refused.stderr


def test_a_folder_with_one_trace_is_the_run_of_that_trace(tmp_path, call):
    paths = [tmp_path / name for name in ('before', 'after')]
    for path in paths:
        path.mkdir()
        runs.by_hand(path / 'run.mcap')
    assert call('replay', paths[0]).stdout == call('replay', paths[0] / 'run.mcap').stdout
    assert call('diff', *paths, '--fail-on-worse').returncode == 0


def test_traces_of_different_runs_are_refused(tmp_path):
    up = Trace(tmp_path, 'up', 0).end(MS)
    other = Trace(tmp_path, 'other', 0, graph=GRAPH.replace('8ms', '9ms')).end(MS)
    with pytest.raises(ReplayError, match='another declaration than'):
        replay([up, other])
    empty = str(tmp_path / 'empty.mcap')
    with TraceFile(empty) as file:
        file.add('callback_start', 5, 1, 1, 7, False)
    with pytest.raises(ReplayError, match='it is of another run than'):
        replay([up, empty])


def test_traces_of_two_runs_of_one_declaration_are_refused(tmp_path, call):
    paths = {}
    for run, begin in (('one', 0), ('two', 200 * MS)):
        for vertex, name in enumerate(('up', 'down')):
            trace = Trace(tmp_path, f'{run}.{name}', vertex, begin=begin)
            trace.runs(begin + vertex * 5, begin + (1 + 2 * vertex) * MS)
            paths[run, name] = trace.end(begin + 90 * MS)
    for order in (['down', 'up'], ['up', 'down']):
        given = [paths[run, name] for run in ('one', 'two') for name in order]
        run = call('replay', *given) if order[0] == 'up' else call('replay', tmp_path)
        assert (run.returncode, run.stdout, run.stderr.count('\n')) == (2, '', 1)
        assert run.stderr == (
            f'error: {given[2]}: it is of another run than {given[0]}: no trace goes on from one '
            'to the other: give the traces of one run: {} {}, or {} {}\n'.format(*given))
    one = call('replay', paths['one', 'up'], paths['one', 'down'])
    assert '1 in time' in one.stdout and not one.stderr

    # one that was started again was not there at the same time as the first one
    long = Trace(tmp_path, 'long', 1)
    long.runs(5, 3 * MS)
    whole = replay([paths['one', 'up'], paths['two', 'up'], long.end(300 * MS)])
    assert whole.result()['dags']['chain']['jobs'] == 2
    # but what runs in two at once is of two runs
    twin = Trace(tmp_path, 'twin', 1)
    for release in (0, 10 * MS):
        twin.runs(release, release + 2 * MS)
    with pytest.raises(ReplayError, match='/b:take ran in it and, at the same time, in '):
        replay([twin.end(50 * MS), paths['one', 'up'], long.path])


def test_processes_of_containers_may_have_the_same_numbers(tmp_path, call):
    found = []
    for pids in ((101, 102), (7, 7)):
        traces = [Trace(tmp_path, name, vertex, pid=pid)
                  for vertex, (name, pid) in enumerate(zip(('up', 'down'), pids))]
        for i in range(9):      # /b:take begins while /a:tick still runs
            traces[0].runs(i * 10 * MS, i * 10 * MS, 6 * MS)
            traces[1].runs(i * 10 * MS, i * 10 * MS + 4 * MS, 3 * MS, ready=i * 10 * MS + 3 * MS)
        paths = [trace.end(100 * MS) for trace in traces]
        for verb, *more in (('replay', '--callbacks'), ('replay', '--reschedule'),
                            ('explain',), ('slack',)):
            found.append(call(verb, *paths, *more, '--json', '-').result)
    apart, same = found[:4], found[4:]
    assert {name: (use['executions'], use['busy_ns'])
            for name, use in same[0]['callbacks'].items()} == {
        '/a:tick': (9, 54 * MS), '/b:take': (9, 27 * MS)}
    assert same == apart


def test_places_of_jobs_are_dense():
    """One fast DAG and many slow ones: joining kept an entry for each DAG and each number."""
    dag = np.r_[np.zeros(1000), np.repeat(np.arange(1, 100), 2)].astype(np.int32)
    released = rows(RELEASES, len(dag), dag=dag, job=np.r_[np.arange(1000), np.tile((0, 999), 99)])
    jobs = Jobs(100, released)
    assert len(jobs) == len(released)
    assert sorted(jobs.places(released).tolist()) == list(range(len(released)))
    assert jobs.rows_of(1, np.array([0, 999, 998])).tolist() == [0, 1, -1]
    unknown = np.array([-1, 1, 100, 0]), np.array([0, 998, 0, 1000])
    assert jobs.places_of(*unknown).tolist() == [-1] * 4


def test_machines_are_compared_by_way_of_others_and_by_what_is_given():
    # 1 is 10 ahead of 0, and 2 is 100 ahead of 1; from 2 to 0 messages go one way only
    ways = {(0, 1): 14, (1, 0): -4, (1, 2): 103, (2, 1): -97, (2, 0): -50}
    assert offsets({1, 2}, ways, {}) == {0: (0, 0), 1: (9, 5), 2: (109, 8)}
    assert offsets({1, 2}, ways, {1: 10}) == {0: (0, 0), 1: (10, 0), 2: (110, 3)}
    assert offsets({1, 2}, {(0, 1): 14}, {}) == {0: (0, 0)}

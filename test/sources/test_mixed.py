# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Runs of which this executor recorded some processes, and LTTng others."""

import json
from pathlib import Path

from mddag_executor import open_recording, replay, ReplayError, reschedule
from mddag_executor.errors import UsageError
from mddag_executor.recording.tables import FAILED
from mddag_executor.sources.open import Traces
from msg_graph import load, loads
import pytest

from .mixed import DETECT, detecting, detector, GRAPH, N, Own, OWN_GRAPH, robot
from .recorded import MS, US

PAIR = Path(__file__).parent / 'mixed_pair'


@pytest.fixture
def graph():
    return loads(GRAPH, 'graph.yaml')


def pair(folder, ahead=0, **more):
    """Return the paths of both recordings."""
    return [detector(folder / 'own.mcap', ahead=ahead, **more),
            str(robot(folder / 'lttng.mcap', ahead).write())]


def sink(result):
    return result['dags']['/camera']['sinks']['/plan:plan']


def same(value):
    return dict.fromkeys(('min', 'median', 'p99', 'max'), value)


@pytest.mark.parametrize('declared', [False, True])
@pytest.mark.parametrize('ahead', [0, 7 * MS, -3_000 * MS])
def test_jobs_go_from_one_recording_to_the_other_and_back(tmp_path, graph, ahead, declared):
    """The system clock was set by some ms between the start of LTTng and of the executor."""
    paths = pair(tmp_path, ahead, declared=declared)
    results = [replay(given, graph).result() for given in (paths, paths[::-1])]
    assert results[0]['dags'] == results[1]['dags']
    result = results[0]
    assert result['warnings'] == []
    assert (sink(result)['completed'], sink(result)['late']) == (N, 0)
    assert sink(result)['response_ns'] == same(15 * MS)
    worst = sink(result)['breakdown']['worst']
    assert [step['vertex'] for step in worst['chain']] == [
        '/camera:grab', '/detect:detect', '/plan:plan']
    # to /detect the message arrives after the end of /camera's callback; what LTTng does not
    # record, the arrival at /plan, counts as waiting
    assert (worst['transport_ns'], worst['waiting_ns'], worst['executing_ns']) == (
        500 * US, (1_000 + 500 + 1_980) * US, (2_000 + 5_020 + 4_000) * US)
    assert result['callbacks']['/detect:detect']['executions'] == N
    path = result['paths']['seen']
    # from the publication of the image to the start of /plan
    assert path['response_time']['best']['max'] == (11 - 2) * MS
    required = result['requirements']['seen']['reaction']
    assert (required['completed'], required['late'], required['response_ns']['max']) == (
        N - 1, 0, 114 * MS)
    assert [(each['topic'], each['callback'], each['arrived']) for each in result[
        'communications']] == [
            ('/boxes', '/plan subscription /boxes', N),
            ('/image', '/detect subscription /image', N)]


@pytest.mark.parametrize(('style', 'taken'), [
    ('caret', 'caret'), ('humble_fastdds', 'take'), ('jazzy', 'take')])
def test_recordings_of_caret_are_joined_as_well(tmp_path, graph, style, taken):
    lttng = robot(tmp_path / 'lttng.mcap', 7 * MS, style=style, taken=taken).write()
    result = replay([detector(tmp_path / 'own.mcap', ahead=7 * MS), str(lttng)], graph).result()
    assert result['warnings'] == []
    assert (sink(result)['completed'], sink(result)['response_ns']) == (N, same(15 * MS))


@pytest.mark.parametrize('ahead', [5 * MS, -5 * MS, 40_000 * MS])
def test_messages_both_ways_show_how_the_clock_of_another_computer_differs(
        tmp_path, graph, ahead):
    paths = [detector(tmp_path / 'own.mcap', ahead=ahead, boot='other'),
             str(robot(tmp_path / 'lttng.mcap', other=ahead).write())]
    result = replay(paths, graph).result()
    # from /camera to /detect 1.5 ms at least, back 2 ms
    line, = result['warnings']
    assert f'the clock of /detect is taken to be {abs(ahead / MS - 0.248):.3f} ms ' in line
    assert (sink(result)['completed'], sink(result)['response_ns']) == (N, same(15 * MS))


def test_whatever_is_lost_no_job_is_late_or_expired(tmp_path, graph):
    r = robot(tmp_path / 'lttng.mcap', n=3, until=4)
    r.run(11, 1, 3000 * MS, 3001 * MS)
    own = detector(tmp_path / 'own.mcap', n=3, end=3500 * MS)
    whole = replay([own, str(r.write())], graph).result()['dags']['/camera']['ends']
    assert (whole['completed'], whole['late'], whole['expired']) == (3, 0, 1)
    names = r.names()
    for place in range(names.index('ros2:callback_start'), len(names)):
        ends = replay([own, str(r.write(but=[place]))], graph).result()['dags']['/camera']['ends']
        assert (ends['late'], ends['expired']) in ((0, 0), (0, 1)), (place, names[place], ends)
    lttng = str(r.write())
    names = detecting(tmp_path / 'whole.mcap', n=3).names
    for place in range(names.index('rmw_take'), len(names)):
        cut = detecting(tmp_path / 'cut.mcap', n=3, but=place).end(3500 * MS)
        ends = replay([cut, lttng], graph).result()['dags']['/camera']['ends']
        assert (ends['late'], ends['expired']) in ((0, 0), (0, 1)), (place, names[place], ends)


def test_without_graph_the_recorded_one_judges(tmp_path):
    result = replay(pair(tmp_path, declared=True)).result()
    found = result['dags']['/detect']['sinks']['/detect:detect']
    # its message is from a callback that the declaration does not know
    assert (found['completed'], found['response_ns']) == (N, same(6500 * US))
    assert result['recording']['declaration'] == 'own.yaml'
    assert result['recording']['shut_down']


def test_a_timer_of_this_executor_starts_jobs_that_come_back(tmp_path):
    """It is due every 100 ms, and noticed 300 us later."""
    nodes = ('  - {node: /front, callbacks: [{name: grab, timer: 100ms, '
             'publishes: [/image]DEADLINE},'
             ' {name: plan, subscription: /boxes, deadline: 20ms}]}\n')
    own = Own(tmp_path / 'own.mcap', 'mddag: 1\nnodes:\n' + nodes.replace(
        ', publishes: [/image]DEADLINE', ', deadline: 30ms').replace(
            '/boxes,', '/boxes, period: 100ms,'))
    own.node('/front')
    own.publisher(100, '/image')
    own.timer(20, 100 * MS)
    own.subscription(40, '/boxes')
    r = robot(tmp_path / 'lttng.mcap', until=0)
    r.node(3, '/detect')
    r.publisher(101, 3, '/boxes')
    r.subscription(30, 3, '/image')
    for k in range(1, N + 1):
        at = k * 100 * MS
        own.publish(100, at + 2 * MS)
        own.run(20, at + 300 * US, at + 500 * US, at + 3 * MS, declared=True, release=at)
        r.receive(30, 5, at + 4 * MS, at + 8 * MS, at + 2020 * US, style='take')
        boxes = r.publish(101, 5, at + 7 * MS, style='tracing')
        own.take(40, at + 9 * MS, boxes)
        own.run(40, at + 9 * MS, at + 10 * MS, at + 12 * MS)
    detect = ('  - {node: /detect, callbacks: [{name: detect, subscription: /image, '
              'publishes: [/boxes]}]}\n')
    graph = loads('mddag: 1\nnodes:\n' + nodes.replace('DEADLINE', '') + detect, 'graph.yaml')
    result = replay([own.end(1100 * MS), str(r.write())], graph).result()
    assert result['warnings'] == []
    found = result['dags']['/front']['sinks']['/front:plan']
    assert (found['completed'], found['response_ns']) == (N, same(12 * MS))
    assert found['breakdown']['mean']['release_lag_ns'] == 300 * US


def test_all_tables_name_the_process_and_join(tmp_path, graph):
    """`process` is the row of the table of processes, in each table that has it."""
    paths = [detector(tmp_path / 'own.mcap', declared=True, fails=(3,)),
             str(robot(tmp_path / 'lttng.mcap', n=8).write())]
    outcome = replay(paths, graph)
    processes = outcome.table('processes')
    names = dict(zip(processes['process'].tolist(), processes['name'].tolist()))
    assert sorted(names.values()) == ['own', 'robot']
    assert dict(zip(processes['name'].tolist(), processes['executions'].tolist())) == {
        'robot': N + 8, 'own': N}
    run = outcome.recording
    assert {names[each] for each in run.releases['process'].tolist()} == {'robot'}
    released = {(each['dag'], each['job']) for each in run.releases.records()}
    assert {(each['dag'], each['job']) for each in run.job_ends.records()} <= released
    sent = run.publications[run.publications['execution'] >= 0]
    assert sent['process'].tolist() == run.executions['process'][sent['execution']].tolist()
    assert {(names[each['process']], run.names.publishers[each['publisher']].topic)
            for each in run.publications.records()} == {('robot', '/image'), ('own', '/boxes')}
    assert {(names[each['process']], each['reason']) for each in run.job_ends.records()} >= {
        ('own', FAILED)}


def test_an_execution_that_raised_has_failed(tmp_path, graph):
    result = replay(pair(tmp_path, declared=True, fails=(3, 4)), graph).result()
    ends = result['dags']['/camera']['ends']
    assert (ends['failed'], ends['completed']) == (2, N - 2)


@pytest.mark.parametrize('executions', [False, True])
def test_a_process_that_both_have_recorded_counts_once(tmp_path, graph, executions):
    """The middleware has tracepoints, and a program may have those of executions as well."""
    own = detector(tmp_path / 'own.mcap')
    r = robot(tmp_path / 'lttng.mcap')
    r.add('mddag:host', 0, 7, 'robot', 'boot', 0, pid=2)
    r.node(9, '/detect', pid=2)
    r.publisher(77, 9, '/boxes', pid=2)
    r.subscription(DETECT, 9, '/image', pid=2)
    for k in range(1, N + 1):
        at = k * 100 * MS
        if executions:
            r.receive(DETECT, 7, at + 4 * MS, at + 10 * MS, at + 2010 * US, 'take', pid=2)
        r.add('ros2:rcl_publish', at + 9 * MS, 7, 77, 1, pid=2)
        r.add('ros2:rmw_publish', at + 9 * MS, 7, 1, 5, pid=2)
    result = replay([own, str(r.write())], graph).result()
    line, = result['warnings']
    assert line == (f'{tmp_path}/lttng.mcap: left out: {50 if executions else 20} events of '
                    f'process 2, because {own} has recorded it as well, and with its executions')
    assert sink(result)['response_ns'] == same(15 * MS)
    assert result['callbacks']['/detect:detect']['executions'] == N


@pytest.mark.parametrize('boot', ['boot', 'other'])
def test_a_process_of_another_container_or_computer_may_have_the_same_number(
        tmp_path, graph, boot):
    own = detector(tmp_path / 'own.mcap', pid=1, boot=boot)
    outcome = replay([own, str(robot(tmp_path / 'lttng.mcap').write())], graph)
    assert sink(outcome.result())['completed'] == N
    assert [line for line in outcome.warnings if 'left out' in line] == []
    assert sorted(outcome.recording.names.processes.values()) == ['own', 'robot']


def test_topics_without_source_timestamps_are_named(tmp_path, graph):
    """As ros2_tracing records them before Jazzy; CARET's recordings have them."""
    own = detector(tmp_path / 'own.mcap')
    r = robot(tmp_path / 'lttng.mcap', style='rclpy')
    stamps = [at for at, name in enumerate(r.names()) if 'bind' in name or 'dds_write' in name]
    result = replay([own, str(r.write(but=stamps))], graph).result()
    line, = (each for each in result['warnings'] if 'is not joined' in each)
    assert f'/image is not joined: {N} executions for messages that LTTng recorded ' in line
    camera = result['dags']['/camera']
    assert (camera['jobs'], camera['unjudged']) == (N, N)
    assert not any(camera['ends'].values())


def test_jobs_before_and_after_one_of_the_recordings_are_not_judged(tmp_path, graph):
    """The executor ran from the third to the seventh image; LTTng recorded all."""
    own = detector(tmp_path / 'own.mcap', n=7, first=3, end=720 * MS)
    r = robot(tmp_path / 'lttng.mcap', n=0)
    for k in range(3, 8):
        at = k * 100 * MS
        r.receive(13, 1, at + 11 * MS, at + 15 * MS, at + 9020 * US, style='take')
    for at in (2000, 5000):
        r.run(11, 1, at * MS, (at + 1) * MS)
    result = replay([own, str(r.write())], graph).result()
    camera = result['dags']['/camera']
    assert (camera['jobs'], camera['ends']['completed'], camera['unjudged']) == (N, 5, 5)
    assert camera['ends']['expired'] == sink(result)['late'] == sink(result)['overdue'] == 0

    # a killed process is missing in the run as well
    killed = detector(tmp_path / 'killed.mcap', n=7, first=1, end=None)
    result = replay([killed, str(tmp_path / 'lttng.mcap')], graph).result()
    assert any('its end is not recorded' in line for line in result['warnings'])
    assert not result['recording']['shut_down']
    assert result['dags']['/camera']['ends']['expired'] > 0


def test_each_process_has_a_pool_of_its_own(tmp_path, graph):
    outcome = reschedule(pair(tmp_path), graph, policy='rad')
    result = outcome.result()
    # one thread ran the callbacks of the other executor
    assert [(each['name'], each['nodes'], each['workers']) for each in result['processes']] == [
        ('robot', ['/camera', '/plan'], 1), ('own', ['/detect'], 2)]
    assert (sink(result)['completed'], sink(result)['late']) == (N, 0)


def test_a_callback_waits_for_its_pool_or_for_its_thread(tmp_path, graph):
    """Both workers of /detect's process are busy in some jobs, the thread of /plan in others."""
    own = Own(tmp_path / 'own.mcap')
    own.node('/detect')
    own.publisher(101, '/boxes')
    own.subscription(DETECT, '/image')
    own.subscription(50, '/hog')
    r = robot(tmp_path / 'lttng.mcap', n=0)
    r.subscription(51, 2, '/other')
    for k in range(1, N + 1):
        at, late = k * 100 * MS, (20 if k % 2 else 0) * MS
        own.take(DETECT, at + 3 * MS, at + 2010 * US, k)
        if k % 2:
            for tid in (7, 8):
                own.run(50, at, at + MS, at + 23 * MS, tid=tid)
        own.publish(101, at + late + 9 * MS)
        own.run(DETECT, at + 3 * MS, at + late + 4 * MS, at + late + 10 * MS)
        if not k % 2:
            r.run(51, 1, at + 10 * MS, at + 40 * MS)
        start = at + (31 if k % 2 else 41) * MS
        r.receive(13, 1, start, start + MS, at + late + 9020 * US, style='take')
    outcome = replay([own.end(1200 * MS), str(r.write())], graph)
    found = outcome.explanation.result()
    assert {cause: n for cause, n in found['causes'].items() if n} == {'waited': N}
    behind = {(job['job'] % 2, each['callback']) for job in found['jobs']
              for part in job['parts'] for each in part['behind']}
    assert behind == {(0, '/detect subscription /hog'), (1, '/plan subscription /other')}


def test_the_commands_take_both(tmp_path, call):
    own, lttng = pair(tmp_path)
    graph = tmp_path / 'graph.yaml'
    graph.write_text(GRAPH)
    run = call('replay', own, lttng, graph)
    assert f'{N} in time' in run.stdout and run.stderr == ''
    drafted = tmp_path / 'drafted.yaml'
    assert call('graph', 'from-trace', own, lttng, '-o', drafted).returncode == 0
    for node in ('/camera', '/detect', '/plan'):
        assert f'node: {node}\n' in drafted.read_text()
    for verb in (['explain'], ['slack'], ['export', '-o', tmp_path / 'out.csv']):
        assert call(verb[0], own, lttng, graph, *verb[1:]).returncode == 0, verb
    result = call('replay', own, lttng, graph, '--report', tmp_path / 'out.html', '--json', '-')
    assert sink(json.loads(result.stdout))['completed'] == N


def test_a_list_of_one_recording_is_that_recording(tmp_path, graph):
    for path in pair(tmp_path):
        assert replay([path], graph).result()['dags'] == replay(path, graph).result()['dags']


def test_recordings_that_cannot_be_joined_are_refused(tmp_path, graph):
    own, lttng = pair(tmp_path, declared=True)
    second = str(robot(tmp_path / 'second.mcap').write())
    with pytest.raises(ReplayError, match='it is an imported recording, as .*lttng.mcap is: '
                       'import all sessions of the run into one'):
        replay([own, lttng, second], graph)
    with pytest.raises(UsageError, match='clocks of computers are compared by messages'):
        replay(Traces([own, lttng], {'own': 5}), graph)
    later = detector(tmp_path / 'later.mcap', begin=9_000 * MS, first=90, n=92, end=None)
    with pytest.raises(ReplayError, match='another run than .*: it begins 7.[0-9]* s after the'):
        replay([later, lttng], graph)
    other = Own(tmp_path / 'other.mcap', OWN_GRAPH.replace('20ms', '30ms'), pid=3)
    other.node('/detect')
    other.subscription(DETECT, '/image')
    other.run(DETECT, 3 * MS, 4 * MS, 5 * MS)
    with pytest.raises(ReplayError, match='with another declaration than .*give the GRAPH'):
        replay([own, other.end(9 * MS), lttng])


def test_a_recorded_pair_has_the_times_of_the_callbacks_themselves():
    """
    Two nodes with the tracepoints of ros2_tracing, and one under ``mddag run``, over Fast DDS.

    LTTng has recorded both processes. Each callback has noted its number, its start and its end,
    and that of the timer also when it was due.
    """
    graph = load(PAIR / 'graph.yaml')
    truth = json.loads((PAIR / 'truth.json').read_text())
    outcome = replay([PAIR / 'own.mcap', PAIR / 'lttng.mcap'], graph)
    found = outcome.judged.verdicts
    times = (found['completed'] - found['release']).tolist()
    assert len(times) == len(truth['responses'])
    for time, expected in zip(times, truth['responses']):
        assert abs(time - expected) <= 20_000
    result = outcome.result()
    assert {name: use['executions'] for name, use in result['callbacks'].items()} == truth[
        'executions']
    line, = result['warnings']
    assert 'left out: ' in line and 'own.mcap has recorded it as well' in line
    assert [(each['topic'], each['arrived']) for each in result['communications']] == [
        ('/boxes', 12), ('/image', 12)]
    assert open_recording([PAIR / 'lttng.mcap', PAIR / 'own.mcap'], graph).end == (
        outcome.recording.end)

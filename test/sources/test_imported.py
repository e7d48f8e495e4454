# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Jobs, verdicts and waits of imported recordings; a hand-made one that needs no CARET files."""

from types import SimpleNamespace

from mddag_executor import open_recording, replay, ReplayError, reschedule
from mddag_executor.analysis.communications import recorded_callbacks
from mddag_executor.analysis.drafting import System
from mddag_executor.recording.columns import rows, Table
from mddag_executor.recording.tables import EXECUTIONS, UNKNOWN
from mddag_executor.sources.imported_run import process_names
from msg_graph import load, loads
import numpy as np
import pytest

from .imported import BOXES, DETECT, GRAB, GRAPH, IMAGE, N, PLAN, record
from .recorded import BEGIN, CAMERA, MS, Recorded, US


@pytest.fixture
def recorded(tmp_path):
    return record(Recorded(tmp_path / 'recorded.mcap'))


@pytest.fixture
def graph():
    return loads(GRAPH, 'graph.yaml')


def result_of(path, graph):
    outcome = replay(path, graph)
    return outcome.result(), [w.removeprefix(f'{path}: ') for w in outcome.warnings]


@pytest.mark.parametrize(('nameless', 'lacks'), [
    (('pid',), 'context vpid, so'), (('tid',), 'context vtid, so'),
    (('pid', 'tid'), 'contexts vpid and vtid, so')])
def test_events_without_processes_or_threads_are_said(recorded, graph, nameless, lacks):
    _, warnings = result_of(recorded.write(nameless=nameless), graph)
    line, = (each for each in warnings if 'context' in each)
    assert line.startswith(f'its events lack the {lacks} what ran in several threads is mixed up')


def test_jobs_responses_where_the_time_went_and_paths(recorded, graph):
    result, warnings = result_of(recorded.write(), graph)
    assert warnings == []
    camera = result['dags']['/camera']
    assert camera['jobs'] == N
    sink = camera['sinks']['/fuse:join']
    assert (sink['completed'], sink['late'], sink['expired']) == (N, 0, 0)
    # from the timer's release, 7 ms + k * 100 ms, to the end of the leg that made it whole
    assert sink['response_ns'] == dict.fromkeys(('min', 'median', 'p99', 'max'), 40 * MS)
    assert sink['slack_ns'] == dict.fromkeys(('min', 'p1', 'median', 'max'), 10 * MS)
    worst = sink['breakdown']['worst']
    assert [step['vertex'] for step in worst['chain']] == [
        '/camera:grab', '/detect:detect', '/fuse:join']
    # grab 1 ms after its release; a message is ready at its source timestamp, 10 us after its
    # publication
    waits = 1 * MS + (6 - 2) * MS - 10 * US + (22 - 19) * MS - 10 * US
    assert worst['waiting_ns'] == waits
    assert worst['waiting_group_ns'] == (21 - 19) * MS - 10 * US
    assert worst['executing_ns'] == 40 * MS - waits
    assert (worst['release_lag_ns'], worst['transport_ns'], worst['unknown_ns']) == (0, 0, 0)
    plan = result['dags']['/fuse']['sinks']['/fuse:plan']
    assert (plan['completed'], plan['late'], plan['response_ns']['max']) == (2 * N - 1, 0, 5 * MS)
    use = result['callbacks']['/fuse:join']
    assert (use['executions'], use['busy_ns']) == (2 * N, N * (3 + 18) * MS)
    assert use['waiting_group_ns'] == N * ((21 - 19) * MS - 10 * US)
    path = result['paths']['seen']
    assert path['hops'] == ['trigger', 'trigger', 'variable']
    # published at 9 ms after k * 100 ms, kept at 47 ms after it, planned with 50 ms after it, and
    # once more 50 ms later
    age = [50 * MS + 400 * US - 9 * MS, 100 * MS + 400 * US - 9 * MS]
    assert path['data_age'] == {
        'count': 2 * N - 3, 'min': age[0], 'mean': round((4 * age[0] + 3 * age[1]) / 7),
        'median': age[0], 'p99': age[1], 'max': age[1]}
    assert path['response_time']['best']['max'] == age[0]
    assert path['reaction_time']['max'] == age[0] + 100 * MS
    # rescheduled, it keeps releases, times and groups
    again = reschedule(recorded.path, graph, policy='rad', workers=6, overheads=False)
    sink = again.result()['dags']['/camera']['sinks']['/fuse:join']
    # grab 4 ms, then the longer of detect 14 and imu 6, then the leg that made it whole, 18
    assert (sink['completed'], sink['response_ns']['median']) == (N, (4 + 14 + 18) * MS)
    assert again.tables.n_groups == 1
    with pytest.raises(ReplayError, match='it was imported'):
        reschedule(recorded.path)
    below = loads('mddag: 1\nnodes:\n  - node: /robot/fuse\n    callbacks:\n'
                  '      - {name: t, timer: 50ms, deadline: 5ms}\n', 'x.yaml')
    with pytest.raises(ReplayError, match="/robot/fuse:t: did you mean the node '/fuse'\\?$"):
        replay(recorded.path, below)


def test_a_job_whose_message_was_lost_has_expired(recorded, graph):
    """A message that was not received is the robot's fault, whatever else comes from outside."""
    recorded.run(PLAN, 5, 3000 * MS, 3001 * MS)
    recorded.run(GRAB, 1, 2007 * MS, 2009 * MS)
    recorded.publish(IMAGE, 1, 2008 * MS)
    recorded.receive(DETECT, 2, 2015 * MS, 2016 * MS, 77)
    recorded.run(GRAB, 1, 4007 * MS, 4008 * MS)
    result, _ = result_of(recorded.write(), graph)
    camera = result['dags']['/camera']
    assert (camera['ends']['completed'], camera['ends']['expired'], camera['unjudged']) == (
        N, 1, 0)


def test_nothing_is_judged_without_links(recorded, graph):
    stamps = [place for place, name in enumerate(recorded.names()) if 'bind' in name]
    result, warnings = result_of(recorded.write(but=stamps), graph)
    camera = result['dags']['/camera']
    assert (camera['jobs'], camera['unjudged']) == (N, N)
    assert not any(camera['ends'].values())
    assert not any(camera['sinks']['/fuse:join'][key]
                   for key in ('completed', 'late', 'overdue', 'expired'))
    assert [line for line in warnings if line.endswith(f'missing: {N} jobs: /camera ({N})')]
    assert not [line for line in warnings if 'is not in it' in line]


def test_whatever_is_lost_no_job_is_late_or_expired(recorded, graph):
    recorded.run(PLAN, 5, 3000 * MS, 3001 * MS)
    recorded.run(GRAB, 1, 3007 * MS, 3008 * MS)
    for tid in (2, 3, 4, 9):    # some other callback: what has no end does not run until the end
        recorded.run(77, tid, 3002 * MS, 3003 * MS, pid=2 if tid == 9 else 1)
    before, _ = result_of(recorded.write(), graph)
    names = recorded.names()
    first = names.index('ros2:callback_start')
    for missing in (*({'but': [place]} for place in range(first, len(names), 4)),
                    *({'stop': stop} for stop in range(0, len(names), 12))):
        try:
            result, _ = result_of(recorded.write(**missing), graph)
        except ReplayError as error:
            assert 'run' in error.problem or 'none of the callbacks' in error.problem
            assert missing['stop'] < first + 3
            continue
        for name, dag in result['dags'].items():
            assert dag['jobs'] <= before['dags'][name]['jobs'], missing
            assert dag['ends']['expired'] <= before['dags'][name]['ends']['expired'], missing
            assert dag['ends']['late'] == 0, (missing, name)
            for sink in dag['sinks'].values():
                assert sink['late'] == 0, (missing, name)


def test_what_the_tracer_discarded_is_not_held_against_a_job(recorded, graph):
    """From 200 to 300 ms nothing is recorded; the jobs before and after are judged."""
    recorded.add('mddag:lost', 300 * MS, 0, 50)
    recorded.run(PLAN, 5, 3000 * MS, 3001 * MS)
    recorded.run(GRAB, 1, 3007 * MS, 3008 * MS)
    gap = [place for place, time in enumerate(recorded.times()) if 215 * MS <= time < 300 * MS]
    result, warnings = result_of(recorded.write(but=gap), graph)
    camera = result['dags']['/camera']
    assert (camera['ends']['completed'], camera['unjudged']) == (N - 1, 1)
    assert camera['sinks']['/fuse:join']['late'] == 0
    assert [line for line in warnings if line.startswith(
        'the tracer discarded 50 events or more, or files were damaged')]


def test_a_job_that_would_expire_while_events_are_discarded_is_not_judged(recorded, graph):
    """One CPU discards events for two seconds, and a timer on another one goes on."""
    recorded.add('mddag:lost', 2500 * MS, 0, 50, BEGIN + 215 * MS)
    for at in (2000, 3000):
        recorded.run(PLAN, 5, at * MS, (at + 1) * MS)
    gap = [place for place, time in enumerate(recorded.times()) if 215 * MS <= time < 1000 * MS]
    result, _ = result_of(recorded.write(but=gap), graph)
    camera = result['dags']['/camera']
    assert (camera['jobs'], camera['ends']['completed'], camera['unjudged']) == (2, 1, 1)
    assert camera['ends']['expired'] == 0


@pytest.mark.parametrize(('lost', 'runs', 'ends'), [
    ((), True, (N, 0, 0)), (('rcl_node_init',), True, (0, 0, N)), ((), False, (0, N, 0)),
    (('_subscription_init', '_subscription_callback_added'), True, (0, 0, N))])
def test_a_callback_without_initialisation_may_be_the_declared_one(tmp_path, lost, runs, ends):
    """Its process was started before the tracer, and nothing says which callback it is."""
    r = Recorded(tmp_path / 'camera.mcap')
    r.node(2, '/detect', time=-MS, pid=2)
    r.subscription(DETECT, 2, '/image', time=-MS, pid=2)
    gone = [place for place, name in enumerate(r.names()) if name.endswith(lost or ('nothing',))]
    r.node(1, '/camera')
    r.timer(GRAB, 1, 100 * MS)
    r.publisher(IMAGE, 1, '/image')
    for k in range(1, N + 2):
        at = k * 2000 * MS
        r.run(GRAB, 1, at, at + MS)
        stamp = r.publish(IMAGE, 1, at + MS // 2)
        if runs and k <= N:
            r.receive(DETECT, 2, at + 3 * MS, at + 5 * MS, stamp, pid=2)
    result, _ = result_of(r.write(but=gone), loads(CAMERA, 'graph.yaml'))
    camera = result['dags']['/camera']
    assert (camera['ends']['completed'], camera['ends']['expired'], camera['unjudged']) == ends


def test_publications_of_unknown_publishers_are_counted(recorded, graph):
    made = [place for place, name in enumerate(recorded.names()) if name.endswith('lisher_init')]
    whole, warnings = result_of(recorded.write(), graph)
    assert warnings == []
    result, warnings = result_of(recorded.write(but=made[-1:]), graph)
    assert warnings == [f'{N} publications of a publisher whose initialisation is not in it, so '
                        f'of no topic: process 2 ({N})']
    assert len(result['communications']) == len(whole['communications']) - 1


def test_late_and_off_the_grid(tmp_path):
    graph = loads('mddag: 1\nnodes:\n  - node: /n\n    callbacks:\n'
                  '      - {name: t, timer: 10ms, deadline: 5ms}\n', 'graph.yaml')
    r = Recorded(tmp_path / 'timer.mcap')
    r.node(1, '/n')
    r.timer(GRAB, 1, 10 * MS)
    r.run(GRAB, 1, 10 * MS - 200 * US, 12 * MS)     # just before: its init was recorded after it
    r.run(GRAB, 1, 24 * MS, 26 * MS)                # late
    r.run(GRAB, 1, 27 * MS, 28 * MS)                # not a period of this timer
    r.run(GRAB, 1, 50 * MS, 51 * MS)                # two left out
    r.add('ros2:callback_start', 2 ** 63 - 1 - BEGIN, 1, GRAB, False)
    result, warnings = result_of(r.write(), graph)
    sink = result['dags']['/n']['sinks']['/n:t']
    assert (sink['completed'], sink['late']) == (4, 1)
    assert (sink['response_ns']['min'], sink['response_ns']['max']) == (1 * MS, 6 * MS)
    assert result['first_miss']['job'] == 1
    assert warnings == [
        'left out: 1 event at an impossible time, the first at 9223372036854775807 ns',
        '1 execution of timers off the grid of the period (reset, by another clock, or without '
        'initialisation in it): released when it started: /n timer 10ms (1)',
        '2 periods of timers passed without an execution (late by more than one, or events were '
        'lost): without a job: /n timer 10ms (2)']


@pytest.mark.parametrize('starts', [
    (10_000, 29_400, 30_100, 39_800, 49_800), (10_000, 29_400, 40_100, 50_100, 60_100, 70_200)],
    ids=['the next one has its own', 'few start so early'])
def test_an_execution_that_is_late_by_nearly_a_period(starts, tmp_path):
    """It starts shortly before the next due time (us), but does not have it."""
    graph = loads('mddag: 1\nnodes:\n  - node: /n\n    callbacks:\n'
                  '      - {name: t, timer: 10ms, deadline: 5ms}\n', 'graph.yaml')
    r = Recorded(tmp_path / 'timer.mcap')
    r.node(1, '/n')
    r.timer(GRAB, 1, 10 * MS)
    for start in starts:
        r.run(GRAB, 1, start * US, (start + 500) * US)
    result, warnings = result_of(r.write(), graph)
    sink = result['dags']['/n']['sinks']['/n:t']
    assert (sink['completed'], sink['late']) == (len(starts), 1)
    assert sink['response_ns']['max'] == 9_900 * US
    assert result['first_miss']['job'] == 1
    assert [line for line in warnings if 'off the grid' in line] == []


SHOW = 17


def two_computers(path, skew=0, back=False, ways=2 * MS, hosts=(), boots=None):
    """
    Write a camera, and on another computer, whose clock is behind, what detects and plans.

    :param hosts: the names of the computers of two or three processes, of which the third, on the
        other computer as well, only shows images: no messages both ways say how its clock differs.
    :param boots: the boots of the computers, if they are not those of their names.
    """
    r = Recorded(path)
    for pid, (host, boot) in enumerate(zip(hosts, boots or hosts), 1):
        r.add('mddag:host', 0, 1, host, f'boot of {boot}', pid=pid)
    if len(hosts) > 2:
        r.node(3, '/show', pid=3)
        r.subscription(SHOW, 3, '/image', time=-skew, pid=3)
    r.node(1, '/camera')
    r.node(2, '/detect', pid=2)
    r.timer(GRAB, 1, 100 * MS)
    r.publisher(IMAGE, 1, '/image')
    r.subscription(DETECT, 2, '/image', time=-skew, pid=2)
    r.publisher(BOXES, 2, '/boxes', time=-skew, pid=2)
    r.subscription(PLAN, 1, '/boxes')
    for k in range(1, 11):
        at = k * 100 * MS
        r.run(GRAB, 1, at, at + 2 * MS)
        image = r.publish(IMAGE, 1, at + MS)
        r.receive(DETECT, 2, at + MS + ways - skew, at + MS + ways + 4 * MS - skew, image, pid=2)
        if len(hosts) > 2:
            r.receive(SHOW, 3, at + MS + ways - skew, at + MS + ways + MS - skew, image, pid=3)
        if back:
            boxes = r.publish(BOXES, 2, at + 5 * MS - skew, pid=2)
            r.receive(PLAN, 1, at + 5 * MS + ways, at + 5 * MS + ways + MS, boxes)
    return r.write()


TWO = """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]},
                                {name: plan, subscription: /boxes, deadline: 10ms}]}
  - {node: /detect, callbacks: [{name: run, subscription: /image, publishes: [/boxes]}]}
"""
SHOWN = """\
  - {node: /show, callbacks: [{name: show, subscription: /image, deadline: 10ms}]}
"""


@pytest.mark.parametrize('skew', [5 * MS, -5 * MS, 40_000 * MS])
def test_messages_both_ways_show_how_clocks_of_two_computers_differ(tmp_path, skew):
    graph = loads(TWO, 'graph.yaml')
    sound, nothing = result_of(two_computers(tmp_path / 'one.mcap', 0, back=True), graph)
    result, warnings = result_of(two_computers(tmp_path / 'two.mcap', skew, back=True), graph)
    said, = (line for line in warnings if 'clock' in line)
    assert not [line for line in nothing if 'clock' in line]
    ahead = f'{abs(skew) / 1e6:.3f} ms {"behind" if skew > 0 else "ahead of"}'
    assert said == (f'the clock of /detect is taken to be {ahead} that of /camera, within '
                    '1.996 ms, by the messages both ways')
    for key in ('dags', 'communications', 'callbacks', 'duration_ns'):
        assert result[key] == sound[key], key
    assert result['dags']['/camera']['sinks']['/camera:plan']['completed'] == 10


def test_processes_of_one_computer_have_one_clock(tmp_path):
    """LTTng says the computer of each process; otherwise it shows only in messages."""
    graph = loads(TWO + SHOWN, 'graph.yaml')
    for hosts, judged in (('one', 'two', 'two'), 10), (('one', 'two', 'three'), 0):
        path = two_computers(tmp_path / f'{hosts[2]}.mcap', 5 * MS, back=True, hosts=hosts)
        result, warnings = result_of(path, graph)
        shown = result['dags']['/camera']['sinks']['/show:show']
        assert shown['completed'] == judged, warnings
        assert any('clocks of computers differ' in line for line in warnings) == (not judged)


@pytest.mark.parametrize(('skew', 'back', 'boots', 'says'), [
    (-5 * MS, False, None, 'no messages both ways show how they differ, and latencies and '
     'response times between them are off by the difference'),
    (0, True, None, 'by the messages both ways they differ by less than 1.996 ms'),
    (0, False, ('one', 'one'), None)], ids=['one way', 'both ways', 'two containers'])
def test_clocks_of_computers_that_are_assumed_to_be_synchronised(
        tmp_path, skew, back, boots, says):
    path = two_computers(tmp_path / 'two.mcap', skew, back, hosts=('camera', 'main'), boots=boots)
    result, warnings = result_of(path, loads(TWO if back else CAMERA, 'graph.yaml'))
    said = [line for line in warnings if 'clock' in line]
    assert said == ([] if says is None else [
        f'the clocks of the computers camera and main are assumed to be synchronised: {says}'])
    camera = result['dags']['/camera']
    assert (camera['unjudged'], camera['jobs']) == (0, 10)


@pytest.mark.parametrize('skew', [3 * MS, 5 * MS, 400 * MS])
def test_nothing_is_judged_by_two_clocks_that_differ_by_an_unknown_time(tmp_path, skew):
    graph = loads(CAMERA, 'graph.yaml')
    result, warnings = result_of(two_computers(tmp_path / 'two.mcap', skew), graph)
    camera = result['dags']['/camera']
    assert (camera['unjudged'], camera['jobs']) == (10, 10)
    assert set(camera['ends'].values()) == {0}
    sink, = camera['sinks'].values()
    assert (sink['completed'], sink['late'], sink['expired'], sink['overdue']) == (0, 0, 0, 0)
    said, = (line for line in warnings if 'clocks of computers differ' in line)
    assert f'from /camera to /detect arrive up to {(skew - 2 * MS) / 1e6 + 0.004:.3f} ms' in said


def test_an_execution_that_publishes_twice_is_judged_by_the_last_answer(tmp_path, call):
    r = Recorded(tmp_path / 'twice.mcap')
    r.node(1, '/camera')
    r.node(2, '/detect')
    r.timer(GRAB, 1, 100 * MS)
    r.publisher(IMAGE, 1, '/image')
    r.subscription(DETECT, 2, '/image')
    for k in range(1, 6):
        at = k * 100 * MS
        r.run(GRAB, 1, at, at + 3 * MS)
        first, second = (r.publish(IMAGE, 1, at + each * MS) for each in (1, 2))
        r.receive(DETECT, 2, at + 4 * MS, at + 6 * MS, first)
        r.receive(DETECT, 2, at + 7 * MS, at + (30 if k == 3 else 9) * MS, second)
    graph = tmp_path / 'graph.yaml'
    graph.write_text(CAMERA)
    result = call('replay', r.write(), graph, '--json', '-').result
    assert result['warnings'] == []
    sink, = result['dags']['/camera']['sinks'].values()
    assert (sink['completed'], sink['late'], sink['response_ns']['max']) == (5, 1, 30 * MS)
    assert result['callbacks']['/detect:run']['executions'] == 10
    again = call('replay', r.path, graph, '--reschedule', '--json', '-').result
    assert again['dags']['/camera']['sinks']['/detect:run']['late'] == 1


SOURCE = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {{name: s, subscription: /in, period: 100ms, deadline: 50ms, release_from: {}}}
"""


@pytest.mark.parametrize('release_from, stated, response, said', [
    ('arrival', 0, 5 * MS + 4 * US, False), ('source_timestamp', 0, 15 * MS, False),
    ('header_stamp', 30 * MS, 75 * MS, False), ('header_stamp', 0, 15 * MS, True),
    # of a simulated clock, say
    ('header_stamp', 12_000 * MS - BEGIN, 15 * MS, True)])
def test_releases_of_messages(tmp_path, release_from, stated, response, said):
    r = Recorded(tmp_path / 'source.mcap')
    r.node(1, '/n')
    r.node(2, '/driver')
    r.publisher(IMAGE, 2, '/in')
    r.subscription(DETECT, 1, '/in')
    stamp = r.publish(IMAGE, 8, 90 * MS - 10 * US)
    r.receive(DETECT, 1, 100 * MS, 105 * MS, stamp, stated=stated)
    result, warnings = result_of(
        r.write(), loads(SOURCE.format(release_from), 'graph.yaml'))
    assert result['dags']['/n']['sinks']['/n:s']['response_ns']['max'] == response
    assert [line for line in warnings if 'the next best stamp' in line] == ([
        '1 release by the next best stamp, because the declared one is not recorded or years '
        'away: /n:s (header_stamp)'] if said else [])


class Counted(np.ndarray):
    """A column that counts the rows that are read of it."""

    rows = 0

    def __getitem__(self, key):
        found = super().__getitem__(key)
        Counted.rows += found.size
        return found


def test_callbacks_are_summed_up_in_one_pass():
    number = np.arange(1_000) % 200
    table = rows(EXECUTIONS, 1_000, callback=number, start=1_000, end=np.where(
        np.arange(1_000) < 10, UNKNOWN, 1_000 + number))
    table = Table({name: table[name].view(Counted) for name in table.names})
    Counted.rows = 0
    found = recorded_callbacks(SimpleNamespace(executions=table, labels=lambda numbers: (
        [f'c{n:03}' for n in numbers.tolist()], np.arange(len(numbers)))))
    assert Counted.rows < 20 * len(table)
    assert list(found) == [f'c{n:03}' for n in range(200)]
    assert found['c007'] == {'executions': 4, 'unfinished': 1, 'busy_ns': 28, 'shortest_ns': 7,
                             'longest_ns': 7}


SEVERAL = """\
mddag: 1
nodes:
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
  - node: /detect
    callbacks:
      - {name: detect, subscription: /image, deadline: 10ms}
      - {name: tidy, timer: 200ms, deadline: 100ms}
"""


@pytest.fixture
def three_processes(tmp_path):
    """
    Record ten jobs of /camera and /detect, and the computing /hog, each in its own process.

    In every second job the thread of /detect is busy with its timer when the message arrives; in
    two others the message is under way for 20 ms.
    """
    r = Recorded(tmp_path / 'three.mcap')
    for pid, tid, name, node in ((1, 1, 'cam', '/camera'), (2, 3, 'det', '/detect'),
                                 (3, 5, 'hog', '/hog')):
        r.add('mddag:process', 0, tid, name, pid=pid)
        r.add('mddag:process', 0, pid, name, pid=pid)
        r.node(pid, node, pid=pid)
    r.timer(11, 1, 100 * MS)
    r.publisher(100, 1, '/image')
    r.subscription(12, 2, '/image', pid=2)
    r.timer(13, 2, 200 * MS, pid=2)
    r.timer(14, 3, 50 * MS, pid=3)
    for k in range(10, 20):
        at = k * 100 * MS
        r.run(11, 1, at, at + 2 * MS)
        stamp = r.publish(100, 1, at + 1 * MS)
        start = at + 3 * MS
        if k % 2 == 0:
            r.run(13, 3, at, at + 15 * MS, pid=2)
            start = at + 15 * MS + 100 * US
        elif k in (11, 13):
            start = at + 21 * MS
        r.receive(12, 3, start, start + 2 * MS, stamp, pid=2)
        for part in (0, 50):
            r.run(14, 5, at + part * MS, at + (part + 45) * MS, pid=3)
    return r.write()


def test_only_the_own_thread_of_a_callback_makes_it_wait(three_processes):
    outcome = replay(three_processes, loads(SEVERAL, 'graph.yaml'))
    result = outcome.explanation.result()
    assert {cause: n for cause, n in result['causes'].items() if n} == {
        'waited': 5, 'transport': 2}
    for job in result['jobs']:
        behind = [each['callback'] for part in job['parts'] for each in part['behind']]
        assert behind == (['/detect:tidy'] if job['cause'] == 'waited' else [])
    assert outcome.recording.names.workers == [
        'cam 1, thread 1', 'det 2, thread 3', 'hog 3, thread 5']
    table = outcome.recording.executions
    assert {*zip(table['process'].tolist(), table['thread'].tolist())} == {(0, 1), (1, 3), (2, 5)}


@pytest.mark.parametrize('workers', [None, 1])
def test_each_recorded_process_has_a_pool_of_its_own(workers, three_processes):
    graph = loads(SEVERAL, 'graph.yaml')
    outcome = reschedule(three_processes, graph, workers=workers)
    result = outcome.result()
    assert (result['policy'], result['workers']) == ('fifo', 2)
    assert result['processes'] == [
        {'name': 'cam', 'nodes': ['/camera'], 'workers': 1},
        {'name': 'det', 'nodes': ['/detect'], 'workers': 1}]
    sinks = result['dags']['/camera']['sinks']['/detect:detect'], replay(
        three_processes, graph).result()['dags']['/camera']['sinks']['/detect:detect']
    assert [(sink['completed'], sink['late']) for sink in sinks] == [(10, 7)] * 2
    assert any('because ros2 (polling) is known of one process only' in each
               for each in outcome.warnings)
    given = reschedule(three_processes, graph, policy='rad', workers=workers)
    assert not any('polling' in each for each in given.warnings)


def test_a_draft_has_the_recorded_processes(three_processes, call, tmp_path):
    assert System(three_processes).draft().processes == {
        'cam': ['/camera'], 'det': ['/detect'], 'hog': ['/hog']}
    graph = tmp_path / 'drafted.yaml'
    call('graph', 'from-trace', three_processes, '--accept', '-o', graph)
    assert [each.name for each in load(graph).processes] == ['cam', 'det', 'hog']
    assert [each.name for each in open_recording(three_processes, load(graph)).run.placed] == [
        'cam', 'det', 'hog']


def test_processes_have_different_names():
    names = {(5, 5): 'a_12', (12, 12): 'a', (13, 13): 'a', (14, 14): 'b c'}
    assert process_names([5, 12, 13, 14, 15], names) == [
        'a_12_5', 'a_12', 'a_13', 'b_c', 'process_15']

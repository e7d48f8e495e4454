# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a live run says: diagnostics, statistics, drift, wrong names, a QoS that does not match."""

import itertools
import os
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mddag_executor import open_recording, replay
from mddag_executor.analysis.drift import drift_of
from mddag_executor.core import Tables, Tally
from mddag_executor.core.requirements import RequirementTally
from mddag_executor.core.state import SINK_EXPIRED, SINK_IN_TIME, SINK_LATE
from mddag_executor.errors import UsageError
from mddag_executor.executor.diagnostics import DagWatch, ERROR, OK, RequirementWatch, STALE, WARN
from mddag_executor.executor.settings import Thresholds
from mddag_executor.executor.watch import Watch
from mddag_executor.report.board import Board
from mddag_executor.report.live_runs import live_lines
from mddag_executor.results.runs import Statistics
from msg_graph import loads, Path
import pytest
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import Empty, String

from ..json_results import errors_of
from .conftest import is_idle, Spinning, wait_for
from .declared import CHAIN, Declared, graph
from .inside import engine_of

SECOND = 1_000_000_000


# --- the verdicts, without ROS -------------------------------------------------------------------


def test_levels_follow_the_share_of_misses_in_the_window():
    task_set = loads(CHAIN)
    tables = Tables.build(task_set)
    tally = Tally(task_set, tables)
    sink = next(v for v in tables.sinks if tables.sink_deadline[v] == 50_000_000)
    in_stops, jobs, seconds = [0], itertools.count(), itertools.count(2)
    watch = DagWatch(tally, task_set.dags[0], Thresholds(window=3), SECOND, in_stops)
    hosted = {vertex.callback.key for vertex in task_set.dags[0].vertices}

    def after(in_time=0, late=0, expired=0):
        for kind, count, response in (
            (SINK_IN_TIME, in_time, 20_000_000), (SINK_LATE, late, 60_000_000),
            (SINK_EXPIRED, expired, -1),
        ):
            for _ in range(count):
                tally.released(0)
                tally.add([(kind, 0, sink, next(jobs), 50_000_000, response)])
        return watch.status(next(seconds) * SECOND, hosted)

    assert after().level == STALE
    assert after(in_time=50).level == OK
    in_stops[0] = 1
    status = after(in_time=49, late=1)
    assert (status.level, status.message) == (
        WARN, '1 of 100 results missed their deadlines, 1 as the machine stood still')
    assert status.values['margin_min_ms'] == '-10.000'
    name = tally.vertex_name(sink)
    assert {key: status.values[f'{key} {name}'] for key in (
        'level', 'window_results', 'in_time_ratio', 'response_p99_ms', 'deadline_ms', 'margin_ms',
        'wrong')} == {
        'level': 'WARN', 'window_results': '100', 'in_time_ratio': '0.9900',
        'response_p99_ms': '20.000', 'deadline_ms': '50.000', 'margin_ms': '-10.000',
        'wrong': '1 late'}
    others = [tally.vertex_name(v) for v in tables.sinks if v != sink]
    assert [status.values[f'in_time_ratio {other}'] for other in others] == [''] * len(others)
    assert status.values['window_missed_ratio'] == '0.0100'
    status = after(in_time=20, expired=30)
    assert (status.level, status.values['expired']) == (ERROR, '30')
    assert status.values[f'wrong {name}'] == '30 expired, 1 late'
    levels = [after(in_time=50).level for _ in range(3)]
    assert levels == [ERROR, ERROR, OK]  # the window has moved on


def test_a_dag_is_as_bad_as_its_worst_sink_and_has_no_sinks_of_other_processes():
    task_set = loads(graph(
        source='name: tick, timer: 20ms, publishes: [/x], dag: d',
        **{f'sink{i}': 'name: cb, subscription: /x, deadline: 50ms' for i in range(30)}))
    tables = Tables.build(task_set)
    tally = Tally(task_set, tables)
    dag = task_set.dags[0]
    watch = DagWatch(tally, dag, Thresholds(), SECOND, [0])
    for job in range(10):
        tally.released(0)
        tally.add((SINK_LATE if v == tables.sinks[0] else SINK_IN_TIME, 0, v, job, 50_000_000,
                   60_000_000 if v == tables.sinks[0] else 1_000_000) for v in tables.sinks[:20])
    here = {vertex.callback.key for vertex in dag.vertices if vertex.name != '/sink29:cb'}
    status = watch.status(SECOND, here)
    assert (status.level, status.values['window_missed_ratio']) == (ERROR, '0.0500')  # 10 of 200
    assert status.values['level /sink0:cb'] == 'ERROR'
    assert status.values['in_time_ratio /sink1:cb'] == '1.0000'
    assert status.values['in_time_ratio /sink28:cb'] == ''
    assert 'level /sink29:cb' not in status.values


@pytest.mark.parametrize('wrong', [
    {'warn_ratio': 0.0}, {'warn_ratio': 1.5}, {'error_ratio': -1.0}, {'error_ratio': float('nan')},
    {'warn_burst': 0}, {'window': 0}, {'stale_periods': 0}])
def test_thresholds_that_make_no_sense(wrong):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Thresholds(**wrong)


# --- published -----------------------------------------------------------------------------------


#: A DAG without a callback here has no status.
ELSEWHERE = """
  - node: /elsewhere
    callbacks: [{name: tick, timer: 20ms, dag: other, deadline: 10ms}]
"""


def values(status):
    return {pair.key: pair.value for pair in status.values}


def test_statuses_are_published_from_ok_to_stale(make_executor, make_node):
    """Each level is seen from another executor."""
    arrays, slow, begin = [], [0.0], int(time.time())
    listener = make_node('listener')
    listener.create_subscription(DiagnosticArray, '/diagnostics', arrays.append, 10)
    # deadlines that a busy machine meets
    text = CHAIN.replace('deadline: 10ms', 'deadline: 400ms').replace(
        'deadline: 50ms', 'deadline: 2s')
    chain = Declared(make_node, text, {'early': lambda: time.sleep(slow[0])})
    executor = make_executor(
        loads(text + ELSEWHERE), diagnostics_period='100ms',
        thresholds=Thresholds(window=2, name='robot'))
    names = [n for n, _ in make_node('look').get_node_names_and_namespaces()]
    assert not any('diagnostics' in name for name in names)  # not before it spins

    def becomes(level):
        """Return the newest statuses by name when that of the DAG has this level."""
        def found():
            return {status.name: status for status in arrays[-1].status} if arrays else {}
        assert wait_for(
            lambda: 'robot: chain' in found() and found()['robot: chain'].level == level)
        return found()

    with Spinning(make_executor(nodes=[listener])), Spinning(executor):
        chain.start(executor)
        statuses = becomes(DiagnosticStatus.OK)
        assert set(statuses) == {'robot: chain', 'robot: workers'}
        status, workers = statuses['robot: chain'], statuses['robot: workers']
        assert status.message.endswith('results in time')
        assert values(status)['period_ms'] == '20.000'
        assert status.hardware_id == workers.hardware_id != ''
        assert float(values(workers)['callbacks_per_s']) > 2
        slow[0] = 0.5
        becomes(DiagnosticStatus.ERROR)
        slow[0] = 0.0
        becomes(DiagnosticStatus.OK)
        chain.cancel()
        status = becomes(DiagnosticStatus.STALE)['robot: chain']
        assert status.message.startswith('nothing has been released')
        chain.timers[0].reset()
        becomes(DiagnosticStatus.OK)
        assert begin <= arrays[-1].header.stamp.sec <= time.time()
        assert set(executor.get_nodes()) == set(chain.nodes.values())


def test_a_shutdown_of_the_context_ends_it_quietly(make_executor, make_node, ros_context, capfd):
    executor = make_executor(diagnostics_period='20ms', nodes=[make_node()])
    with Spinning(executor, raises=ExternalShutdownException) as spinning:
        assert wait_for(lambda: executor._diagnostics._thread is not None)
        time.sleep(0.1)
        ros_context.try_shutdown()
        spinning.join()
        assert wait_for(lambda: not executor._diagnostics._thread.is_alive())
    assert 'diagnostics' not in capfd.readouterr().err


# --- statistics ----------------------------------------------------------------------------------


def test_statistics_have_the_declared_types(make_executor, make_node, tmp_path):
    trace = tmp_path / 'run.mcap'
    node = make_node('n')
    node.create_timer(0.02, lambda: time.sleep(0.001))
    node.create_timer(0.01, lambda: None)
    executor = make_executor(loads("""\
mddag: 1
nodes:
  - {node: /n, callbacks: [{name: t, timer: 20ms, deadline: 1us}]}
"""), trace=trace, worker_cpus=list(os.sched_getaffinity(0)))
    assert errors_of(executor.statistics(), (Statistics,)) == []
    executor.add_node(node)
    with executor as entered, Spinning(entered):
        assert wait_for(lambda: executor.statistics()['dags']['/n']['ends']['late'] > 0)
    found = executor.statistics()
    assert errors_of(found, (Statistics,)) == []
    assert found['trace'] == {'path': str(trace), 'lost': 0, 'error': None}
    assert found['first_miss'] is not None
    assert found['dags']['/n']['sinks']['/n:t']['response_ns'] is not None
    assert {'/n:t'} < set(found['callbacks'])


# --- what does not match -------------------------------------------------------------------------


def test_a_sync_that_never_got_one_of_its_topics(make_executor, make_node, tmp_path):
    task_set = loads(graph(
        camera='name: grab, timer: 20ms, publishes: [/image, /info]',
        eye='name: see, sync: [/image, /info], deadline: 20ms'))
    path = str(tmp_path / 'run.mcap')
    executor = make_executor(task_set, num_workers=2, trace=path)
    watch = Watch(executor, task_set)
    camera, eye, seen = make_node('camera'), make_node('eye'), []
    image = camera.create_publisher(Empty, 'image', 10)
    for topic in ('image', 'inf'):
        eye.create_subscription(Empty, topic, seen.append, 10)
    camera.create_timer(0.02, lambda: image.publish(Empty()))
    executor.add_node(camera)
    executor.add_node(eye)
    with Spinning(executor):
        assert wait_for(lambda: len(seen) > 8)
    live = watch.drift(executor.statistics())
    for text in (live[0].text, drift_of(open_recording(path))[0].text):
        assert text.startswith('/eye:see never got a message of /info in ')
        assert text.endswith(": did you mean the topic '/inf'?")


def test_what_ran_before_the_begin_is_no_drift(make_executor, make_node):
    """In several processes a camera may run for a while before its subscriber is made."""
    task_set = loads(graph(
        camera='name: grab, timer: 20ms, publishes: [/image]',
        eye='name: see, subscription: /image, deadline: 20ms'))
    executor = make_executor(task_set, num_workers=2)
    watch = Watch(executor, task_set)
    camera, eye, sent, seen = make_node('camera'), make_node('eye'), [], []
    image = camera.create_publisher(Empty, 'image', 10)

    def grab():
        image.publish(Empty())
        sent.append(1)

    timer = camera.create_timer(0.02, grab)
    executor.add_node(camera)
    with Spinning(executor):
        assert wait_for(lambda: len(sent) > 30)
        eye.create_subscription(Empty, 'image', seen.append, 10)
        executor.add_node(eye)
        assert wait_for(lambda: seen)
        assert [each.kind for each in watch.drift(executor.statistics())] == ['rate']
        watch.restart()
        assert watch.drift(executor.statistics()) == []
        missed = len(sent)
        assert wait_for(lambda: len(sent) > missed + 15)
        timer.cancel()
        assert wait_for(lambda: is_idle(executor))
        found = watch.drift(executor.statistics())
    # a machine that stops for a second skips releases
    assert [each for each in found if each.callback == '/eye:see'] == []


@pytest.mark.parametrize('is_made_again', [False, True])
def test_a_callback_whose_node_has_ended_is_named(
        make_executor, make_node, tmp_path, is_made_again):
    """Its messages were published, and are lost for no other reason."""
    task_set = loads(graph(
        camera='name: grab, timer: 20ms, publishes: [/image]',
        eye='name: see, subscription: /image, deadline: 300ms'))
    path = tmp_path / 'run.mcap'
    executor = make_executor(task_set, num_workers=2, trace=path)
    watch = Watch(executor, task_set)
    camera, seen = make_node('camera'), []
    image = camera.create_publisher(Empty, 'image', 10)
    camera.create_timer(0.02, lambda: image.publish(Empty()))
    executor.add_node(camera)

    def see():
        eye = make_node('eye')
        eye.create_subscription(Empty, 'image', seen.append, 10)
        executor.add_node(eye)
        before = len(seen)
        assert wait_for(lambda: len(seen) > before + 3)
        return eye

    def found():
        return [each.text for each in watch.drift(executor.statistics())
                if each.kind == 'stopped']

    with Spinning(executor):
        eye = see()
        assert found() == []
        executor.remove_node(eye)
        eye.destroy_node()
        assert wait_for(found)
        live = found()
        assert engine_of(executor).verdicts.gone == {'/eye:see'}
        if is_made_again:
            see()
            assert found() == [] and not engine_of(executor).verdicts.gone
    if is_made_again:
        assert [each.kind for each in drift_of(open_recording(path))] in ([], ['rate'])
        return
    recorded = [each.text for each in drift_of(open_recording(path))]
    for text, in (live, recorded):
        assert text.startswith('the subscription of /eye:see was destroyed ')
    causes = replay(path).explanation.result()['causes']
    assert causes['destroyed'] > 0 == causes['lost']


def test_what_ran_only_before_the_begin_is_said(make_executor, make_node):
    """A timer that fires once may do so before all processes of a run have met."""
    executor = make_executor(loads(graph(
        bringup='name: start, timer: 20ms, once: true, deadline: 1s')))
    node, fired = make_node('bringup'), []

    def start():
        fired.append(1)
        timer.cancel()

    executor.set_judging(False)
    timer = node.create_timer(0.02, start)
    executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: fired and is_idle(executor))
        executor.set_judging(True)
        statistics = executor.statistics()
    lines = [*live_lines({**statistics, 'measured': None})]
    assert 'never due, so not judged: 1 sink: /bringup:start' in lines
    assert ('ran only before all programs and processes were ready, which is not judged: '
            '/bringup:start') in lines


def test_all_callbacks_are_known_when_judging_begins(make_executor, make_node):
    """On a busy machine a node that has just been added is noticed only some time later."""
    executor = make_executor(loads(graph(eye='name: see, timer: 20ms, deadline: 1s')))
    executor.set_judging(False)
    with Spinning(executor):
        assert wait_for(lambda: not executor._upkeep.changed)
        executor._upkeep._refresh_at = time.monotonic() + 1000.0
        node = make_node('eye')
        node.create_timer(0.02, lambda: None)
        executor.add_node(node)
        executor.set_judging(True)
        assert executor._registry.hosted() == {'/eye:see'}


CAMERA = graph(
    camera='name: capture, timer: 50ms, publishes: [/image], dag: vision',
    detector='name: detect, subscription: /image, deadline: 50ms')


@pytest.mark.parametrize(('node', 'topic', 'expected'), [
    ('camera', 'image', None),
    ('kamera', 'image', '1 declared callback was found in no node: /camera:capture '
     "(did you mean the node '/kamera'?); undeclared callbacks that ran: "
     '/kamera: tick (timer 50ms): '),
    ('camera', 'robot/image', '1 declared callback was found in no node: /detector:detect '
     "(did you mean the topic '/robot/image'?); undeclared callbacks that ran: /detector: hear "
     '(subscription /robot/image): ')])
def test_a_wrong_name_is_warned_of_once(
        make_executor, make_node, capfd, monkeypatch, node, topic, expected):
    monkeypatch.setattr('mddag_executor.executor.bindings.LEAST_S', 0.3)
    camera, detector, heard = make_node(node), make_node('detector'), []
    publisher = camera.create_publisher(String, topic, 10)

    def tick():
        publisher.publish(String())

    def hear(message):
        heard.append(message)

    camera.create_timer(0.05, tick)
    detector.create_subscription(String, topic, hear, 10)
    executor = make_executor(loads(CAMERA, 'camera.yaml'), nodes=[camera, detector])
    executor.spin_until_future_complete(Future(), 1.1)
    executor.shutdown()
    assert heard
    warned = [line for line in capfd.readouterr().err.splitlines() if 'found in no node' in line]
    if expected is None:
        assert warned == []
    else:
        line, = warned
        assert f'camera.yaml: {expected}' in line
    # the last lines repeat it, apart from callbacks that nothing has started
    lines = list(live_lines({**executor.statistics(), 'measured': None}))
    never = [line for line in lines if 'never ran' in line or 'found in no node' in line]
    assert never == ([] if expected is None else [expected.partition(';')[0]])
    never_started = {'never_ran': ['/detector:detect'], 'not_found': {}, 'measured': None}
    assert ('1 declared callback never ran, as nothing started it: /detector:detect'
            in live_lines({**executor.statistics(), **never_started}))
    never_started['dropped'] = {'/detector:detect': 7}
    assert ('1 declared callback never ran, as all that was ready was dropped: /detector:detect'
            in live_lines({**executor.statistics(), **never_started}))


def test_timers_that_fire_once_need_not_exist_all_the_time(
        make_executor, make_node, capfd, monkeypatch):
    """One has fired and is destroyed, and the other one is made later."""
    monkeypatch.setattr('mddag_executor.executor.bindings.LEAST_S', 0.3)
    node, later = make_node('mission'), Future()

    def arm():
        node.destroy_timer(first)
        node.create_timer(0.7, lambda: later.set_result(True))

    first = node.create_timer(0.05, arm)
    executor = make_executor(loads("""\
mddag: 1
nodes:
  - node: /mission
    callbacks:
      - {name: arm, timer: 50ms, once: true, deadline: 1s}
      - {name: start, timer: 700ms, once: true, deadline: 1s}
      - {name: end, timer: 5s, once: true, deadline: 1s}
""", 'mission.yaml'), nodes=[node])
    executor.spin_until_future_complete(later, 30.0)
    executor.shutdown()
    assert later.done()
    assert 'found in no node' not in capfd.readouterr().err
    assert list(executor.statistics()['not_found']) == ['/mission:end']


def test_jobs_that_did_not_come_are_those_that_were_due(make_executor, make_node):
    detector = make_node('detector')
    detector.create_subscription(String, '/image', print, 10)
    executor = make_executor(loads(CAMERA), nodes=[detector])
    result = {**executor.statistics(), 'processes': [], 'measured': None}
    dag = result['dags']['vision']
    dag['jobs'] = 150
    dag['sinks']['/detector:detect'].update(completed=56, not_due=93)
    assert not [line for line in live_lines(result) if 'did not come' in line]
    dag['sinks']['/detector:detect'].update(not_due=90)
    line, = (line for line in live_lines(result) if 'did not come' in line)
    assert line.endswith(': /detector:detect 4 of 150')


def test_messages_without_a_job_are_no_runs(make_executor, make_node):
    """Some of them may have been dropped."""
    camera, detector = make_node('camera'), make_node('detector')
    publisher, heard = camera.create_publisher(String, '/image', 10), []
    detector.create_subscription(String, '/image', heard.append, 10)
    executor = make_executor(loads(CAMERA), nodes=[detector])
    publisher.publish(String())     # outside of callbacks
    with Spinning(executor):
        assert wait_for(lambda: heard)
    lines = list(live_lines({**executor.statistics(), 'measured': None}))
    assert '1 message without a job: /detector:detect 1' in lines
    assert not [line for line in lines if 'undeclared' in line]


def test_all_callbacks_of_a_run_without_a_declaration_are_listed(make_executor, make_node):
    node, ran = make_node('many'), []
    for _ in range(14):
        node.create_timer(0.01, lambda: ran.append(1))
    executor = make_executor(nodes=[node])
    executor.spin_until_future_complete(Future(), 0.3)
    line, = (line for line in live_lines({**executor.statistics(), 'measured': None})
             if 'runs of undeclared callbacks' in line)
    assert ran and 'more' not in line
    assert line.count('/many') == len(executor.statistics()['callbacks'])


def test_a_subscription_that_gets_nothing_for_its_qos_is_named(make_executor, make_node):
    camera, detector = make_node('camera'), make_node('detector')
    publisher = camera.create_publisher(
        String, '/image', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    camera.create_timer(0.05, lambda: publisher.publish(String()))
    detector.create_subscription(String, '/image', print, 10)
    executor = make_executor(loads(CAMERA), nodes=[camera, detector])

    def incompatible():
        return {name: each['incompatible_qos']
                for name, each in executor.statistics()['callbacks'].items()}

    with Spinning(executor):
        assert wait_for(lambda: incompatible().get('/detector:detect'))
    assert incompatible()['/detector:detect'] == 'RELIABILITY'
    assert incompatible()['/camera:capture'] is None
    lines = list(live_lines({**executor.statistics(), 'measured': None}))
    assert ('1 callback without messages, as a publisher has an incompatible QoS: '
            '/detector:detect (RELIABILITY)') in lines


def test_paths_are_shown_next_to_sinks():
    watch, board = RequirementWatch(Thresholds()), Board()
    path = Path('imu_to_wheels', ('/a:a', '/b:b'), reaction_ns=30_000_000)
    tally = RequirementTally(path, 30_000_000)
    levels = []
    for late in (0, 0, 5):
        for _ in range(10 - late):
            tally.add(20_000_000)
        status, = watch.statuses({path.name: {'reaction': tally.result_with(missed=late)}})
        levels.append(status.level)
    assert levels == [OK, OK, ERROR]
    board.take(SimpleNamespace(status=[SimpleNamespace(
        level=bytes([status.level]), name=status.name, message=status.message, hardware_id='h/1',
        values=[SimpleNamespace(key=k, value=v) for k, v in status.values.items()])]))
    sink, = board.result()['sinks']
    assert (sink['dag'], sink['sink'], sink['level']) == (
        'path imu_to_wheels', 'imu_to_wheels:reaction', 'ERROR')
    assert (sink['in_time_ratio'], sink['deadline_ms']) == (pytest.approx(25 / 30, abs=1e-3), 30)
    assert sink['wrong'] == '5 late'

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Real runs are replayed, and their misses have the cause that they were given."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
import random
import re
import threading
import time

from benchmarks.known_causes import causes, record
from mddag_executor import open_recording, replay, reschedule
from mddag_executor.analysis.drafting import System
from mddag_executor.clocks import TraceClock
from mddag_executor.core.tally import total
from mddag_executor.executor import current_job
from mddag_executor.executor.stamps import StampedReleases
from mddag_executor.trace import read_events
from msg_graph import loads
import pytest
from rclpy.duration import Duration
from rclpy.task import Future
from rclpy.time import Time
import rclpy.timer
from std_msgs.msg import Header
from std_srvs.srv import Empty

from .conftest import is_idle, Spinning, wait_for
from .declared import Declared, graph

GRAPH = graph(
    camera='name: grab, timer: 20ms, publishes: [/image, /info]',
    left='name: detect, subscription: /image, publishes: [/boxes]',
    right="""
        name: rectify, subscription: /info, publishes: [/flat]
        name: watch, subscription: /info, deadline: 200ms""",
    fuse='name: join, sync: [/boxes, /flat], deadline: 12ms',
    imu='name: tick, timer: 10ms, publishes: [/twist], keep: newest',
    filter="""
        name: use, subscription: /twist, publishes: [/odometry]
        name: show, subscription: /odometry, deadline: 6ms""")


def is_every(jobs):
    job = current_job()  # None: its message came after its job had expired
    return job is not None and job.job % jobs == 0


def every(jobs, seconds):
    """Return a body that sleeps in one of this many jobs."""
    return lambda: time.sleep(seconds if is_every(jobs) else 0.0)


async def rectify(waiting):
    """Wait for something once in a while, without a worker."""
    if is_every(5):
        future = Future()
        waiting.append(future)
        threading.Timer(0.004, future.set_result, (None,)).start()
        await future
        waiting.remove(future)


def test_entities_may_come_and_go_while_recorded(make_executor, make_node, tmp_path):
    """A new one often gets the address of an earlier one: they are not confused."""
    text = graph(
        a="""
            name: step, timer: 10ms, publishes: [/left]
            name: tick, timer: 20ms, publishes: [/right]""",
        b="""
            name: use, subscription: /left, deadline: 1s
            name: show, subscription: /right, deadline: 1s""")
    path, node, other, heard = tmp_path / 'live.mcap', make_node('a'), make_node('b'), []
    executor = make_executor(loads(text, 'live.yaml'), nodes=[node, other], trace=str(path))
    with Spinning(executor):
        for period, topic in ((0.01, '/left'), (0.02, '/right')) * 6:
            heard.clear()
            publisher = node.create_publisher(Header, topic, 10)
            subscription = other.create_subscription(Header, topic, heard.append, 10)
            timer = node.create_timer(period, lambda p=publisher: p.publish(Header()))
            assert wait_for(lambda: heard)
            other.destroy_subscription(subscription)
            node.destroy_timer(timer)
            assert wait_for(lambda: is_idle(executor))
            node.destroy_publisher(publisher)
            del publisher, subscription, timer
    run = open_recording(path)
    names = [vertex.name for vertex in run.task_set.vertices]
    assert all(run.callback_name(row['callback']) == names[row['vertex']]
               for row in run.executions)
    assert {(names[row['vertex']], run.names.publishers[int(row['publisher'])].topic)
            for row in run.publications} == {('/a:step', '/left'), ('/a:tick', '/right')}


def test_a_publisher_that_is_noticed_too_late_is_recorded(make_executor, make_node, tmp_path):
    """A callback makes it, uses it and destroys it; or its node belongs to no executor."""
    path = tmp_path / 'live.mcap'
    text = graph(eye='name: see, timer: 20ms, may_publish: [/seen]',
                 hand='name: act, subscription: /seen, deadline: 1s')
    eye, hand, published, heard = make_node('eye'), make_node('hand'), [], []
    other = make_node('helper').create_publisher(Header, '/seen', 10)

    def see():
        published.append(1)
        if len(published) % 2:
            other.publish(Header())
        else:
            brief = eye.create_publisher(Header, '/seen', 10)
            brief.publish(Header())
            eye.destroy_publisher(brief)

    eye.create_timer(0.02, see)
    hand.create_subscription(Header, '/seen', heard.append, 10)
    executor = make_executor(loads(text), nodes=[eye, hand], trace=str(path))
    with Spinning(executor):
        assert wait_for(lambda: len(heard) >= 10)
    live = executor.statistics()['dags']['/eye']['sinks']['/hand:act']
    found = replay(path).result()['dags']['/eye']['sinks']['/hand:act']
    assert live['completed'] >= 10
    assert [found.get(key) for key in ('completed', 'not_due')] == [
        live.get(key) for key in ('completed', 'not_due')]
    recorded = Counter(event['publisher_handle'] for event in read_events(path)
                       if event['_name'] == 'ros2:rcl_publisher_init')
    assert {*recorded.values()} == {1}


@pytest.mark.parametrize('given', ['rolling', ''])
def test_a_trace_names_the_distribution(make_executor, tmp_path, monkeypatch, given):
    """That of the environment; without one it is known by rclpy."""
    path = tmp_path / 'live.mcap'
    monkeypatch.setenv('ROS_DISTRO', given)
    make_executor(trace=path).shutdown()
    begun, = read_events(path, ['ros2_caret:caret_init'])
    usual = 'kilted' if hasattr(rclpy.timer, 'TimerInfo') else 'jazzy'
    assert begun['distribution'] == (given or usual)


def test_an_undeclared_coroutine_is_one_execution_however_often_it_is_resumed(
        make_executor, tmp_path):
    path = tmp_path / 'live.mcap'
    executor = make_executor(loads(GRAPH, 'live.yaml'), trace=str(path))
    futures = [Future(executor=executor) for _ in range(2)]

    async def wait():
        for future in futures:
            await future

    with Spinning(executor):
        tasks = [executor.create_task(wait) for _ in range(3)]
        for future in futures:
            assert wait_for(lambda: is_idle(executor))
            future.set_result(None)
        assert wait_for(lambda: all(task.done() for task in tasks) and is_idle(executor))
    outcome = replay(path)
    rows = outcome.recording.executions
    assert outcome.result()['undeclared']['executions'] == 3
    assert sorted(rows['piece'].tolist()) == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert set(rows['job'].tolist()) == {-1}


def has_all_kinds(live):
    """Return whether something has happened several times in each of the ways that there are."""
    sinks = {name: sink for dag in live['dags'].values() for name, sink in dag['sinks'].items()}
    imu = live['dags']['/imu']
    return (min(dag['jobs'] for dag in live['dags'].values()) > 30
            and total(live['dags']).missed > 20 and sinks['/fuse:join']['late'] > 3
            and sinks['/right:watch']['completed'] > 20
            and imu['ends']['late'] + imu['ends']['dropped'] > 3
            and sum(live['dropped'].values()) > 3)


def test_replay_counts_what_the_executor_counted(make_executor, make_node, tmp_path):
    """And misses are reported once each; callbacks end just before and after their deadlines."""
    path, misses, waiting = tmp_path / 'live.mcap', [], []
    nodes = Declared(make_node, GRAPH, {
        'detect': lambda: time.sleep(0.002), 'rectify': partial(rectify, waiting),
        'join': every(7, 0.015), 'use': every(9, 0.007), 'tick': every(20, 0.035),
        'show': lambda: time.sleep(random.uniform(0.0, 0.008))})
    ticks = []
    undeclared = nodes.nodes['filter'].create_timer(
        0.03, lambda: (ticks.append(1), time.sleep(0.001)))
    executor = make_executor(
        loads(GRAPH, 'live.yaml'), num_workers=3, trace=str(path), on_deadline_miss=misses.append)
    with Spinning(executor):
        nodes.start(executor)
        assert wait_for(
            lambda: len(ticks) > 10 and len(misses) > 20 and has_all_kinds(executor.statistics()),
            60.0)
        nodes.cancel()
        undeclared.cancel()
        assert wait_for(lambda: not waiting and is_idle(executor))
    live = executor.statistics()
    outcome = replay(path)
    assert outcome.warnings == []
    result = outcome.result()
    breakdowns = []
    for dag in result['dags'].values():
        for sink in dag['sinks'].values():
            breakdowns.append((sink.pop('breakdown'), sink['response_ns']))
            del sink['slack_ns']
    for key in ('policy', 'workers', 'deadline_missed', 'first_miss', 'dags'):
        assert result[key] == live[key], key
    # on a busy machine messages come after their jobs have expired, and run without one
    jobless = outcome.recording.executions
    jobless = jobless[jobless['vertex'] < 0]
    for key, use in result['callbacks'].items():
        mine = jobless[[outcome.recording.callback_name(each) == key
                        for each in jobless['callback'].tolist()]]
        counted = live['callbacks'][key]
        assert use['executions'] + len(mine) == counted['ran'], key
        assert use['busy_ns'] + sum(mine['busy'].tolist()) == counted['busy_ns'], key
    # also for `graph from-trace`: a coroutine is one execution, however often it is resumed
    drafted = {f'{each.node}:{each.name}': each.runs for each in System(path).draft().callbacks()}
    assert drafted['/right:rectify'] == live['callbacks']['/right:rectify']['ran']
    assert len(ticks) <= result['undeclared']['executions'] <= live['undeclared']
    assert sum(result['dropped'].values()) >= sum(live['dropped'].values())
    reported = sorted((miss.vertex, miss.job) for miss in misses)
    missed = total(live['dags']).missed
    assert len({*reported}) == len(reported)
    # some reported as overdue may have ended in time: their threads could not say so before
    assert missed <= len(reported) <= missed + sum(miss.kind == 'overdue' for miss in misses)
    dags = open_recording(path).task_set.dags
    recorded = {(dags[event['dag']].vertices[event['vertex']].name, event['job'])
                for event in read_events(path) if event['_name'] == 'mddag:deadline'}
    certain = {(miss.vertex, miss.job) for miss in misses if miss.kind != 'overdue'}
    assert certain <= recorded <= {*reported} and len(recorded) == missed

    for breakdown, response in breakdowns:
        worst = breakdown['worst']
        assert worst['completed_ns'] - worst['release_ns'] == response['max']
        assert worst['executing_ns'] > 0
        assert abs(sum(breakdown['mean'].values())) < response['max']

    # and the core, given the same load and as many workers, does no worse than the run itself
    rescheduled = reschedule(path).result()
    assert rescheduled['warnings'] == [
        f'{path}: the time in which coroutines waited is left out: /right:rectify']
    for name, dag in rescheduled['dags'].items():
        assert dag['jobs'] == live['dags'][name]['jobs']


def test_what_is_late_when_it_arrives_is_late_after_its_release(
        make_executor, make_node, tmp_path):
    text = graph(
        late='name: cb, subscription: /old, period: 10ms, release_from: header_stamp, '
             'deadline: 5ms')
    path, node = tmp_path / 'late.mcap', make_node('late')
    publisher = node.create_publisher(Header, '/old', 10)
    node.create_subscription(Header, '/old', print, 10)
    executor = make_executor(
        loads(text, 'g.yaml'), num_workers=1, trace=str(path), nodes=[node])

    def late(result):
        return result['dags']['/late']['sinks']['/late:cb']['late']

    with Spinning(executor):
        for _ in range(20):
            stamp = node.get_clock().now() - Duration(seconds=1)
            publisher.publish(Header(stamp=stamp.to_msg()))
            time.sleep(0.01)
    outcome = replay(path)
    assert outcome.warnings == []
    assert 10 < late(outcome.result()) == late(executor.statistics())


@pytest.mark.parametrize('hours', [-500_000, -1, 1])
def test_a_stamp_of_another_clock_is_no_release(
        hours, make_executor, make_node, tmp_path, capfd):
    # of simulated time, a played bag, or a machine whose clock is wrong
    text = graph(
        played='name: cb, subscription: /old, period: 10ms, release_from: header_stamp, '
               'deadline: 10s')
    path, node, got = tmp_path / 'played.mcap', make_node('played'), []
    publisher = node.create_publisher(Header, '/old', 10)
    node.create_subscription(Header, '/old', got.append, 10)
    executor = make_executor(loads(text, 'g.yaml'), trace=str(path), nodes=[node])
    started = time.time_ns()
    begin = max(100 * 10**9, started + hours * 3600 * 10**9)
    with Spinning(executor):
        for step in range(10):
            publisher.publish(Header(
                stamp=Time(nanoseconds=begin + step * 10_000_000).to_msg()))
            assert wait_for(lambda n=step + 1: len(got) == n)
    sink = executor.statistics()['dags']['/played']['sinks']['/played:cb']
    assert sink['completed'] == 10 and not sink['late']
    replayed = replay(path).result()['dags']['/played']['sinks']['/played:cb']
    assert (replayed['completed'], replayed['late']) == (10, 0)
    warnings = [line for line in capfd.readouterr().err.splitlines() if 'header stamps' in line]
    assert len(warnings) == 1
    said = int(re.search(r'/old: the header stamps are (\d+) s ', warnings[0])[1])
    first, last = sorted(abs(begin - at) / 1e9 for at in (started, time.time_ns()))
    assert first - 1 <= said <= last + 1
    assert ('after' if hours > 0 else 'before') in warnings[0]
    assert warnings[0].endswith('at the arrivals')


def test_a_stamp_that_is_some_seconds_old_counts_and_is_named():
    """It may be late, or of a bag that is played right after it was recorded."""
    lines = []
    releases = StampedReleases(TraceClock(), lines.append)
    now = releases.clock.now()
    stamp = time.time_ns()
    for age in (1, 20, 30):
        release = releases.release(stamp - age * 10**9, '/old', now)
        assert abs(now - release - age * 10**9) < 10**9
    line, = lines
    assert line.startswith('/old: the header stamps are 20 s before the arrivals')
    assert "declare 'release_from: arrival'" in line and not releases.is_other


def test_steps_after_a_spin_belong_to_the_run(make_executor, make_node, tmp_path):
    """Nothing that they leave open is judged earlier than it ended."""
    path, ran, node = tmp_path / 'live.mcap', [], make_node()
    node.create_timer(0.01, lambda: ran.append(1))
    executor = make_executor(loads(graph(
        node='name: tick, timer: 10ms, publishes: [/a], dag: a',
        none='name: hear, subscription: /a, deadline: 1ms')), nodes=[node], trace=str(path))
    for step in (lambda: executor.spin_until_future_complete(Future(), 0.05), executor.spin_once):
        before = len(ran)
        assert wait_for(lambda n=before, step=step: step() or len(ran) > n + 4)
    executor.shutdown()
    live = executor.statistics()['dags']
    assert total(live).missed >= 8
    result = replay(path).result()['dags']
    for sink in result['a']['sinks'].values():
        del sink['breakdown'], sink['slack_ns']
    assert result == live


def test_what_waits_at_the_end_was_not_lost(make_executor, make_node, tmp_path):
    text = graph(
        a="""
            name: hog, timer: 20ms, deadline: 10s, dag: hog
            name: starved, timer: 10ms, deadline: 10ms, dag: starved""")
    path = tmp_path / 'starved.mcap'
    node, begun, go_on = make_node('a'), threading.Event(), threading.Event()
    node.create_timer(0.02, lambda: (begun.set(), go_on.wait(30.0)))    # of the same group
    node.create_timer(0.01, lambda: None)
    executor = make_executor(
        loads(text, 'g.yaml'), num_workers=2, trace=str(path), nodes=[node])

    def jobs():
        return executor.statistics()['dags']['starved']['jobs']

    with Spinning(executor):
        assert begun.wait(15.0)
        before = jobs()
        assert wait_for(lambda: jobs() >= before + 30)
        threading.Timer(0.5, go_on.set).start()     # the end waits for it
    outcome = replay(path)
    assert outcome.warnings == []
    causes = outcome.explanation.summary()['sinks']['/a:starved']
    assert causes['group'] > 1 and sum(causes.values()) > 10
    # the others are those of a busy machine
    assert {cause for cause, n in causes.items() if n} <= {
        'group', 'released late', 'machine', 'interpreter', 'waited'}
    assert [each.kind for each in outcome.drift()] == []


def test_what_the_executor_dropped_was_not_lost(make_executor, make_node, tmp_path):
    """A queue of one message, whose callback is blocked while others arrive."""
    text = graph(
        a='name: tick, timer: 10ms, publishes: [/data]',
        b='name: use, subscription: /data, deadline: 5ms')
    path = tmp_path / 'dropped.mcap'
    node, reader = make_node('a'), make_node('b')
    begun, go_on, sent = threading.Event(), threading.Event(), []
    publisher = node.create_publisher(Header, '/data', 10)
    node.create_timer(0.01, lambda: (sent.append(1), publisher.publish(Header())))
    reader.create_subscription(Header, '/data', lambda _: (begun.set(), go_on.wait(30.0)), 1)
    executor = make_executor(
        loads(text, 'g.yaml'), num_workers=2, trace=str(path), nodes=[node, reader])
    with Spinning(executor):
        assert begun.wait(15.0)
        before = len(sent)
        assert wait_for(lambda: len(sent) >= before + 30)
        go_on.set()
    outcome = replay(path)
    assert outcome.warnings == []
    causes = outcome.explanation.summary()['sinks']['/b:use']
    assert causes['dropped'] > 15 and not causes['lost'] and not causes['not published']


def test_requests_that_arrive_together_are_recorded_one_by_one(make_executor, make_node, tmp_path):
    path, node, ran = tmp_path / 'requests.mcap', make_node(), []

    def serve(request, response):
        ran.append(request)
        return response

    node.create_service(Empty, '/serve', serve)
    client = node.create_client(Empty, '/serve')
    assert client.wait_for_service(60.0)

    def call():
        timer.cancel()
        for _ in range(5):
            client.call_async(Empty.Request())
        time.sleep(0.05)  # so all of them have arrived when the worker is free

    timer = node.create_timer(0.01, call)
    with Spinning(make_executor(
            loads(GRAPH), num_workers=1, trace=str(path), nodes=[node])):
        assert wait_for(lambda: len(ran) == 5)
    recording = open_recording(path)
    served = [row for row in recording.executions
              if '/serve' in recording.callback_name(int(row['callback']))]
    assert len(served) == len({int(row['ready']) for row in served}) == 5
    assert all(row['piece'] == 0 and row['began'] == row['start'] for row in served)


@pytest.mark.slow
def test_the_cause_of_most_misses(tmp_path):
    """Of three runs at once, in processes of their own."""
    def found(cause):
        for misses in (9, 36):  # a busy machine has stops of its own, so that fewer are made
            trace = tmp_path / f'{cause}{misses}.mcap'
            stops = record(cause, trace, misses, scale=3.0)
            told = causes(trace) if cause != 'machine' else causes_in(trace, stops)
            if told.get(cause, 0) >= 5:
                break
        return told

    kinds = ['waited', 'machine', 'not published']
    with ThreadPoolExecutor() as pool:
        for cause, told in zip(kinds, pool.map(found, kinds)):
            assert told.get(cause, 0) >= 5, cause
            assert all(n <= told[cause] for other, n in told.items() if other != 'machine'), told
            # what a busy machine makes late besides has other causes as well, and what came during
            # a stop may be dropped before it runs
            assert cause != 'machine' or {*told} <= {'machine', 'dropped'}


def causes_in(trace, stops):
    """Return by cause the misses whose release and deadline are in a stop of the process."""
    replayed = replay(trace)
    deadline = replayed.result()['dags']['/sensor']['sinks']['/victim:use']['relative_deadline_ns']
    return Counter(
        job['cause'] for job in replayed.explanation.result()['jobs']
        if job['sink'] == '/victim:use' and any(
            begin <= job['release_ns'] <= end - deadline for begin, end in stops))

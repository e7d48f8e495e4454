# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Systems from traces: who is who, what was measured, what drifted; on traces made here."""

import random
import re

from mddag_executor import Replay, replay
from mddag_executor.analysis.drafting import System
from mddag_executor.errors import InputError
from msg_graph import loads
from msg_graph.blanks import MARK
from msg_graph.draft import accept, declaration_of, Draft, DraftCallback, DraftNode, LEFT_OUT
import pytest

from ..sources.helpers import MS, Written
from ..sources.recorded import Recorded


def service(r, number, node, name):
    r.add('ros2:rcl_service_init', 0, 1, number, node, 0, name)
    r.add('ros2:rclcpp_service_callback_added', 0, 1, number, number + 1)


def ran(r, callback, thread, start, length, *publishers):
    r.run(callback, thread, start, start + length)
    for each in publishers:
        r.add('ros2:rcl_publish', start + 1, thread, each, 0)


@pytest.fixture
def recorded(tmp_path):
    """Give a trace of two timers, of which the second publishes, and of two subscriptions."""
    r = Recorded(tmp_path / 'r.mcap')
    for handle, name in ((200, '/b'), (100, '/a'), (300, '/ns/quiet')):     # in any order
        r.node(handle, name)
    for handle, node, topic in ((110, 100, '/x'), (111, 100, '/rosout'), (112, 100, '/unseen'),
                                (310, 300, '/alone')):
        r.publisher(handle, node, topic)
    for callback in (130, 131):
        r.timer(callback, 100, 10 * MS)
    r.group(140, 'mutually_exclusive', ('timer', 130), ('timer', 131))
    # rclcpp makes a subscription's links in another order than rclpy
    r.add('ros2:rclcpp_subscription_callback_added', 0, 1, 220, 230)
    r.add('ros2:rclcpp_subscription_init', 0, 1, 210, 220)
    r.add('ros2:rcl_subscription_init', 0, 1, 210, 200, 0, '/x', 10)
    for callback, topic in ((231, '/out'), (232, '/parameter_events')):
        r.subscription(callback, 200, topic)
    service(r, 250, 200, '/b/get_parameters')
    service(r, 260, 200, '/serve')
    for k in range(20):
        at = 1_000 * MS + 10 * MS * k
        ran(r, 130, 1, at, MS)
        ran(r, 131, 2, at, 2 * MS + k, 110, 111)
        ran(r, 230, 3, at + 3 * MS, MS)
        ran(r, 231, 3, at // 2 + 4 * MS, MS)
    r.add('ros2:callback_end', 5_000 * MS, 9, 131)     # cut: its start is not there
    return r.write()


def test_from_a_trace(recorded):
    text = declaration_of(System(recorded).draft())
    assert f'# From the trace {recorded}.' in text
    accepted = re.sub(rf'^( +)# (\w+: .*# {MARK})', r'\1\2', text, flags=re.MULTILINE)
    # That quiet node's publisher has no callback: a timer of unknown period is supposed.
    accepted = accepted.replace('publishes: [/unseen]', 'publishes: []', 1).replace(
        '        publishes: [/x]\n', '', 1)
    task_set = loads(accepted)
    assert [(c.key, c.kind, c.topics) for c in task_set.callbacks] == [
        ('/a:callback_0', 'timer', ()), ('/a:callback_1', 'timer', ()),
        ('/b:callback_0', 'subscription', ('/x',)), ('/b:callback_1', 'subscription', ('/out',)),
        ('/ns/quiet:callback_0', 'timer', ())]
    assert [line for line in text.splitlines() if line.startswith(LEFT_OUT)] == [
        f'{LEFT_OUT} /b:callback_2 (service /serve): it never ran']
    assert task_set.callbacks[0].group == task_set.callbacks[1].group == 'callback_group_0'
    assert task_set.callbacks[1].publishes == ('/x', '/unseen')
    assert task_set.callbacks[3].period_ns == 5 * MS
    assert 'no callback here publishes the topic; the time between two messages; proposed' in text
    time = task_set.callbacks[1].execution_time
    assert time.quantiles_ns == (
        2 * MS, 2 * MS + 9, 2 * MS + 17, 2 * MS + 19, 2 * MS + 19)
    assert time.percent == (0, 50, 90, 99, 100)
    assert 'get_parameters' not in text and 'parameter_events' not in text


def test_subscriptions_that_may_be_a_sync_have_a_comment():
    """One source leads to /left and /right, another one to /other."""
    def node(name, *heard, **timers):
        return DraftNode(name, {
            **{topic: DraftCallback(name, topic, 'subscription', [f'/{topic}'])
               for topic in heard},
            **{timer: DraftCallback(name, timer, 'timer', period_ns=MS, publishes=topics)
               for timer, topics in timers.items()}})

    text = declaration_of(Draft('a test', [
        node('/a', both=['/left', '/right'], other=['/other']),
        node('/b', 'left', 'right', 'other'), node('/c', 'left', 'other')]))
    assert [line for line in text.splitlines() if 'sync' in line] == [
        '      # If these are one sync, declare one callback: sync: [/left, /right]']


def test_a_stored_message_is_a_result_if_its_dag_has_no_other():
    """Else nothing of the DAG were judged, and its source were less urgent than its period."""
    def stores(name, topic, **keys):
        return DraftCallback('/n', name, 'subscription', [topic], stores=True, **keys)

    text = declaration_of(Draft('a test', [DraftNode('/n', {each.name: each for each in (
        DraftCallback('/n', 'imu', 'timer', period_ns=5 * MS, publishes=['/imu']),
        DraftCallback('/n', 'scan', 'timer', period_ns=9 * MS, publishes=['/scan']),
        DraftCallback('/n', 'stop', 'subscription', ['/scan']),
        stores('keep_imu', '/imu'), stores('keep_scan', '/scan'),
        stores('keep_map', '/map', period_ns=MS))})]), accepted=True)
    found = {each.name: each.deadline_ns for each in loads(text).callbacks}
    assert found == {'imu': None, 'scan': None, 'keep_map': None, 'keep_scan': None,
                     'stop': 9 * MS, 'keep_imu': 5 * MS}


def test_names_periods_and_what_no_one_declares(tmp_path):
    r = Recorded(tmp_path / 'n.mcap')
    r.node(100, '/cam')
    r.publisher(110, 100, '/cam/transition_event')
    for n, period, symbol in (
            (1, 33_333_333, 'robot.Cam.grab'), (2, 33_299_999, 'robot.make.<locals>.<lambda>'),
            (3, 1_500, 'robot.Cam.grab'), (4, 20 * MS, 'std::_Bind<void (Node::*(Node*))()>')):
        r.timer(n, 100, period)
        r.add('ros2:rclcpp_callback_register', 0, 1, n, symbol)
    for n, name in enumerate(('change_state', 'get_state', 'get_available_states',
                              'get_available_transitions', 'get_transition_graph',
                              'ask/get_state')):
        service(r, 200 + 2 * n, 100, f'/cam/{name}')
    r.node(300, '/a')       # nodes are sorted
    r.timer(310, 300, 50 * MS)
    ran(r, 1, 1, 1_000 * MS, MS, 110)
    ran(r, 3, 1, 1_050 * MS, MS)         # else it would be left out
    ran(r, 211, 1, 1_100 * MS, MS)       # of /cam/ask/get_state: the others never run
    text = declaration_of(System(r.write()).draft())
    assert re.findall(r'name: (.*)', text) == [
        'callback_0', 'grab', 'callback_1', 'grab_2', 'callback_3', 'callback_4']
    assert re.findall(r'timer: (.*)', text)[:5] == [
        '50ms', '33.333ms', '33.3ms', '1.5us', '20ms']
    assert re.findall(r'service: (.*)', text) == ['/cam/ask/get_state']
    assert 'transition_event' not in text


def test_a_subscription_of_diagnostics_is_an_ordinary_callback(tmp_path):
    """The publications of a node's state are not its outputs."""
    r = Recorded(tmp_path / 'n.mcap')
    r.node(100, '/cam')
    r.publisher(110, 100, '/diagnostics')
    r.timer(1, 100, 100 * MS)
    r.node(200, '/aggregator')
    r.subscription(7, 200, '/diagnostics')
    for number in range(5):
        ran(r, 1, 1, (number + 1) * 100 * MS, MS, 110)
        ran(r, 7, 1, (number + 1) * 100 * MS + 2 * MS, MS)
    draft = System(r.write()).draft()
    accept(draft)
    callbacks = {each.node: each for each in loads(declaration_of(draft, True)).callbacks}
    assert callbacks['/aggregator'].topics == ('/diagnostics',)
    assert callbacks['/aggregator'].period_ns == 100 * MS
    assert callbacks['/cam'].publishes == ()


def test_what_comes_when_it_is_needed_is_sporadic(tmp_path):
    """Requests, and a latched topic, which a node publishes before its callbacks run."""
    r = Recorded(tmp_path / 'n.mcap')
    r.node(100, '/maps')
    r.node(300, '/planner')
    r.publisher(110, 100, '/map')
    r.timer(1, 100, 100 * MS)
    r.timer(2, 100, 50 * MS)
    r.add('ros2:rclcpp_callback_register', 0, 1, 2, 'threading.Event.set')    # of a Rate
    r.subscription(230, 300, '/map')
    service(r, 260, 300, '/plan')
    for k in range(40):
        ran(r, 1, 1, 1_000 * MS + 100 * MS * k, MS)
        if k % 10 == 0:
            ran(r, 261, 2, 1_003 * MS + 100 * MS * k, 5 * MS)
    ran(r, 230, 3, 1_002 * MS, 1_000)
    system = System(r.write())
    text = declaration_of(system.draft())
    assert 'which callback publishes' not in text and 'timer: 50ms' not in text
    assert LEFT_OUT not in text
    draft = system.draft()
    accept(draft)
    map_, plan = loads(declaration_of(draft, accepted=True)).callbacks[1:]
    assert (map_.topics, map_.period_ns, map_.sporadic, map_.judged) == (
        ('/map',), 1_000 * MS, True, False)
    assert (plan.service, plan.period_ns, plan.sporadic, plan.deadline_ns) == (
        '/plan', 1_000 * MS, True, 1_000 * MS)


def test_a_timer_that_fired_once_may_be_reset(tmp_path):
    r = Recorded(tmp_path / 'o.mcap')
    r.node(100, '/motors')
    r.timer(1, 100, 100 * MS)
    r.timer(2, 100, 150 * MS)
    for k in range(40):
        ran(r, 1, 1, 1_000 * MS + 100 * MS * k, MS)
    ran(r, 2, 1, 1_050 * MS, MS)
    draft = System(r.write()).draft()
    accept(draft)
    text = declaration_of(draft, accepted=True)
    assert [callback.once for callback in loads(text).callbacks] == [False, True]
    assert "proposed: it fired once; if the node resets it, 'sporadic: true'" in text


def test_two_clients_of_a_service_do_not_give_it_a_tiny_deadline(tmp_path):
    """Requests of both come together: the least time between two says nothing of their rate."""
    r = Recorded(tmp_path / 'n.mcap')
    r.node(300, '/planner')
    r.timer(1, 300, 50 * MS)
    service(r, 260, 300, '/plan')
    r.publisher(110, 300, '/path')
    r.node(400, '/drive')
    r.subscription(430, 400, '/path')
    for k in range(40):
        at = 1_000 * MS + 100 * MS * k
        ran(r, 1, 1, at, MS)
        for after in (0, 10_000):       # each of the two sends a request each 100 ms
            ran(r, 261, 2, at + after, 5_000, 110)
            ran(r, 430, 3, at + after + 2_000, 1_000_000)
    draft = System(r.write()).draft()
    text = declaration_of(draft)
    assert '10us' not in text
    accept(draft)
    drive, plan = (each for each in loads(declaration_of(draft, accepted=True)).callbacks
                   if each.kind != 'timer')
    assert plan.period_ns == drive.deadline_ns == 50 * MS and plan.sporadic


def jitter(count, period, most, seed=1):
    """Return arrivals each period, ms, which are late by at most a time, but for lost ones."""
    chance = random.Random(seed)
    return [period * k + chance.uniform(0, most) for k in range(count) if chance.random() < 0.95]


@pytest.mark.parametrize(('arrivals', 'low', 'high', 'sporadic'), [
    (jitter(300, 100, 5), 99, 101, False),
    (jitter(300, 100, 90), 95, 110, False),
    ([at + late for at in jitter(300, 67, 1) for late in (0, 0.3)], 33, 36, False),
    ([*jitter(150, 100, 5), *(30_000 + at for at in jitter(150, 100, 5))], 99, 101, True),
    ([15_000 * k + 100 * i for k in range(4) for i in range(50)], 100, 100, True),
    ([at + late for at in (0, 900, 4_000, 4_700, 7_000, 9_000, 9_500) for late in (0, 5)],
     800, 950, True),
    ([0, 1, 2], 5_900, 6_000, True),
    ([0, 100, 200], 100, 100, False)],
    ids=['sensor', 'network', 'frames two at a time', 'pause', 'phases', 'button that bounces',
         'burst', 'three'])
def test_the_period_of_a_topic_from_outside(tmp_path, arrivals, low, high, sporadic):
    """It is the usual one, and not the least time between two messages, which may be tiny."""
    r = Recorded(tmp_path / 'n.mcap')
    r.node(100, '/use')
    r.node(200, '/driver')
    r.publisher(120, 200, '/in')
    r.timer(9, 200, 10 * MS)    # its node publishes in a thread of its own
    r.subscription(130, 100, '/in')
    for at in arrivals:
        ran(r, 130, 1, 1_000 * MS + round(at * MS), 1_000)
    ran(r, 9, 2, 1_010 * MS, 1_000)
    # the publisher may go on for a period; three messages in a minute have no rate
    last = 60_000 if arrivals == [0, 1, 2] else arrivals[-1] + 50
    ran(r, 9, 2, 1_000 * MS + round(last * MS), 1_000)
    draft = System(r.write()).draft()
    accept(draft)
    use, = (each for each in loads(declaration_of(draft, accepted=True)).callbacks
            if each.kind == 'subscription')
    assert low * MS <= use.period_ns <= high * MS
    assert use.deadline_ns == use.period_ns and use.sporadic is sporadic


def lifecycle(path, second_period, symbol='robot.Driver.tick'):
    """Write a timer that was destroyed before it fired, and the one that was made after it."""
    r = Recorded(path)
    r.node(100, '/driver')
    for number, period, made in ((1, 100 * MS, 500 * MS), (2, second_period, 530 * MS)):
        r.timer(number, 100, period, time=made)
        r.add('ros2:rclcpp_callback_register', made, 1, number, symbol)
    for k in range(60):
        ran(r, 2, 1, 700 * MS + second_period * k, MS)
    return r.write()


def test_a_timer_that_was_destroyed_before_it_fired_is_made_again(tmp_path):
    """A lifecycle node that was configured, cleaned up and configured again."""
    draft = System(lifecycle(tmp_path / 'n.mcap', 100 * MS)).draft()
    assert draft.left_out == []
    accept(draft)
    tick, = loads(declaration_of(draft, accepted=True)).callbacks
    assert (tick.name, tick.period_ns, tick.sporadic) == ('tick', 100 * MS, True)


def test_a_timer_that_was_made_again_is_one_row(tmp_path, call):
    """Two functions make a timer for each shot; a third one has two timers at a time."""
    r = Recorded(tmp_path / 'n.mcap')
    r.node(100, '/driver')
    for k, symbol in enumerate(['fast', 'slow'] * 10 + ['both'] * 2):
        timer = 10 + k
        made = 100 * MS * k if symbol != 'both' else 5_000 * MS
        r.timer(timer, 100, 10 * MS, time=made)
        r.add('ros2:rclcpp_callback_register', made, 1, timer, symbol)
        ran(r, timer, k, made + 10 * MS, MS)
    path = r.write()
    rows = replay(path).result()['recorded_callbacks']
    assert {name: row['executions'] for name, row in rows.items()} == {
        '/driver timer 10ms': 10, '/driver timer 10ms #2': 10,
        '/driver timer 10ms #3': 1, '/driver timer 10ms #4': 1}
    page, folder = tmp_path / 'r.html', tmp_path / 'tables'
    call('replay', path, '--report', page)
    assert 'timer 10ms #4' in page.read_text() and 'timer 10ms #5' not in page.read_text()
    call('export', path, '-o', f'{folder}/')


@pytest.mark.parametrize('symbol, name', [
    ('robot.Driver.tick', 'tick'), ('robot.make.<locals>.<lambda>', 'callback_0')])
def test_what_never_ran_takes_no_name_from_what_did(tmp_path, symbol, name):
    """The timer got another period, as from a parameter, when it was made again."""
    draft = System(lifecycle(tmp_path / 'n.mcap', 50 * MS, symbol)).draft()
    left, = draft.left_out
    assert 'it never fired' in left and f'/driver:{name} ' not in left
    accept(draft)
    tick, = loads(declaration_of(draft, accepted=True)).callbacks
    assert (tick.name, tick.period_ns, tick.sporadic) == (name, 50 * MS, False)


def test_two_timers_that_are_not_yet_due_are_two(tmp_path):
    r = Recorded(tmp_path / 'n.mcap')
    r.node(100, '/driver')
    r.timer(3, 100, 10 * MS)
    for number in (1, 2):
        r.timer(number, 100, 5_000 * MS)
        r.add('ros2:rclcpp_callback_register', 0, 1, number, 'robot.Driver.save')
    for k in range(50):
        ran(r, 3, 1, 1_000 * MS + 10 * MS * k, MS)
    text = declaration_of(System(r.write()).draft())
    assert re.findall(r'name: (.*)', text) == ['callback_0', 'save', 'save_2']
    assert 'sporadic' not in text


def test_what_a_thread_of_a_node_publishes_comes_from_no_callback(tmp_path):
    """A main loop that sleeps with a Rate, for instance: its subscriber is a source."""
    r = Recorded(tmp_path / 'n.mcap')
    r.node(100, '/lidar')
    r.node(300, '/stop')
    r.publisher(110, 100, '/scan')
    r.publisher(120, 100, '/unheard')
    r.timer(1, 100, 50 * MS)
    r.subscription(230, 300, '/scan')
    for k in range(20):
        ran(r, 1, 1, 1_000 * MS + 50 * MS * k, MS)
        ran(r, 230, 3, 1_002 * MS + 100 * MS * k, MS)
    system = System(r.write())
    text = declaration_of(system.draft())
    assert '# publishes: [/unheard]' in text and text.count('/scan') == 1
    draft = system.draft()
    accept(draft)
    tick, scan = loads(declaration_of(draft, accepted=True)).callbacks
    assert (scan.topics, scan.period_ns, scan.sporadic, scan.deadline_ns) == (
        ('/scan',), 100 * MS, False, 100 * MS)
    assert (tick.publishes, draft.left_out) == ((), [])


def test_what_is_no_system(tmp_path):
    r = Recorded(tmp_path / 'e.mcap')
    r.run(5, 1, 1, 2)
    with pytest.raises(InputError, match='no timer, subscription or service of a node'):
        System(r.write())


def test_drift_of_an_imported_recording(recorded):
    text = """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: one, timer: 10ms, deadline: 5ms, dag: one}
      - {name: two, timer: 10ms, publishes: [/x]}
  - node: /b
    callbacks:
      - {name: x, subscription: /x, deadline: 5ms}
      - {name: o, subscription: /out, period: 5ms, deadline: 5ms, dag: o}
"""
    # something else goes on for some seconds after its sources
    assert {each.kind for each in replay(recorded, loads(text)).drift()} == {'stopped'}
    outcome = replay(recorded, loads(
        text.replace(', publishes: [/x]', ', deadline: 1s')
        .replace('/x, deadline', '/x, period: 15ms, deadline')
        .replace('/out', '/gone').replace('two', 'zwei')))
    assert '1 of the 4 callbacks' in outcome.warnings[0] and '/b:o' in outcome.warnings[0]
    found = [each for each in outcome.drift() if each.kind != 'stopped']
    assert [(each.kind, each.callback) for each in found] == [
        ('publishes', '/a:zwei'), ('rate', '/b:x'), ('never ran', '/b:o')]
    assert (found[1].declared, found[1].observed) == (15 * MS, 10 * MS)


@pytest.mark.parametrize(('sent', 'text'), [
    (60, None),     # all but the first were lost
    (20, "/b:x got 20 messages, and by the declaration 60 were due: if /a:tick published /x in 20 "
         "of 60 runs, declare 'may_publish: [/x]'")])
def test_a_publication_that_did_not_arrive_is_no_drift(tmp_path, sent, text):
    r = Recorded(tmp_path / 'r.mcap')
    r.node(100, '/a')
    r.node(200, '/b')
    r.publisher(110, 100, '/x')
    r.timer(130, 100, 10 * MS)
    r.subscription(230, 200, '/x')
    for k in range(60):
        at = 1_000 * MS + 10 * MS * k
        ran(r, 130, 1, at, MS, *[110] * (k < sent))
        if k < 20:
            ran(r, 230, 3, at + 3 * MS, MS)
    outcome = replay(r.write(), loads("""\
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: tick, timer: 10ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: x, subscription: /x, deadline: 5ms}]}
"""))
    assert [each.text for each in outcome.drift()] == [text] * (text is not None)


def test_a_warm_up_does_not_count_for_rates(tmp_path):
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/x]}
      - {name: once, subscription: /once, period: 10ms, deadline: 5ms}
  - {node: /b, callbacks: [{name: x, subscription: /x, deadline: 5ms}]}
""")
    trace.release(1, 0, 0)
    trace.run(1, 0, 0, 0, 1)
    start = 0
    for job in range(60):
        start += 50 if job < 20 else 10   # until 1 s it is slow
        trace.release(0, job, start)
        trace.run(0, 0, job, start, start + 1)
        if job >= 20:
            trace.run(0, 1, job, start + 1, start + 2)
    recording = replay(trace.end(start + 10)).recording
    assert [each.kind for each in Replay(recording).drift()] == ['rate']
    assert Replay(recording, skip=1_000 * MS).drift() == []

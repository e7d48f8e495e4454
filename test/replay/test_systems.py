# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Systems from traces: who is who, what was measured, what drifted; on traces made here."""

import re

from mddag_executor.errors import InputError
from mddag_executor.replay import Replay, replay
from mddag_executor.replay.drafting import System
from mddag_executor.trace import TraceFile
from msg_graph import loads
from msg_graph.caret import declaration_from_caret
from msg_graph.draft import declaration_of, Draft, DraftCallback, DraftNode, LEFT_OUT, MARK
import pytest

from .helpers import add_execution, begin_trace, end_trace, START_TIME

MS = 1_000_000
PID = 7
ARCHITECTURE = """\
named_paths: []
nodes:
- node_name: /a
  callbacks:
  - {callback_name: /a/callback_0, callback_type: timer_callback, period_ns: 10000000}
  - {callback_name: /a/callback_1, callback_type: timer_callback, period_ns: 10000000}
  publishes:
  - {topic_name: /x, callback_names: [UNDEFINED]}
- node_name: /b
  callbacks:
  - {callback_name: /b/callback_0, callback_type: subscription_callback, topic_name: /x}
  - {callback_name: /b/callback_1, callback_type: subscription_callback, topic_name: /out}
  - {callback_name: /b/callback_2, callback_type: subscription_callback, topic_name: /never}
"""


def head():
    """Return who is who: rclcpp makes a subscription's links in another order than rclpy."""
    return [
        ('rcl_node_init', 0, 1, 100, 0, 'a', '/'),
        ('rcl_node_init', 0, 1, 200, 0, 'b', '/'),
        ('rcl_node_init', 0, 1, 300, 0, 'quiet', '/ns'),
        ('rcl_publisher_init', 0, 1, 110, 100, 0, '/x', 10),
        ('rcl_publisher_init', 0, 1, 111, 100, 0, '/rosout', 10),
        ('rcl_publisher_init', 0, 1, 112, 100, 0, '/unseen', 10),
        ('rcl_publisher_init', 0, 1, 310, 300, 0, '/alone', 10),
        *(event for n in (0, 1) for event in (
            ('rcl_timer_init', 0, 1, 120 + n, 10 * MS),
            ('rclcpp_timer_callback_added', 0, 1, 120 + n, 130 + n),
            ('rclcpp_timer_link_node', 0, 1, 120 + n, 100),
            ('callback_group_add_timer', 0, 1, 140, 120 + n))),
        ('add_callback_group', 0, 1, 5, 140, 'mutually_exclusive'),
        *(event for n, topic in enumerate(('/x', '/out', '/parameter_events')) for event in (
            ('rclcpp_subscription_callback_added', 0, 1, 220 + n, 230 + n),
            ('rclcpp_subscription_init', 0, 1, 210 + n, 220 + n),
            ('rcl_subscription_init', 0, 1, 210 + n, 200, 0, topic, 10))),
        ('rcl_service_init', 0, 1, 250, 200, 0, '/b/get_parameters'),
        ('rclcpp_service_callback_added', 0, 1, 250, 251),
        ('rcl_service_init', 0, 1, 260, 200, 0, '/serve'),
        ('rclcpp_service_callback_added', 0, 1, 260, 261),
    ]


def run(callback, thread, start, length, *publishers):
    return [('callback_start', start, thread, callback, False),
            *(('rcl_publish', start + 1, thread, each, 0) for each in publishers),
            ('callback_end', start + length, thread, callback)]


def trace(path, events):
    with TraceFile(path) as file:
        file.extend(sorted(events, key=lambda event: event[1]), PID)
        assert file.rejected == 0, file.rejection
    return path


@pytest.fixture
def recorded(tmp_path):
    """Give a trace of two timers, of which the second publishes, and of two subscriptions."""
    events = head()
    for k in range(20):
        at = 1_000 * MS + 10 * MS * k
        events += run(130, 1, at, MS)
        events += run(131, 2, at, 2 * MS + k, 110, 111)
        events += run(230, 3, at + 3 * MS, MS)
        events += run(231, 3, at // 2 + 4 * MS, MS)
    events.append(('callback_end', 5_000 * MS, 9, 131))  # cut: its start is not there
    return trace(tmp_path / 'r.mcap', events)


def test_nodes_are_sorted(tmp_path):
    """An executor has a set of nodes, which it records in any order."""
    path = trace(tmp_path / 'r.mcap', [event for n, name in enumerate('bca') for event in (
        ('rcl_node_init', n, 1, 10 + n, 0, name, '/'),
        ('rcl_timer_init', n, 1, 20 + n, 10 * MS),
        ('rclcpp_timer_callback_added', n, 1, 20 + n, 30 + n),
        ('rclcpp_timer_link_node', n, 1, 20 + n, 10 + n), *run(30 + n, 1, 100 + 10 * n, 5))])
    assert [node.name for node in System(path).draft().nodes] == ['/a', '/b', '/c']


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
    timer, hear = 'timer', 'subscription'
    text = declaration_of(Draft('a test', [
        DraftNode('/a', {
            'both': DraftCallback(
                '/a', 'both', timer, period_ns=MS, publishes=['/left', '/right']),
            'other': DraftCallback('/a', 'other', timer, period_ns=2 * MS, publishes=['/other'])}),
        DraftNode('/b', {topic: DraftCallback('/b', topic, hear, [f'/{topic}'])
                         for topic in ('left', 'right', 'other')}),
        DraftNode('/c', {topic: DraftCallback('/c', topic, hear, [f'/{topic}'])
                         for topic in ('left', 'other')})]))
    assert [line for line in text.splitlines() if 'sync' in line] == [
        '      # If these are one sync, declare one callback: sync: [/left, /right]']


def test_names_periods_and_what_no_one_declares(tmp_path):
    """Functions give names, periods are as people write them, lifecycle services are left out."""
    symbols = {1: 'robot.Cam.grab', 2: 'robot.make.<locals>.<lambda>', 3: 'robot.Cam.grab',
               4: 'std::_Bind<void (Node::*(Node*))()>'}
    lifecycle = ('change_state', 'get_state', 'get_available_states',
                 'get_available_transitions', 'get_transition_graph')
    events = [
        ('rcl_node_init', 0, 1, 100, 0, 'cam', '/'),
        ('rcl_publisher_init', 0, 1, 110, 100, 0, '/cam/transition_event', 10)]
    for n, period in ((1, 33_333_333), (2, 33_299_999), (3, 1_500), (4, 20 * MS)):
        events += [
            ('rcl_timer_init', 0, 1, 120 + n, period),
            ('rclcpp_timer_callback_added', 0, 1, 120 + n, n),
            ('rclcpp_timer_link_node', 0, 1, 120 + n, 100),
            ('rclcpp_callback_register', 0, 1, n, symbols[n])]
    for n, name in enumerate((*lifecycle, 'ask/get_state')):
        events += [('rcl_service_init', 0, 1, 200 + n, 100, 0, f'/cam/{name}'),
                   ('rclcpp_service_callback_added', 0, 1, 200 + n, 300 + n)]
    events += run(1, 1, 1_000 * MS, MS, 110)
    events += run(305, 1, 1_100 * MS, MS)       # of /cam/ask/get_state: the others never run
    text = declaration_of(System(trace(tmp_path / 'n.mcap', events)).draft())
    assert re.findall(r'name: (.*)', text) == [
        'grab', 'callback_1', 'grab_2', 'callback_3', 'callback_4']
    assert re.findall(r'timer: (.*)', text)[:4] == ['33.333ms', '33.3ms', '1.5us', '20ms']
    assert re.findall(r'service: (.*)', text) == ['/cam/ask/get_state']
    assert 'transition_event' not in text


def test_measures_for_an_architecture_file(recorded):
    system, counts = System(recorded), []
    text = declaration_from_caret(
        ARCHITECTURE, 'arch.yaml', lambda draft: counts.append(system.measure(draft)))
    assert counts == [4]
    plain = declaration_from_caret(ARCHITECTURE, 'arch.yaml')
    assert plain.count('which callback publishes /x?') == 2
    assert '# period: 5ms' in text and '# period: 5ms' not in plain
    assert text.count('# measured in 20 executions') == 4
    # The second timer was seen to publish; of the first it is not known that it never does.
    assert text.index('callback_1') < text.index('publishes: [/x]\n')


def test_what_is_no_system(tmp_path):
    path = trace(tmp_path / 'e.mcap', [('callback_start', 1, 1, 5, False)])
    with pytest.raises(InputError, match='no timer, subscription or service of a node'):
        System(path)


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
    assert replay(recorded, loads(text)).drift() == []
    found = replay(recorded, loads(
        text.replace(', publishes: [/x]', ', deadline: 1s')
        .replace('/x, deadline', '/x, period: 15ms, deadline')
        .replace('/out', '/gone').replace('two', 'zwei'))).drift()
    assert [(each.kind, each.callback) for each in found] == [
        ('publishes', '/a:zwei'), ('rate', '/b:x'), ('never ran', '/b:o')]
    assert (found[1].declared, found[1].observed) == (15 * MS, 10 * MS)


def test_a_warm_up_does_not_count_for_rates(tmp_path):
    path = tmp_path / 'run.mcap'
    with begin_trace(path, """\
mddag: 1
nodes:
  - node: /a
    callbacks:
      - {name: tick, timer: 10ms, publishes: [/x]}
      - {name: once, subscription: /once, period: 10ms, deadline: 5ms}
  - node: /b
    callbacks:
      - {name: x, subscription: /x, deadline: 5ms}
""") as file:
        file.add('job_release', START_TIME, 1, 1, 1, 0, START_TIME)
        add_execution(file, START_TIME, START_TIME + MS, 1, 0, 0, address=8)
        start = START_TIME
        for job in range(60):
            start += 50 * MS if job < 20 else 10 * MS   # until 1 s it is slow
            file.add('job_release', start, 1, 1, 0, job, start)
            add_execution(file, start, start + MS, 0, 0, job, address=7)
            if job >= 20:
                add_execution(file, start + MS, start + 2 * MS, 0, 1, job)
        end_trace(file, start + 10 * MS)
    recording = replay(path).recording
    assert [each.kind for each in Replay(recording).drift()] == ['rate']
    assert Replay(recording, skip=1_000 * MS).drift() == []

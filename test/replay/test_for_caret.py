# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Traces of this executor as CARET's analysis takes them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from mddag_executor.replay import caret_events
from mddag_executor.replay.for_caret import CARET_EVENTS
from mddag_executor.trace import read_events

from .recorded import BEGIN, MS, Recorded

DEMO = Path(__file__).resolve().parent.parent.parent / 'bags' / 'demo_short.mcap'


def test_a_live_trace_gets_what_only_carets_tracer_sees() -> None:
    events = list(caret_events(DEMO))
    assert {event['_name'] for event in events} <= CARET_EVENTS
    assert [e['_timestamp'] for e in events] == sorted(e['_timestamp'] for e in events)
    count = Counter(event['_name'].partition(':')[2] for event in events)
    # what caret_analyze 0.5 found in it: every message that started a callback, with its sender
    assert (count['callback_start'], count['dispatch_subscription_callback']) == (1934, 1630)
    assert count['dds_bind_addr_to_stamp'] == count['dds_write'] == 1344
    assert count['rmw_take'] == count['add_callback_group'] == 0
    assert count['callback_group_to_executor_entity_collector'] == 74
    assert count['executor_entity_collector_to_executor'] == 1
    bound: dict[int, dict[str, Any]] = {}
    for place, event in enumerate(events):
        if event['_name'] == 'ros2_caret:dds_bind_addr_to_stamp':
            assert events[place - 2]['_name'] == 'ros2:rcl_publish'
            assert events[place - 2]['message'] == event['addr']
            assert event['source_stamp'] not in bound
            assert 0 <= event['source_stamp'] - event['_timestamp'] < 1 * MS
            bound[event['source_stamp']] = event
        elif event['_name'] == 'ros2:dispatch_subscription_callback':
            start = events[place + 1]
            assert (start['_name'], start['callback'], start['_vtid']) == (
                'ros2:callback_start', event['callback'], event['_vtid'])
            assert bound[event['source_stamp']]['_timestamp'] < event['_timestamp']


def test_an_imported_trace_stays_as_it_is(tmp_path: Path) -> None:
    r = Recorded(tmp_path / 'recorded.mcap')
    r.node(1, '/n')
    r.timer(11, 1, 10 * MS)
    r.publisher(100, 1, '/t')
    r.run(11, 1, 10 * MS, 12 * MS)
    r.publish(100, 1, 11 * MS, style='tracing')
    path = r.write()
    events = list(caret_events(path))
    assert events == [e for e in read_events(path) if e['_name'] != 'ros2:rmw_publish']
    assert len(events) > 8


GRAPH = """\
mddag: 1
nodes:
  - node: /a
    callbacks: [{name: send, timer: 10ms, publishes: [/t]}]
  - node: /b
    callbacks: [{name: get, subscription: /t, deadline: 9ms}]
"""


def own(path: Path, publications: tuple[int, ...], taken: dict[int, int]) -> Path:
    """Write a trace of this executor: job k publishes at a time, is taken with a stamp."""
    r = Recorded(path)
    r.add('mddag:task_set', 0, 1, GRAPH, 'g.yaml', 'rad', 2, 100 * MS, 0, False)
    r.node(1, '/a')
    r.node(2, '/b')
    r.timer(11, 1, 10 * MS)
    r.publisher(100, 1, '/t')
    r.subscription(12, 2, '/t')
    for k, time in enumerate(publications):
        r.add('mddag:dispatch', time - 3, 1, 11, 0, 0, k, 0, BEGIN + time - 9, 0)
        r.add('ros2:callback_start', time - 2, 1, 11, False)
        r.add('ros2:rclcpp_publish', time, 1, 100, 0x50 + k, 0)
        r.add('ros2:rcl_publish', time, 1, 100, 0x50 + k)
        r.add('ros2:callback_end', time + 20, 1, 11)
        if k in taken:
            r.add('ros2:rmw_take', time + 30, 3, 30_012, 0x98, BEGIN + taken[k], True)
            r.add('mddag:dispatch', time + 40, 2, 12, 0, 1, k, 1, BEGIN + time + 30, 0)
            r.add('ros2:callback_start', time + 41, 2, 12, False)
            r.add('ros2:callback_end', time + 50, 2, 12)
    return r.write()


def test_a_message_that_nobody_took_gets_no_stamp(tmp_path: Path) -> None:
    # the second one was lost: the stamp after it is the third's
    path = own(tmp_path / 'a.mcap', (1000, 2000, 3000), {0: 1010, 2: 3010})
    events = list(caret_events(path))
    assert [(e['addr'], e['source_stamp'] - BEGIN) for e in events
            if e['_name'] == 'ros2_caret:dds_bind_addr_to_stamp'] == [(0x50, 1010), (0x52, 3010)]
    assert [(e['_timestamp'] - BEGIN, e['message'], e['source_stamp'] - BEGIN) for e in events
            if e['_name'] == 'ros2:dispatch_subscription_callback'] == [
                (1041, 0x50, 1010), (3041, 0x52, 3010)]

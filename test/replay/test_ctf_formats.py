# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""From an LTTng session of ros2_tracing, Jazzy, to jobs and a path: import, then replay."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mddag_executor.replay import replay
from mddag_executor.trace import import_ctf
from msg_graph import loads
import pytest

from ..trace.ctf_session import CLOCK_OFFSET, session

MS = 1_000_000
KINDS = [
    ('ros2:rcl_node_init', [('node_handle', 'u64'), ('rmw_handle', 'u64'), ('node_name', 'str'),
                            ('namespace', 'str')]),
    ('ros2:rcl_publisher_init', [('publisher_handle', 'u64'), ('node_handle', 'u64'),
                                 ('rmw_publisher_handle', 'u64'), ('topic_name', 'str'),
                                 ('queue_depth', 'u64')]),
    ('ros2:rcl_subscription_init', [('subscription_handle', 'u64'), ('node_handle', 'u64'),
                                    ('rmw_subscription_handle', 'u64'), ('topic_name', 'str'),
                                    ('queue_depth', 'u64')]),
    ('ros2:rclcpp_subscription_init', [('subscription_handle', 'u64'), ('subscription', 'u64')]),
    ('ros2:rclcpp_subscription_callback_added', [('subscription', 'u64'), ('callback', 'u64')]),
    ('ros2:rcl_timer_init', [('timer_handle', 'u64'), ('period', 'i64')]),
    ('ros2:rclcpp_timer_callback_added', [('timer_handle', 'u64'), ('callback', 'u64')]),
    ('ros2:rclcpp_timer_link_node', [('timer_handle', 'u64'), ('node_handle', 'u64')]),
    ('ros2:callback_start', [('callback', 'u64'), ('is_intra_process', 'i32')]),
    ('ros2:callback_end', [('callback', 'u64')]),
    # from Iron on without the publisher's handle
    ('ros2:rclcpp_publish', [('message', 'u64')]),
    ('ros2:rcl_publish', [('publisher_handle', 'u64'), ('message', 'u64')]),
    # `timestamp` is what the trace calls an event's own time
    ('ros2:rmw_publish', [('rmw_publisher_handle', 'u64'), ('message', 'u64'),
                          ('timestamp', 'i64')]),
    ('ros2:rmw_take', [('rmw_subscription_handle', 'u64'), ('message', 'u64'),
                       ('source_timestamp', 'i64'), ('taken', 'i32')]),
]
NUMBER = {name.partition(':')[2]: number for number, (name, _) in enumerate(KINDS)}
GRAPH = """\
mddag: 1
nodes:
  - node: /ns/camera
    callbacks: [{name: grab, timer: 10ms, publishes: [/image]}]
  - node: /detect
    callbacks: [{name: detect, subscription: /image, deadline: 4ms}]
paths:
  - {name: seen, callbacks: ['/ns/camera:grab', '/detect:detect']}
"""


def events() -> list[tuple[Any, ...]]:
    """Return three jobs of two processes; the subscriber is late in the third."""
    found: list[tuple[Any, ...]] = []

    def add(name: str, time: int, pid: int, tid: int, *values: Any) -> None:
        found.append((NUMBER[name], time, pid, tid, f'p{pid}', *values))

    add('rcl_node_init', 1, 7, 7, 1, 1, 'camera', '/ns')
    add('rcl_publisher_init', 2, 7, 7, 2, 1, 3, '/image', 10)
    add('rcl_timer_init', 3, 7, 7, 4, 10 * MS)
    add('rclcpp_timer_callback_added', 4, 7, 7, 4, 5)
    add('rclcpp_timer_link_node', 5, 7, 7, 4, 1)
    add('rcl_node_init', 6, 8, 8, 1, 1, 'detect', '/')
    add('rcl_subscription_init', 7, 8, 8, 2, 1, 3, '/image', 10)
    add('rclcpp_subscription_init', 8, 8, 8, 2, 4)
    add('rclcpp_subscription_callback_added', 9, 8, 8, 4, 5)
    for k in range(1, 4):
        at = k * 10 * MS + 3
        stamp = CLOCK_OFFSET + at + 1020
        add('callback_start', at, 7, 70, 5, 0)
        add('rclcpp_publish', at + 1000, 7, 70, 0x99)
        add('rcl_publish', at + 1010, 7, 70, 2, 0x99)
        add('rmw_publish', at + 1030, 7, 70, 3, 0x99, stamp)
        add('callback_end', at + 2000, 7, 70, 5)
        took = (5 if k == 3 else 1) * MS
        add('rmw_take', at + 3000, 8, 80, 3, 0x98, stamp, 1)
        add('callback_start', at + 4000, 8, 80, 5, 0)
        add('callback_end', at + took, 8, 80, 5)
    return found


@pytest.mark.needs('babeltrace2')
def test_a_session_of_two_processes(tmp_path: Path) -> None:
    session(tmp_path / 'session' / 'ust', KINDS, events())
    trace = tmp_path / 'drive.mcap'
    assert import_ctf(tmp_path / 'session', trace).processes == {7, 8}
    outcome = replay(trace, loads(GRAPH, 'graph.yaml'))
    result = outcome.result()
    assert [line for line in outcome.warnings if '2 processes' not in line] == []
    sink = result['dags']['/ns/camera']['sinks']['/detect:detect']
    assert (sink['completed'], sink['late']) == (3, 1)
    assert sink['response_ns'] == {'min': MS, 'median': MS, 'p99': 5 * MS, 'max': 5 * MS}
    path = result['paths']['seen']
    assert (path['flows'], path['arrived']) == (3, 3)
    assert path['data_age']['max'] == path['data_age']['min'] == 3000
    assert path['reaction_time'] == dict.fromkeys(
        ('min', 'mean', 'median', 'p99', 'max'), 10 * MS + 3000) | {'count': 1}

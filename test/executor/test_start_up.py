# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What was due before the executor was ready is no miss of the run."""

from __future__ import annotations

import time
from typing import Any

from msg_graph import loads
import pytest
from std_msgs.msg import Header

from .conftest import Spinning, wait_for

GRAPH = """
mddag: 1
nodes:
  - node: /node
    callbacks:
      - name: tick
        timer: 10ms
        publishes: [/topic]
        execution_time: 1us
      - name: heard
        subscription: /topic
        execution_time: 1us
        deadline: 10s
"""


def test_periods_before_the_spin_are_no_jobs_and_no_misses(make_executor, make_node):
    node, ran = make_node(), []
    publisher = node.create_publisher(Header, '/topic', 10)
    node.create_subscription(Header, '/topic', lambda m: None, 10)

    def tick() -> None:
        ran.append(1)
        publisher.publish(Header())

    node.create_timer(0.01, tick)
    executor = make_executor(loads(GRAPH), nodes=[node])
    releases: list[int] = []
    executor._engine.verdicts.on_release = lambda dag, release: releases.append(release)
    time.sleep(0.3)
    begin = executor._trace_clock.now()
    with Spinning(executor):
        assert wait_for(lambda: len(ran) > 5)
    assert min(releases) >= begin
    assert executor.statistics()['callbacks']['/node:tick']['skipped'] < 25


@pytest.mark.parametrize('stamp', ['source_timestamp', 'header_stamp'])
def test_a_message_from_before_the_spin_is_released_when_it_begins(
    make_executor, make_node, stamp
):
    node, got = make_node(), []
    graph: Any = loads(f"""
mddag: 1
nodes:
  - node: /node
    callbacks:
      - name: heard
        subscription: /topic
        period: 10ms
        release_from: {stamp}
        execution_time: 1us
        deadline: 1s
""")
    publisher = node.create_publisher(Header, '/topic', 10)
    node.create_subscription(Header, '/topic', got.append, 10)
    assert wait_for(publisher.get_subscription_count)
    executor = make_executor(graph, nodes=[node])
    releases: list[int] = []
    executor._engine.verdicts.on_release = lambda dag, release: releases.append(release)
    publisher.publish(Header(stamp=node.get_clock().now().to_msg()))
    time.sleep(0.2)
    begin = executor._trace_clock.now()
    with Spinning(executor):
        assert wait_for(lambda: got)
    assert len(releases) == 1 and releases[0] >= begin

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What a live run tells the drift rules."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.executor.statistics import Watch
from msg_graph import loads
from rclpy.node import Node
from std_msgs.msg import Empty

from .conftest import Spinning, wait_for

TEXT = """\
mddag: 1
nodes:
  - node: /camera
    callbacks:
      - {name: grab, timer: 20ms, publishes: [/image]}
  - node: /eye
    callbacks:
      - {name: see, subscription: /image, deadline: 20ms}
      - {name: hear, subscription: /sound, period: 50ms, deadline: 50ms, dag: sound}
"""


def test_drift(make_executor: Callable[..., Any], make_node: Callable[..., Node]) -> None:
    task_set = loads(TEXT)
    executor = make_executor(task_set, num_workers=2)
    watch = Watch(executor, task_set)
    camera, eye = make_node('camera'), make_node('eye')
    image = camera.create_publisher(Empty, '/image', 10)
    extra = camera.create_publisher(Empty, '/extra', 10)
    seen: list[int] = []

    def grab() -> None:
        for _ in range(6):  # far too many, also where a busy machine skips releases
            image.publish(Empty())
        extra.publish(Empty())

    camera.create_timer(0.02, grab)
    eye.create_subscription(Empty, '/image', lambda _: seen.append(1), 10)
    for node in (camera, eye):
        executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: len(seen) > 180, 10.0)
    found = {(each.kind, each.callback): each
             for each in watch.drift(executor.statistics())}
    assert found['publishes', '/camera:grab'].topic == '/extra'
    assert found['never ran', '/eye:hear'].observed == 0
    many = found['rate', '/eye:see']
    assert many.declared is not None and many.observed is not None
    assert many.observed > 1.5 * many.declared
    found.pop(('rate', '/camera:grab'), None)  # of a busy machine
    assert len(found) == 3


def test_what_never_ran_and_is_probably_meant(
        make_executor: Callable[..., Any], make_node: Callable[..., Node]) -> None:
    """A namespace more, and a timer of another period; the nodes are gone when it is asked."""
    task_set = loads("""
mddag: 1
nodes:
  - node: /camera
    callbacks: [{name: grab, timer: 20ms, deadline: 20ms}]
  - node: /eye
    callbacks: [{name: see, subscription: /image, period: 30ms, deadline: 20ms}]
""")
    executor = make_executor(task_set, num_workers=2)
    watch = Watch(executor, task_set)
    camera, eye = make_node('camera'), make_node('eye', namespace='/robot')
    image = camera.create_publisher(Empty, '/robot/image', 10)
    seen: list[int] = []
    eye.create_subscription(Empty, 'image', lambda _: seen.append(1), 10)
    camera.create_timer(0.025, lambda: image.publish(Empty()))
    for node in (camera, eye):
        executor.add_node(node)
    with Spinning(executor):
        assert wait_for(lambda: len(seen) > 8, 10.0)
        for node in (camera, eye):
            executor.remove_node(node)
            node.destroy_node()
    texts = {each.callback: each.text for each in watch.drift(executor.statistics())}
    assert texts['/camera:grab'].endswith(': did you mean its timer of 25ms?')
    assert texts['/eye:see'].endswith(": did you mean the node '/robot/eye'?")

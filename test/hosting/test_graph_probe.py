# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Drafts of the system that runs now."""

import re

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.hosting.graph_probe import draft_of, Endpoints, Probe, probe, Seen
from msg_graph import loads
from msg_graph.draft import declaration_of, MARK
from std_msgs.msg import Empty, String

from ..executor.conftest import Spinning, wait_for

MS = 1_000_000


def test_lost_messages_of_one_publisher_are_known_by_their_numbers():
    seen = Seen()
    for number in (7, 8, 11):
        seen.message(number * 10 * MS, number)
    nodes = {name: Endpoints({'/t': 'std_msgs/msg/Empty'}) for name in ('/a', '/b')}
    found = Probe(nodes, {'/t': seen})
    assert found.interval_ns('/t') == 2 * 20 * MS   # which of the two has lost some is not known
    del nodes['/b']
    assert found.interval_ns('/t') == 10 * MS


def test_a_real_system(make_node, ros_context):
    """A camera at 50 Hz, what works on its images, and our own nodes, which are left out."""
    camera, worker = make_node('camera'), make_node('worker', namespace='/deep')
    watcher = make_node('watcher')
    images = camera.create_publisher(String, '/image', 10)
    camera.create_timer(0.02, lambda: images.publish(String()))
    worker.create_subscription(String, '/image', lambda _: None, 10)
    for topic in ('/result', '/never'):
        worker.create_publisher(Empty, topic, 10)
    executor = MultiDeadlineExecutor(diagnostics_period='100ms', context=ros_context)
    executor.add_node(camera)
    ticks = []
    with Spinning(executor):
        assert wait_for(lambda: [
            name for name in watcher.get_node_names() if 'mddag_diagnostics' in name])
        for seconds in (2.5, 10.0, 30.0):   # a busy machine discovers late
            ticks.clear()
            found = probe(seconds, ticks.append)
            if '/deep/worker' in found.nodes and found.interval_ns('/image'):
                break
    assert set(found.nodes) >= {'/camera', '/deep/worker'}
    assert not [name for name in found.nodes if 'mddag' in name]
    assert not [warning for warning in found.warnings if 'rate' in warning]
    assert found.nodes['/camera'].publishes == {'/image': 'std_msgs/msg/String'}
    interval = found.interval_ns('/image')
    assert interval is not None and interval > 15 * MS  # a busy machine may only be slower
    assert ticks and ticks == sorted(ticks)
    draft = draft_of(found)
    draft.nodes = [node for node in draft.nodes if node.name in ('/camera', '/deep/worker')]
    text = declaration_of(draft)
    assert f'{MARK}: is this a timer? Proposed: ' in text
    accepted = re.sub(rf'^( +)# (\w+: .*# {MARK})', r'\1\2', text, flags=re.MULTILINE)
    task_set = loads(accepted)
    assert task_set.callback('/camera:callback_0').publishes == ('/image',)
    worker = task_set.callback('/deep/worker:callback_0')
    assert worker.topics == ('/image',)
    assert worker.publishes == ('/never', '/result')

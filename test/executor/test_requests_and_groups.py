# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What requests inherit if a callback group is busy, or another executor has the service."""

import threading

from mddag_executor.sources.open import open_recording
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_msgs.msg import Empty

from .asking import Asking
from .inside import engine_of


def test_a_request_waits_for_its_callback_group_only(make_executor, make_node):
    """When the callback of its group that runs has ended, it goes before less urgent work."""
    may_end, has_begun, ends = threading.Event(), threading.Event(), threading.Event()

    def block(_):
        has_begun.set()
        assert may_end.wait(60.0)
        ends.set()

    def let_it_end():
        may_end.set()
        assert ends.wait(60.0)

    async def ask(each):
        publisher.publish(Empty())
        assert has_begun.wait(60.0)
        each.executor.create_task(let_it_end)
        Asking.begin_others(each)
        await each.request('ask')

    each = Asking(make_executor, make_node, ask, num_workers=2)
    each.begin_others = lambda: None
    publisher = each.node.create_publisher(Empty, '/block', 1)
    each.group = MutuallyExclusiveCallbackGroup()
    each.serving.create_subscription(Empty, '/block', block, 1, callback_group=each.group)
    each.serve('ask')
    assert 'ask' in each.run()[:3]


def test_requests_to_another_executor_are_answered_and_inherit_nothing(
        make_executor, make_node, spinning, tmp_path):
    """Both executors spin at the same time; each has its own work."""
    async def ask(each):
        for _ in range(20):
            await each.request('ask')

    path = tmp_path / 'run.mcap'
    each = Asking(make_executor, make_node, ask)
    each.executor.remove_node(each.serving)
    other = make_executor(None, num_workers=1, nodes=[each.serving], trace=str(path))
    each.serve('ask')
    with spinning(other):
        order = each.run(spinning)
    assert order.count('ask') == 20
    other.shutdown()
    assert not (open_recording(path).executions['inherited'] > 0).any()
    assert engine_of(other).sent_requests.is_empty()

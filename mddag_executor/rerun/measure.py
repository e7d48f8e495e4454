# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How fast a rerun is: nodes made from a declaration, whose callbacks do as little as they can."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.errors import UsageError
from mddag_executor.live.loading import Program
from mddag_executor.rerun.run import Rerun, Settings
from mddag_executor.rerun.sources import Source
from mddag_executor.rerun.times import SameInEachJob
from mddag_executor.simulate import draw_execution_times
from msg_graph import Callback, TaskSet
from rclpy.node import Node
from std_msgs.msg import Header

_DEPTH = 100


def measure(
    task_set: TaskSet, workers: int, duration_ns: int, seed: int, repeat: int
) -> dict[str, Any]:
    """
    Rerun the nodes of a declaration, from nothing but their timers.

    :return: the medians, and whether all runs had the same digest.
    :raises mddag_executor.errors.MddagError: where a source of the declaration is no timer.
    """
    for dag in task_set.dags:
        source = dag.vertices[dag.source].callback
        if source.kind != 'timer':
            raise UsageError(
                f'{task_set.file}: {source.key} is no timer: give a declaration whose sources are '
                'timers')
    times = draw_execution_times(task_set, seed, undeclared=0)
    runs = []
    for _ in range(repeat):
        source_of = Source(task_set.file, 0, duration_ns, None, SameInEachJob(times))
        run = Rerun(source_of, task_set, Settings(workers, seed=seed), keep=False)
        runs.append(run.run(lambda: [Program('declared', 'rerun', lambda: _nodes(task_set))]))
    elapsed, started = (
        sorted(getattr(each, name) for each in runs)[repeat // 2]
        for name in ('elapsed_s', 'started_s'))
    first = runs[0]
    return {
        'graph': task_set.file, 'workers': workers, 'virtual_s': first.virtual_ns / 1e9,
        'elapsed_s': elapsed, 'times_real_time': first.virtual_ns / 1e9 / elapsed,
        'callbacks': first.callbacks, 'messages': sum(first.counts.values()),
        'started_s': started,
        'us_per_callback': (elapsed - started) * 1e6 / max(1, first.callbacks),
        'digest': first.digest, 'same': len({each.digest for each in runs}) == 1}


def _nodes(task_set: TaskSet) -> list[Node]:
    """Make the declared nodes: each callback publishes a header with the stamp that it got."""
    nodes: dict[str, Node] = {}
    for callback in task_set.callbacks:
        node = nodes.get(callback.node)
        if node is None:
            namespace, _, name = callback.node.rpartition('/')
            node = nodes[callback.node] = Node(name, namespace=namespace or None)
        _add(node, callback)
    return list(nodes.values())


def _add(node: Node, callback: Callback) -> None:
    publishers = [node.create_publisher(Header, topic, _DEPTH) for topic in callback.publishes]

    def publish(message: Header) -> None:
        for publisher in publishers:
            publisher.publish(message)

    if callback.kind == 'timer':
        assert callback.timer_period_ns is not None
        node.create_timer(
            callback.timer_period_ns / 1e9,
            lambda: publish(Header(stamp=node.get_clock().now().to_msg())))
    elif len(callback.topics) == 1:
        node.create_subscription(Header, callback.topics[0], publish, _DEPTH)
    else:
        take = _joined(len(callback.topics), publish)
        for topic in callback.topics:
            node.create_subscription(Header, topic, take, _DEPTH)


def _joined(count: int, function: Callable[[Header], None]) -> Callable[[Header], None]:
    """Return what calls a function with every message that is the last one of its stamp."""
    waiting: dict[tuple[int, int], int] = {}

    def take(message: Header) -> None:
        stamp = message.stamp.sec, message.stamp.nanosec
        waiting[stamp] = waiting.get(stamp, 0) + 1
        if waiting[stamp] == count:
            del waiting[stamp]
            function(message)

    return take

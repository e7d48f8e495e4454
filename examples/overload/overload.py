# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A node that is too slow for its rate: its late jobs go behind, others keep their deadlines.

    python examples/overload/overload.py

It runs twice.  With a queue of ten images, the segmentation is always busy with one that is nearly
late, and few jobs are in time.  With a queue of one, it uses the newest, and every image that it
starts with has a result in time.  An executor cannot make a node faster.  But only one DAG misses
deadlines, all misses are counted, and what is dropped early costs nothing.
"""

from collections import Counter
from pathlib import Path
import time

from mddag_executor import DeadlineMiss, MultiDeadlineExecutor
import rclpy
from rclpy.node import Node
from std_msgs.msg import Header


def control() -> Node:
    node = Node('control')
    node.create_timer(0.05, lambda: time.sleep(0.005))
    return node


def camera() -> Node:
    node = Node('camera')
    publisher = node.create_publisher(Header, '/image', 10)
    node.create_timer(0.05, lambda: publisher.publish(Header()))
    return node


def stage(name: str, takes_s: float, topic: str, to: str | None, depth: int) -> Node:
    node = Node(name)
    publisher = node.create_publisher(Header, to, 10) if to else None

    def work(message: Header) -> None:
        time.sleep(takes_s)
        if publisher is not None:
            publisher.publish(message)

    node.create_subscription(Header, topic, work, depth)
    return node


def run(depth: int) -> None:
    """Run for two seconds, with at most ``depth`` images waiting."""
    reported: Counter[str] = Counter()

    def missed(miss: DeadlineMiss) -> None:
        reported[f'{miss.dag} {miss.kind}'] += 1

    executor = MultiDeadlineExecutor(
        str(Path(__file__).with_name('graph.yaml')), on_deadline_miss=missed)
    nodes = [control(), camera(), stage('segment', 0.07, '/image', '/segments', depth),
             stage('track', 0.02, '/segments', None, depth)]
    for node in nodes:
        executor.add_node(node)
    executor.spin_until_future_complete(rclpy.Future(), 2.0)
    executor.shutdown()
    for node in nodes:
        node.destroy_node()
    print(f'queue of {depth}:')
    for name, dag in executor.statistics()['dags'].items():
        ends = ', '.join(f'{count} {end}' for end, count in dag['ends'].items())
        print(f"  {name}: {dag['jobs']} jobs: {ends}")
    print('  misses:', ', '.join(f'{count} {what}' for what, count in sorted(reported.items())))


def main() -> None:
    rclpy.init()
    for depth in (10, 1):
        run(depth)
    rclpy.shutdown()


if __name__ == '__main__':
    main()

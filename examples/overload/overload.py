# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
A node that is too slow for its rate: late jobs are aborted, what matters keeps its deadline.

    python examples/overload/overload.py
"""

from collections import Counter
from pathlib import Path
import time

from mddag_executor import DeadlineMiss, MultiDeadlineExecutor
import rclpy
from rclpy.node import Node
from std_msgs.msg import Header

misses: Counter[tuple[str, str]] = Counter()


def missed(miss: DeadlineMiss) -> None:
    """Count a miss; this runs in a worker, so it has to be short."""
    misses[miss.dag, miss.kind] += 1


def control() -> Node:
    node = Node('control')
    node.create_timer(0.05, lambda: time.sleep(0.005))
    return node


def camera() -> Node:
    node = Node('camera')
    publisher = node.create_publisher(Header, '/image', 10)
    node.create_timer(0.05, lambda: publisher.publish(Header()))
    return node


def stage(name: str, takes_s: float, topic: str, to: str | None) -> Node:
    node = Node(name)
    publisher = node.create_publisher(Header, to, 10) if to else None

    def work(message: Header) -> None:
        time.sleep(takes_s)
        if publisher is not None:
            publisher.publish(message)

    node.create_subscription(Header, topic, work, 10)
    return node


def main() -> None:
    rclpy.init()
    executor = MultiDeadlineExecutor(
        str(Path(__file__).with_name('graph.yaml')), on_deadline_miss=missed)
    for node in (control(), camera(), stage('segment', 0.07, '/image', '/segments'),
                 stage('track', 0.02, '/segments', None)):
        executor.add_node(node)
    executor.spin_until_future_complete(rclpy.Future(), 3.0)
    executor.shutdown()
    for name, dag in executor.statistics()['dags'].items():
        ends = ', '.join(f'{count} {end}' for end, count in dag['ends'].items())
        print(f"{name}: {dag['jobs']} jobs: {ends}")
    for (dag, kind), count in sorted(misses.items()):
        print(f'told of {count} misses of {dag}: {kind}')


if __name__ == '__main__':
    main()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Eleven ordinary nodes: each sink takes times of its own, to compare them with the verdicts.

    python examples/ordinary_robot/robot.py

The detector publishes an alarm only when it sees a person, and needs 150 ms for every second one,
so that the brake is late.  A timer fires once, a button is pressed now and then, and the planner
only stores what the IMU measures.  The fusion combines each scan of the lidar with the next boxes,
which have another rate.  Two paths have requirements from end to end.
"""

from __future__ import annotations

from pathlib import Path
import time

from mddag_executor import MultiDeadlineExecutor
import rclpy
from rclpy.node import Node
from std_msgs.msg import Header

DURATION_S = 2.0
GRAPH = Path(__file__).with_name('graph.yaml')


class Part(Node):
    """A node that knows how long after the stamps of its messages its results were complete."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.responses_ms: dict[str, list[float]] = {}

    def stamped(self) -> Header:
        return Header(stamp=self.get_clock().now().to_msg())

    def done(self, callback: str, message: Header) -> None:
        stamp = message.stamp.sec * 10**9 + message.stamp.nanosec
        self.responses_ms.setdefault(callback, []).append(
            (self.get_clock().now().nanoseconds - stamp) / 1e6)


class Source(Part):
    """Publish at a fixed rate."""

    def __init__(self, name: str, period_s: float, topic: str) -> None:
        super().__init__(name)
        publisher = self.create_publisher(Header, topic, 10)
        self.create_timer(period_s, lambda: publisher.publish(self.stamped()))


class Detector(Part):
    """See a person in every third image."""

    def __init__(self) -> None:
        super().__init__('detector')
        self.images = 0
        self.boxes = self.create_publisher(Header, '/boxes', 10)
        self.alarm = self.create_publisher(Header, '/alarm', 10)
        self.create_subscription(Header, '/image', self.detect, 10)

    def detect(self, image: Header) -> None:
        self.images += 1
        time.sleep(0.15 if self.images % 6 == 0 else 0.005)
        self.boxes.publish(image)
        if self.images % 3 == 0:
            self.alarm.publish(image)


class Brake(Part):
    def __init__(self) -> None:
        super().__init__('brake')
        self.create_subscription(Header, '/alarm', lambda alarm: self.done('stop', alarm), 10)


class Mapper(Part):
    def __init__(self) -> None:
        super().__init__('mapper')
        self.map = self.create_publisher(Header, '/map', 10)
        self.create_subscription(Header, '/boxes', self.update, 10)

    def update(self, boxes: Header) -> None:
        self.map.publish(boxes)


class Planner(Part):
    """Plan with each map, and with the latest message of the IMU."""

    def __init__(self) -> None:
        super().__init__('planner')
        self.imu: Header | None = None
        self.create_subscription(Header, '/imu', self.keep_imu, 10)
        self.create_subscription(Header, '/map', self.plan, 10)

    def keep_imu(self, message: Header) -> None:
        self.imu = message

    def plan(self, message: Header) -> None:
        imu = self.imu
        self.done('plan', message)
        if imu is not None:
            self.done('imu', imu)   # how old it is


class Fusion(Part):
    """Combine each scan with the next boxes."""

    def __init__(self) -> None:
        super().__init__('fusion')
        self.points: Header | None = None
        self.objects = self.create_publisher(Header, '/objects', 10)
        self.create_subscription(Header, '/points', self.on_points, 10)
        self.create_subscription(Header, '/boxes', self.on_boxes, 10)

    def on_points(self, points: Header) -> None:
        self.points = points

    def on_boxes(self, boxes: Header) -> None:
        if self.points is not None:
            self.objects.publish(self.points)
            self.points = None


class Tracker(Part):
    def __init__(self) -> None:
        super().__init__('tracker')
        self.create_subscription(
            Header, '/objects', lambda points: self.done('track', points), 10)


class Bringup(Part):
    def __init__(self) -> None:
        super().__init__('bringup')
        self.ready = self.create_publisher(Header, '/ready', 10)
        self.timer = self.create_timer(0.2, self.start)

    def start(self) -> None:
        self.timer.cancel()
        self.ready.publish(self.stamped())


class Panel(Part):
    def __init__(self) -> None:
        super().__init__('panel')
        self.create_subscription(Header, '/ready', lambda ready: self.done('lamp', ready), 10)
        self.create_subscription(Header, '/button', lambda push: self.done('pressed', push), 10)


def main() -> None:
    rclpy.init()
    parts = [Source('camera', 0.1, '/image'), Detector(), Brake(), Mapper(),
             Source('imu', 0.02, '/imu'), Planner(), Source('lidar', 0.3, '/points'), Fusion(),
             Tracker(), Bringup(), Panel()]
    user = Source('user', 0.7, '/button')   # not declared: a person
    executor = MultiDeadlineExecutor(str(GRAPH))
    for node in [*parts, user]:
        executor.add_node(node)
    executor.spin_until_future_complete(rclpy.Future(), DURATION_S)
    executor.shutdown()
    responses = {f'{part.get_fully_qualified_name()}:{callback}': times
                 for part in parts for callback, times in part.responses_ms.items()}
    for dag in executor.statistics()['dags'].values():
        for name, sink in dag['sinks'].items():
            deadline_ms = sink['relative_deadline_ns'] / 1e6
            times = responses.get(name, [])
            print(f'{name}: itself {len(times)} results, '
                  f'{sum(t > deadline_ms for t in times)} late; judged {sink["completed"]} '
                  f'results, {sink["late"]} late, {sink.get("not_due", 0)} not due, '
                  f'{sink["expired"]} expired in {dag["jobs"]} jobs')
    required = executor.statistics()['requirements']
    age, ages = required['imu_to_plan']['age'], responses['/planner:imu']
    print(f'imu_to_plan: itself {len(ages)} outputs, the oldest {max(ages):.0f} ms; judged '
          f'{age["completed"]} outputs, the oldest {age["response_ns"]["max"] / 1e6:.0f} ms')
    reaction = required['image_to_brake']['reaction']
    print(f'image_to_brake: judged {reaction["completed"]} reactions, {reaction["not_due"]} not '
          'due')


if __name__ == '__main__':
    main()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Sensor, filter and control; every message passes the stamp of the sensor's reading on."""

import time

import rclpy
from rclpy.node import Node
from std_msgs.msg import Header


class Sensor(Node):
    """Stamp a reading; everything after it is measured from that time."""

    def __init__(self) -> None:
        super().__init__('sensor')
        self._raw = self.create_publisher(Header, '/raw', 10)
        self.create_timer(0.05, self.read)

    def read(self) -> None:
        self._raw.publish(Header(stamp=self.get_clock().now().to_msg()))


class Filter(Node):
    """Pass the stamp on, as nodes do in ROS."""

    def __init__(self) -> None:
        super().__init__('filter')
        self._clean = self.create_publisher(Header, '/clean', 10)
        self.create_subscription(Header, '/raw', self.clean, 10)

    def clean(self, reading: Header) -> None:
        self._clean.publish(Header(stamp=reading.stamp, frame_id='filtered'))


class Control(Node):
    """The sink, which runs in the other process."""

    def __init__(self) -> None:
        super().__init__('control')
        subscription = self.create_subscription(Header, '/clean', self.step, 10)
        # The run begins when its nodes are there: this one waits for the other process.
        for _ in range(600):
            if subscription.get_publisher_count() or not rclpy.ok():
                break
            time.sleep(0.05)

    def step(self, reading: Header) -> None:
        pass

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

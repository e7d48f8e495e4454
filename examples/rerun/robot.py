# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Three nodes of a robot; nothing in them knows of this program."""

import random

from rclpy.node import Node
from std_msgs.msg import Bool, Float64

GAIN = 0.3


class Lidar(Node):

    def __init__(self):
        super().__init__('lidar')
        self.publisher = self.create_publisher(Float64, '/distance', 10)
        self.distance = 50.0
        self.create_timer(0.1, self.measure)

    def measure(self):
        self.distance -= 0.5
        self.publisher.publish(Float64(data=self.distance + random.gauss(0.0, 0.5)))


class Tracker(Node):

    def __init__(self):
        super().__init__('tracker')
        self.publisher = self.create_publisher(Float64, '/track', 10)
        self.create_subscription(Float64, '/distance', self.track, 10)
        self.distance = None

    def track(self, message):
        if self.distance is None:
            self.distance = message.data
        self.distance += GAIN * (message.data - self.distance)
        self.publisher.publish(Float64(data=self.distance))


class Brake(Node):

    def __init__(self):
        super().__init__('brake')
        self.publisher = self.create_publisher(Bool, '/brake', 10)
        self.create_subscription(Float64, '/track', self.decide, 10)

    def decide(self, message):
        self.publisher.publish(Bool(data=message.data < 20.0))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""An ordinary node; it knows nothing of this executor."""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String


class Talker(Node):

    def __init__(self):
        super().__init__('talker')
        self.publisher = self.create_publisher(String, 'chatter', 10)
        self.create_timer(0.1, self.tick)
        self.count = 0

    def tick(self):
        self.count += 1
        self.publisher.publish(String(data=f'hello {self.count}'))


def main():
    rclpy.init()
    node = Talker()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()

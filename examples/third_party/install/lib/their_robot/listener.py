# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Another one, with an executor of its own choice."""

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String


class Listener(Node):

    def __init__(self):
        super().__init__('listener')
        self.create_subscription(String, 'chatter', self.heard, 10)
        self.count = 0

    def heard(self, message):
        self.count += 1


def main():
    rclpy.init()
    node = Listener()
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        print(f'heard {node.count} messages')
        executor.shutdown()


if __name__ == '__main__':
    main()

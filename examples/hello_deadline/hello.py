# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Two nodes and a deadline; ends after thirty images.

    python examples/hello_deadline/hello.py
"""

from pathlib import Path

from mddag_executor import MultiDeadlineExecutor
import rclpy
from std_msgs.msg import Header

rclpy.init()
camera, detector = rclpy.create_node('camera'), rclpy.create_node('detector')
image = camera.create_publisher(Header, '/image', 10)
enough = rclpy.Future()
seen = []


def capture():
    image.publish(Header(stamp=camera.get_clock().now().to_msg()))


def detect(message):
    seen.append(message)
    if len(seen) == 30:
        enough.set_result(True)


camera.create_timer(0.05, capture)
detector.create_subscription(Header, '/image', detect, 10)
executor = MultiDeadlineExecutor(str(Path(__file__).with_name('graph.yaml')))
executor.add_node(camera)
executor.add_node(detector)
executor.spin_until_future_complete(enough, 20.0)
executor.shutdown()
sink = executor.statistics()['dags']['vision']['sinks']['/detector:detect']
print(f"{sink['completed']} images, {sink['late']} later than 40 ms")

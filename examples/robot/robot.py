# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A robot of ordinary nodes, which mix numpy and Python as nodes do.

    python examples/robot/robot.py --seconds 5
    python -m benchmarks live --load robot

The camera's images go through a detector to a brake.  The lidar's points are segmented, fused
with the detections that are closest in time, and planned around; a controller follows the path at
50 Hz.  An operator changes a parameter of the detector now and then, with a service call in a
callback.  No node knows of an executor: `make_nodes` returns them, and the node at the end
of a chain keeps a log of stamps.
"""

import argparse
from array import array
from collections import deque
import math
from pathlib import Path

from geometry_msgs.msg import Pose, PoseArray, PoseStamped, Twist
from mddag_executor import MultiDeadlineExecutor
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
import numpy as np
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header

HEIGHT, WIDTH, CELL = 480, 640, 16
MS = 1_000_000


class Sensor:
    """Something that samples at an exact rate, whenever it is read: its stamps are a grid."""

    def __init__(self, node: Node, period_ms: int) -> None:
        self._clock = node.get_clock()
        self._period = period_ms * MS
        self._start = self._clock.now().nanoseconds

    def stamp(self) -> Time:
        """Return when the newest sample was taken."""
        passed = self._clock.now().nanoseconds - self._start
        return Time(nanoseconds=self._start + passed // self._period * self._period)


class Logging(Node):
    """A node with a log: when what it used was sampled, and when it was done (ns)."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.log: dict[str, list[tuple[int, int]]] = {}

    def done(self, callback: str, stamp: Time | Header) -> None:
        sampled = Time.from_msg(stamp.stamp) if isinstance(stamp, Header) else stamp
        self.log.setdefault(callback, []).append(
            (sampled.nanoseconds, self.get_clock().now().nanoseconds))


class Camera(Node):
    """Publish an image of bright things that move, 30 times a second."""

    def __init__(self, scale: float) -> None:
        super().__init__('camera')
        self._noise = np.random.default_rng(1).integers(0, 30, (8, HEIGHT, WIDTH), np.uint8)
        self._frame = 0
        self._images = self.create_publisher(Image, '/image', 10)
        self._sensor = Sensor(self, 33)
        self.create_timer(0.033, self.capture)

    def capture(self) -> None:
        self._frame += 1
        picture = self._noise[self._frame % 8].copy()
        for i in range(5):  # five bright things, which move
            row, column = (37 * i + self._frame) % (HEIGHT - 20), (61 * i) % (WIDTH - 20)
            picture[row:row + 16, column:column + 16] = 255
        image = Image(height=HEIGHT, width=WIDTH, encoding='mono8', step=WIDTH)
        image.header.stamp = self._sensor.stamp().to_msg()
        image.data = array('B', picture.tobytes())
        self._images.publish(image)


class Detector(Node):
    """Find bright things: edges by numpy, then boxes in Python."""

    def __init__(self, scale: float) -> None:
        super().__init__('detector')
        self._passes = max(1, round(2 * scale))
        self._rounds = max(1, round(10 * scale))
        self.declare_parameter('threshold', 40.0)
        self._detections = self.create_publisher(PoseArray, '/detections', 10)
        self.create_subscription(Image, '/image', self.detect, 10)

    def detect(self, image: Image) -> None:
        pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
        smooth = pixels.astype(np.float32)
        for _ in range(self._passes):
            down, right = np.gradient(smooth)
            smooth = 0.5 * smooth + np.hypot(down, right)
        cells = smooth.reshape(HEIGHT // CELL, CELL, WIDTH // CELL, CELL).mean((1, 3))
        threshold = self.get_parameter('threshold').value
        found = PoseArray(header=image.header)
        for _ in range(self._rounds):
            found.poses = self._boxes(cells.tolist(), threshold)
        self._detections.publish(found)

    def _boxes(self, cells: list[list[float]], threshold: float) -> list[Pose]:
        """Return the middles of cells that belong together."""
        left = {(r, c) for r, row in enumerate(cells) for c, value in enumerate(row)
                if value > threshold}
        poses = []
        while left:
            todo, box = [left.pop()], []
            while todo:
                r, c = todo.pop()
                box.append((r, c))
                for near in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
                    if near in left:
                        left.remove(near)
                        todo.append(near)
            pose = Pose()
            pose.position.x = sum(c for _, c in box) / len(box)
            pose.position.y = sum(r for r, _ in box) / len(box)
            poses.append(pose)
        return poses[:20]


class Brake(Logging):
    """Look whether anything is near."""

    def __init__(self, scale: float) -> None:
        super().__init__('brake')
        self.create_subscription(PoseArray, '/detections', self.check, 10)

    def check(self, detections: PoseArray) -> None:
        near = [p for p in detections.poses if math.hypot(p.position.x, p.position.y) < 3]
        self.stop = bool(near)
        self.done('check', detections.header)


class Lidar(Node):
    """Publish a cloud of points, ten times a second."""

    def __init__(self, scale: float) -> None:
        super().__init__('lidar')
        self._draw = np.random.default_rng(2)
        self._points = self.create_publisher(PointCloud2, '/points', 10)
        self._sensor = Sensor(self, 100)
        self.create_timer(0.1, self.scan)

    def scan(self) -> None:
        angles = np.linspace(0, 2 * math.pi, 8000, dtype=np.float32)
        ranges = 10 + 2 * np.sin(7 * angles) + self._draw.normal(0, 0.05, 8000)
        height = self._draw.normal(0, 0.5, 8000)
        points = np.stack(
            (ranges * np.cos(angles), ranges * np.sin(angles), height), 1).astype(np.float32)
        cloud = PointCloud2(height=1, width=len(points), point_step=12, row_step=12 * len(points))
        cloud.fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
                        for i, name in enumerate('xyz')]
        cloud.header.stamp = self._sensor.stamp().to_msg()
        cloud.data = array('B', points.tobytes())
        self._points.publish(cloud)


class Segmentation(Node):
    """Leave out the ground by numpy, and cluster the rest in Python."""

    def __init__(self, scale: float) -> None:
        super().__init__('segmentation')
        self._passes = max(1, round(10 * scale))
        self._obstacles = self.create_publisher(PoseArray, '/obstacles', 10)
        self.create_subscription(PointCloud2, '/points', self.segment, 10)

    def segment(self, cloud: PointCloud2) -> None:
        points = np.frombuffer(cloud.data, np.float32).reshape(-1, 3)
        for _ in range(self._passes):
            _, axes = np.linalg.eigh(np.cov(points[np.abs(points[:, 2]) < 0.3].T))
            above = points[np.abs(points @ axes[:, 0]) > 0.2]
        clusters: dict[tuple[int, int], list[float]] = {}
        for x, y, z in above.tolist():
            clusters.setdefault((int(x), int(y)), []).append(z)
        found = PoseArray(header=cloud.header)
        for (x, y), heights in clusters.items():
            if len(heights) > 10:
                pose = Pose()
                pose.position.x, pose.position.y = float(x), float(y)
                pose.position.z = sum(heights) / len(heights)
                found.poses.append(pose)
        self._obstacles.publish(found)


class Fusion(Logging):
    """Join obstacles with the detections that are closest in time, as an approximate sync does."""

    def __init__(self, scale: float) -> None:
        super().__init__('fusion')
        self._scale = scale
        self._lately: deque[PoseArray] = deque(maxlen=10)
        self._objects = self.create_publisher(PoseArray, '/objects', 10)
        self.create_subscription(PoseArray, '/detections', self.keep, 10)
        self.create_subscription(PoseArray, '/obstacles', self.fuse, 10)

    def keep(self, detections: PoseArray) -> None:
        self._lately.append(detections)
        self.done('keep', detections.header)

    def fuse(self, obstacles: PoseArray) -> None:
        stamp = Time.from_msg(obstacles.header.stamp).nanoseconds
        detections = min(list(self._lately), default=PoseArray(), key=lambda each: abs(
            Time.from_msg(each.header.stamp).nanoseconds - stamp))
        objects = PoseArray(header=obstacles.header)
        for obstacle in obstacles.poses[:round(60 * self._scale)]:
            at = obstacle.position
            closest = min((math.hypot(at.x - p.position.x / 10, at.y - p.position.y / 10)
                           for p in detections.poses), default=math.inf)
            obstacle.position.z = min(closest, 10.0)
            objects.poses.append(obstacle)
        self._objects.publish(objects)


class Planner(Logging):
    """Plan around objects: steps on a grid, in Python, from where the robot is."""

    def __init__(self, scale: float) -> None:
        super().__init__('planner')
        self._rounds = max(1, round(12 * scale))
        self._at = (0.0, 0.0)
        self._path = self.create_publisher(PathMessage, '/path', 10)
        self.create_subscription(Odometry, '/odom', self.locate, 10)
        self.create_subscription(PoseArray, '/objects', self.plan, 10)

    def locate(self, odometry: Odometry) -> None:
        position = odometry.pose.pose.position
        self._at = (position.x, position.y)
        self.done('locate', odometry.header)

    def plan(self, objects: PoseArray) -> None:
        blocked = {(round(p.position.x), round(p.position.y)) for p in objects.poses}
        for _ in range(self._rounds):
            steps = self._steps(blocked, (round(self._at[0]) % 20, round(self._at[1]) % 20))
        path = PathMessage(header=objects.header)
        for x, y in steps[:20]:
            pose = PoseStamped(header=objects.header)
            pose.pose.position.x, pose.pose.position.y = float(x), float(y)
            path.poses.append(pose)
        self._path.publish(path)

    def _steps(
        self, blocked: set[tuple[int, int]], start: tuple[int, int]
    ) -> list[tuple[int, int]]:
        """Return the cells that are reached first, breadth first."""
        seen, todo = {start}, deque([start])
        while todo and len(seen) < 1200:
            x, y = todo.popleft()
            for near in ((x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)):
                if near not in seen and near not in blocked:
                    seen.add(near)
                    todo.append(near)
        return sorted(seen)


class OdometryNode(Node):
    """Publish where the robot is, 50 times a second."""

    def __init__(self, scale: float) -> None:
        super().__init__('odometry')
        self._odometry = self.create_publisher(Odometry, '/odom', 10)
        self._sensor = Sensor(self, 20)
        self._angle = 0.0
        self.create_timer(0.02, self.integrate)

    def integrate(self) -> None:
        self._angle += 0.001
        message = Odometry()
        message.header.stamp = self._sensor.stamp().to_msg()
        message.pose.pose.position.x = 5 * math.cos(self._angle)
        message.pose.pose.position.y = 5 * math.sin(self._angle)
        self._odometry.publish(message)


class Controller(Logging):
    """Follow the newest path from the newest position, at 50 Hz."""

    def __init__(self, scale: float) -> None:
        super().__init__('controller')
        self._rounds = max(1, round(40 * scale))
        self._path: list[tuple[float, float]] = [(1.0, 0.0)]
        self._at = (0.0, 0.0)
        self._commands = self.create_publisher(Twist, '/cmd_vel', 10)
        self.create_subscription(Odometry, '/odom', self.locate, 10)
        self.create_subscription(PathMessage, '/path', self.follow, 10)
        self._sensor = Sensor(self, 20)
        self.create_timer(0.02, self.control)

    def locate(self, odometry: Odometry) -> None:
        position = odometry.pose.pose.position
        self._at = (position.x, position.y)
        self.done('locate', odometry.header)

    def follow(self, path: PathMessage) -> None:
        self._path = [(p.pose.position.x, p.pose.position.y) for p in path.poses]
        self.done('follow', path.header)

    def control(self) -> None:
        stamp = self._sensor.stamp()
        x, y = self._at
        for _ in range(self._rounds):
            _, angle = min(
                (math.hypot(px - x, py - y), math.atan2(py - y, px - x)) for px, py in self._path)
        command = Twist()
        command.linear.x, command.angular.z = 1.0, angle
        self._commands.publish(command)
        self.done('control', stamp)


class Operator(Logging):
    """Change the detector's threshold, twice a second: a service call inside of a callback."""

    def __init__(self, scale: float) -> None:
        super().__init__('operator')
        self._client = self.create_client(
            SetParameters, '/detector/set_parameters', callback_group=ReentrantCallbackGroup())
        self._sensor = Sensor(self, 500)
        self._turn = 0
        self.create_timer(0.5, self.adjust)

    async def adjust(self) -> None:
        if not self._client.service_is_ready():
            return
        stamp = self._sensor.stamp()
        self._turn += 1
        value = ParameterValue(
            type=ParameterType.PARAMETER_DOUBLE, double_value=40.0 + self._turn % 2)
        await self._client.call_async(SetParameters.Request(
            parameters=[ParameterMessage(name='threshold', value=value)]))
        self.done('adjust', stamp)


NODES = (Camera, Detector, Brake, Lidar, Segmentation, Fusion, Planner, OdometryNode, Controller,
         Operator)


def make_nodes(scale: float = 1.0) -> list[Node]:
    """Make the nodes; with a scale of 2 they compute about twice as much."""
    return [node(scale) for node in NODES]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    arguments.add_argument('--seconds', type=float, default=5.0)
    arguments.add_argument('--scale', type=float, default=1.0, help='of what the nodes compute')
    given = arguments.parse_args()
    rclpy.init()
    executor = MultiDeadlineExecutor(str(Path(__file__).with_name('graph.yaml')))
    nodes = make_nodes(given.scale)
    for node in nodes:
        executor.add_node(node)
    executor.spin_until_future_complete(rclpy.Future(), given.seconds)
    executor.shutdown()
    statistics = executor.statistics()
    for node in nodes:
        for callback, log in getattr(node, 'log', {}).items():
            ages = sorted(done - sampled for sampled, done in log)
            middle = ages[len(ages) // 2] / MS
            print(f'{node.get_name()}:{callback}: {len(log)} times, half of them within '
                  f'{middle:.1f} ms of the sensor')
    print('computing in Python:', ', '.join(sorted(
        name for name, count in statistics['callbacks'].items() if count['holds_interpreter'])))
    rclpy.shutdown()


if __name__ == '__main__':
    main()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A pipeline that really computes: numpy's functions run without the interpreter lock.

    python examples/numpy_pipeline/pipeline.py

It runs the same eight images with one worker and with two, and prints how much of the computing
went on at the same time.  Every tile goes to a node of its own, so that they may overlap; what is
computed is checked against the same outside of any executor.
"""

from pathlib import Path
import threading
import time

from mddag_executor import MultiDeadlineExecutor
import numpy as np
import rclpy
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray, Float64

IMAGES, TILES, SIDE = 8, 4, 256
ROUNDS = 8  # of the filter, for each tile: about 20 ms
PICTURES = np.random.default_rng(1).random((IMAGES, TILES, SIDE, SIDE), dtype=np.float32)


def filtered(tile: np.ndarray) -> float:
    """Find edges, again and again; return the mean of what comes out."""
    for _ in range(ROUNDS):
        down, right = np.gradient(tile)
        # Each of these computes 65,536 values without the interpreter lock.
        tile = np.hypot(down, right) * np.cos(np.arctan2(down, right))
    return float(tile.mean())


class Meter:
    """How long the filters ran all together, and how long any of them did."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running = 0
        self._since = 0.0
        self.busy = self.any = 0.0
        self.most = 0

    def __enter__(self) -> 'Meter':
        self._step(1)
        return self

    def __exit__(self, *error: object) -> None:
        self._step(-1)

    def _step(self, change: int) -> None:
        with self._lock:
            now = time.perf_counter()
            self.busy += self._running * (now - self._since)
            self.any += (now - self._since) if self._running else 0.0
            self._running += change
            self._since = now
            self.most = max(self.most, self._running)


class Camera(Node):
    """Publish an image in tiles, every 250 ms."""

    def __init__(self) -> None:
        super().__init__('camera')
        self._tiles = [
            self.create_publisher(Float32MultiArray, f'/tile_{i}', 10) for i in range(TILES)]
        self._images = iter(PICTURES)
        self.create_timer(0.25, self.capture)

    def capture(self) -> None:
        for publisher, tile in zip(self._tiles, next(self._images, ())):
            publisher.publish(Float32MultiArray(data=tile.ravel()))


class Filter(Node):
    """Filter one tile of each image."""

    def __init__(self, index: int, meter: Meter) -> None:
        super().__init__(f'filter_{index}')
        self._meter = meter
        self._spectrum = self.create_publisher(Float64, f'/spectrum_{index}', 10)
        self.create_subscription(Float32MultiArray, f'/tile_{index}', self.on_tile, 10)

    def on_tile(self, message: Float32MultiArray) -> None:
        tile = np.asarray(message.data, dtype=np.float32).reshape(SIDE, SIDE)
        with self._meter:
            mean = filtered(tile)
        self._spectrum.publish(Float64(data=mean))


class Join(Node):
    """Add the tiles' results up; one subscription for each, and one callback for all of them."""

    def __init__(self) -> None:
        super().__init__('join')
        self.done = rclpy.Future()
        self.sums: list[float] = []
        self._waiting: list[list[float]] = [[] for _ in range(TILES)]
        for i in range(TILES):
            self.create_subscription(
                Float64, f'/spectrum_{i}', lambda message, i=i: self.join(i, message.data), 10)

    def join(self, index: int, value: float) -> None:
        self._waiting[index].append(value)
        if all(self._waiting):
            self.sums.append(sum(values.pop(0) for values in self._waiting))
            if len(self.sums) == IMAGES:
                self.done.set_result(True)


def run(workers: int) -> list[float]:
    """Run all images on some workers; print what happened and return the sums."""
    context = rclpy.get_default_context()
    meter, join = Meter(), Join()
    nodes = [Camera(), join, *(Filter(i, meter) for i in range(TILES))]
    executor = MultiDeadlineExecutor(
        str(Path(__file__).with_name('graph.yaml')), num_workers=workers, context=context)
    for node in nodes:
        executor.add_node(node)
    executor.spin_until_future_complete(join.done, 30.0)
    executor.shutdown()
    for node in nodes:
        node.destroy_node()
    sink = executor.statistics()['dags']['image']['sinks']['/join:join']
    print(f"{workers} workers: {sink['completed']} images, {sink['late']} late; at most "
          f'{meter.most} filters at once, {meter.busy / meter.any:.2f} on average', flush=True)
    return join.sums


def main() -> None:
    rclpy.init()
    expected = [sum(filtered(tile) for tile in image) for image in PICTURES]
    for workers in (1, 2):
        sums = run(workers)
        right = len(sums) == IMAGES and np.allclose(sums, expected)
        print(f"the results are {'right' if right else 'WRONG'}", flush=True)
    rclpy.shutdown()


if __name__ == '__main__':
    main()

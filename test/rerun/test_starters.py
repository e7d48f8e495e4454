# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What threads, pools and tasks publish for a callback belongs to its job, as in a live run."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
import threading

from mddag_executor import replay
from mddag_executor.rerun import rerun
from msg_graph import loads
import pytest
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import Header

from .helpers import write_bag

GRAPH = """\
mddag: 1
workers: 2
nodes:
  - node: /camera
    callbacks:
      - {name: grab, timer: 100ms, publishes: [/image]}
  - node: /detector
    callbacks:
      - {name: detect, subscription: /image, may_publish: [/alarm], execution_time: 10ms}
  - node: /brake
    callbacks:
      - {name: stop, subscription: /alarm, execution_time: 5ms, deadline: 90ms}
"""


class Camera(Node):
    """Publishes numbered images."""

    def __init__(self):
        super().__init__('camera')
        self.count = 0
        self.publisher = self.create_publisher(Header, '/image', 10)
        self.create_timer(0.1, self.grab)

    def grab(self):
        self.publisher.publish(Header(frame_id=str(self.count)))
        self.count += 1


class Detector(Node):
    """Has an alarm published for every second image, in one of several ways."""

    def __init__(self, publish):
        super().__init__('detector')
        self.alarms = self.create_publisher(Header, '/alarm', 10)
        self.pool = ThreadPoolExecutor(1)
        self.pool.submit(int).result()      # its thread was there before
        self.create_subscription(Header, '/image', partial(self.detect, publish), 10)

    def detect(self, publish, message):
        if int(message.frame_id) % 2:
            publish(self, message)

    def alarm(self, message):
        self.alarms.publish(message)


class Brake(Node):
    """Stops."""

    def __init__(self):
        super().__init__('brake')
        self.create_subscription(Header, '/alarm', lambda message: None, 10)


def thread(node, message):
    threading.Thread(target=node.alarm, args=(message,)).start()


def joined(node, message):
    each = threading.Thread(target=node.alarm, args=(message,))
    each.start()
    each.join()


def pool(node, message):
    node.pool.submit(node.alarm, message)


def pool_that_is_waited_for(node, message):
    node.pool.submit(node.alarm, message).result()


def task(node, message):
    node.executor.create_task(node.alarm, message)


def timer(node, message):
    threading.Timer(0.005, node.alarm, (message,)).start()


def late_timer(node, message):
    threading.Timer(0.05, node.alarm, (message,)).start()


@pytest.mark.parametrize(('publish', 'belongs'), [
    (thread, True), (joined, True), (pool, True), (pool_that_is_waited_for, True), (task, True),
    (timer, True), (late_timer, False)])
def test_what_a_callback_has_started_publishes_for_it_until_it_ends(tmp_path, publish, belongs):
    bag = write_bag(tmp_path / 'bag.mcap', [(ms, '/other', Header()) for ms in range(0, 1000, 50)])
    trace = str(tmp_path / 'out.mcap')
    result = rerun(bag, loads(GRAPH), [Camera, partial(Detector, publish), Brake], trace=trace)
    assert result.counts['/alarm'] >= 4
    again = replay(trace)
    for verdicts in (result.result(), again.result()):
        sink = verdicts['dags']['/camera']['sinks']['/brake:stop']
        assert (sink['completed'] == result.counts['/alarm']) == belongs
        assert (sink['completed'] == 0) == (not belongs)
        assert (sink['late'], sink['expired']) == (0, 0)
    warned = [line for line in result.warnings if '/alarm' in line]
    assert bool(warned) == (not belongs), result.warnings
    outside = [each for each in again.drift() if each.kind == 'published outside']
    assert [each.topic for each in outside] == ['/alarm'] * (not belongs)
    same = rerun(bag, loads(GRAPH), [Camera, partial(Detector, publish), Brake])
    assert same.digest == result.digest


def test_what_a_thread_starts_later_is_not_of_the_callback_that_waits(tmp_path):
    """While a callback waits, another thread runs the callbacks, and starts threads for them."""
    def waits(node, message):
        each = threading.Thread(target=node.get_clock().sleep_for, args=(node.a_while,))
        each.start()
        each.join()

    class Waiting(Detector):
        def __init__(self):
            super().__init__(waits)
            self.a_while = Duration(seconds=0.03)

    class Other(Node):
        """An undeclared node that lets threads publish while the detector waits."""

        def __init__(self):
            super().__init__('other')
            self.alarms = self.create_publisher(Header, '/alarm', 10)
            self.create_timer(0.035, lambda: threading.Thread(
                target=self.alarms.publish, args=(Header(),)).start())

    bag = write_bag(tmp_path / 'bag.mcap', [(ms, '/other', Header()) for ms in range(0, 1000, 50)])
    result = rerun(bag, loads(GRAPH), [Camera, Waiting, Brake, Other])
    assert result.counts['/alarm'] > 20
    assert result.result()['dags']['/camera']['sinks']['/brake:stop']['completed'] == 0

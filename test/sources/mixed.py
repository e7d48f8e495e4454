# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A robot of which LTTng recorded one process, and this executor another one.

Each 100 ms, /camera publishes an image 2 ms after its timer was due, /detect (a process of this
executor) receives it at 3.5 ms and computes from 4 to 10 ms, and /plan (of the first process)
from 11 to 15 ms.
"""

from mddag_executor.trace import TraceFile

from .recorded import BEGIN, MS, Recorded, US

GRAB, DETECT, PLAN = 11, 12, 13
IMAGE, BOXES = 100, 101
WORD = 'mddag: 1\nnodes:\n'
DETECTOR = ('  - {node: /detect, callbacks: [{name: detect, subscription: /image, '
            'publishes: [/boxes]}]}\n')
GRAPH = WORD + """\
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image]}]}
""" + DETECTOR + """\
  - {node: /plan, callbacks: [{name: plan, subscription: /boxes, deadline: 20ms}]}
paths:
  - {name: seen, callbacks: ['/camera:grab', '/detect:detect', '/plan:plan'], reaction: 120ms}
"""
OWN_GRAPH = WORD + DETECTOR.replace('/image,', '/image, period: 100ms,').replace(
    'publishes: [/boxes]', 'deadline: 20ms')
N = 10
OFFSET = 1_700_000_000_000_000_000


class Own:
    """
    The trace of a process of this executor; times are ns since `BEGIN` by LTTng's clock.

    :param ahead: how far its clock is ahead of LTTng's.
    :param boot: of its computer; that of LTTng's is `boot`.
    :param but: the place of an event that is lost.
    """

    def __init__(self, path, graph='', ahead=0, pid=2, boot='boot', begin=0, but=-1):
        self.path, self.ahead, self.pid = str(path), ahead, pid
        self.boot, self.but, self.names = boot, but, []
        self.file = TraceFile(self.path, overwrite=True)
        self.add('task_set', begin, graph, 'own.yaml' if graph else '', 'rad', 2, 100 * MS, 64,
                 False, 2, 0)
        self.add('caret_init', begin, OFFSET + ahead, 'jazzy')
        self.add('host', begin, 'robot', boot)
        self.begin, self.job = begin, 0

    def at(self, time):
        return BEGIN + time + self.ahead

    def add(self, name, time, *fields, tid=7):
        if len(self.names) != self.but:
            self.file.add(name, self.at(time), self.pid, tid, *fields)
        self.names.append(name)

    def node(self, name):
        namespace, _, short = name.rpartition('/')
        self.add('rcl_node_init', self.begin, 1, 1, short, namespace or '/')

    def publisher(self, handle, topic):
        self.add('rcl_publisher_init', self.begin, handle, 1, handle, topic, 10)

    def subscription(self, callback, topic):
        self.add('rcl_subscription_init', self.begin, callback + 10, 1, callback + 10, topic, 10)
        self.add('rclcpp_subscription_init', self.begin, callback + 10, callback + 10)
        self.add('rclcpp_subscription_callback_added', self.begin, callback + 10, callback)

    def timer(self, callback, period):
        self.add('rcl_timer_init', self.begin, callback + 10, period)
        self.add('rclcpp_timer_callback_added', self.begin, callback + 10, callback)
        self.add('rclcpp_timer_link_node', self.begin, callback + 10, 1)

    def take(self, callback, time, stamp, number=0):
        """Take a message of LTTng's computer; the system clock of that has its stamp."""
        self.add('rmw_take', time, callback + 10, 0,
                 self.at(stamp) if self.boot == 'boot' else BEGIN + stamp, True, number)

    def run(self, callback, ready, start, end, tid=7, declared=False, fails=False, release=None):
        ids = (0, 0, self.job) if declared else (-1, -1, -1)
        self.job += declared
        if declared:
            self.add('job_release', ready, 0, ids[2],
                     self.at(ready if release is None else release))
        self.add('dispatch', start, callback, *ids, 0, self.at(ready), 0, 0,
                 *((-1, False) if declared else (5 * MS, True)), tid=tid)
        self.add('callback_start', start, callback, False, tid=tid)
        self.add('callback_end', end, callback, tid=tid)
        if fails:
            self.add('fail', end, 0, 0, ids[2], tid=tid)
        if declared:
            self.add('complete', end, callback, *ids, True, self.at(end), 0, 5 * MS, True, tid=tid)

    def publish(self, handle, time, tid=7):
        self.add('rclcpp_publish', time, handle, 1, 0, tid=tid)

    def end(self, time):
        if time is not None:
            self.add('shutdown', time, self.at(time))
        self.file.finish()
        return self.path


def detector(path, n=N, declared=False, fails=(), end=(N + 1) * 100 * MS, first=1, **more):
    """Write the trace of /detect, which publishes boxes 9 ms after the camera's timer was due."""
    return detecting(path, n, declared, fails, first, **more).end(end)


def detecting(path, n=N, declared=False, fails=(), first=1, **more):
    """Return the trace of /detect without its end."""
    own = Own(path, OWN_GRAPH if declared else '', **more)
    own.node('/detect')
    own.publisher(BOXES, '/boxes')
    own.subscription(DETECT, '/image')
    for k in range(first, n + 1):
        at = k * 100 * MS
        own.take(DETECT, at + 3500 * US, at + 2010 * US, k)
        own.publish(BOXES, at + 9 * MS)
        own.run(DETECT, at + 3500 * US, at + 4 * MS, at + 10 * MS, declared=declared,
                fails=k in fails)
    return own


def robot(path, ahead=0, n=N, boot='boot', offset=OFFSET, style='tracing', until=N, taken='take',
          other=0):
    """
    Return what LTTng recorded of /camera and /plan, up to some job; not written yet.

    :param style: of ``Recorded.publish``; ``taken``: of ``receive``.
    :param other: how far the clock of the executor's computer is ahead, if it is another one.
    """
    r = Recorded(path)
    r.add('mddag:host', 0, 1, 'robot', boot, offset)
    r.add('mddag:process', 0, 1, 'robot')
    r.node(1, '/camera')
    r.node(2, '/plan')
    r.timer(GRAB, 1, 100 * MS)
    r.publisher(IMAGE, 1, '/image')
    r.subscription(PLAN, 2, '/boxes')
    for k in range(1, until + 1):
        at = k * 100 * MS
        r.run(GRAB, 1, at + 1 * MS, at + 3 * MS)
        r.publish(IMAGE, 1, at + 2 * MS, at + 2010 * US + ahead, style=style)
        if k <= n:
            r.receive(PLAN, 1, at + 11 * MS, at + 15 * MS, at + 9020 * US + ahead + other,
                      style=taken)
    return r

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A recording as CARET makes it: two processes, a sync and a path."""

from .recorded import MS, US

GRAB, DETECT, FUSE_BOXES, FUSE_IMU, IMU, PLAN = 11, 12, 13, 14, 15, 16
IMAGE, BOXES, IMU_OUT, PATH = 100, 101, 102, 103
GRAPH = """\
mddag: 1
nodes:
  - {node: /detect, callbacks: [{name: detect, subscription: /image, publishes: [/boxes]}]}
  - {node: /camera, callbacks: [{name: grab, timer: 100ms, publishes: [/image, /info]}]}
  - {node: /imu, callbacks: [{name: read, subscription: /info, publishes: [/imu]}]}
  - node: /fuse
    callbacks:
      - {name: join, sync: [/boxes, /imu], deadline: 50ms}
      - {name: plan, timer: 50ms, reads: [join], deadline: 20ms}
paths:
  - {name: seen, callbacks: ['/camera:grab', '/detect:detect', '/fuse:join', '/fuse:plan']}
"""
N = 5


def record(r):
    """
    Record `N` jobs of 40 ms each, in two processes.

    The camera's timer was made at 7 ms, the planner's at 0. Both legs of the fusion and the
    planner are in one callback group; the boxes' leg waits 2 ms for the other.
    """
    r.node(1, '/camera')
    r.node(2, '/detect')
    r.node(3, '/imu', pid=2)
    r.node(4, '/fuse')
    r.timer(GRAB, 1, 100 * MS, time=7 * MS)
    r.timer(PLAN, 4, 50 * MS)
    r.publisher(IMAGE, 1, '/image')
    r.publisher(104, 1, '/info')
    r.publisher(BOXES, 2, '/boxes')
    r.publisher(IMU_OUT, 3, '/imu', pid=2)
    r.subscription(DETECT, 2, '/image')
    r.subscription(IMU, 3, '/info', pid=2)
    r.subscription(FUSE_BOXES, 4, '/boxes')
    r.subscription(FUSE_IMU, 4, '/imu')
    r.group(0xA0, 'mutually_exclusive', ('subscription', FUSE_BOXES),
            ('subscription', FUSE_IMU), ('timer', PLAN))
    for k in range(1, N + 1):
        at = 7 * MS + k * 100 * MS
        r.run(GRAB, 1, at + 1 * MS, at + 5 * MS)
        image = r.publish(IMAGE, 1, at + 2 * MS)
        info = r.publish(104, 1, at + 3 * MS)
        r.receive(DETECT, 2, at + 6 * MS, at + 20 * MS, image)
        boxes = r.publish(BOXES, 2, at + 19 * MS)
        r.receive(IMU, 9, at + 10 * MS, at + 16 * MS, info, style='take', pid=2)
        imu = r.publish(IMU_OUT, 9, at + 15 * MS, pid=2)
        r.receive(FUSE_IMU, 3, at + 18 * MS, at + 21 * MS, imu)
        r.receive(FUSE_BOXES, 4, at + 22 * MS, at + 40 * MS, boxes)
    for k in range(1, 2 * N):
        r.run(PLAN, 5, k * 50 * MS + 400 * US, k * 50 * MS + 5 * MS)
    return r

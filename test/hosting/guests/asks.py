# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A callback with a deadline that asks a service, and less urgent work; each node in a program."""

import time

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

WORKS, ENOUGH = 3, 20


class Control(Node):
    """
    It awaits a service in each of its periods, after it has made work for others.

    When it has had enough answers, it ends the run.  It awaits none before a first one has come:
    the server may not know its client yet although it is ready, and then loses the request.
    """

    def __init__(self):
        super().__init__('control')
        self.n_answers = 0
        self.is_known = False
        self.work = self.create_publisher(Empty, '/work', 50)
        self.client = self.create_client(Trigger, '/ask')
        self.create_timer(0.05, self.tick)

    async def tick(self):
        if not (self.work.get_subscription_count() and self.client.service_is_ready()):
            return
        if not self.is_known:
            self.client.call_async(Trigger.Request()).add_done_callback(self.note)
        else:
            for _ in range(WORKS):
                self.work.publish(Empty())
            assert (await self.client.call_async(Trigger.Request())).message == 'answer'
            self.n_answers += 1
            if self.n_answers == ENOUGH:
                rclpy.shutdown()

    def note(self, _):
        self.is_known = True


class Serving(Node):
    """It answers, in the same callback group as work of its own."""

    def __init__(self):
        super().__init__('serving')
        self.create_service(Trigger, '/ask', self.answer)
        self.create_subscription(Empty, '/work', self.work, 50)

    def answer(self, request, response):
        response.message = 'answer'
        return response

    def work(self, _):
        time.sleep(0.002)


class Working(Node):
    """It has work only."""

    def __init__(self):
        super().__init__('working')
        self.create_subscription(Empty, '/work', lambda _: time.sleep(0.002), 50)


def spins():
    rclpy.init()
    try:
        rclpy.spin(Serving())
    except (ExternalShutdownException, KeyboardInterrupt):
        pass


def steps():
    rclpy.init()
    node = Serving()
    try:
        while rclpy.ok():
            rclpy.spin_once(node, timeout_sec=0.01)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass


def spins_several():
    rclpy.init()
    executor = MultiThreadedExecutor(2)
    executor.add_node(Serving())
    try:
        executor.spin()
    except (ExternalShutdownException, KeyboardInterrupt):
        pass

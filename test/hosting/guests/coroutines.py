# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Programs whose callbacks and tasks await asyncio, as people wrote them before it worked."""

import asyncio

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Float64
from std_srvs.srv import Trigger


def serves_slowly():
    """Answer two clients in the time of one; a timer goes on meanwhile."""
    rclpy.init()
    node = Node('slow_server')
    open_requests, most, ticks = set(), 0, []

    async def answer(request, response):
        nonlocal most
        me = object()
        open_requests.add(me)
        await asyncio.sleep(0.3)
        most = max(most, len(open_requests))
        open_requests.discard(me)
        response.message = 'slept'
        return response

    group = rclpy.callback_groups.ReentrantCallbackGroup()
    node.create_service(Trigger, 'sleep', answer, callback_group=group)
    node.create_timer(0.02, lambda: ticks.append(len(open_requests)))
    clients = [node.create_client(Trigger, 'sleep') for _ in range(2)]
    assert all(client.wait_for_service(30.0) for client in clients)
    futures = [client.call_async(Trigger.Request()) for client in clients]
    for future in futures:
        rclpy.spin_until_future_complete(node, future, timeout_sec=30.0)
    print([future.result().message for future in futures], most, 2 in ticks)
    rclpy.shutdown()


class Rudder(Node):
    """A script of steps for hardware, each of which waits until the hardware is there."""

    def __init__(self):
        super().__init__('rudder')
        self.angle = self.wanted = 0.0
        self.publisher = self.create_publisher(Float64, 'wanted', 10)
        self.create_subscription(Float64, 'wanted', self.move, 10)
        self.create_timer(0.01, self.turn)

    def move(self, message):
        self.wanted = message.data

    def turn(self):
        self.angle += max(-0.2, min(0.2, self.wanted - self.angle))

    async def reach(self, angle, seconds):
        self.publisher.publish(Float64(data=angle))

        async def reached():
            while abs(self.angle - angle) > 0.01:
                await asyncio.sleep(0.01)

        await asyncio.wait_for(reached(), seconds)

    async def steps(self):
        await self.reach(1.0, 30.0)
        print('starboard')
        await self.reach(-1.0, 30.0)
        print('port')
        try:
            await self.reach(99.0, 0.1)
        except asyncio.TimeoutError:
            print('not that far')


def runs_steps():
    rclpy.init()
    node = Rudder()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin_until_future_complete(executor.create_task(node.steps()))
    executor.shutdown()
    rclpy.shutdown()


def fails_in_a_step():
    rclpy.init()
    executor = SingleThreadedExecutor()
    executor.add_node(Node('failing'))

    async def step():
        await asyncio.sleep(0.01)
        raise ValueError('rudder stuck')

    try:
        executor.spin_until_future_complete(executor.create_task(step()))
    except ValueError as error:
        print(error)
    rclpy.shutdown()


def polls_in_a_loop():
    """Step now and then in a loop of the program; callbacks await as well."""
    async def main():
        rclpy.init()
        node = Node('polling')
        heard = asyncio.Queue()

        async def put(message):
            await asyncio.sleep(0.01)
            await heard.put(message.data)

        async def step():
            while rclpy.ok():
                rclpy.spin_once(node, timeout_sec=0)
                await asyncio.sleep(0.001)

        node.create_subscription(Float64, 'said', put, 10)
        publisher = node.create_publisher(Float64, 'said', 10)
        stepping = asyncio.create_task(step())
        while heard.empty():
            publisher.publish(Float64(data=1.5))
            await asyncio.sleep(0.05)
        print(await heard.get())
        stepping.cancel()
        rclpy.shutdown()

    asyncio.run(main())

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What rolling's tutorial of ``AsyncNode`` does, with the ``Node`` of every ROS 2.

    python examples/asyncio_service/service.py

The callbacks of the services are coroutines that await asyncio.  The program has an event loop of
its own, in which it spins the executor.  Meanwhile a timer keeps its deadline.
"""

import asyncio
from contextlib import asynccontextmanager
from pathlib import Path
import threading

from mddag_executor import MultiDeadlineExecutor
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger


class Server(Node):
    """Answers requests: at leisure, with a blocking function, or by asking another service."""

    def __init__(self):
        super().__init__('server')
        self.asleep, self.most_asleep = 0, 0
        # AsyncNode: concurrent=True
        self.create_service(
            Trigger, 'rest', self.rest, callback_group=ReentrantCallbackGroup())
        self.create_service(Trigger, 'read', self.read)
        self.create_service(Trigger, 'ask', self.ask)
        self.create_timer(0.02, self.beat)
        self.client = self.create_client(Trigger, 'rest')

    async def rest(self, request, response):
        """Sleep without a worker: other callbacks run meanwhile."""
        self.asleep += 1
        self.most_asleep = max(self.asleep, self.most_asleep)
        await asyncio.sleep(0.2)  # AsyncNode: self.get_clock().sleep(0.2)
        self.asleep -= 1
        response.success, response.message = True, 'slept for 0.2 s'
        return response

    async def read(self, request, response):
        """Call a blocking function in a thread."""
        thread = await asyncio.to_thread(threading.current_thread)
        response.success = True
        response.message = f'in a thread of asyncio: {thread is not threading.current_thread()}'
        return response

    async def ask(self, request, response):
        """Call a service of this node, which is in another group; the client is in this one's."""
        answer = await self.client.call_async(Trigger.Request())
        response.success, response.message = True, f'the other service {answer.message}'
        return response

    def beat(self):
        """Run every 20 ms, with a deadline."""


@asynccontextmanager
async def spinning(*nodes):
    """Run nodes in the event loop while entered."""
    executor = MultiDeadlineExecutor(Path(__file__).with_name('graph.yaml'))
    for node in nodes:
        executor.add_node(node)
    task = asyncio.create_task(executor.spin_async())
    try:
        yield executor
    finally:
        task.cancel()
        executor.shutdown()


async def main():
    """Ask each service, and three times at once."""
    server, node = Server(), Node('client')
    async with spinning(server, node) as executor:
        clients = {name: node.create_client(Trigger, name) for name in ('rest', 'read', 'ask')}

        async def call(name):
            await asyncio.to_thread(clients[name].wait_for_service)
            return (await clients[name].call_async(Trigger.Request())).message

        for name in clients:
            print(f'{name}: {await call(name)}')
        await asyncio.gather(*(call('rest') for _ in range(3)))
        print(f'requests that slept at once: {server.most_asleep}')
        beats = executor.statistics()['dags']['beat']['sinks']['/server:beat']
        print(f'beats: {beats["completed"]}, in time: {beats["completed"] - beats["late"]}')


if __name__ == '__main__':
    rclpy.init()
    asyncio.run(main())
    rclpy.shutdown()

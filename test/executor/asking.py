# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A callback with a deadline that sends requests while other callbacks wait."""

import inspect
import time

from msg_graph import loads
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from .conftest import matched, Spinning, wait_for
from .declared import graph

# the default deadline is ten times as long, and nothing depends on the speed of the machine
URGENT = graph(urgent='name: control, subscription: /go, period: 30s, deadline: 30s')
OTHERS = [*range(6)]


class Asking:
    """
    A callback with a deadline that sends requests while other callbacks wait already.

    :param ask: what it does, a function or a coroutine function; it gets this object.
    :param text: the declaration; None: the callback has no deadline.
    :param pause_s: how long each of the others takes.
    :ivar ran: what has run, in order: the numbers of the others, and names.
    """

    def __init__(self, make_executor, make_node, ask, text=URGENT, pause_s=0.0, **more):
        self.ran, self._ask, self._pause_s = [], ask, pause_s
        self.group = ReentrantCallbackGroup()
        self.node, self.serving = make_node('urgent'), make_node('serving')
        self.executor = make_executor(
            None if text is None else loads(text), nodes=[self.node, self.serving],
            **{'num_workers': 1, 'default_deadline': '300s', **more})
        self.node.create_subscription(
            Empty, '/go', self._wait if inspect.iscoroutinefunction(ask) else self._call, 1,
            callback_group=self.group)
        self._publisher = make_node('other').create_publisher(Empty, '/go', 1)
        self.clients = {}

    def serve(self, name, answer=None, client_node=None):
        """Create a service with its client; its callback notes the name, or is given."""
        self.serving.create_service(
            Trigger, f'/{name}', self._noting(name) if answer is None else answer,
            callback_group=self.group)
        self.clients[name] = (client_node or self.node).create_client(
            Trigger, f'/{name}', callback_group=self.group)

    def _noting(self, name):
        def answer(request, response):
            self.ran.append(name)
            return response
        return answer

    def request(self, name):
        return self.clients[name].call_async(Trigger.Request())

    def call(self, name):
        return self.clients[name].call(Trigger.Request(), timeout_sec=60.0)

    def begin_others(self):
        """Let other callbacks wait from now on."""
        def run(number):
            time.sleep(self._pause_s)
            self.ran.append(number)
        for number in OTHERS:
            self.executor.create_task(run, number)

    async def _wait(self, _):
        self.begin_others()
        await self._ask(self)
        self.ran.append('control')

    def _call(self, _):
        self.begin_others()
        self._ask(self)
        self.ran.append('control')

    def run(self, spinning=Spinning, names=('control',)):
        """Run the callback once; return what has run, in order, once these names have."""
        with spinning(self.executor):
            assert all(client.wait_for_service(15.0) for client in self.clients.values())
            matched(self._publisher)
            self._publisher.publish(Empty())
            assert wait_for(lambda: {*names, *OTHERS} <= {*self.ran}), self.ran
        return self.ran

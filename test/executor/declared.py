# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Declarations, and nodes made of them, whose callbacks note what they run for."""

from functools import partial
from inspect import iscoroutinefunction
from itertools import count
from typing import Any, NamedTuple

from mddag_executor.executor import current_job
from mddag_executor.executor.attribution import header_stamp
from msg_graph import loads
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import wait_for


def graph(**nodes):
    """Return the YAML of nodes: the keys of each callback, one callback a line."""
    text = 'mddag: 1\nnodes:\n'
    for node, callbacks in nodes.items():
        text += f'  - node: /{node}\n    callbacks:\n' + ''.join(
            f'      - {{{line.strip()}}}\n' for line in callbacks.strip().splitlines())
    return text


class Ran(NamedTuple):
    """An execution: the number and stamp of its message, and the job that it runs for."""

    number: int
    stamp: int
    topic: str
    job: Any


class Declared:
    """
    The nodes of a declaration; a callback publishes the message that it gets on its topics.

    A timer's callback publishes a numbered message, and starts with ``start``. ``ran`` has the
    executions by the name of the callback.

    :param bodies: by the name of a callback, the function or coroutine function that it calls
        before it publishes.  A function may return a frozenset of topics that are not published.
    :param reentrant: whether all callbacks may run at once (but no timer's with itself), or one
        of each node.
    """

    def __init__(self, make_node, text, bodies=None, reentrant=True):
        self._bodies = bodies or {}
        self.ran = {}
        self.nodes = {}
        self.timers = []
        self._publishers = []
        group = ReentrantCallbackGroup() if reentrant else None
        callbacks = loads(text).callbacks
        self._topics = [topic for callback in callbacks for topic in callback.topics]
        for each in callbacks:
            name = each.node.strip('/')
            if name not in self.nodes:
                self.nodes[name] = make_node(name)
            node = self.nodes[name]
            self.ran[each.name] = []
            publishers = [node.create_publisher(Header, t, 100) for t in each.publishes]
            self._publishers += publishers
            run = self._callback(each.name, publishers)
            for topic in each.topics:
                node.create_subscription(
                    Header, topic, partial(run, topic), 100, callback_group=group)
            if each.timer_period_ns:
                self.timers.append(node.create_timer(
                    each.timer_period_ns / 1e9, partial(self._tick, run, node, count()),
                    MutuallyExclusiveCallbackGroup() if reentrant else None, autostart=False))

    def _tick(self, run, node, numbers):
        now = node.get_clock().now().to_msg()
        run('', Header(stamp=now, frame_id=str(next(numbers))))

    def _callback(self, name, publishers):
        body = self._bodies.get(name)

        def begin(topic, message):
            self.ran[name].append(Ran(
                int(message.frame_id or -1), header_stamp(message), topic, current_job()))

        def end(message, left_out=frozenset()):
            for publisher in publishers:
                if publisher.topic not in left_out:
                    publisher.publish(message)

        def run(topic, message):
            begin(topic, message)
            left_out = None if body is None else body()
            end(message, left_out if isinstance(left_out, frozenset) else frozenset())

        async def wait(topic, message):
            begin(topic, message)
            await body()
            end(message)
        return wait if iscoroutinefunction(body) else run

    def jobs(self, name):
        """Return the jobs that a callback ran for."""
        return [each.job for each in self.ran[name]]

    def jobs_of_numbers(self, name):
        """Return the job of each message that a callback ran for, which ran for none twice."""
        found = {each.number: each.job for each in self.ran[name]}
        assert len(found) == len(self.ran[name])
        return found

    def connected(self):
        """Tell whether all publishers have met their subscriptions."""
        return all(each.get_subscription_count() == self._topics.count(each.topic)
                   for each in self._publishers)

    def start(self, *executors):
        """Start the timers when all are connected; one executor gets all nodes."""
        if len(executors) == 1:
            for node in self.nodes.values():
                executors[0].add_node(node)
        assert wait_for(self.connected)
        for timer in self.timers:
            timer.reset()
        for executor in executors:
            executor.wake()

    def cancel(self):
        """Let no timer start a job any more."""
        for timer in self.timers:
            timer.cancel()


# Two sinks with deadlines of their own, and a chain of two messages to the later one.
CHAIN = graph(
    source='name: tick, timer: 20ms, publishes: [/a], dag: chain',
    middle="""
        name: relay, subscription: /a, publishes: [/b]
        name: early, subscription: /a, deadline: 10ms""",
    sink='name: last, subscription: /b, deadline: 50ms')

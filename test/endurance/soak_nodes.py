# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The nodes of an endurance run: made from a declaration, each of them destroyed and made again.

Unlike those of ``synthetic`` they keep nothing for each message, so that a run may last for days.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
import threading
import time
from typing import Any

from mddag_executor.live import current_job
from mddag_executor.live.bodies import release_of, stamped
from mddag_executor.live.execution import emulator, ExecutionPlan
from mddag_executor.live.synthetic import QOS, quiet_node
from msg_graph import Callback, TaskSet, Vertex
from rclpy.callback_groups import (
    CallbackGroup,
    MutuallyExclusiveCallbackGroup,
    ReentrantCallbackGroup,
)
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Header

JOINS = 64


class SoakFault(Exception):
    """What a callback raises on purpose."""


class SoakNodes:
    """
    The nodes of a declaration; each can be destroyed and made again.

    ``started`` counts the starts of bodies, ``raise_next`` lets the next body raise, ``cut_off``
    counts bodies whose node was destroyed while they ran, so that they could not publish.
    """

    def __init__(self, task_set: TaskSet, plan: ExecutionPlan) -> None:
        self.task_set = task_set
        self.started = 0
        self.raise_next = False
        self.cut_off = 0
        self.nodes: dict[str, Node] = {}
        self.timers: dict[str, Timer] = {}
        self._plan = plan
        self._emulate = emulator('sleep')
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._lock = threading.Lock()
        self._joins: dict[str, OrderedDict[int, set[str]]] = {}
        self._vertices: dict[str, list[Vertex]] = {}
        for vertex in task_set.vertices:
            self._vertices.setdefault(vertex.callback.key, []).append(vertex)
        self._by_node: dict[str, list[Callback]] = {}
        for callback in task_set.callbacks:
            self._by_node.setdefault(callback.node, []).append(callback)
        for name in self._by_node:
            self.make(name)

    def make(self, full_name: str) -> Node:
        """Make a node with its publishers and entities."""
        node = self.nodes[full_name] = quiet_node(full_name)
        publishers: dict[str, Any] = {}
        groups: dict[str, CallbackGroup] = {}
        for callback in self._by_node[full_name]:
            for topic in callback.publishes:
                if topic not in publishers:
                    publishers[topic] = node.create_publisher(Header, topic, QOS)
            kind = MutuallyExclusiveCallbackGroup if callback.group else ReentrantCallbackGroup
            group = groups.setdefault(callback.group or '', kind())
            body = self._body(callback, [publishers[t] for t in callback.publishes])
            if callback.kind == 'timer':
                self.timers[callback.key] = node.create_timer(
                    (callback.timer_period_ns or 0) / 1e9, body, group, clock=self._clock)
            for topic in callback.topics:
                node.create_subscription(
                    Header, topic, self._leg(callback, topic, body), QOS, callback_group=group)
        return node

    def _body(self, callback: Callback, publishers: list[Any]) -> Callable[[int], None]:
        vertices = self._vertices.get(callback.key, [])
        times = {self.task_set.dags[v.dag].name: self._plan.execution_ns(v.dag, v.index)
                 for v in vertices}
        usual = next(iter(times.values()), 0)

        def body(release: int = 0) -> None:
            with self._lock:
                raises, self.raise_next = self.raise_next, False
            if raises:
                raise SoakFault(callback.key)
            job = current_job()
            self._emulate(usual if job is None else times.get(job.dag, usual))
            message = stamped(release or (time.time_ns() if job is None else job.release_ns))
            try:
                for publisher in publishers:
                    publisher.publish(message)
            except InvalidHandle:
                self.cut_off += 1  # its node was destroyed while it ran

        def counted(release: int = 0) -> None:
            with self._lock:
                self.started += 1
            body(release)

        return counted if callback.kind == 'timer' else body

    def _leg(
        self, callback: Callback, topic: str, body: Callable[[int], None]
    ) -> Callable[[Any], None]:
        """Return what a message calls: of a sync callback's legs the last one executes."""
        joins = self._joins.setdefault(callback.key, OrderedDict())
        wanted = len(callback.topics)

        def on_message(message: Any) -> None:
            release = release_of(message)
            with self._lock:
                self.started += 1
                if wanted > 1:
                    there = joins.setdefault(release, set())
                    there.add(topic)
                    if len(joins) > JOINS:
                        joins.popitem(last=False)
                    if len(there) < wanted:
                        return
                    joins.pop(release, None)
            body(release)

        return on_message

    def matched(self) -> bool:
        """Tell whether every trigger topic has met all of its subscriptions."""
        wanted: dict[str, int] = {}
        for callback in self.task_set.callbacks:
            for topic in callback.topics:
                wanted[topic] = wanted.get(topic, 0) + 1
        return all(
            publisher.get_subscription_count() >= wanted.get(publisher.topic_name, 0)
            for node in list(self.nodes.values()) for publisher in node.publishers
            if publisher.topic_name in wanted)

    def sources(self) -> list[str]:
        """Return the keys of the callbacks that timers start."""
        return list(self.timers)


class SimulatedTime:
    """A node that follows simulated time, and who publishes that."""

    def __init__(self) -> None:
        self.node = quiet_node('/soak_simulated', use_sim_time=True)
        self._sender = quiet_node('/soak_clock')
        self._publisher = self._sender.create_publisher(ClockMessage, '/clock', 10)
        self.ticks = 0
        self.node.create_timer(0.1, self._tick)
        self._now_ns = 1_000_000_000_000
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name='soak-clock')
        self._thread.start()

    def _tick(self) -> None:
        self.ticks += 1

    def _run(self) -> None:
        while not self._ending.wait(0.02):
            self._now_ns += 20_000_000
            message = ClockMessage()
            message.clock.sec, message.clock.nanosec = divmod(self._now_ns, 1_000_000_000)
            self._publisher.publish(message)

    def jump(self, nanoseconds: int) -> None:
        """Let the time jump."""
        self._now_ns = max(1_000_000_000, self._now_ns + nanoseconds)

    def stop(self) -> None:
        """End the thread and destroy both nodes."""
        self._ending.set()
        self._thread.join()
        self._sender.destroy_node()
        self.node.destroy_node()

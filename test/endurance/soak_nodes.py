# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The nodes of an endurance run: synthetic ones, each of them destroyed and made again."""

import threading

from mddag_executor.executor import current_job
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.hosting.synthetic import SyntheticWorkload
from rclpy.exceptions import InvalidHandle
from rosgraph_msgs.msg import Clock as ClockMessage


class SoakFault(Exception):
    """What a callback raises on purpose."""


class SoakNodes:
    """
    The nodes of a declaration; each can be destroyed and made again.

    ``started`` counts the starts of callbacks, ``raise_next`` lets the next one raise, ``cut_off``
    counts those whose node was destroyed while they ran, so that they could not publish.
    """

    def __init__(self, task_set, plan):
        self.workload = SyntheticWorkload(task_set, plan, current_job=current_job)
        self.started = 0
        self.raise_next = False
        self.cut_off = 0
        self._lock = threading.Lock()
        self.nodes = {node.get_fully_qualified_name(): node for node in self.workload.nodes}
        for node in self.workload.nodes:
            self._watch(node)

    def make_again(self, name):
        """Make a node that was destroyed, and start its timers."""
        node = self.nodes[name] = self.workload.make(name)
        self._watch(node)
        for dag, timer in self.workload.timers.items():
            if timer in node.timers:
                self.workload.start_timer(dag)
        return node

    def _watch(self, node):
        for entity in (*node.timers, *node.subscriptions):
            entity.callback = self._watched(entity.callback)

    def _watched(self, callback):
        def timer():
            run()

        def subscription(message):
            run(message)

        def run(*message):
            with self._lock:
                self.started += 1
                raises, self.raise_next = self.raise_next, False
            if raises:
                raise SoakFault('on purpose')
            try:
                callback(*message)
            except InvalidHandle:
                self.cut_off += 1

        return timer if callback.__code__.co_argcount == 0 else subscription


class SimulatedTime:
    """A node that follows simulated time, and who publishes that."""

    def __init__(self):
        self.node = quiet_node('/soak_simulated', use_sim_time=True)
        self._sender = quiet_node('/soak_clock')
        self._publisher = self._sender.create_publisher(ClockMessage, '/clock', 10)
        self.ticks = 0
        self.node.create_timer(0.1, self._tick)
        self._now_ns = 1_000_000_000_000
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name='soak-clock')
        self._thread.start()

    def _tick(self):
        self.ticks += 1

    def _run(self):
        while not self._ending.wait(0.02):
            self._now_ns += 20_000_000
            message = ClockMessage()
            message.clock.sec, message.clock.nanosec = divmod(self._now_ns, 1_000_000_000)
            self._publisher.publish(message)

    def jump(self, nanoseconds):
        """Let the time jump."""
        self._now_ns = max(1_000_000_000, self._now_ns + nanoseconds)

    def stop(self):
        """End the thread and destroy both nodes."""
        self._ending.set()
        self._thread.join()
        self._sender.destroy_node()
        self.node.destroy_node()

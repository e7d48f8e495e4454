# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Programs without a lock, whose executors run one callback at a time; they say if two overlap."""

import random
import time

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

ENOUGH = 150


class Robot:
    """Two nodes with callbacks of all kinds, which may all overlap for their groups."""

    def __init__(self, name):
        rclpy.init()
        self.inside = self.calls = self.overlaps = 0
        self.done = rclpy.Future()
        self.node, other = Node(name), Node(f'{name}_other')
        self.nodes = self.node, other
        self.random = random.Random(name)
        free = {'callback_group': ReentrantCallbackGroup()}
        self.publisher = self.node.create_publisher(String, f'{name}/said', 10)
        other.create_subscription(String, f'{name}/said', self.work, 10, **free)
        self.node.create_subscription(String, f'{name}/said', self.asks, 10, **free)
        other.create_service(Trigger, f'{name}/ask', self.answer, **free)
        self.client = self.node.create_client(Trigger, f'{name}/ask', **free)
        self.node.create_timer(0.004, self.tick, **free)
        other.create_timer(0.003, self.work, **free)
        # its own group: on a busy machine it would wait within itself without end
        self.node.create_timer(0.05, self.calls_and_spins,
                               callback_group=MutuallyExclusiveCallbackGroup())

    def work(self, *_):
        self.inside += 1
        self.calls += 1
        self.overlaps += self.inside > 1
        time.sleep(self.random.choice((0, 0.0003, 0.002)))
        self.inside -= 1
        if self.calls >= ENOUGH and not self.done.done():
            self.done.set_result(None)

    def tick(self):
        self.work()
        self.publisher.publish(String())
        if self.random.random() < 0.2:
            self.node.executor.create_task(self.work)

    async def asks(self, message):
        self.work()
        if self.random.random() < 0.2:
            await self.client.call_async(Trigger.Request())
            self.work()

    def answer(self, request, response):
        self.work()
        return response

    def calls_and_spins(self):
        self.work()
        if self.random.random() < 0.5:
            self.client.call(Trigger.Request(), timeout_sec=1.0)
        else:
            future = self.client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(self.node, future, timeout_sec=1.0)
        self.work()

    def run(self, executor, spin):
        for node in self.nodes:
            executor.add_node(node)
        spin(executor)
        print(f'{self.node.get_name()}: {self.overlaps} overlaps', flush=True)
        executor.shutdown()
        rclpy.shutdown()

    def steps(self, executor):
        while not self.done.done():
            executor.spin_once(timeout_sec=self.random.choice((0, 0.001, 0.1)))
            self.work()


def spins():
    robot = Robot('spins')
    robot.run(SingleThreadedExecutor(), lambda e: e.spin_until_future_complete(robot.done))


def steps():
    robot = Robot('steps')
    robot.run(SingleThreadedExecutor(), robot.steps)


def asks_in_steps():
    """Step for responses, and for one that comes between two steps."""
    rclpy.init()
    node = Node('asks')
    client = node.create_client(Trigger, 'answers/ask')
    client.wait_for_service(60.0)
    for pause in (0.0, 0.3, 0.0):
        future = client.call_async(Trigger.Request())
        time.sleep(pause)
        rclpy.spin_once(node)
        while not future.done():
            rclpy.spin_once(node)
    print('asks: answered', flush=True)
    node.create_client(Trigger, 'answers/end').call_async(Trigger.Request())


def answers():
    rclpy.init()
    node = Node('answers')
    node.create_service(Trigger, 'answers/ask', lambda _, response: response)
    node.create_service(Trigger, 'answers/end', lambda _, response: rclpy.shutdown() or response)
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        pass


def waits_between_steps():
    """Step for what a callback does; a concurrent one runs before the step."""
    rclpy.init()
    node, done = Node('waits'), []

    def once():
        timer.cancel()
        done.append(1)

    timer = node.create_timer(0.1, once)
    timer.cancel()
    rclpy.spin_once(node, timeout_sec=0.001)
    timer.reset()
    time.sleep(0.3)
    rclpy.spin_once(node)
    print(f'waits: {len(done)} has run', flush=True)
    rclpy.shutdown()


def has_threads():
    """Let three of twelve timers run at a time, as many as the executor has threads."""
    rclpy.init()
    node, group = Node('threads'), ReentrantCallbackGroup()
    inside, most, done = [], [], rclpy.Future()

    def tick():
        inside.append(1)
        most.append(len(inside))
        time.sleep(0.02)
        inside.pop()
        if len(most) >= 60 and not done.done():  # two threads may append before one looks
            done.set_result(None)

    for _ in range(12):
        node.create_timer(0.005, tick, callback_group=group)
    executor = MultiThreadedExecutor(3)
    executor.add_node(node)
    executor.spin_until_future_complete(done)
    print(f'threads: {max(most)} at a time', flush=True)
    executor.shutdown()
    rclpy.shutdown()

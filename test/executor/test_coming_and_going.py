# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Entities of all kinds come and go in several threads, and nodes move between two executors.

What stays loses nothing meanwhile, and no spin ends.
"""

import random
import threading
import time

import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from .conftest import Spinning, wait_for

RELIABLE = QoSProfile(depth=1000)
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
SECONDS = 3.0


def nothing(*_):
    pass


def new_entity(node, draw):
    """Make an entity of any kind; return what destroys it."""
    group = draw.choice([None, ReentrantCallbackGroup(), MutuallyExclusiveCallbackGroup()])
    kind, topic = draw.randrange(6), f'/topic{draw.randrange(6)}'
    if kind == 0:
        publisher = node.create_publisher(
            Header, topic, draw.choice([RELIABLE, SENSOR]),
            event_callbacks=PublisherEventCallbacks(matched=nothing, incompatible_qos=nothing))
        publisher.publish(Header())
        return lambda: node.destroy_publisher(publisher)
    if kind == 1:
        timer = node.create_timer(draw.choice([0.001, 0.01]), nothing, callback_group=group)
        return lambda: node.destroy_timer(timer)
    if kind == 2:
        service = node.create_service(
            Trigger, f'{topic}/ask', lambda _, answer: answer, callback_group=group)
        return lambda: node.destroy_service(service)
    if kind == 3:
        guard = node.create_guard_condition(nothing, callback_group=group)
        guard.trigger()
        return lambda: node.destroy_guard_condition(guard)
    subscription = node.create_subscription(
        Header, topic, nothing, draw.choice([RELIABLE, SENSOR]), callback_group=group,
        event_callbacks=SubscriptionEventCallbacks(matched=nothing, incompatible_qos=nothing))
    return lambda: node.destroy_subscription(subscription)


class Churn(threading.Thread):
    """Makes and destroys entities of a node, and moves it between executors."""

    def __init__(self, node, executors, moving, seed):
        super().__init__()
        self.error = None
        self._node, self._executors, self._moving = node, executors, moving
        self._draw = random.Random(seed)

    def run(self):
        draw, present = self._draw, []
        end = time.monotonic() + SECONDS
        try:
            while time.monotonic() < end:
                if len(present) < 12 and draw.random() < 0.6:
                    present.append(new_entity(self._node, draw))
                elif present:
                    present.pop(draw.randrange(len(present)))()
                if draw.random() < 0.05:
                    with self._moving:  # else rclpy's add_node may wait for another one, for ever
                        draw.choice(self._executors).add_node(self._node)
                time.sleep(draw.choice([0.0, 0.0, 0.001, 0.01]))
        except BaseException as error:
            self.error = error


@pytest.mark.parametrize('seed', [1, 2])
def test_entities_come_and_go_in_several_threads(make_executor, make_node, seed):
    executors = [make_executor(num_workers=7), make_executor(num_workers=2)]
    stable = [make_node('here'), make_node('there')]
    heard = [[], []]
    answers = []
    publishers, clients = [], []
    for number, node in enumerate(stable):
        node.create_subscription(
            Header, f'/stable{number}', lambda m, h=heard[number]: h.append(m.stamp.sec), RELIABLE)
        publishers.append(stable[1 - number].create_publisher(
            Header, f'/stable{number}', RELIABLE))
        node.create_service(Trigger, f'/stable{number}/ask', lambda _, answer: answer)
        clients.append(stable[1 - number].create_client(Trigger, f'/stable{number}/ask'))
        executors[number].add_node(node)
    moving = threading.Lock()
    churns = [Churn(make_node(f'churn{number}'), executors, moving, 10 * seed + number)
              for number in range(4)]
    assert wait_for(lambda: all(each.get_subscription_count() for each in publishers))
    assert wait_for(lambda: all(each.service_is_ready() for each in clients))
    message, sent, asked = Header(), 0, 0
    with Spinning(executors[0]) as first, Spinning(executors[1]) as second:
        for each in churns:
            each.start()
        while any(each.is_alive() for each in churns):
            message.stamp.sec = sent
            for publisher in publishers:
                publisher.publish(message)
            sent += 1
            if sent % 10 == 0:
                for client in clients:
                    client.call_async(Trigger.Request()).add_done_callback(answers.append)
                    asked += 1
            time.sleep(0.005)
        assert wait_for(lambda: len(heard[0]) == len(heard[1]) == sent)
        assert wait_for(lambda: len(answers) == asked)
    assert first.error is None and second.error is None
    assert [each.error for each in churns] == [None] * len(churns)
    assert heard == [list(range(sent))] * 2

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Callbacks that wait for one another, compute, sleep and call services, at random.

They end under this executor, whatever was declared or learnt of them.  ``FUZZ_ROUNDS`` is how many
rounds are run, from ``FUZZ_SEED`` on.
"""

import os
import random
import threading
import time

import msg_graph
from rcl_interfaces.srv import ListParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from .conftest import Spinning, wait_for

NAMES = tuple('abcdef')
WORKERS = len(NAMES) + 1
ROUNDS = int(os.environ.get('FUZZ_ROUNDS', '25'))
PATIENCE_S = 60.0


def scripts(seed):
    """
    Return what each callback does in a round.

    Each waits only for those after it in the alphabet, so that there is an end.
    """
    draw = random.Random(seed)
    found = {}
    for place, name in enumerate(NAMES):
        steps = [('set', place)]
        for _ in range(draw.randint(1, 4)):
            kind = draw.choice(('compute', 'sleep', 'call', 'wait', 'wait', 'lock'))
            if kind == 'wait' and place + 1 < len(NAMES):
                steps.append((kind, draw.randrange(place + 1, len(NAMES))))
            elif kind != 'wait':
                steps.append((kind, draw.choice((20, 300, 3000))))
        draw.shuffle(steps)
        found[name] = steps
    return found


class Robot:
    """A node whose callbacks do what the script of the round says, and note what they did."""

    def __init__(self, node):
        self.done = {}
        self._scripts = {}
        self._events = []
        self._lock = threading.Lock()
        group = ReentrantCallbackGroup()
        self._publishers = {
            name: node.create_publisher(Header, f'/{name}', 10) for name in NAMES}
        for name in NAMES:
            node.create_subscription(
                Header, f'/{name}', lambda message, name=name: self._run(name), 10,
                callback_group=group)
        node.create_service(
            ListParameters, '/serve', lambda request, response: response, callback_group=group)
        self._client = node.create_client(ListParameters, '/serve', callback_group=group)

    def start(self, seed):
        self._scripts = scripts(seed)
        self._events = [threading.Event() for _ in NAMES]
        self.done = {}
        for name in random.Random(seed).sample(NAMES, len(NAMES)):
            self._publishers[name].publish(Header())

    def _run(self, name):
        done = []
        for kind, number in self._scripts[name]:
            if kind == 'compute':
                end = time.thread_time_ns() + number * 1000
                while time.thread_time_ns() < end:
                    pass
            elif kind == 'sleep':
                time.sleep(number / 1e6)
            elif kind == 'call':
                assert self._client.call(ListParameters.Request()) is not None
            elif kind == 'wait':
                assert self._events[number].wait(PATIENCE_S)
            elif kind == 'lock':
                with self._lock:
                    time.sleep(number / 1e7)
            else:
                self._events[number].set()
            done.append((kind, number))
        self.done[name] = done


def run(executor, node, rounds, seed):
    """Return what the callbacks have done in each round."""
    robot = Robot(node)
    executor.add_node(node)
    results = []
    with Spinning(executor):
        assert wait_for(lambda: robot._client.service_is_ready(), PATIENCE_S)
        for number in range(rounds):
            robot.start(seed + number)
            assert wait_for(lambda: len(robot.done) == len(NAMES), PATIENCE_S), robot.done
            results.append(dict(sorted(robot.done.items())))
    return results


def declaration(seed):
    """Declare callbacks that hold the interpreter, do not, or of which nothing is said."""
    draw = random.Random(seed)
    return msg_graph.loads('mddag: 1\nnodes:\n  - node: /node\n    callbacks:\n' + ''.join(
        f'      - {{name: {name}, subscription: /{name}, dag: {name}, period: 100ms, deadline: '
        f'{draw.randint(5, 50)}ms'
        f'{draw.choice((", holds_interpreter: true", ", holds_interpreter: false", ""))}}}\n'
        for name in NAMES), 'g.yaml')


def test_all_end_whatever_was_declared(make_executor, make_node):
    seed = int(os.environ.get('FUZZ_SEED', '1'))
    executor = make_executor(declaration(seed), num_workers=WORKERS)
    found = run(executor, make_node(), ROUNDS, seed)
    assert found == [dict(sorted(scripts(seed + number).items())) for number in range(ROUNDS)]

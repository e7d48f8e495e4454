# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the tests of the executor share: executors that spin in a thread of their own."""

import contextlib
import threading
import time

from mddag_executor import MultiDeadlineExecutor
import pytest
from rclpy.node import Node


class Spinning:
    """An executor that spins in a thread until it is left; keeps what spin raised."""

    def __init__(self, executor):
        self.executor = executor
        self.error = None
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        try:
            self.executor.spin()
        except BaseException as error:
            self.error = error

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *args):
        assert self.executor.shutdown(30.0)
        self.join()

    def join(self):
        """Wait until spin has ended."""
        self._thread.join(30.0)
        assert not self._thread.is_alive(), 'spin did not end'


class Stepping(Spinning):
    """Spins by a loop of ``spin_once``."""

    def _run(self):
        try:
            while not self.executor._is_shutdown:
                self.executor.spin_once()
        except BaseException as error:
            self.error = error


@pytest.fixture(params=[Spinning, Stepping], ids=['spin', 'spin_once'])
def spinning(request):
    """Give the ways of spinning."""
    return request.param


def wait_for(condition, seconds=15.0):
    """Wait until something is true; return whether it became so."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.002)
    return True


def is_idle(executor):
    """Tell whether nothing runs or waits."""
    statistics = executor.statistics()
    return bool(not statistics['queue'] and statistics['idle_workers'] == statistics['workers'])


@pytest.fixture
def make_executor(ros_context):
    """Give a function that makes executors with nodes; they are shut down afterwards."""
    with contextlib.ExitStack() as stack:
        def make(*args, nodes=(), **kwargs):
            kwargs.setdefault('context', ros_context)
            executor = MultiDeadlineExecutor(*args, **kwargs)
            stack.callback(executor.shutdown, 5.0)
            for node in nodes:
                executor.add_node(node)
            return executor
        yield make


@pytest.fixture
def make_node(ros_context):
    """Give a function that makes nodes; they are destroyed afterwards."""
    nodes = []

    def make(name='node', **kwargs):
        kwargs.setdefault('start_parameter_services', False)
        kwargs.setdefault('enable_rosout', False)
        nodes.append(Node(name, context=ros_context, **kwargs))
        return nodes[-1]
    yield make
    for node in nodes:
        with contextlib.suppress(Exception):
            node.destroy_node()

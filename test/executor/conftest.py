# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the tests of the executor share: executors that spin in a thread, nodes, a waitable."""

import contextlib
from functools import cache
import os
import threading
import time

from mddag_executor import MultiDeadlineExecutor
from mddag_executor.executor import gil_check
import pytest
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities, Waitable

#: For tests of exact answers: without them, two callbacks may share the interpreter.
shown = pytest.mark.skipif(
    not gil_check._is_shown(), reason='this kernel does not show what threads do')


class Spinning:
    """
    An executor that spins in a thread until it is left, which raises what spin raised.

    :param raises: the kind of error with which spin has to end; it is in ``error`` then.
    """

    def __init__(self, executor, raises=None):
        self.executor = executor
        self.error = None
        self._raises = raises
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        try:
            self._spin()
        except BaseException as error:
            self.error = error

    def _spin(self):
        self.executor.spin()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        assert self.executor.shutdown(30.0)
        self.join()
        if self._raises is not None:
            assert isinstance(self.error, self._raises)
        elif self.error is not None:
            raise self.error

    def join(self):
        """Wait until spin has ended."""
        self._thread.join(30.0)
        assert not self._thread.is_alive(), 'spin did not end'


class Stepping(Spinning):
    """Spins by a loop of ``spin_once``."""

    def _spin(self):
        while not self.executor._is_shutdown:
            self.executor.spin_once()


@pytest.fixture(params=[Spinning, Stepping], ids=['spin', 'spin_once'])
def spinning(request):
    """Give the ways of spinning."""
    return request.param


def patience(seconds):
    """Return how long to wait for what takes no more than this time on an idle machine."""
    return seconds * min(4.0, max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)))


def wait_for(condition, seconds=15.0):
    """Wait until something is true; return whether it became so; longer on a busy machine."""
    end = time.monotonic() + patience(seconds)
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.002)
    return True


def matched(*publishers, count=1):
    """Wait until each publisher has met this many subscriptions."""
    assert wait_for(lambda: all(p.get_subscription_count() == count for p in publishers))


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


@pytest.fixture
def kernel_that_hides_threads(monkeypatch):
    """Let the kernel show of no thread what it does, as in a sandbox (gVisor)."""
    monkeypatch.setattr(gil_check, '_first_argument', lambda tid: 0)
    monkeypatch.setattr(gil_check, '_is_shown', lambda: False)
    monkeypatch.setattr(gil_check, '_gil_address', cache(gil_check._gil_address.__wrapped__))


class Pulse(Waitable):
    """A waitable of a user's own, which consists of a guard condition."""

    def __init__(self, node, group):
        super().__init__(group)
        self.guard = node.create_guard_condition(lambda: None)
        node._guards.remove(self.guard)
        self._index = None

    def __enter__(self):
        self.guard.handle.__enter__()

    def __exit__(self, *_):
        self.guard.handle.__exit__(None, None, None)

    def is_ready(self, wait_set):
        return bool(wait_set.is_ready('guard_condition', self._index))

    def take_data(self):
        return None

    async def execute(self, taken_data):
        pass

    def get_num_entities(self):
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set):
        self._index = wait_set.add_guard_condition(self.guard.handle)

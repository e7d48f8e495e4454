# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What executors and hosts keep of nodes, executors and entities that are gone: nothing."""

from contextlib import contextmanager, suppress
import gc
import os
import weakref

from mddag_executor.executor import publishing, waitables
from msg_graph import loads
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from std_msgs.msg import Header
from std_srvs.srv import Empty

from .conftest import Spinning, wait_for

GRAPH = """
mddag: 1
nodes:
  - node: /source
    callbacks: [{name: tick, timer: 10ms, publishes: [/chatter], dag: chain}]
  - node: /sink
    callbacks: [{name: heard, subscription: /chatter, deadline: 50ms}]
"""
CYCLES = 30
# What is kept of the last ones: publications and response times, a few in a worker's frame.
SETTLED = 5


class Brief:
    """Two nodes for a while: a declared chain, and everything else that a node can have."""

    def __init__(self, executor, make_node, made):
        self.executor = executor
        self.nodes = make_node('source'), make_node('sink')
        source, sink = self.nodes
        self.heard = 0
        publisher = self._publisher = source.create_publisher(Header, 'chatter', 10)
        group = MutuallyExclusiveCallbackGroup()
        entities = [
            publisher, group, source.create_timer(0.01, self._tick),
            sink.create_subscription(Header, 'chatter', self._hear, 10, callback_group=group),
            sink.create_service(Empty, 'empty', lambda request, response: response),
            sink.create_client(Empty, 'empty'),
            sink.create_guard_condition(lambda: None)]
        made += [weakref.ref(thing) for thing in (self, *self.nodes, *entities)]
        for node in self.nodes:
            executor.add_node(node)

    def _tick(self):
        with suppress(InvalidHandle):  # destroyed while it runs
            self._publisher.publish(Header())

    def has_heard(self):
        return self.heard > 0

    def _hear(self, message):
        self.heard += 1

    def end(self):
        for node in self.nodes:
            node.destroy_node()
            self.executor.remove_node(node)


def sizes(*owners):
    """Return the sizes of everything that these have, and of what that has."""
    found = {}
    for owner in owners:
        attributes = [*getattr(owner, '__dict__', {}).items(), *(
            (name, getattr(owner, name)) for name in getattr(owner, '_fields', ()))]
        for name, value in attributes:
            if hasattr(value, '__len__') and not isinstance(value, str):
                found[f'{type(owner).__name__}.{name}'] = len(value)
    return found


def used(scheduler):
    """Return how much of the core's tables is in use; the rest waits to be used again."""
    state = scheduler.state
    free = 0
    for slot in state.free_slot:
        while slot >= 0:
            free, slot = free + 1, state.job_next[slot]
    return {'jobs': len(state.job_next) - free,
            'groups': len(state.group_owner) - len(scheduler._free_groups)}


def tables(executor):
    engine, pool, at_once = executor._engine, executor._pool, executor._at_once
    found = used(engine.scheduler) | sizes(
        executor, engine, engine.jobs, engine.verdicts, executor._registry, executor._upkeep,
        executor._wait_sets, pool, pool.timers)
    for name, loop in (('pool', pool.loop), ('at_once', at_once.loop)):
        found |= {f'{name}.{key}': size for key, size in sizes(loop).items()}
    found |= {f'at_once.{key}': size for key, size in sizes(at_once.timers).items()}
    return found | {
        'deliveries': sum(map(len, publishing._deliveries.values())),
        'events': len(waitables._known), 'descriptors': len(os.listdir('/proc/self/fd'))}


def test_nodes_that_come_and_go_leave_nothing_behind(make_executor, ros_context):
    def make(name):  # not by the fixture, which keeps its nodes
        return Node(name, context=ros_context, enable_rosout=False,
                    start_parameter_services=False)

    executor = make_executor(loads(GRAPH))
    made = []

    def cycle(times):
        for _ in range(times):
            brief = Brief(executor, make, made)
            assert wait_for(brief.has_heard, 15.0), spinning.error
            brief.end()
            gc.collect()  # else it depends on how busy the interpreter is

    def nothing_left():
        gc.collect()
        return len(executor._registry.by_id) == 0 and not executor._registry._retired

    with Spinning(executor) as spinning:
        cycle(SETTLED)
        assert wait_for(nothing_left, 15.0)
        before = tables(executor)
        assert len(before) > 30
        cycle(CYCLES)
        assert wait_for(nothing_left, 15.0)

        def grown():
            return {name: (before.get(name), size) for name, size in tables(executor).items()
                    if size - before.get(name, 0) >= CYCLES // 5}
        assert wait_for(lambda: not grown()), grown()

        def left():
            gc.collect()
            return [thing() for thing in made[:-10 * SETTLED] if thing() is not None]
        assert wait_for(lambda: not left()), left()
    assert spinning.error is None


@contextmanager
def without_collector():
    """Let only that be freed to which nothing refers."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def test_a_destroyed_node_is_freed_without_the_collector(make_executor, ros_context):
    """Else it waits with all its handles: with many objects around that may take hours."""
    executor = make_executor()
    with Spinning(executor), without_collector():
        node = Node('brief', context=ros_context, enable_rosout=False,
                    start_parameter_services=False)
        publisher = node.create_publisher(Header, 'chatter', 10)
        subscription = node.create_subscription(Header, 'chatter', lambda message: None, 10)
        things = [publisher, subscription, *publisher.event_handlers,
                  *subscription.event_handlers, node.create_timer(100.0, print)]
        n_things = len(things) - 1  # publishers are not kept
        executor.add_node(node)
        assert wait_for(lambda: len(executor._registry.by_id) >= n_things)
        assert wait_for(lambda: executor._pool.is_current)
        left = [weakref.ref(thing) for thing in (node, *things)]
        assert len(left) > 6
        node.destroy_node()
        executor.remove_node(node)
        del node, publisher, subscription, things
        assert wait_for(lambda: all(thing() is None for thing in left)), [
            thing() for thing in left if thing() is not None]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the executor keeps for each rclpy entity, and the unit of work that a worker runs."""

from __future__ import annotations

from collections.abc import Callable
import functools
import types
from typing import Any

from mddag_executor.core import legs_of, Tables
from mddag_executor.live.attribution import Origin
from mddag_executor.live.compat import awaited
from mddag_executor.live.gates import Gate
from mddag_executor.live.interpreter import Habit
from msg_graph import Callback, TaskSet
from msg_graph.binding import entity_name
from rclpy.exceptions import InvalidHandle

TIMER, SUBSCRIPTION, SERVICE, CLIENT, GUARD, WAITABLE, TASK = (
    'timer', 'subscription', 'service', 'client', 'guard', 'waitable', 'task')


SOON_FROM = 8

_HANDLED = (TIMER, SUBSCRIPTION, SERVICE)
COUNTS = ('ready', 'ran', 'failed', 'dropped', 'skipped', 'unattributed', 'busy_ns')


class AtOnce:
    """
    A future's done callback that takes no time, and never fails.

    A future hands its callbacks to its executor as tasks; this one is called at once instead.
    """

    __slots__ = ('_function',)

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function

    def __call__(self, _: Any = None) -> None:
        """Call the function."""
        self._function()


class Destroyed(Exception):
    """
    The entity was destroyed after its execution had become ready: it must not run.

    Or it is a timer that was cancelled.
    """


class Entry:
    """
    An rclpy entity as the executor sees it.

    :param callback: the declared callback that it is, or None.
    :param group: the number of its mutually exclusive callback group in the core, or -1.
    :param depth: how many of its executions may wait; 0 stands for any number.
    """

    __slots__ = (
        'kind', 'entity', 'node', 'callback', 'group', 'depth', 'label', 'source', 'targets',
        'topic', 'waiting', 'ready', 'ran', 'failed', 'dropped', 'skipped',
        'busy_ns', 'unattributed', 'removed', 'address', 'handle', 'enters', 'soon', 'soon_from',
        'publishes', 'at_once', 'habit', 'since', 'gate', '__weakref__')

    def __init__(
        self, kind: str, entity: Any, node: str, callback: Callback | None, group: int,
        depth: int, label: str,
    ) -> None:
        self.kind = kind
        self.entity = entity
        self.node = node
        self.callback = callback
        self.group = group
        self.depth = depth
        self.label = label
        self.topic = ''
        # global vertex of the source that this starts, or -1
        self.source = -1
        # publishing vertex -> (vertex that its message starts, leg)
        self.targets: dict[int, tuple[int, int]] = {}
        # publishing vertices in other processes whose messages enter here (see ``crossings``)
        self.enters: list[int] = []
        self.waiting: dict[int, None] = {}
        self.ready = 0
        self.ran = 0
        # how many times its callback let an exception out
        self.failed = 0
        self.dropped = 0
        self.skipped = 0
        self.busy_ns = 0
        self.unattributed = 0
        # how many times in a row its callback ended soon after it published
        self.soon = 0
        # from which number on that is expected again; grows each time it turns out wrong
        self.soon_from = SOON_FROM
        # the topics that its callback has published on
        self.publishes: set[str] = set()
        self.removed = False
        # whether it holds the interpreter while it runs
        self.habit = Habit(None if callback is None else callback.holds_interpreter)
        # when the executor began to look after it, on the trace's clock: no job is due before
        self.since = 0
        # whether it runs where it is taken (see ``receiver``)
        self.at_once = False
        # its callback group, where that is to be asked whether it may run
        self.gate: Gate | None = None
        self.address = id(self)
        # taken from before a callback runs: it raises once the entity is destroyed
        self.handle = entity.handle if kind in _HANDLED else None

    @property
    def symbol(self) -> str:
        """Return module and name of what it calls, as ``rclcpp_callback_register`` has it."""
        function: Any = getattr(self.entity, 'callback', None)
        while isinstance(function, functools.partial):
            function = function.func
        if function is None:
            function = None if self.kind in (CLIENT, TASK) else type(self.entity)
        elif not hasattr(function, '__qualname__'):
            function = type(function)
        return '' if function is None else f'{function.__module__}.{function.__qualname__}'

    @property
    def name(self) -> str:
        """Return the key of its declared callback, or what an undeclared one is called."""
        if self.callback is not None:
            return self.callback.key
        return entity_name(self.node, self.symbol, f'{self.kind} {self.label}'.rstrip())

    def is_through(self) -> bool:
        """Return whether nothing of it waits or runs."""
        return self.ready <= self.ran + self.dropped

    def count_into(self, counts: dict[str, dict[str, Any]]) -> None:
        """
        Add what there is to count to the counts of this entry's callback.

        What nobody uses (the many services and events of every node) is left out.
        """
        if self.callback is None and not self.ready + self.skipped + self.dropped:
            return
        total = counts.setdefault(self.name, {
            'kind': self.kind, 'declared': self.callback is not None, 'waiting': 0,
            'holds_interpreter': False,
            **dict.fromkeys(COUNTS, 0)})
        for key in COUNTS:
            total[key] += getattr(self, key)
        total['waiting'] += len(self.waiting)
        total['holds_interpreter'] |= bool(self.habit.holds)


def link(entry: Entry, task_set: TaskSet, tables: Tables, topic: str) -> None:
    """Find the vertices that an entity bound to a declared callback starts."""
    callback = entry.callback
    assert callback is not None
    entry.topic = topic
    for dag in task_set.dags:
        first = tables.first_vertex[dag.index]
        for vertex in dag.vertices:
            if vertex.callback is not callback and vertex.callback.key != callback.key:
                continue
            if vertex.index == dag.source:
                entry.source = first + vertex.index
            for leg, (place, before) in enumerate(legs_of(vertex, dag.vertices)):
                if callback.topics[place] == topic:
                    entry.targets[first + before] = (first + vertex.index, leg)


class Work:
    """
    One execution of a callback: what to call, for which job, and where it stands.

    ``origin`` is the vertex and job that it executes (None for others).
    """

    __slots__ = ('entry', 'x', 'function', 'args', 'then', 'coroutine', 'origin', 'ready_ns')

    def __init__(
        self, entry: Entry, function: Callable[..., Any], args: tuple[Any, ...],
        then: Callable[[Any], None] | None = None,
    ) -> None:
        self.entry = entry
        self.x = -1
        self.function = function
        self.args = args
        self.then = then
        self.coroutine: Any = None
        self.origin: Origin | None = None
        self.ready_ns = 0

    def step(self) -> Any:
        """
        Run, or go on running; return None when it has finished, else what it waits for.

        :raises Destroyed: where it must not run any more.
        :raises BaseException: whatever the callback raises.
        """
        if self.coroutine is None:
            handle = self.entry.handle
            if handle is not None:
                try:
                    with handle:
                        # One more may have become due before it was cancelled in its callback.
                        if self.entry.kind == TIMER and self.entry.entity.is_canceled():
                            raise Destroyed
                except InvalidHandle:
                    raise Destroyed from None
            result = self.function(*self.args)
            if type(result) is not types.CoroutineType:
                if self.then is not None:
                    self.then(result)
                return None
            self.coroutine = result
        try:
            yielded = self.coroutine.send(None)
        except StopIteration as stop:
            if self.then is not None:
                self.then(stop.value)
            return None
        return yielded if yielded is not None else awaited(self.coroutine)

    def close(self) -> None:
        """Close what will never run on."""
        if self.coroutine is not None:
            self.coroutine.close()


def _nothing() -> None:
    pass


class TaskWork(Work):
    """An execution of an rclpy ``Task``; exceptions are the task's."""

    __slots__ = ()

    def step(self) -> Any:
        """Run the task once; return None when it is done."""
        task: Any = self.function
        task.waits_for = None
        task()
        if task.done() or task.cancelled():
            self.function = _nothing  # whoever else holds on to the task does so: see ``tasks``
            if self.then is not None:
                self.then(task)
            del task
            return None
        return awaited(self.coroutine) if task.waits_for is None else task.waits_for

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the executor keeps for each entity of rclpy: timer, subscription, service, …."""

from __future__ import annotations

import functools
from typing import Any, TYPE_CHECKING

from mddag_executor.core import legs_of, Tables
from mddag_executor.live.habits import Habit
from msg_graph import Callback, TaskSet
from msg_graph.binding import entity_name

if TYPE_CHECKING:
    from mddag_executor.live.groups import Gate

TIMER, SUBSCRIPTION, SERVICE, CLIENT, GUARD, WAITABLE, TASK = (
    'timer', 'subscription', 'service', 'client', 'guard', 'waitable', 'task')

SOON_NS = 300_000
"""So much time between publishing and the end of a callback is not worth waking a worker."""
BRIEF_NS = 50_000
"""A callback that ends within this is not worth waking a worker."""
SOON_RUNS, BRIEF_RUNS = 8, 32
DOUBT = 4
MOST_DEBT = 4096
SELDOM, FORGIVEN_NS = 32, 2_000_000
"""One in so many may be so long: the machine stalls, too."""

COUNTS = ('ready', 'ran', 'failed', 'dropped', 'skipped', 'unattributed', 'busy_ns')
_HAVE_HANDLES = (TIMER, SUBSCRIPTION, SERVICE)


class Guess:
    """
    Whether something is expected to be short, because it was so the last times.

    What takes longer is a debt, which as many short ones pay off as it was too long: so a wrong
    guess costs no more than ``limit_ns`` for each time, on average.  One in ``SELDOM`` is none.

    :param limit_ns: what is short.
    :param first: how many times it must have been short before it is expected.
    :ivar debt: it is expected to be short where there is none.
    """

    __slots__ = ('limit_ns', 'debt', '_last_long')

    def __init__(self, limit_ns: int, first: int) -> None:
        self.limit_ns = limit_ns
        self.debt = first
        self._last_long = 0

    def took(self, ns: int, run: int) -> None:
        """Learn how long it was in the run of this number."""
        if ns <= self.limit_ns:
            self.debt -= self.debt > 0
            return
        if ns > FORGIVEN_NS or run - self._last_long < SELDOM:
            self.debt = min(MOST_DEBT, self.debt + DOUBT * ns // self.limit_ns)
        self._last_long = run


class Entity:
    """
    An entity as the executor sees it.

    :param rclpy: rclpy's own object.
    :param callback: the declared callback that it is, or None.
    :param group: the number of its mutually exclusive callback group in the core, or -1.
    :param depth: how many of its executions may wait; 0 stands for any number.
    """

    __slots__ = (
        'kind', 'rclpy', 'node', 'callback', 'group', 'depth', 'label', 'source', 'targets',
        'topic', 'waiting', 'ready', 'ran', 'failed', 'dropped', 'skipped',
        'busy_ns', 'unattributed', 'removed', 'address', 'handle', 'remote_publishers',
        'awaits', 'is_own', 'incompatible_qos',
        'ends_soon', 'is_brief', 'publishes', 'at_once', 'habit', 'since', 'gate', '__weakref__')

    def __init__(
        self, kind: str, rclpy: Any, node: str, callback: Callback | None, group: int,
        depth: int, label: str,
    ) -> None:
        self.kind = kind
        self.rclpy = rclpy
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
        # the vertices in other processes whose messages enter here
        self.remote_publishers: list[int] = []
        # whether other processes announce publications for it; whether it is what hears of these
        self.awaits = False
        self.is_own = False
        # its executions that wait, the oldest first
        self.waiting: dict[int, None] = {}
        self.ready = 0
        self.ran = 0
        # how many times its callback let an exception out
        self.failed = 0
        self.dropped = 0
        self.skipped = 0
        self.busy_ns = 0
        self.unattributed = 0
        # of a subscription: the policy for which a publisher's messages do not come
        self.incompatible_qos: str | None = None
        # whether its callback ends soon after it has published; whether it always ends at once
        self.ends_soon = Guess(SOON_NS, SOON_RUNS)
        self.is_brief = Guess(BRIEF_NS, BRIEF_RUNS)
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
        self.handle = rclpy.handle if kind in _HAVE_HANDLES else None

    @property
    def symbol(self) -> str:
        """Return module and name of what it calls, as ``rclcpp_callback_register`` has it."""
        function: Any = getattr(self.rclpy, 'callback', None)
        while isinstance(function, functools.partial):
            function = function.func
        if function is None:
            function = None if self.kind in (CLIENT, TASK) else type(self.rclpy)
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
        Add what there is to count to the counts of this entity's callback.

        What nobody uses (the many services and events of every node) is left out.
        """
        if self.callback is None and not self.ready + self.skipped + self.dropped:
            return
        total = counts.setdefault(self.name, {
            'kind': self.kind, 'declared': self.callback is not None, 'waiting': 0,
            'holds_interpreter': False, 'interpreter_share': None, 'incompatible_qos': None,
            **dict.fromkeys(COUNTS, 0)})
        for key in COUNTS:
            total[key] += getattr(self, key)
        total['waiting'] += len(self.waiting)
        total['holds_interpreter'] |= bool(self.habit.holds)
        total['incompatible_qos'] = total['incompatible_qos'] or self.incompatible_qos
        share = self.habit.share
        if share is not None:
            total['interpreter_share'] = max(total['interpreter_share'] or 0.0, round(share, 3))


def link(entity: Entity, task_set: TaskSet, tables: Tables, topic: str) -> None:
    """Find the vertices that an entity bound to a declared callback starts."""
    callback = entity.callback
    assert callback is not None
    entity.topic = topic
    for dag in task_set.dags:
        first = tables.first_vertex[dag.index]
        for vertex in dag.vertices:
            if vertex.callback is not callback and vertex.callback.key != callback.key:
                continue
            if vertex.index == dag.source:
                entity.source = first + vertex.index
            for leg, (place, before) in enumerate(legs_of(vertex, dag.vertices)):
                if callback.topics[place] == topic:
                    entity.targets[first + before] = (first + vertex.index, leg)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The executor's record of an entity of rclpy: what all kinds of callbacks have in common.

Each kind is a subclass (``kinds``); engine and workers only use what is here.
"""

from __future__ import annotations

from collections.abc import Callable as Callable_
from collections.abc import Mapping
import functools
from typing import Any, ClassVar

from mddag_executor.core import legs_of, Tables
from mddag_executor.core.driven import Awaiting
from mddag_executor.executor.attribution import new_address, Origin
from mddag_executor.executor.bounds import SHORT_CALLBACK_NS
from mddag_executor.executor.gil import GilHabit
from mddag_executor.executor.loop import ChannelSource
from msg_graph import Callback, TaskSet
from msg_graph.binding import Entity as Declarable
from msg_graph.binding import entity_name

UNKNOWN_NS = 100_000_000
"""The expected duration of a callback that has not run yet, ns."""

COUNTS = (
    'ready', 'ran', 'failed', 'dropped', 'lost', 'skipped', 'unattributed', 'guessed', 'busy_ns')


class Entity(ChannelSource):
    """
    An entity as the executor sees it.

    :param rclpy_object: the object of rclpy; None: it has none (a task).
    :param node: the full name of its node.
    :cvar kind: what it is called in names, statistics and recordings.
    :cvar is_due_at_release: whether its arrivals are the releases of its jobs (a timer's).
    :cvar keeps_oldest: whether a new execution is skipped when too many wait (a timer's); else the
        oldest is dropped for it.
    :cvar at_once: whether its arrivals are handled at once (see ``at_once``).
    :cvar names_type: whether it is named after the type of rclpy's object if it has no function.
    :cvar is_known_to_caret: whether CARET knows such callbacks, with their callback groups.
    :ivar declarable: what a declaration calls it; None: a declaration cannot name it.
    :ivar callback: its declared callback, or None.
    :ivar group: the number of its mutually exclusive callback group in the core, or -1.
    :ivar depth: how many of its executions may wait; 0: any number.
    """

    kind: ClassVar[str] = ''
    is_due_at_release: ClassVar[bool] = False
    keeps_oldest: ClassVar[bool] = False
    names_type: ClassVar[bool] = True
    at_once: ClassVar[bool] = False
    is_known_to_caret: ClassVar[bool] = False

    __slots__ = (
        'declarable', 'rclpy_object', 'node', 'callback', 'group', 'outer', 'depth', 'label',
        'source', 'targets', 'topic', 'waiting', 'last_since', 'ready', 'ran', 'failed', 'dropped',
        'lost', 'skipped', 'busy_ns', 'unattributed', 'guessed', 'removed', 'may_be_gone',
        'address', 'handle', 'remote_publishers', 'awaits', 'is_own', 'incompatible_qos',
        'wall_ns', 'tail_ns', 'publishes', 'habit', 'since', 'gate', 'exclusive', 'most_waiting',
        'collect_more', 'counts_as_eager', 'queue', 'awaiting', 'may_answer', '__weakref__')

    def __init__(self, rclpy_object: Any, node: str) -> None:
        super().__init__()
        self.rclpy_object = rclpy_object
        self.node = node
        self.declarable: Declarable | None = None
        self.callback: Callback | None = None
        self.group = -1
        # the number of its outer group in the core, or -1
        self.outer = -1
        # its queue in the core, if it has run without a job; else -1
        self.queue = -1
        self.depth = 0
        self.label = ''
        self.topic = ''
        # global vertex of the source that it starts, or -1
        self.source = -1
        # publishing vertex -> (vertex that its message starts, leg)
        self.targets: dict[int, tuple[int, int]] = {}
        # the vertices in other processes whose messages enter here
        self.remote_publishers: list[int] = []
        # whether other processes announce publications for it; whether it receives announcements
        self.awaits = False
        # of a topic of a driven sync: its jobs; whether another topic drives it
        self.awaiting: Awaiting[Origin] | None = None
        self.may_answer = False
        self.is_own = False
        # its waiting executions, the oldest first
        self.waiting: dict[int, None] = {}
        # since when its last execution without a job counts as ready
        self.last_since = 0
        self.ready = 0
        self.ran = 0
        # how many times its callback raised an exception
        self.failed = 0
        self.dropped = 0
        # messages of a subscription that the middleware dropped (see ``gaps``)
        self.lost = 0
        self.skipped = 0
        self.busy_ns = 0
        self.unattributed = 0
        # of a driven sync: answers to one of several jobs, it is not known which (``core.driven``)
        self.guessed = 0
        # recent averages: duration of its callback, and time from its first publication to its end
        self.wall_ns = UNKNOWN_NS
        self.tail_ns = 0
        # of a subscription: the policy because of which a publisher's messages do not arrive
        self.incompatible_qos: str | None = None
        # the topics that its callback has published on
        self.publishes: set[str] = set()
        # whether it was destroyed; whether that, or ``is_withdrawn``, must be checked first
        self.removed = False
        self.may_be_gone = False
        # whether it holds the interpreter while it runs
        self.habit = GilHabit()
        # when the executor began to manage it, on the trace's clock: no job is due before
        self.since = 0
        # how many may wait in Python, the rest stays in the middleware; 0: any number
        self.most_waiting = 0
        # called when fewer of its executions wait: the middleware may have more
        self.collect_more: Callable_[[], None] | None = None
        # whether the pool lets a thread wait for its messages or requests (``is_eager``)
        self.counts_as_eager = False
        # runs a step in its callback group, if that must be asked (``work.run_in_group``)
        self.gate: Callable_[..., Any] | None = None
        # its mutually exclusive callback group, which is notified of each execution
        self.exclusive: Any = None
        self.address = new_address()
        # entered before a callback runs: it raises once the entity is destroyed
        self.handle: Any = None

    def declare(self, callback: Callback) -> None:
        """Set its declared callback."""
        self.callback = callback
        self.habit = GilHabit(callback.holds_interpreter)

    def is_withdrawn(self, work: Any) -> bool:
        """Return whether a ready execution must not run any more; its handle is entered."""
        return False

    def is_eager(self) -> bool:
        """Return whether its callback is known to wait for long, so that it starts at once."""
        habit = self.habit
        return bool(habit.is_known and not habit.computes and self.wall_ns > SHORT_CALLBACK_NS)

    def may_come_from_outside(self) -> bool:
        """Return whether messages may come that declared callbacks of this process do not send."""
        return False

    def leave(self, several: list[Any]) -> None:
        """Leave executions that will not run here to the next executor of its node, if any."""

    def record(self, say: Callable_[..., None], node: int) -> None:
        """
        Record it, with the tracepoints that CARET expects if it knows the kind.

        :param say: records an event with its fields.
        :param node: the address of its node.
        """
        say('rclcpp_callback_register', self.address, self.name)

    @property
    def symbol(self) -> str:
        """Return module and name of its callback, in the form of ``rclcpp_callback_register``."""
        function: Any = getattr(self.rclpy_object, 'callback', None)
        while isinstance(function, functools.partial):
            function = function.func
        if function is None:
            function = type(self.rclpy_object) if self.names_type else None
        elif not hasattr(function, '__qualname__'):
            function = type(function)
        return '' if function is None else f'{function.__module__}.{function.__qualname__}'

    @property
    def name(self) -> str:
        """Return the key of its declared callback, or the name of an undeclared one."""
        if self.callback is not None:
            return self.callback.key
        return entity_name(self.node, self.symbol, f'{self.kind} {self.label}'.rstrip())

    def is_through(self) -> bool:
        """Return whether none of its executions waits or runs."""
        return self.ready <= self.ran + self.dropped

    def count_into(self, counts: dict[str, dict[str, Any]], name: str | None = None) -> None:
        """
        Add the counts of this entity to those of its callback, or to those of a name.

        Unused entities (the many services and events of every node) are left out.
        """
        if self.callback is None and not self.ready + self.skipped + self.dropped:
            return
        share = self.habit.share
        add_counts(counts, name or self.name, {
            'kind': self.kind, 'declared': self.callback is not None,
            'waiting': len(self.waiting), 'holds_interpreter': bool(self.habit.holds),
            'interpreter_share': None if share is None else round(share, 3),
            'incompatible_qos': self.incompatible_qos,
            **{key: getattr(self, key) for key in COUNTS}})


def add_counts(counts: dict[str, dict[str, Any]], name: str, more: Mapping[str, Any]) -> None:
    """Add the counts of a callback to those of the same name."""
    total = counts.get(name)
    if total is None:
        counts[name] = {**more}
        return
    for key in (*COUNTS, 'waiting'):
        total[key] += more[key]
    total['holds_interpreter'] |= more['holds_interpreter']
    total['incompatible_qos'] = total['incompatible_qos'] or more['incompatible_qos']
    total['interpreter_share'] = max(
        total['interpreter_share'], more['interpreter_share'], key=lambda share: share or 0.0)


def link(entity: Entity, task_set: TaskSet, tables: Tables) -> None:
    """Find the vertices that an entity bound to a declared callback starts."""
    callback = entity.callback
    assert callback is not None
    topic = entity.topic
    if topic in callback.other_topics:
        entity.may_answer = True
        return
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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What the numbers in the tables of a recording mean: nodes, callbacks, publishers, processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from msg_graph import format_duration
from msg_graph.binding import Entity, entity_name
from msg_graph.duration import exact_duration

KINDS = ('timer', 'subscription', 'service')

Address = tuple[int, int]
"""Process and address."""


class Node(NamedTuple):
    """A node of a process."""

    pid: int
    name: str
    time: int


class Publisher(NamedTuple):
    """A publisher; `node` is None if its node is not recorded."""

    number: int
    node: Node | None
    topic: str


class Callback:
    """
    A timer, subscription or service of a recording, with its callback.

    :ivar number: identifies the callback; 0: no callback is recorded.
    :ivar kind: ``timer``, ``subscription``, ``service``, ``other`` (an action, a task, …; it has
        only a symbol) or ``unknown``.
    :ivar start: topic or name of the service; empty for timers.
    :ivar period: of its timer, ns; 0 for others.
    :ivar made: when its timer, subscription or service was created, ns.
    :ivar grid: origin of its timer's periods, ns; None: not recorded.
    :ivar group: number of its mutually exclusive group; -1: reentrant, None: unknown.
    :ivar symbol: of its function; empty if not recorded.
    :ivar address: process and address of its callback; of several the last one.
    :ivar gone: when it was destroyed or left the executor, ns; None: this is not recorded.
    """

    __slots__ = ('number', 'node', 'kind', 'start', 'period', 'made', 'grid', 'group', 'symbol',
                 'label', 'address', 'rmw', 'gone')

    def __init__(self, node: Node | None, kind: str, start: str = '', period: int = 0,
                 made: int = 0, grid: int | None = None) -> None:
        self.number = 0
        self.node = node
        self.kind = kind
        self.start = start
        self.period = period
        self.made = made
        self.grid = grid
        self.group: int | None = None
        self.symbol = ''
        self.label = ''
        self.address: Address | None = None
        self.rmw: Address | None = None
        self.gone: int | None = None

    @property
    def node_name(self) -> str:
        """Return the name of its node; empty if not recorded."""
        return '' if self.node is None else self.node.name

    @property
    def description(self) -> str:
        """Return its node and trigger."""
        node = self.node_name or 'a node that is not recorded'
        if self.kind == 'timer':
            return f'{node} timer {format_duration(self.period)}'
        return f'{node} {self.kind} {self.start}'.rstrip()

    @property
    def entity(self) -> Entity | None:
        """Return the entity that a declaration may bind to it; None if its node is unknown."""
        return None if self.node is None else Entity(
            self.node.name, self.kind, self.start, self.period or None)


@dataclass(frozen=True)
class Names:
    """
    The nodes, callbacks and publishers of a recording, by their numbers in tables.

    :ivar made: all timers, subscriptions and services; ``callbacks``: those with a callback.
    :ivar by_number: callbacks by number; ``publishers``: likewise.
    :ivar nodes: the names of the nodes.
    :ivar groups: by callback its mutually exclusive group; -1: reentrant.
    :ivar programs: by callback its program, if that runs one callback at a time.
    :ivar symbols: the functions of otherwise unknown callbacks.
    :ivar vertices: by callback a vertex of its declared callback, for executions without job.
    :ivar processes: in a recording of another executor by process id a name.
    :ivar process_names: of several processes their names, by the numbers of columns ``process``.
    :ivar workers: names of workers, if they are more than a number.
    :ivar drop_reasons: names of the values of ``drops['reason']``.
    :ivar places: names of the values of ``unfinished['where']``.
    """

    made: list[Callback] = field(default_factory=list)
    callbacks: list[Callback] = field(default_factory=list)
    by_number: dict[int, Callback] = field(default_factory=dict)
    publishers: dict[int, Publisher] = field(default_factory=dict)
    nodes: dict[str, None] = field(default_factory=dict)
    groups: dict[int, int] = field(default_factory=dict)
    programs: dict[int, int] = field(default_factory=dict)
    symbols: dict[int, str] = field(default_factory=dict)
    vertices: Mapping[int, int] = field(default_factory=dict)
    processes: Mapping[int, str] = field(default_factory=dict)
    process_names: Sequence[str] = ()
    workers: Sequence[str] = ()
    drop_reasons: Sequence[str] = ()
    places: Sequence[str] = ()

    def topic(self, number: int) -> str:
        """Return the topic of a subscription's callback; empty for others."""
        callback = self.by_number.get(number)
        return callback.start if callback is not None and callback.kind == 'subscription' else ''

    def name(self, number: int) -> str:
        """Return the name of an undeclared callback."""
        callback = self.by_number.get(number)
        if callback is None:
            return self.symbols.get(number, 'a callback whose start is not recorded')
        if callback.label or callback.node is None:
            return callback.label or callback.symbol
        what = exact_duration(callback.period) if callback.period else callback.start
        return entity_name(callback.node.name, callback.symbol, f'{callback.kind} {what}')

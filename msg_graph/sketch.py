# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A sketch of a system: its nodes and callbacks as far as a file, a trace or a running system knows.

Sketches come from CARET architecture files (``caret``), from traces and from running systems;
``blanks`` writes them as declarations to fill in. Names in a sketch are valid: whoever makes one
checks them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from msg_graph.model import ExecutionTime, ReleaseFrom

UNDEFINED = 'UNDEFINED'
"""Stands for a topic at the end of a path (CARET's word)."""

_BACKGROUND_TOPICS = {'/rosout', '/parameter_events', '/clock', '/diagnostics'}
_BACKGROUND_SERVICES = {
    'describe_parameters', 'get_parameter_types', 'get_parameters', 'list_parameters',
    'set_parameters', 'set_parameters_atomically', 'get_type_description',
    'get_logger_levels', 'set_logger_levels'}
_LIFECYCLE = {
    'change_state', 'get_state', 'get_available_states', 'get_available_transitions',
    'get_transition_graph', 'transition_event'}


@dataclass
class SketchCallback:
    """
    A callback.

    :ivar kind: ``timer``, ``subscription``, ``sync`` or ``service``.
    :ivar starts: the topics that start it, or its service; empty for a timer.
    :ivar period_ns: its timer's period; of a source that is no timer, where that is known.
    :ivar publishes: topics that it publishes for sure.
    :ivar maybe: topics of its node that it may publish.
    :ivar reads: topics and callbacks of its node that it reads by queue edges.
    :ivar interval_ns: measured mean time between two of its executions.
    :ivar times: its measured execution time, and the number of executions that were measured.
    :ivar guessed: whether it is only supposed that there is this timer.
    """

    node: str
    name: str
    kind: str
    starts: list[str] = field(default_factory=list)
    period_ns: int | None = None
    publishes: list[str] = field(default_factory=list)
    maybe: list[str] = field(default_factory=list)
    reads: list[str] = field(default_factory=list)
    group: str | None = None
    dag: str | None = None
    deadline_ns: int | None = None
    release_from: ReleaseFrom = 'arrival'
    interval_ns: int | None = None
    times: tuple[ExecutionTime, int] | None = None
    guessed: bool = False

    @property
    def key(self) -> str:
        """Return the key that the callback has in a declaration."""
        return f'{self.node}:{self.name}'

    @property
    def source_period_ns(self) -> int | None:
        """Return the time between two releases if this is a source, as far as it is known."""
        return self.interval_ns if self.period_ns is None else self.period_ns


@dataclass
class SketchNode:
    """A node with its callbacks by name, and topics that it subscribes without a callback."""

    name: str
    callbacks: dict[str, SketchCallback] = field(default_factory=dict)
    taken: list[str] = field(default_factory=list)


@dataclass
class SketchPath:
    """A named path: node, subscribed and published topic of each step."""

    name: str
    steps: list[tuple[str, str, str]]


@dataclass
class Sketch:
    """
    A system.

    :ivar origin: what it was made from, for the first line of the declaration.
    """

    origin: str
    nodes: list[SketchNode]
    paths: list[SketchPath] = field(default_factory=list)
    workers: int | None = None

    def callbacks(self) -> Iterator[SketchCallback]:
        """Yield the callbacks of all nodes."""
        for node in self.nodes:
            yield from node.callbacks.values()


def is_background(name: str, node: str) -> bool:
    """
    Tell whether a node has a topic or service as every node has, or is an action's inner one.

    So it is with what every lifecycle node has. A declaration is about what a system is there for,
    not about what the client library adds.
    """
    before, _, word = name.rpartition('/')
    return (name in _BACKGROUND_TOPICS or '/_action/' in name or word in _BACKGROUND_SERVICES
            or (word in _LIFECYCLE and before == node))

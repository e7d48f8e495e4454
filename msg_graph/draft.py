# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Drafts of declarations: a system as far as a file, a trace or the system itself shows it.

Drafts come from CARET architecture files (``caret``), from traces and from running systems;
``draft_text`` writes them as declarations to fill in. Names in a draft are valid: whoever makes
one checks them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from msg_graph.model import ExecutionTime, ReleaseFrom

UNDEFINED = 'UNDEFINED'
"""Stands for a topic at the end of a path (CARET's word)."""


@dataclass
class DraftCallback:
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
    :ivar also: other keys that were declared, with their values.
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
    also: dict[str, str] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Return the key that the callback has in a declaration."""
        return f'{self.node}:{self.name}'

    @property
    def source_period_ns(self) -> int | None:
        """Return the time between two releases if this is a source, as far as it is known."""
        return self.interval_ns if self.period_ns is None else self.period_ns


@dataclass
class DraftNode:
    """A node with its callbacks by name, and topics that it subscribes without a callback."""

    name: str
    callbacks: dict[str, DraftCallback] = field(default_factory=dict)
    taken: list[str] = field(default_factory=list)


@dataclass
class DraftPath:
    """A named path: node, subscribed and published topic of each step, or keys of callbacks."""

    name: str
    steps: list[tuple[str, str, str]]
    keys: list[str] = field(default_factory=list)


@dataclass
class Draft:
    """
    A system.

    :ivar origin: what it was made from, for the first line of the declaration.
    """

    origin: str
    nodes: list[DraftNode]
    paths: list[DraftPath] = field(default_factory=list)
    workers: int | None = None

    def callbacks(self) -> Iterator[DraftCallback]:
        """Yield the callbacks of all nodes."""
        for node in self.nodes:
            yield from node.callbacks.values()

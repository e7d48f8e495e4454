# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Keeping up with nodes: whose entities there are now, and who has to know.

Nodes say that something has changed (``wake``), not what.  So registry, intake and trace are
brought up to date with all nodes at once, by whoever spins, and where entities are made in a row
not anew for each of them.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from typing import Any, TYPE_CHECKING

from mddag_executor.live.dispatcher import Dispatcher
from mddag_executor.live.groups import GroupOwner
from mddag_executor.live.intake.entities import EntitySet, snapshot
from mddag_executor.live.intake.waitset import WaitSetIntake
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry

if TYPE_CHECKING:
    from rclpy.node import Node

REFRESH_REST = 3
"""After looking at all entities, rest for so many times what it took."""


class Upkeep(GroupOwner):
    """The part of the executor that keeps up with its nodes."""

    _attention: threading.Event
    _changed: bool
    _dispatcher: Dispatcher
    _entities: EntitySet | None
    _inline: WaitSetIntake | None
    _recorder: Recorder | None
    _refresh_at: float
    _refreshing: threading.Lock
    _registry: Registry

    def add_node(self, node: Node) -> bool:
        """
        Add a node whose callbacks this executor runs; False when it has it already.

        :raises TypeError: when it is no node.
        :raises RuntimeError: when the executor was shut down.
        """
        if not hasattr(node, 'executor'):
            raise TypeError(f'{node!r} is no node: add an rclpy.node.Node')
        if self.is_gone():
            raise RuntimeError('The executor was shut down: add the node to a new one')
        added: bool = super().add_node(node)
        if added:
            self.wake()
        return added

    def remove_node(self, node: Node) -> None:
        """Stop running a node's callbacks."""
        super().remove_node(node)
        self.wake()

    def wake(self) -> None:
        """Take note of entities that were created or destroyed, or of a change of state."""
        self._changed = True
        self._ring()

    def _ring(self) -> None:
        """End the wait of whoever spins."""
        self._attention.set()
        self.ring()

    def _refresh(self) -> None:
        """Bring registry, intake and trace up to date with the nodes' entities."""
        with self._refreshing:
            if not self._changed:
                return
            start = time.monotonic()
            self._changed = False
            nodes = self._served_nodes()
            self._register(nodes)
            self._inform_intakes(nodes)
            end = time.monotonic()
            self._refresh_at = end + REFRESH_REST * (end - start)

    def _register(self, nodes: list[Any], keep: bool = False) -> None:
        added, gone = self._registry.refresh(nodes, keep)
        crossings = self._dispatcher.crossings
        if crossings is not None and (added or gone):
            with self._dispatcher.lock:
                crossings.host(
                    self._registry.hosted(), self._registry.subscriptions(),
                    self._dispatcher.record, self._dispatcher.tick())
        since = self._dispatcher.now()
        for entry in added:
            entry.since = since
        for entry in gone:
            self._dispatcher.remove(entry)
        if self._recorder is not None:
            self._recorder.entities(nodes, added)

    def _inform_intakes(self, nodes: list[Any]) -> None:
        self._entities = snapshot(nodes, self._entities)
        for intake in (self._intake, self._inline):
            if intake is not None:
                intake.update(self._entities)

    def _let_go(self, settled: Callable[[], bool]) -> None:
        """Take nothing more of what another executor gets, and only then forget it."""
        with self._refreshing:
            nodes = self._served_nodes()
            self._register(nodes, keep=True)
            self._inform_intakes(nodes)
            settled()
            self._register(nodes)

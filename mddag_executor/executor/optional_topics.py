# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Topics that a callback publishes only sometimes: what they lead to may be not due (rule 13).

An execution that ends, here or in another process, without having published such a topic leaves
the vertices that the topic leads to out of its job.
"""

from __future__ import annotations

from collections.abc import Callable

from mddag_executor.core import Scheduler
from mddag_executor.core.state import ELSEWHERE
from mddag_executor.executor.attribution import Origin
from msg_graph import TaskSet
from msg_graph.model import optional_edges


class OptionalTopics:
    """
    The optional topics of a task set.

    :ivar edges: by (global) vertex: the vertices that it may start, each with the topic that does.
    :ivar on_silent: announce that a vertex ends without a topic that starts one elsewhere.
    """

    def __init__(self, task_set: TaskSet | None, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._expected = scheduler.state.expected
        self._pending = scheduler.state.x_pending
        self.on_silent: list[Callable[[Origin, str], None]] = []
        self.edges: dict[int, list[tuple[int, str]]] = {}
        for dag in task_set.dags if task_set else ():
            first = scheduler.tables.first_vertex[dag.index]
            for vertex in dag.vertices:
                if several := optional_edges(vertex, dag.vertices):
                    self.edges[first + vertex.index] = [
                        (first + after, topic) for after, topic in several]

    def completes(self, origin: Origin) -> bool:
        """Return whether the end of an execution completes its vertex: False for an early leg."""
        return self._pending[self._scheduler.execution(origin.slot, origin.vertex)] <= 1

    def withhold(self, origin: Origin, published: set[str], now: int) -> None:
        """Leave out of a job what an execution that ends might have started, but has not."""
        slot, _, _, vertex = origin
        if self._pending[self._scheduler.execution(slot, vertex)] < 0:
            return
        for after, topic in self.edges[vertex]:
            if topic not in published:
                if self._expected[after] == ELSEWHERE:
                    for announce in self.on_silent:
                        announce(origin, topic)
                self._scheduler.withhold(slot, vertex, after, now)

    def is_heard(self, dag: int, vertex: int, topic: str) -> bool:
        """Return whether it matters here that a vertex elsewhere has not published a topic."""
        return dag >= 0 and self._expected[vertex] == ELSEWHERE and any(
            each == topic for _, each in self.edges.get(vertex, ()))

    def withhold_heard(self, origin: Origin, topic: str, now: int) -> None:
        """Leave out of an open job what an execution in another process has not started."""
        for after, each in self.edges[origin.vertex]:
            if each == topic:
                self._scheduler.withhold(origin.slot, origin.vertex, after, now)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages on topics of declared callbacks that none of these has published.

Theory of operation
-------------------
1.  A message belongs to a job if an execution of the job published it, or code that works on its
    behalf (``starters``).  A message that a thread, a task or an undeclared callback publishes
    otherwise belongs to no job.  The job counts as without it, although the node has published.
2.  Such messages are counted by publisher, and by the code that publishes.  Drift reports them at
    the end of the run (``msg_graph.drift``, rule 6), and a recorded run has them.
3.  If a callback may publish the topic (``may_publish``), results are not due without the message,
    and are not judged.  Nothing else shows this during a run, so it is also logged, once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from mddag_executor.executor.attribution import PublisherState
from msg_graph import TaskSet
from msg_graph.drift import outside_text
from rclpy.exceptions import InvalidHandle
from rclpy.logging import get_logger

Outsiders = tuple[tuple[str, str, str, int], ...]
"""Node, topic, callback or task (empty: none), and the number of its messages."""


def _log(text: str) -> None:
    get_logger('mddag_executor').warning(text)


class Outside:
    """
    Counts these messages.

    :param nodes: returns the nodes of the executor.
    :param warn: receives a warning.
    """

    def __init__(
        self, task_set: TaskSet, nodes: Callable[[], Iterable[Any] | None],
        warn: Callable[[str], object] = _log,
    ) -> None:
        self._warn = warn
        self._task_set = task_set
        self._nodes_now = nodes
        # by the address of the publisher: the counts by callback or task, its node, and its topic
        self._counts: dict[int, dict[str, int]] = {}
        self._nodes: dict[int, str] = {}
        self._topics: dict[int, str] = {}
        self._has_warned: set[int] = set()

    def note(
        self, publisher: Any, state: PublisherState, by: str, may_warn: bool
    ) -> None:
        """
        Count a message; the caller owns the publisher's lock.

        :param by: the undeclared callback, or the task; empty: the thread runs none.
        :param may_warn: whether jobs are judged now.
        """
        address = state.address
        counts = self._counts.setdefault(address, {})
        number = counts[by] = counts.get(by, 0) + 1
        self._topics[address] = state.topic
        node = self._nodes.get(address, '')
        if not node and number & (number - 1) == 0:  # it may have been added to the executor
            node = self._nodes[address] = self._node_of(publisher)
        if node and may_warn and address not in self._has_warned:
            self._has_warned.add(address)
            text = outside_text(self._task_set, node, state.topic, {by: number}, only_silent=True)
            if text is not None:
                self._warn(text)

    def _node_of(self, publisher: Any) -> str:
        for node in self._nodes_now() or ():
            try:
                if publisher in list(node.publishers):
                    return str(node.get_fully_qualified_name())
            except InvalidHandle:
                pass  # it was destroyed meanwhile
        return ''

    def counts(self) -> Outsiders:
        """Return the counts so far of publishers whose nodes are known."""
        return tuple(
            (self._nodes[address], self._topics[address], by, count)
            for address, counts in list(self._counts.items()) if self._nodes.get(address)
            for by, count in list(counts.items()))


def since(now: Outsiders, before: Outsiders) -> Outsiders:
    """Return counts without those of before; several publishers of a node have one."""
    found: dict[tuple[str, str, str], int] = {}
    for sign, several in ((1, now), (-1, before)):
        for node, topic, by, count in several:
            found[node, topic, by] = found.get((node, topic, by), 0) + sign * count
    return tuple((*key, count) for key, count in found.items() if count > 0)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The flows along declared paths in a trace of this executor.

Theory of operation
-------------------
Which message an execution ran for is known from its job: it is the one that the vertex before it
published in the same job (see ``paths`` for the rest).  What is published is recorded as CARET
does it; a simulated trace has no publications, there every topic is published when the callback
ends.

The topic that started a leg of a sync callback is its subscription's.  An execution of several
pieces (a coroutine) is one, from its first start to its last end.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable as Function
from typing import Any

from mddag_executor.replay.follower import Follower, Observer, Piece
from mddag_executor.replay.path_flows import Flows
from mddag_executor.replay.paths import PathBook, Places
from msg_graph import TaskSet

_KEEP_JOBS = 4096

Event = tuple[Any, ...]


class _Job:
    """What the executions of a job have published, and their places in paths."""

    __slots__ = ('runs', 'messages')

    def __init__(self) -> None:
        self.runs: dict[tuple[int, int], Places] = {}       # by vertex and ready time
        self.messages: dict[tuple[int, str], Places] = {}   # by vertex and topic


class OwnPaths(Observer):
    """
    Collects the flows while a follower tells what happened.

    :param task_set: the declaration that judges.
    """

    def __init__(self, task_set: TaskSet) -> None:
        self.book = PathBook(task_set)
        self.follower: Follower | None = None
        self._vertices = task_set.vertices
        self._before = [
            [v - vertex.index + p for p in vertex.predecessors]
            for v, vertex in enumerate(task_set.vertices)]
        self._jobs: OrderedDict[tuple[int, int], _Job] = OrderedDict()
        #: By address: node and topic.
        self.publishers: dict[int, tuple[str, str]] = {}
        #: What a compiled replay has found instead of the book.
        self.flows: Flows | None = None
        self._node: dict[int, str] = {}
        #: By handle, then by callback.
        self.topic_of: dict[int, str] = {}
        #: Whether what is published is recorded.
        self.any_published = False

    def handlers(self) -> dict[str, Function[[Event], None]]:
        """Return what takes in further events, by full name."""
        if not self.book:
            return {}
        return {
            'ros2:rcl_node_init': self._node_init,
            'ros2:rcl_publisher_init': self._publisher_init,
            'ros2:rcl_subscription_init': self._subscription_init,
            'ros2:rclcpp_subscription_callback_added': self._callback_added,
            'ros2:rclcpp_publish': self._publish}

    # --- who is who ------------------------------------------------------------------------------

    def _node_init(self, event: Event) -> None:
        self._node[event[4]] = f'{event[7].rstrip("/")}/{event[6]}'

    def _publisher_init(self, event: Event) -> None:
        self.any_published = True
        self.publishers[event[4]] = self._node.get(event[5], ''), event[7]

    def _subscription_init(self, event: Event) -> None:
        self.topic_of[event[4]] = event[7]

    def _callback_added(self, event: Event) -> None:
        topic = self.topic_of.get(event[4])
        if topic is not None:
            self.topic_of[event[5]] = topic

    # --- what happened ---------------------------------------------------------------------------

    def _job(self, dag: int, job: int) -> _Job:
        key = (dag, job)
        found = self._jobs.get(key)
        if found is None:
            found = self._jobs[key] = _Job()
            if len(self._jobs) > _KEEP_JOBS:
                self._jobs.popitem(last=False)
        return found

    def started(self, dag: int, vertex: int, job: int, ready: int, start: int) -> None:
        """Take in an execution that has begun, or a coroutine that went on."""
        callback = self._vertices[vertex].callback
        if not self.book.concerns(callback.key):
            return
        self.book.tidy()
        found = self._job(dag, job)
        if (vertex, ready) in found.runs:
            return
        topic = ''
        if self.follower is not None and callback.topics:
            topic = self.topic_of.get(self.follower.starting, '')
        message = Places()
        for before in self._before[vertex]:
            for of_topic in (topic,) if topic else callback.topics:
                message.update(found.messages.get((before, of_topic), ()))
        places = found.runs[(vertex, ready)] = Places()
        self.book.started(callback.key, places, start, message, topic)

    def _publish(self, event: Event) -> None:
        known = self.publishers.get(event[4])
        if known is None or known[1] not in self.book.topics or self.follower is None:
            return
        node, topic = known
        running = self.follower.running_in(event[3])
        times = (event[1], event[1], 0)
        if running is None or running[2] < 0:
            self.book.published(topic, node, None, None, Places(), times)
            return
        _, dag, vertex, job, ready = running
        self._published(dag, vertex, job, ready, topic, times)

    def _published(self, dag: int, vertex: int, job: int, ready: int, topic: str,
                   times: tuple[int, int, int]) -> None:
        callback = self._vertices[vertex].callback
        if not self.book.concerns(callback.key):
            return
        found = self._job(dag, job)
        message = found.messages.setdefault((vertex, topic), Places())
        self.book.published(
            topic, callback.node, callback.key, found.runs.get((vertex, ready)), message, times)

    def ran(self, piece: Piece) -> None:
        """Take in that an execution (or a piece of it) has ended."""
        if piece.vertex < 0:
            return
        callback = self._vertices[piece.vertex].callback
        if not self.book.concerns(callback.key):
            return
        places = self._job(piece.dag, piece.job).runs.get((piece.vertex, piece.ready)) or Places()
        if not self.any_published:
            for topic in callback.publishes:
                self._published(piece.dag, piece.vertex, piece.job, piece.ready, topic,
                                (piece.end, 0, 0))
        self.book.ended(callback.key, places, piece.end)

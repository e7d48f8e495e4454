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

from mddag_executor.replay.happenings import (
    Batch,
    different,
    Ints,
    Observer,
    PUBLISHED,
    RAN,
    STARTED,
)
from mddag_executor.replay.own import OwnRun
from mddag_executor.replay.path_forest import NONE
from mddag_executor.replay.paths import by_column, PathBook, S_MESSAGE, S_TOPIC, S_VERTEX
from msg_graph import TaskSet
import numpy as np

_JOB = 42   # bits: no execution is ready more than an hour before one of the job before it


class OwnPaths(Observer):
    """
    Collects the flows along the paths of a run.

    :param run: which knows who publishes and takes what.
    """

    def __init__(self, run: OwnRun) -> None:
        task_set, self._who = run.task_set, run.who
        self.book = _Book(task_set)
        self._n_dags, self._n_vertices = max(1, len(task_set.dags)), len(task_set.vertices) + 1
        book, vertices = self.book, task_set.vertices
        # by vertex; the last stands for none
        self._callback = np.array([
            *(book.callbacks[v.callback.key] if v.callback.key in book.on_path else NONE
              for v in vertices), NONE])
        self._takes_topics = np.array([*(bool(v.callback.topics) for v in vertices), False])
        self._publishes = [[book.topics[topic] for topic in v.callback.publishes
                            if topic in book.topics] for v in vertices]

    def take(self, batch: Batch) -> None:
        """Give the book what callbacks on paths did."""
        if not self.book:
            return
        started, ran = batch.columns(STARTED), batch.columns(RAN)
        chosen = np.flatnonzero(self._callback[started[:, 1]] != NONE)
        dag, vertex, job, ready, start, address, _ = started[chosen].T
        topics = np.where(self._takes_topics[vertex], self._number_of(address), NONE)
        begun = np.column_stack((
            batch.places(STARTED)[chosen], self._callback[vertex],
            self._run(vertex, job, ready), start, topics, job * self._n_dags + dag, vertex))
        chosen = np.flatnonzero(self._callback[ran[:, 2]] != NONE)
        ran = ran[chosen]
        vertex = ran[:, 2]
        ended = np.column_stack((
            batch.places(RAN)[chosen], self._callback[vertex],
            self._run(vertex, ran[:, 3], ran[:, 5]), ran[:, 7]))
        if not self._who.every_publisher:     # what is published is not recorded
            sent = self._at_ends(ended, ran)
        else:
            sent = self._published(batch)
        self.book.add(len(batch.order) + 1, begun, ended, sent)

    def _run(self, vertex: Ints, job: Ints, ready: Ints) -> Ints:
        """Return the numbers of executions: nearly ascending, which is quick to sort."""
        return (ready + (job << _JOB)) * self._n_vertices + vertex

    def _number_of(self, callbacks: Ints) -> Ints:
        """Return the numbers of the topics of callbacks: -2 of one that no path leads over."""
        different, which = np.unique(callbacks, return_inverse=True)
        topics = [self._who.topic(callback) for callback in different.tolist()]
        return np.array([self.book.topics.get(topic, -2) if topic else NONE
                         for topic in topics], dtype=np.int64)[which]

    def _at_ends(self, ended: Ints, ran: Ints) -> Ints:
        """Return what is published when a callback ends, of which nothing is recorded."""
        parts = []
        rows = np.column_stack((ended, ran))
        for vertex, mine in by_column(rows, ended.shape[1] + 2).items():
            place, callback, run, time, _, dag, _, job = mine[:, :8].T
            parts += [self._sent(place, callback, NONE, run, topic, dag, job, vertex, time)
                      for topic in self._publishes[vertex]]
        found = np.concatenate(parts) if parts else np.empty((0, 7), dtype=np.int64)
        return found[np.argsort(found[:, 0], kind='stable')]

    def _sent(
        self, place: Ints, callback: Ints, node: Ints | int, run: Ints, topic: Ints | int,
        dag: Ints, job: Ints, vertex: Ints | int, time: Ints,
    ) -> Ints:
        message = self.book.message(job * self._n_dags + dag, vertex, topic)
        return np.column_stack(np.broadcast_arrays(
            place, callback, node, run, topic, message, time))

    def _published(self, batch: Batch) -> Ints:
        """Return what is published on topics that paths lead over."""
        published = batch.columns(PUBLISHED)
        different, which = np.unique(published[:, 0], return_inverse=True)
        known = [self._who.every_publisher.get(number) for number in different.tolist()]
        topic, node = np.array(
            [(NONE, NONE) if each is None else (
                self.book.topics.get(each.topic, NONE),
                self.book.nodes.get(each.node.name if each.node is not None else '', NONE))
             for each in known], dtype=np.int64).reshape(-1, 2)[which].T
        vertex = published[:, 3]
        callback = np.where(published[:, 2] < 0, NONE, self._callback[vertex])
        chosen = np.flatnonzero(
            (topic != NONE) & ((callback != NONE) | (published[:, 2] < 0)))
        _, _, dag, vertex, job, ready, now = published[chosen].T
        sent = self._sent(
            batch.places(PUBLISHED)[chosen], callback[chosen], node[chosen],
            self._run(vertex, job, ready), topic[chosen], dag, job, vertex, now)
        sent[dag < 0, 5] = NONE
        return sent


class _Book(PathBook):
    """The paths; a message is known by its job, and the vertex and topic that published it."""

    def __init__(self, task_set: TaskSet) -> None:
        super().__init__(task_set)
        self._n_vertices, self._n_topics = len(task_set.vertices), len(self.topics) + 1
        # by place and vertex: the vertices of the callback before it that lead to it; by vertex
        # its topics
        self._before: list[dict[int, list[int]]] = []
        self._topics_of = [[self.topics[topic] for topic in v.callback.topics
                            if topic in self.topics] for v in task_set.vertices]
        for path in self.paths:
            for before, after in zip((None, *path.callbacks), path.callbacks):
                self._before.append({
                    v: [v - vertex.index + p for p in vertex.predecessors
                        if task_set.vertices[v - vertex.index + p].callback.key == before]
                    for v, vertex in enumerate(task_set.vertices) if vertex.callback.key == after})

    def message(self, job: Ints, vertex: Ints | int, topic: Ints | int) -> Ints:
        """Return the numbers of messages."""
        return (job * self._n_vertices + vertex) * self._n_topics + topic

    def messages_of(self, place: int, started: Ints) -> list[Ints]:
        """Return what the vertices before executions may have published for them."""
        found: list[Ints] = []
        for vertex in different(started[:, S_VERTEX]):
            mine = started[:, S_VERTEX] == vertex
            topics, job = started[:, S_TOPIC], started[:, S_MESSAGE]
            for before in self._before[place].get(vertex, ()):
                for topic in self._topics_of[vertex]:
                    fits = mine & ((topics == topic) | (topics == NONE))
                    found.append(np.where(fits, self.message(job, before, topic), NONE))
        return found

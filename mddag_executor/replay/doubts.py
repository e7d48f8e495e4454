# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds jobs of an imported recording that cannot be judged because of lost events.

Theory of operation
-------------------
A job that has not completed counts as late or expired only if the recording shows it.  It is in
doubt if, at or after its release,

* a callback of one of its uncompleted vertices ran for an unknown job: its message is unknown, or
  its start or end is not recorded.  If the message's source timestamp is known but its publication
  is not, this only affects jobs without a recorded publication with source timestamp to this
  callback;
* the tracer discarded events.

Doubts are reported in the order of time.
"""

from __future__ import annotations

from collections.abc import Iterable

from msg_graph import Dag

Job = tuple[int, int]       # DAG and number


class Doubts:
    """Collects lost events, and the known events of open jobs."""

    def __init__(self, dags: Iterable[Dag]) -> None:
        self._vertices: list[tuple[int, list[tuple[str, tuple[str, ...]]], list[int]]] = []
        first = 0
        for dag in dags:
            self._vertices.append((
                first, [(v.callback.key, tuple(v.callback.topics)) for v in dag.vertices],
                list(dag.sinks)))
            first += len(dag.vertices)
        self._unknown: dict[str, int] = {}      # by callback: last execution of an unknown job
        self._unsent: dict[str, int] = {}       # the same, for a message of unknown publication
        self._discarded = -1
        self._done: dict[Job, set[int]] = {}
        self._sent: dict[Job, set[str]] = {}
        #: By DAG the number of withdrawn jobs.
        self.withdrawn: dict[int, int] = {}

    def ran_for_unknown(self, key: str, time: int, stamped: bool = False) -> None:
        """
        Note that a callback ran for an unknown job.

        :param stamped: whether the source timestamp of its message is known.
        """
        (self._unsent if stamped else self._unknown)[key] = time

    def discarded(self, time: int) -> None:
        """Doubt the jobs released before events were discarded."""
        self._discarded = max(self._discarded, time)

    def opened(self, dag: int, job: int) -> None:
        """Begin a job."""
        self._done[dag, job] = set()
        self._sent[dag, job] = set()

    def done(self, dag: int, vertex: int, job: int) -> None:
        """Note that a vertex of a job has completed."""
        if (dag, job) in self._done:
            self._done[dag, job].add(vertex)

    def sent(self, dag: int, job: int, topic: str) -> None:
        """Note that a message of a job was published, and can be linked."""
        if (dag, job) in self._sent:
            self._sent[dag, job].add(topic)

    def close(self, dag: int, job: int, release: int) -> bool:
        """Forget a job; return whether it cannot be judged."""
        done = self._done.pop((dag, job))
        sent = self._sent.pop((dag, job))
        first, vertices, sinks = self._vertices[dag]
        if all(first + sink in done for sink in sinks):
            return False
        doubted = self._discarded >= release
        for vertex, (key, topics) in enumerate(vertices, first):
            if vertex not in done:
                doubted = doubted or self._unknown.get(key, -1) >= release or (
                    self._unsent.get(key, -1) >= release and not sent.issuperset(topics))
        if doubted:
            self.withdrawn[dag] = self.withdrawn.get(dag, 0) + 1
        return doubted

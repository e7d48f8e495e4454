# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which execution completes a sync of topics with different rates (``driven_by``): rule 16.

Theory of operation
-------------------
A *driving message* is one of the topic of ``driven_by``; it belongs to a job.

1.  A job *awaits* an answer from the start of the execution for its driving message on.
2.  Each execution of the sync, for a message of any of its topics, may answer the newest job of
    which the driving message was received before it started.
3.  It *answers* if it publishes one of the callback's topics.  If the callback need not publish
    any (no ``publishes:``), it also answers as soon as there has been a message of each topic.
4.  An answer completes the vertex in its job, and in all jobs whose driving messages were received
    before that of the answered one and which still await an answer: their data was combined, or
    replaced by newer data.

Live executor and imported recordings use this class.  A job is anything with a ``vertex``, as a
callback may be several vertices.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Set
from typing import Generic, Protocol, TypeVar

from msg_graph import Callback

MOST_AWAITING = 1000
"""So many jobs may await an answer; of more, the oldest are forgotten."""


class Job(Protocol):
    """A job as one vertex."""

    @property
    def vertex(self) -> int:
        """Return the global vertex."""


JobType = TypeVar('JobType', bound=Job)


class Awaiting(Generic[JobType]):
    """The jobs that await an answer of a driven sync, in the order of their driving messages."""

    def __init__(self, callback: Callback) -> None:
        self._topics = frozenset(callback.publishes)
        self._must_publish = len(callback.may_publish) < len(callback.publishes)
        self._missing = set(callback.topics)
        self._jobs: deque[JobType] = deque(maxlen=MOST_AWAITING)

    def hear(self, topic: str) -> None:
        """Note that an execution for a message of a topic starts."""
        self._missing.discard(topic)

    def receive(self, job: JobType) -> None:
        """Note that the execution for the driving message of a job starts."""
        if job not in self._jobs:
            self._jobs.append(job)

    def newest(self, is_open: Callable[[JobType], bool]) -> JobType | None:
        """Return the job that an execution which starts now may answer, None if there is none."""
        while self._jobs and not is_open(self._jobs[-1]):
            self._jobs.pop()
        return self._jobs[-1] if self._jobs else None

    def is_answer(self, published: Set[str]) -> bool:
        """Return whether an execution that ends, and has published some topics, answers."""
        return not self._topics.isdisjoint(published) or not (
            self._must_publish or self._missing)

    def answer(self, job: JobType) -> list[JobType]:
        """
        Return the jobs that an answer to a job completes, that job first; empty: none.

        They no longer await one.
        """
        if job not in self._jobs:
            return []
        place = self._jobs.index(job)
        older = [each for each in list(self._jobs)[:place] if each.vertex == job.vertex]
        for each in (job, *older):
            self._jobs.remove(each)
        return [job, *reversed(older)]

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Which execution completes a sync of topics with different rates (``driven_by``): rule 14.

Theory of operation
-------------------
A *driving message* is one of the topic of ``driven_by``; it belongs to a job.

1.  A job *awaits* an answer from the start of the execution for its driving message on.
2.  Each execution of the sync may answer one job.  The execution for a driving message may answer
    the job of that message.  An execution for a message of another topic may answer the job whose
    driving message has the header stamp that the output carries: programs copy the header of
    the data that they have used.  If the output carries no stamp of a driving message, it is the
    newest job of which the driving message was received before the execution started.  If others
    await an answer then, this is a *guess*.  An output with the stamp of a job that has been
    answered before answers none.
3.  It *answers* if it publishes one of the callback's topics.  If the callback need not publish
    any (no ``publishes:``), it also answers as soon as there has been a message of each topic.
4.  An answer completes the vertex in its job, and in all jobs whose driving messages were received
    before that of the answered one and which still await an answer: their data was combined, or
    replaced by newer data.

Live executor and imported recordings use this class.  A job is anything with a ``vertex``, as a
callback may be several vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Set
from typing import Any, Generic, Protocol, TypeVar

from msg_graph import Callback

ANSWERED, GUESSED = 0, 1
"""The leg, in recordings, of an execution that answers a job; whether it is a guess."""
MOST_AWAITING = 1000
"""This many jobs may await an answer; if there are more, the oldest are forgotten."""


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
        self._jobs: dict[JobType, None] = {}
        # those of which an output has carried the stamp of the driving message
        self._named: dict[JobType, None] = {}
        # by header stamp of a driving message its job, even if it has been answered
        self._stamped: dict[int, JobType] = {}

    def hear(self, topic: str) -> None:
        """Note that an execution for a message of a topic starts."""
        self._missing.discard(topic)

    def receive(self, job: JobType, stamp: int = -1) -> None:
        """
        Note that the execution for the driving message of a job starts.

        :param stamp: the message's header stamp, ns; not positive: it has none.
        """
        self._jobs.setdefault(job)
        _forget(self._jobs)
        if stamp > 0:
            self._stamped[stamp] = job
            _forget(self._stamped)

    def newest(self, is_open: Callable[[JobType], bool]) -> JobType | None:
        """
        Return the job that an execution which starts now may answer, None if there is none.

        The execution is for a message of another topic; its outputs may change this: ``named``.
        """
        while self._jobs and not is_open(newest := next(reversed(self._jobs))):
            del self._jobs[newest]
            self._named.pop(newest, None)
        return next(reversed(self._jobs), None)

    def named(self, topic: str, stamp: int, otherwise: JobType | None) -> JobType | None:
        """
        Return the job that an execution answers which publishes a message with a header stamp.

        A thread that publishes may call this at any time.

        :param stamp: in ns; not positive: the message has none.
        :param otherwise: returned if it is not the stamp of a driving message.
        :return: None if the job has been answered.
        """
        job = self._stamped.get(stamp) if topic in self._topics else None
        if job is None:
            return otherwise
        if job not in self._jobs:
            return None
        self._named[job] = None
        _forget(self._named)
        return job

    def is_answer(self, published: Set[str]) -> bool:
        """Return whether an execution that ends, and has published some topics, answers."""
        return not self._topics.isdisjoint(published) or not (
            self._must_publish or self._missing)

    def is_guess(self, job: JobType) -> bool:
        """Return whether it is not known which job an execution for another topic answers."""
        return (job in self._jobs and job not in self._named
                and next(iter(self._jobs)) != job)

    def answer(self, job: JobType) -> list[JobType]:
        """
        Return the jobs that an answer to a job completes, that job first; empty: none.

        They no longer await one.
        """
        if job not in self._jobs:
            return []
        older = []
        for each in self._jobs:
            if each == job:
                break
            if each.vertex == job.vertex:
                older.append(each)
        for each in (job, *older):
            del self._jobs[each]
            self._named.pop(each, None)
        return [job, *reversed(older)]


def _forget(several: dict[Any, Any]) -> None:
    """Forget the oldest ones that are too many; threads that publish may do so at once."""
    if len(several) > MOST_AWAITING:
        for oldest in list(several)[:-MOST_AWAITING]:
            several.pop(oldest, None)

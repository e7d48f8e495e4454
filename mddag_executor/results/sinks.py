# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Verdicts about sinks and DAGs, which all results about runs share."""

from __future__ import annotations

from typing import TypedDict


class ResponseTimes(TypedDict):
    """Response times of a sink, from the release of the job to the end of the callback, ns."""

    min: int
    """The shortest one."""
    median: int
    """The median (nearest rank)."""
    p99: int
    """99 % of the response times are at most this long (nearest rank)."""
    max: int
    """The longest one."""


class SlackTimes(TypedDict):
    """The time that was left from completions to their deadlines, ns; negative for late ones."""

    min: int
    """The least slack: that of the longest response time."""
    p1: int
    """99 % of the completions had at least this slack."""
    median: int
    """The median."""
    max: int
    """The largest slack: that of the shortest response time."""


class Tolerated(TypedDict):
    """The misses that the declaration tolerates (``tolerate``), and the worst window."""

    misses: int
    """How many misses are tolerated among any `of` consecutive results."""
    of: int
    """Length of the window: the number of consecutive results."""
    worst: int
    """The most results that were missed in any such window."""


class SinkVerdictsRare(TypedDict, total=False):
    """Counts that a sink has only if they are not 0."""

    aborted: int
    """Jobs that were aborted (only in recordings of version 2.0 and before)."""
    demoted: int
    """Jobs that were demoted because they were late; each has another verdict as well."""
    not_due: int
    """Results that were not due, because a callback did not publish (`may_publish`)."""


class SinkVerdicts(SinkVerdictsRare):
    """
    The verdicts about the results of a sink.

    The number of results that were due is the sum of ``completed``, ``overdue``, ``expired``,
    ``failed`` and ``dropped``.  Those in time are ``completed - (late - overdue)``.
    """

    completed: int
    """Results that were completed, in time or late."""
    late: int
    """Results completed after their deadline, and the overdue ones."""
    overdue: int
    """Results that were still open, and past their deadline, when the run ended."""
    expired: int
    """Results that never completed, because their job expired."""
    failed: int
    """Results that never completed, because a callback of their job raised an exception."""
    dropped: int
    """Results that never completed: a newer job replaced their job (`keep: newest`)."""


class SinkTolerance(TypedDict, total=False):
    """The tolerance of a sink, if one is declared."""

    tolerate: Tolerated
    """Only if the declaration tolerates misses of this sink."""


class SinkCounts(SinkVerdicts, SinkTolerance):
    """
    The results of a sink, or of a requirement of a path.

    The number of results that were due is the sum of ``completed``, ``overdue``, ``expired``,
    ``failed`` and ``dropped``.  Those in time are ``completed - (late - overdue)``.
    """

    relative_deadline_ns: int
    """The declared deadline, counted from the release; of a path the required time."""
    response_ns: ResponseTimes | None
    """Response times of the completed results; null if there are none."""


class JobEndsRare(TypedDict, total=False):
    """Ends that are counted only if there were any."""

    aborted: int
    """Jobs that were aborted (only in recordings of version 2.0 and before)."""


class JobEnds(JobEndsRare):
    """How the jobs of a DAG ended; each job counts once."""

    completed: int
    """All sinks completed in time."""
    late: int
    """A sink missed its deadline, and the job did not expire."""
    expired: int
    """The job expired, because it could no longer complete."""
    failed: int
    """A callback of the job raised an exception."""
    dropped: int
    """A newer job replaced it (`keep: newest`)."""


class DagCounts(TypedDict):
    """A DAG: its released jobs, how they ended, and its sinks."""

    jobs: int
    """Number of released jobs."""
    ends: JobEnds
    """How the jobs ended, each counted once."""
    sinks: dict[str, SinkCounts]
    """By name of the sink its results."""


class UnfinishedRun(TypedDict):
    """An execution that has not ended."""

    callback: str
    """Its callback."""
    since_ns: int
    """When it began, ns since the epoch; of a suspended coroutine, since when it waits."""
    for_ns: int
    """How long ago that was."""
    where: str
    """The line of the program that it had reached, and what it waits for; empty if unknown."""


class FirstMiss(TypedDict):
    """The missed deadline that came first."""

    dag: str
    """Name of the DAG."""
    vertex: str
    """Name of the sink."""
    job: int
    """Number of the job."""
    deadline_ns: int
    """The deadline that was missed."""
    completed_ns: int | None
    """When the sink completed after all; null if it did not."""


class Verdicts(TypedDict):
    """The verdicts about all sinks of a run."""

    deadline_missed: bool
    """Whether any deadline was missed."""
    first_miss: FirstMiss | None
    """The missed deadline that came first; null if there was none."""
    never_due: list[str]
    """Sinks that no job was due at, so their deadlines were never tested."""
    dags: dict[str, DagCounts]
    """By name of the DAG its jobs and sinks."""


Requirements = dict[str, dict[str, SinkCounts]]
"""By path, and `reaction` or `age`, the results in the format of a sink."""

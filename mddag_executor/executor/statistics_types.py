# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The dictionaries that ``MultiDeadlineExecutor.statistics()`` returns, with their keys.

``dags``, ``deadline_missed`` and ``first_miss`` have the form of ``replay --json``. Times are in
ns; names of callbacks and sinks are ``/node:callback``.
"""

from __future__ import annotations

from typing import Any, TypedDict

ResponseTimes = TypedDict(  # noqa: UP013 - a class would shadow min and max
    'ResponseTimes', {'min': int, 'median': int, 'p99': int, 'max': int})
"""Response times of a sink from the release on; quantiles are those of the last 2,000."""


class RareCounts(TypedDict, total=False):
    """
    Counts that are only there if they are not 0.

    ``demoted``: jobs of a sink that were put behind others, with ``on_late: demote``; ``not_due``:
    jobs in which nothing was published that would have started it (``may_publish``).
    """

    demoted: int
    not_due: int


class SinkCounts(RareCounts):
    """
    The results of a sink.

    ``late`` counts completions after the deadline and, at the end of the run, jobs that were
    ``overdue``. ``dropped`` counts jobs replaced by a newer one (``keep: newest``).
    ``response_ns`` is None if no job completed.
    """

    relative_deadline_ns: int
    completed: int
    late: int
    overdue: int
    expired: int
    failed: int
    dropped: int
    response_ns: ResponseTimes | None


class JobEnds(TypedDict):
    """How the jobs of a DAG ended, each counted once."""

    completed: int
    late: int
    expired: int
    failed: int
    dropped: int


class DagCounts(TypedDict):
    """A DAG: its released jobs, how they ended, and its sinks by name."""

    jobs: int
    ends: JobEnds
    sinks: dict[str, SinkCounts]


class FirstMiss(TypedDict):
    """The first missed deadline; ``completed_ns`` is None if the sink did not complete."""

    dag: str
    vertex: str
    job: int
    deadline_ns: int
    completed_ns: int | None


class Stop(TypedDict):
    """A time in which no thread of the process ran, ns since the epoch."""

    begin_ns: int
    end_ns: int


class Stops(TypedDict):
    """The stops: number, total duration, the number of misses they explain, and the last ones."""

    count: int
    total_ns: int
    misses: int
    latest: list[Stop]


class CallbackCounts(TypedDict):
    """
    A callback, declared or not.

    ``ready`` counts what became ready: messages, requests, releases of timers. ``ran`` counts
    executions (``failed``: they raised an exception), ``dropped`` those that did not run (QoS
    depth, destroyed, a newer one), ``lost`` messages that the middleware dropped before the
    executor could take them, ``skipped`` releases of a timer that was too slow,
    ``unattributed`` messages of a declared callback whose job was not found, ``guessed`` results
    of a sync with ``driven_by`` for which it is not known which message was used (the newest
    counts). ``interpreter_share`` is the fraction of its time in which it needs the interpreter,
    None: not known yet.
    ``incompatible_qos`` is the policy because of which a subscription gets nothing from a
    publisher.
    """

    kind: str
    declared: bool
    ready: int
    ran: int
    failed: int
    dropped: int
    lost: int
    skipped: int
    unattributed: int
    guessed: int
    busy_ns: int
    waiting: int
    holds_interpreter: bool
    interpreter_share: float | None
    incompatible_qos: str | None


class Unattributed(TypedDict):
    """Messages of declared callbacks that ran without a job: publication unknown, or ambiguous."""

    unknown: int
    doubtful: int


class TraceState(TypedDict):
    """The trace: its path, the number of lost events, and why recording ended early."""

    path: str
    lost: int
    error: str | None


class Statistics(TypedDict):
    """
    A snapshot of a run.

    ``never_due`` lists sinks without a due job, ``never_ran`` declared callbacks that have not
    run. ``unreported_misses`` counts misses that ``on_deadline_miss`` was too slow for.
    ``undeclared`` counts executions of undeclared callbacks; ``queue`` counts ready executions
    that wait; ``lent`` counts how often a waiting callback has lent its worker.  ``requirements``
    has by path, and 'reaction' or 'age', counts in the format of a sink; it is empty if nothing is
    required.
    """

    policy: str
    on_late: str
    workers: int
    deadline_missed: bool
    first_miss: FirstMiss | None
    never_due: list[str]
    dags: dict[str, DagCounts]
    requirements: dict[str, Any]
    stops: Stops
    callbacks: dict[str, CallbackCounts]
    undeclared: int
    dropped: dict[str, int]
    queue: int
    idle_workers: int
    lent: int
    unattributed: Unattributed
    never_ran: list[str]
    unreported_misses: int
    trace: TraceState | None

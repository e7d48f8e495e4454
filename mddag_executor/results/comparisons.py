# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The results of `diff`, `rerun` and `top`."""

from __future__ import annotations

from typing import TypedDict

from mddag_executor.results.sinks import ResponseTimes, Verdicts


class VerdictCounts(TypedDict):
    """Verdicts about the results of a sink, or of all sinks."""

    due: int
    """Results that got a verdict."""
    in_time: int
    """Results completed by their deadline."""
    late: int
    """Results completed after it, and overdue ones."""
    expired: int
    """Results whose job expired, because it could no longer complete."""
    aborted: int
    """Results whose job was aborted (only in recordings of version 2.0 and before)."""
    failed: int
    """Results whose job failed."""
    dropped: int
    """Results whose job was replaced by a newer one."""
    demoted: int
    """Results whose job was demoted; they have another verdict as well."""
    not_due: int
    """Results that were not due, because a callback did not publish."""


class ComparedRun(VerdictCounts):
    """One of the two runs: its facts, and the verdicts about all sinks."""

    trace: str
    """Name of the recording."""
    policy: str
    """Its policy."""
    workers: int
    """Number of its workers; of an imported recording, of threads that ran callbacks."""
    duration_ns: int
    """Its length."""
    utilisation: float | None
    """Share of the time for which the workers ran declared callbacks."""
    imported: bool
    """Whether another executor ran it."""
    rescheduled: bool
    """Whether it is a what-if."""
    skip_ns: int
    """The warm-up that was left out (`--from`)."""


class SinkSide(VerdictCounts):
    """A sink in one of the runs."""

    relative_deadline_ns: int
    """Its declared deadline."""
    response_ns: ResponseTimes | None
    """Response times of the completed results; null if there are none."""


class TimesChange(TypedDict):
    """The change of each response time as a share of the first one; null if that is 0."""

    min: float | None
    """The change of the shortest response time."""
    median: float | None
    """The change of the median."""
    p99: float | None
    """The change of the 99 % quantile."""
    max: float | None
    """The change of the longest response time."""


class ComparedSink(TypedDict):
    """A sink in both runs."""

    a: SinkSide | None
    """The sink in the first run; null if only the second one has it."""
    b: SinkSide | None
    """The sink in the second run; null if only the first one has it."""
    change_ns: ResponseTimes | None
    """Response times of the second run minus those of the first one; null if one has none."""
    change: TimesChange | None
    """The same as shares of the first run's; null if one has none."""
    worse: bool
    """Whether the sink is worse in the second run."""


class ComparedDag(TypedDict):
    """A DAG in both runs."""

    sinks: dict[str, ComparedSink]
    """By name of the sink both sides."""


class CallbackSide(TypedDict):
    """A callback in one of the runs; null: unknown."""

    executions: int
    """Number of executions."""
    mean_ns: int | None
    """Their mean execution time."""
    longest_ns: int
    """The longest execution."""
    mean_wait_ns: int | None
    """The mean time that they were ready and had not started."""


class ComparedCallback(TypedDict):
    """A callback in both runs."""

    a: CallbackSide | None
    """The callback in the first run; null if only the second one has it."""
    b: CallbackSide | None
    """The callback in the second run; null if only the first one has it."""


class DiffResultRare(TypedDict, total=False):
    """Keys of runs with declarations that require something of paths."""

    requirements: dict[str, ComparedDag]
    """By path its requirements, called `PATH reaction` and `PATH age`, in the format of sinks."""


class DiffResult(DiffResultRare):
    """The result of `diff`: two runs, sink by sink."""

    a: ComparedRun
    """The first run."""
    b: ComparedRun
    """The second run."""
    tolerance: float | None
    """By which share a p99 response time may grow (`--allow-growth`); null: it is not compared."""
    worse: bool
    """Whether any sink or requirement is worse in the second run."""
    compared: int
    """Number of sinks and requirements that were due in both runs."""
    dags: dict[str, ComparedDag]
    """By name of the DAG its sinks."""
    callbacks: dict[str, ComparedCallback]
    """By declared callback both sides."""


class TopicDifference(TypedDict):
    """How the messages of a topic differ."""

    topic: str
    """Name of the topic."""
    kind: str
    """`content`, `timing` (only times differ), or `missing` (one side has none)."""
    number: int
    """Which of the topic's messages is the first that differs, from 0."""
    time: int
    """Virtual time of that message in this run, ns after its start."""
    field: str
    """The first field that differs; empty: when it was published."""
    expected: str
    """The expected value."""
    found: str
    """The value of this run."""
    messages: int
    """Number of messages in this run."""
    expected_messages: int
    """Expected number of messages."""


class RerunVerdicts(Verdicts):
    """How real nodes ran in virtual time, and the verdicts about them."""

    policy: str
    """The policy that chose which callback ran."""
    workers: int
    """Number of workers."""
    preemptive: bool
    """Whether more urgent callbacks preempted running ones: false."""
    duration_ns: int
    """Length of the run in virtual time."""


class RerunResultRare(TypedDict, total=False):
    """Keys of `rerun --expect`."""

    differences: list[TopicDifference]
    """Only with `--expect`: how the published messages differ from those of that bag."""


class RerunResult(RerunResultRare, RerunVerdicts):
    """The result of `rerun`: real nodes in virtual time."""

    digest: str
    """A hash of all that the nodes published, in order, with virtual times."""
    messages: int
    """Number of published messages."""
    callbacks: int
    """Number of executions."""
    virtual_s: float
    """Length of the run in virtual time, in seconds."""
    elapsed_s: float
    """How long it took, in seconds."""
    topics: dict[str, int]
    """By topic the number of published messages."""
    recorded_topics: list[str]
    """Published topics that the recording has as well."""
    recorded: list[TopicDifference]
    """How these differ from the recording."""
    warnings: list[str]
    """The lines that were printed as warnings."""


class TopSink(TypedDict):
    """The state of a sink; null: not known."""

    process: str
    """The process whose executor reports it."""
    dag: str
    """Name of the DAG."""
    sink: str
    """Name of the sink."""
    level: str
    """`OK`, `WARN`, `ERROR`, `STALE`, or `GONE`: nothing was heard for 5 s."""
    wrong: str
    """What is wrong, in words; empty: nothing."""
    window_results: float | None
    """Number of results that were due in the window (the last 10 periods of the diagnostics)."""
    in_time_ratio: float | None
    """Share of these that were in time."""
    response_p99_ms: float | None
    """99 % quantile of their response times, ms."""
    deadline_ms: float | None
    """The declared deadline, ms."""
    margin_ms: float | None
    """The least time that was left to the deadline, ms."""


class TopStatus(TypedDict):
    """A status as on `/diagnostics`."""

    process: str
    """The process whose executor reports it."""
    name: str
    """Name of the status."""
    level: str
    """`OK`, `WARN`, `ERROR`, `STALE` or `GONE`."""
    message: str
    """The status in words."""
    values: dict[str, str]
    """Its values, as texts."""


class TopResult(TypedDict):
    """The result of `top`: what executors report now."""

    sinks: list[TopSink]
    """The sinks, the worst one first."""
    statuses: list[TopStatus]
    """The statuses, as on `/diagnostics`."""

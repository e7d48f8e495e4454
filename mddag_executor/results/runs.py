# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The results of `run` and `demo`, and ``MultiDeadlineExecutor.statistics()``."""

from __future__ import annotations

from typing import TypedDict

from mddag_executor.results.head import Head
from mddag_executor.results.replays import DriftResult, ReplayResult, RescheduleResult
from mddag_executor.results.sinks import (
    DagCounts,
    FirstMiss,
    Requirements,
    ResponseTimes,
    SinkCounts,
    UnfinishedRun,
)


class ClockStep(TypedDict):
    """The system clock was set during a run."""

    at_ns: int
    """When that was noticed, ns since the epoch by the clock as it was at the begin of the run."""
    step_ns: int
    """By how much it was set forward; negative: back."""


class Stop(TypedDict):
    """A time in which no thread of the process ran, ns since the epoch."""

    begin_ns: int
    """Begin of the stop."""
    end_ns: int
    """End of the stop."""


class StopCounts(TypedDict):
    """The stops of the process."""

    count: int
    """Number of stops."""
    total_ns: int
    """Their total duration."""
    misses: int
    """The number of misses that they explain."""


class Stops(StopCounts):
    """The stops of the process, and the last ones."""

    latest: list[Stop]
    """The last 100 stops."""


class CallbackCounts(TypedDict):
    """A callback, declared or not."""

    kind: str
    """`timer`, `subscription`, `service`, `client`, …"""
    declared: bool
    """Whether the declaration has this callback."""
    ready: int
    """How often it became ready: messages, requests, releases of timers."""
    ran: int
    """Number of executions."""
    failed: int
    """How many of them raised an exception."""
    dropped: int
    """How many messages or releases did not run: QoS depth, destroyed, or a newer one."""
    lost: int
    """Messages that the middleware dropped before the executor could take them."""
    skipped: int
    """Releases of a timer that was too slow."""
    unattributed: int
    """Messages of a declared callback whose job was not found."""
    guessed: int
    """Results of a sync with `driven_by` for which it is not known which of several messages was
    used; the newest one counts."""
    busy_ns: int
    """How long it ran in all."""
    waiting: int
    """Ready executions that wait now."""
    holds_interpreter: bool
    """Whether it computes in Python, and so holds the interpreter (declared or measured)."""
    interpreter_share: float | None
    """Share of its time in which it needs the interpreter; null: not known yet."""
    incompatible_qos: str | None
    """The QoS policy because of which a subscription gets nothing from a publisher, else null."""


class Unattributed(TypedDict):
    """Messages of declared callbacks that ran without a job."""

    unknown: int
    """Their publication is not known."""
    doubtful: int
    """More than one publication fits."""


class TraceState(TypedDict):
    """The trace of a run."""

    path: str
    """Its path."""
    lost: int
    """Number of lost events."""
    error: str | None
    """Why recording ended early; null: it did not."""


class ExecutorState(TypedDict):
    """What an executor, or the executors of several processes together, counted."""

    policy: str
    """The policy that chooses which callback runs."""
    on_late: str
    """What happens to late jobs: `continue` or `demote`."""
    workers: int
    """Number of worker threads (in each process)."""
    deadline_missed: bool
    """Whether any deadline was missed."""
    first_miss: FirstMiss | None
    """The missed deadline that came first; null if there was none."""
    never_due: list[str]
    """Sinks that no job was due at, so their deadlines were never tested."""
    requirements: Requirements
    """By path, and `reaction` or `age`, the results in the format of a sink."""
    undeclared: int
    """Executions of undeclared callbacks."""
    dropped: dict[str, int]
    """By callback how many messages or releases did not run, if any."""
    unfinished: list[UnfinishedRun]
    """Executions that have not ended: that run, or are suspended."""
    clock_steps: list[ClockStep]
    """Steps of the system clock, the last 100."""
    queue: int
    """Ready executions that wait."""
    idle_workers: int
    """Workers that run nothing."""
    lent: int
    """How often a callback that waits has lent its worker."""
    unattributed: Unattributed
    """Messages of declared callbacks that ran without a job."""
    never_ran: list[str]
    """Declared callbacks of which no execution has begun."""
    not_found: dict[str, str | None]
    """Those of them that no node has, each with a question about its name, or null."""


class Statistics(ExecutorState):
    """A snapshot of a run: what ``MultiDeadlineExecutor.statistics()`` returns."""

    dags: dict[str, DagCounts]
    """By name of the DAG its jobs and sinks."""
    stops: Stops
    """The stops of the process."""
    callbacks: dict[str, CallbackCounts]
    """By name the callbacks, declared ones and others."""
    unreported_misses: int
    """
    Misses that `on_deadline_miss` was not called for: 256 waited already, or the run had ended.
    """
    trace: TraceState | None
    """The trace; null if the run was not recorded."""


class Exclusion(TypedDict):
    """A program whose callbacks waited for each other, as its own executor would make them."""

    program: str
    """The program, as `--node` names it."""
    waited_ns: int
    """How long its callbacks waited in all."""


class MeasuredSink(TypedDict):
    """The results of a sink that synthetic nodes measured."""

    relative_deadline_ns: int
    """The declared deadline."""
    due: int
    """Results with a deadline in the window."""
    on_time: int
    """Results completed by their deadline."""
    late: int
    """Results completed after it."""
    missing: int
    """Results that never completed."""
    response_ns: ResponseTimes | None
    """Response times of the completed results; null if there are none."""


class MeasuredDag(TypedDict):
    """A DAG that synthetic nodes measured."""

    sinks: dict[str, MeasuredSink]
    """By name of the sink its results."""


class Attribution(TypedDict):
    """How many executions got another job than the one whose message they had."""

    wrong: int
    """Another job."""
    none: int
    """No job."""


class Measured(TypedDict):
    """What synthetic nodes measured themselves, in the same way under any executor."""

    mode: str
    """What a callback does: `sleep`, `spin`, `native` or `mixed`."""
    seed: int
    """Seed of the drawn execution times."""
    workers: int
    """Number of worker threads."""
    utilisation: float
    """Normalised utilisation by the planned execution times."""
    utilisation_taken: float
    """Normalised utilisation by the measured execution times."""
    window_ns: int
    """Duration of the measurement."""
    warm_up_ns: int
    """Time before the measurement."""
    sink_jobs_due: int
    """Results with a deadline in the window."""
    on_time: int
    """Results completed by their deadline."""
    late: int
    """Results completed after it."""
    missing: int
    """Results that never completed."""
    on_time_ratio: float | None
    """Share of the due results that were completed by their deadline; null if none was due."""
    callbacks: int
    """Number of executions."""
    callbacks_per_s: float
    """Executions in each second."""
    cpu_us_per_callback: float | None
    """CPU time of each execution without its own work, us; null without executions."""
    attribution: Attribution
    """How many executions got another job than the one whose message they had."""
    dags: dict[str, MeasuredDag]
    """By name of the DAG its sinks."""


class Program(TypedDict):
    """What was run, and what its nodes measured."""

    file: str | None
    """The file of the declaration; null without one."""
    nodes: list[str]
    """The programs of `--node`."""
    synthetic: str | None
    """What synthetic nodes do (`--synthetic`); null for real nodes."""
    measured: Measured | None
    """What synthetic nodes measured; null for real nodes and several processes."""
    exclusion: list[Exclusion]
    """Programs whose callbacks waited for each other."""
    drift: list[DriftResult]
    """How the run differs from its declaration."""


class RunResult(Program, Statistics):
    """The result of `run` in one process."""


class DividedDag(TypedDict):
    """A DAG of a run in several processes."""

    jobs: int
    """Number of released jobs."""
    sinks: dict[str, SinkCounts]
    """By name of the sink its results."""


class RunProcess(TypedDict):
    """A process of a run."""

    name: str
    """Name of the process."""
    nodes: list[str]
    """Names of its nodes."""
    pid: int
    """Its number in the operating system."""
    status: int | None
    """Its exit status; negative: the signal that ended it."""
    died: bool
    """Whether it ended before the run did."""
    how: str
    """How it ended, in words."""
    said: str | None
    """The last line of its standard error, if it died; else null."""
    trace: TraceState | None
    """Its trace; null if it has none."""


class RunOfProcessesResult(Program, ExecutorState):
    """The result of `run` in several processes: their counts together."""

    dags: dict[str, DividedDag]
    """By name of the DAG its jobs and sinks."""
    stops: StopCounts
    """The stops of all processes."""
    callbacks: dict[str, CallbackCounts]
    """By name the callbacks, declared ones and others."""
    trace: None
    """Always null: each process has its own trace."""
    processes: list[RunProcess]
    """The processes."""


class RunFile(Head, RunResult):
    """The file that `run --json` writes."""


class ReplayFile(Head, ReplayResult):
    """The file that `replay --json` writes."""


class RescheduleFile(Head, RescheduleResult):
    """The file that `replay --reschedule --json` writes."""


class DemoResult(TypedDict):
    """The result of `demo`: its four steps."""

    live: RunFile
    """The result of `mddag run`."""
    recorded: ReplayFile
    """The result of `mddag replay`."""
    rescheduled: RescheduleFile
    """The result of `mddag replay --reschedule`."""
    baseline: Measured
    """What the same nodes measured under rclpy's MultiThreadedExecutor."""
    trace: str
    """The recorded run."""

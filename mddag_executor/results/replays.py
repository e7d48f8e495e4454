# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The results of `replay`, as recorded and rescheduled, and of `explain`."""

from __future__ import annotations

from typing import TypedDict

from mddag_executor.results.sinks import (
    FirstMiss,
    JobEnds,
    Requirements,
    SinkCounts,
    SlackTimes,
    UnfinishedRun,
    Verdicts,
)


class ResponseParts(TypedDict):
    """The parts of a response time along the critical chain, ns; their sum is the whole."""

    release_lag_ns: int
    """From the release until the source was ready."""
    waiting_ns: int
    """Ready callbacks waited for a worker, for their callback group, or for their program."""
    executing_ns: int
    """Callbacks ran, until they published or ended."""
    suspended_ns: int
    """Coroutines waited within their executions."""
    transport_ns: int
    """From the end of a callback until the next one was ready."""
    unknown_ns: int
    """Before the first callback of the chain that is recorded."""
    waiting_group_ns: int
    """Part of `waiting_ns`: another callback of the group ran."""
    waiting_program_ns: int
    """
    Part of `waiting_ns`: another callback of a program ran that runs one at a time, or the program
    did not spin.
    """


class ChainLink(TypedDict):
    """A callback on the critical chain of a job."""

    vertex: str
    """Name of the callback's vertex."""
    ready_ns: int
    """When it was ready to run."""
    start_ns: int
    """When it started."""
    end_ns: int | None
    """When it ended; null if it did not complete."""
    busy_ns: int | None
    """How long it ran, without the waiting of a coroutine; null if it did not complete."""
    waiting_group_ns: int | None
    """How long other callbacks of its group ran while it waited; null if it did not complete."""
    waiting_program_ns: int | None
    """
    How long other callbacks of its program, which runs one at a time, ran while it waited, or the
    program did not spin.

    Null if it did not complete.
    """


class WorstJob(ResponseParts):
    """The job with the longest response time of a sink."""

    job: int
    """Number of the job."""
    release_ns: int
    """When it was released."""
    completed_ns: int
    """When the sink completed."""
    chain: list[ChainLink]
    """The callbacks of its critical chain, from the source to the sink."""


class Breakdown(TypedDict):
    """Where the response times of a sink went."""

    mean: ResponseParts
    """Mean parts of all completed results."""
    worst: WorstJob
    """The parts of the longest response time."""


class ReplayedSink(SinkCounts):
    """The results of a sink in a replay."""

    breakdown: Breakdown | None
    """Where the response times went; null if nothing completed."""
    slack_ns: SlackTimes | None
    """The time that was left to the deadline; null if nothing completed."""


class ReplayedDagRare(TypedDict, total=False):
    """Keys of a DAG of an imported recording."""

    unjudged: int
    """Only of an imported recording: jobs that cannot be judged, as their messages are unknown."""


class ReplayedDag(ReplayedDagRare):
    """A DAG in a replay."""

    jobs: int
    """Number of judged jobs."""
    ends: JobEnds
    """How the jobs ended, each counted once."""
    sinks: dict[str, ReplayedSink]
    """By name of the sink its results."""


class MeasuredUse(TypedDict, total=False):
    """Keys of a callback only if the CPU time of some executions is known."""

    measured: int
    """Executions of which the CPU time is known; the following keys are about these."""
    measured_busy_ns: int
    """How long they ran."""
    cpu_ns: int
    """Their CPU time."""
    held_interpreter: int
    """How many of them computed in Python, and so held the interpreter."""


class CallbackUse(MeasuredUse):
    """How often and how long a callback ran and waited."""

    executions: int
    """Completed executions of its jobs; of undeclared callbacks all executions."""
    busy_ns: int
    """How long it ran in all, without the time in which a coroutine waited."""
    longest_ns: int
    """Its longest execution."""
    waiting_ns: int
    """How long it was ready and had not started, in all."""
    longest_wait_ns: int
    """The longest such time."""
    waiting_group_ns: int
    """Part of `waiting_ns`: another callback of its group ran."""
    waiting_program_ns: int
    """
    Part of `waiting_ns`: another callback of its program ran, which runs one at a time, or the
    program did not spin.
    """


class OverTime(TypedDict):
    """The load of all workers together over time."""

    step_ns: int
    """Length of a step."""
    start_ns: int | None
    """Begin of the first step; null if nothing ran."""
    busy_ns: list[int]
    """By step how long the workers ran callbacks, all workers together."""


class WorkerUse(TypedDict):
    """How busy the workers were."""

    busy_ns: dict[str, int]
    """By number of the worker how long it ran callbacks."""
    lent_ns: int
    """How long callbacks waited in blocking calls, during which their worker ran others."""
    use: float | None
    """Share of the time in which the workers ran callbacks, undeclared ones included."""
    over_time: OverTime
    """The load over time."""


class Stall(TypedDict):
    """A time in which the machine stopped the whole process."""

    at_ns: int
    """When it began."""
    length_ns: int
    """How long it took."""
    misses: int
    """The number of misses that it caused."""


class MissesRare(TypedDict, total=False):
    """Keys about misses that only some recordings have."""

    interpreter_assumed: int
    """
    Misses by the interpreter for which it is not recorded whether the callbacks that ran held it.

    Only if there are any: in recordings of version 2, undeclared callbacks may have held it.
    """


class Misses(MissesRare):
    """The missed deadlines and their causes."""

    missed: int
    """Number of missed deadlines."""
    causes: dict[str, int]
    """By cause the number of misses."""
    sinks: dict[str, dict[str, int]]
    """By sink that missed a deadline, and by cause, the number of misses."""
    stalls: list[Stall]
    """The stops of the machine."""


class Spread(TypedDict):
    """Statistics of times, ns."""

    count: int
    """Number of times."""
    min: int
    """The shortest one."""
    mean: int
    """The mean, rounded."""
    median: int
    """The median (nearest rank)."""
    p99: int
    """99 % of the times are at most this long (nearest rank)."""
    max: int
    """The longest one."""


class ResponseCases(TypedDict):
    """The response times of a path in CARET's cases; null without times."""

    all: Spread | None
    """Of every input."""
    best: Spread | None
    """From the newest input of each output."""
    worst: Spread | None
    """From the oldest input of each output."""
    worst_with_external_latency: Spread | None
    """From the input before the oldest one of each output."""


class PathTimes(TypedDict):
    """The end-to-end times of a path; null without times."""

    response_time: ResponseCases
    """The response times, in CARET's cases."""
    reaction_time: Spread | None
    """The time until an external change has an effect: the worst case with external latency."""
    data_age: Spread | None
    """How old the newest input of each output was."""


class PathResult(PathTimes):
    """
    A declared path: its flows and end-to-end times.

    Its own times are from the first publication to the start of the last callback, as in CARET.
    """

    callbacks: list[str]
    """The callbacks of the path."""
    hops: list[str]
    """How data gets from each of them to the next one: `trigger`, `topic` or `variable`."""
    flows: int
    """Number of flows: ways of an input along the path."""
    arrived: int
    """Number of flows that reached the last callback."""
    whole: PathTimes
    """The same times from the start of the first callback to the end of the last one."""


class RecordedCallback(TypedDict):
    """A recorded callback of an imported recording."""

    executions: int
    """Number of executions that ended."""
    unfinished: int
    """Number of executions that did not end."""
    busy_ns: int
    """How long it ran in all."""
    shortest_ns: int
    """The shortest execution."""
    longest_ns: int
    """The longest execution."""


class Communication(TypedDict):
    """The messages from a publisher to a callback of an imported recording."""

    topic: str
    """Name of the topic."""
    publisher: str | None
    """Node that publishes; null if it is unknown."""
    callback: str
    """Name of the callback."""
    sent: int
    """Number of published messages."""
    arrived: int
    """Number of messages that started the callback."""
    latency_ns: Spread
    """Times from the publication to the start of the callback."""


class RecordedFileRare(TypedDict, total=False):
    """Keys of a trace, or of an ordinary bag."""

    shut_down: bool
    """Whether the end of the run is recorded (not of a bag)."""
    lost: int
    """Number of events that the recorder lost (not of a bag)."""
    messages: int
    """Only of an ordinary bag: number of its messages."""


class RecordedFile(RecordedFileRare):
    """The recording that was replayed."""

    trace: str
    """Its name."""
    declaration: str
    """The file of the declaration with which it was recorded."""
    start_ns: int | None
    """The first release, or when the first callback was ready; null if there is neither."""
    end_ns: int
    """When the recording ended."""


class DriftResult(TypedDict):
    """A difference between a run and its declaration."""

    kind: str
    """`publishes`, `published outside`, `rate`, `stopped` or `never ran`."""
    callback: str
    """The callback that it is about."""
    topic: str | None
    """The topic that is published, or the topic that a sync never got; else null."""
    declared: int | None
    """The declared value, a period in ns or a number of messages; null if there is none."""
    observed: int | None
    """
    The observed value, of `published outside` the number of messages, of `stopped` the time since
    the last release in ns; null if there is none.
    """
    text: str
    """The difference in words."""


class ReplayResultRare(TypedDict, total=False):
    """Keys that only some replays have."""

    unfinished: list[UnfinishedRun]
    """Only if there are any: executions that had not ended when the recording did."""
    guessed: dict[str, int]
    """Only if there are any: by sync with `driven_by` the results for which it is not known which
    of several messages was used; the newest one counts."""
    requirements: Requirements
    """Only if the declaration requires a `reaction` or an `age` of paths."""
    recorded_callbacks: dict[str, RecordedCallback]
    """Only of an imported recording, and without a declaration: all recorded callbacks."""
    communications: list[Communication]
    """Only of an imported recording, and without a declaration: messages by publisher and
    callback."""
    drift: list[DriftResult]
    """How the run differs from its declaration (not in the sides of `diff`)."""


class ReplayResult(ReplayResultRare):
    """The result of `replay`: a recorded run, judged."""

    policy: str
    """The policy that chose which callback ran."""
    workers: int
    """Number of worker threads, of all processes together; of an imported recording, of threads
    that ran callbacks."""
    preemptive: bool
    """Whether more urgent callbacks preempted running ones."""
    duration_ns: int
    """From the first release or execution to the end of the run."""
    utilisation: float | None
    """Share of the time for which the workers ran declared callbacks; null without workers."""
    deadline_missed: bool
    """Whether any deadline was missed."""
    first_miss: FirstMiss | None
    """The missed deadline that came first; null if there was none."""
    never_due: list[str]
    """Sinks that no job was due at, so their deadlines were never tested."""
    dags: dict[str, ReplayedDag]
    """By name of the DAG its jobs and sinks."""
    rescheduled: bool
    """Whether this is a what-if: false for a run as it was recorded."""
    skip_ns: int
    """The warm-up that was left out (`--from` without `--to`)."""
    callbacks: dict[str, CallbackUse]
    """By declared callback how often and how long it ran and waited."""
    undeclared: CallbackUse
    """The same of all undeclared callbacks together, and of declared ones that ran without a
    job."""
    worker_use: WorkerUse
    """How busy the workers were."""
    dropped: dict[str, int]
    """By reason the number of executions that were dropped before they ran."""
    messages_lost: dict[str, int]
    """By callback the number of messages that the middleware lost."""
    misses: Misses
    """The missed deadlines by cause."""
    paths: dict[str, PathResult]
    """By declared path its flows and end-to-end times."""
    recording: RecordedFile
    """The recording."""
    warnings: list[str]
    """The lines that were printed as warnings."""


class Overheads(TypedDict):
    """How the executor's own times are part of a what-if."""

    included: bool
    """Whether the recorded times for noticing, dispatch and transport are part of it."""
    added_ns: int
    """What `--overheads TIME` added to each dispatch."""
    dispatch_median_ns: int | None
    """The median of the recorded times for a dispatch; null if it is unknown."""
    transport_median_ns: int | None
    """The median of the recorded times for transport; null if it is unknown."""


class ScheduledUse(TypedDict):
    """How busy the workers would be."""

    busy_ns: dict[str, int]
    """By number of the worker how long it would run callbacks."""
    use: float | None
    """Share of the time in which the workers would run callbacks."""


class RecordedRunRare(TypedDict, total=False):
    """Keys of the recorded run."""

    requirements: Requirements
    """Only if the declaration requires a `reaction` or an `age` of paths."""


class RecordedRun(RecordedRunRare, Verdicts):
    """The recorded run that a what-if is compared with."""

    policy: str
    """The policy of the recorded run."""
    workers: int
    """Number of its workers."""


class ProcessNodes(TypedDict):
    """A process and its nodes."""

    name: str
    """Name of the process."""
    nodes: list[str]
    """Names of its nodes."""


class ProcessPool(ProcessNodes):
    """A process, its nodes and its workers."""

    workers: int
    """Its number of workers."""


class PathsResult(TypedDict, total=False):
    """Paths of a computed run, if its declaration requires something of them."""

    paths: dict[str, PathResult]
    """Only if something is required of paths: by declared path its flows and end-to-end times."""
    requirements: Requirements
    """Only if the declaration requires a `reaction` or an `age` of paths."""


class RescheduleResultRare(TypedDict, total=False):
    """Keys that only some what-ifs have."""

    cpus: int
    """Number of CPUs, if `--cpus` or the recording limits them."""
    processes: list[ProcessPool]
    """The processes, if there are several."""
    skipped_jobs: int
    """Jobs whose first callback did not run in the recording, if any: they are skipped again."""
    notes: list[str]
    """Assumptions about an ordinary bag, one line each."""


class RescheduleResult(RescheduleResultRare, PathsResult, Verdicts):
    """The result of `replay --reschedule`: what the scheduler would have done."""

    policy: str
    """The policy that chooses which callback runs."""
    on_late: str
    """What happens to late jobs: `continue` or `demote`."""
    workers: int
    """Number of workers, of all processes together."""
    preemptive: bool
    """Whether more urgent callbacks preempt running ones."""
    duration_ns: int
    """From the first release or execution to the end of the recording."""
    utilisation: float | None
    """Share of the time for which the workers would run declared callbacks."""
    rescheduled: bool
    """Whether this is a what-if: true."""
    skip_ns: int
    """The warm-up that was left out (`--from`)."""
    executions: int
    """Number of executions."""
    estimated_executions: int
    """How many did not complete in the recording: they take a median, or as long as they ran."""
    overheads: Overheads
    """The executor's own times."""
    worker_use: ScheduledUse
    """How busy the workers would be."""
    recorded: RecordedRun | None
    """The run as it was recorded; null for an ordinary bag."""
    recording: RecordedFile
    """The recording."""
    warnings: list[str]
    """The lines that were printed as warnings."""


class Behind(TypedDict):
    """A callback that ran while a job waited."""

    callback: str
    """Name of the callback."""
    ns: int
    """How long it ran during that time, ns."""


class MissPartRare(TypedDict, total=False):
    """Keys of a part of a miss that depend on its cause."""

    waiting_job: int
    """For a skipped release: the earlier job whose execution still waited, -1: none."""
    topics: list[str]
    """For a missing message: the topics of the messages that did not come."""


class MissPart(MissPartRare):
    """A part of the time of a missed job."""

    vertex: str
    """The vertex at which the time went."""
    cause: str
    """The cause, or `ran` or `unknown` for time that needs no cause."""
    ns: int
    """How long, ns."""
    behind: list[Behind]
    """The callbacks that ran meanwhile, the longest first; only of waits of at least a tenth."""


class MissedJob(TypedDict):
    """A missed deadline, and where the time of the job went."""

    dag: str
    """Name of the DAG."""
    job: int
    """Number of the job."""
    sink: str
    """Name of the sink."""
    verdict: str
    """`late`, `overdue`, `expired`, `failed`, `dropped` or `aborted`."""
    release_ns: int
    """When the job was released."""
    deadline_ns: int
    """Its deadline at this sink."""
    until_ns: int
    """When the sink completed or the job ended."""
    late_ns: int | None
    """How late the sink completed; null if it did not complete."""
    cause: str
    """The cause of the miss."""
    parts: list[MissPart]
    """The parts of the time from the release to the end, in order."""


class LatePart(TypedDict):
    """A part of the way of late outputs along a path."""

    callback: str
    """The callback that it is about."""
    part: str
    """What happened there."""
    mean_ns: int
    """Mean time of the late outputs."""
    worst_ns: int
    """Time of the latest output."""


class LatePath(TypedDict):
    """The late results of a requirement of a path."""

    late: int
    """Number of late outputs."""
    unanswered: int
    """Changes without output, or missing outputs."""
    parts: list[LatePart]
    """Where the time of the late outputs went, along the path."""


class ExplainResultRare(TypedDict, total=False):
    """Keys that only some explanations have."""

    requirements: dict[str, dict[str, LatePath]]
    """By path, and `reaction` or `age`, where the time of late results went, if there are any."""


class ExplainResult(ExplainResultRare, Misses):
    """The result of `explain`: why each missed deadline was missed."""

    jobs: list[MissedJob]
    """The missed deadlines, in their order; with `--sink` and `--job` only these."""

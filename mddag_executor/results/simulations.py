# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The results of `simulate`, `evaluate` and `slack`."""

from __future__ import annotations

from typing import TypedDict

from mddag_executor.results.replays import PathsResult
from mddag_executor.results.sinks import SlackTimes, Verdicts


class SimulatedRunRare(TypedDict, total=False):
    """Keys that only some simulated runs have."""

    cpus: int
    """Number of CPUs, if `--cpus` limits them."""


class SimulatedRunResult(SimulatedRunRare, Verdicts):
    """A simulated run: what the Python API returns for it."""

    policy: str
    """The policy that chooses which callback runs."""
    on_late: str
    """What happens to late jobs: `continue` or `demote`."""
    workers: int
    """Number of workers."""
    preemptive: bool
    """Whether more urgent callbacks preempt running ones."""
    duration_ns: int
    """Length of the run."""
    utilisation: float | None
    """Load of the execution times, divided by the workers; null if it is unknown."""


class SimulateResult(PathsResult, SimulatedRunResult):
    """The result of `simulate`: one run in virtual time."""

    file: str
    """The file of the declaration."""
    judge: str
    """How jobs that are open at the end are judged: `horizon` or `completions`."""
    seed: int | None
    """Seed of the drawn execution times; null if `--execution-times` gave them."""
    ended_ns: int
    """When the run ended: earlier than its length with `--stop-at-first-miss`."""
    trace: str | None
    """The recorded run; null without `--trace`."""


class PolicyAcceptance(TypedDict):
    """The acceptance of a policy."""

    preemptive: bool
    """Whether more urgent callbacks preempted running ones."""
    total: float | None
    """Share of all runs in which no deadline was missed."""
    accepted: list[int]
    """By bin the number of runs in which no deadline was missed."""
    interval_95: list[list[float] | None]
    """By bin the 95 % confidence interval of the share; null if the bin is empty."""


class GraphAcceptance(TypedDict):
    """The runs of one declaration."""

    graph: str
    """The file of the declaration."""
    workers: int
    """Number of workers."""
    runs: int
    """Number of runs that were done."""
    utilisation: float | None
    """Mean normalised utilisation of its runs; null without runs."""
    accepted: dict[str, int]
    """By policy the number of runs in which no deadline was missed."""
    possible: int
    """The number of runs in which a scheduler could keep the deadlines, as far as is known."""


class EvaluateResult(TypedDict):
    """The result of `evaluate`: acceptance ratios over utilisation."""

    runs: int
    """Number of runs that were done."""
    first_run: int
    """Number of the first run (`--first-run`)."""
    elapsed_s: float
    """How long it took, in seconds."""
    bins: list[float]
    """The centres of the bins of normalised utilisation."""
    counts: list[int]
    """By bin the number of runs."""
    acceptance: dict[str, list[float | None]]
    """By policy and bin the share of runs without missed deadline; null: the bin is empty."""
    bound: list[float | None]
    """By bin the share that no scheduler can exceed; null: the bin is empty."""
    policies: dict[str, PolicyAcceptance]
    """By policy further figures."""
    bound_total: float | None
    """The share of all runs that no scheduler can exceed."""
    workers: int
    """Number of workers."""
    duration_ns: int
    """Length of each run."""
    seed: int
    """Seed of the drawn execution times."""
    overhead_ns: int
    """The time that each dispatch takes."""
    judge: str
    """How jobs that are open at the end are judged: `horizon` or `completions`."""
    samples: bool
    """Whether measured execution times were drawn (`--execution-times`)."""
    interrupted: bool
    """Whether it was interrupted before all runs were done."""
    compiled: bool
    """Whether the compiled core was used."""
    jobs: int
    """How many processes simulated at a time."""
    graphs: list[GraphAcceptance]
    """By declaration, the results of its runs."""


class SlackFactor(TypedDict):
    """By how much execution times may grow."""

    factor: float | None
    """The greatest factor with which no further deadline is missed; null: more than `most`."""
    breaks: str | None
    """The sink that misses first with a greater factor; null if none does."""


class FewerResult(TypedDict):
    """How many workers or CPUs are enough."""

    given: int
    """The present number."""
    least: int
    """The least number with which no deadline is missed."""
    breaks: str | None
    """The sink that misses first with one less; null if none does."""


class SinkMargin(TypedDict):
    """The margin of a sink."""

    relative_deadline_ns: int
    """The declared deadline."""
    margin_ns: SlackTimes | None
    """The time that is left to the deadline now; null if nothing completed."""


class SlackProcess(TypedDict):
    """A process of a result of `slack`."""

    name: str
    """Name of the process."""
    workers: FewerResult | None
    """How many workers are enough in it, together with the other numbers; null if unknown."""


class SlackResultRare(TypedDict, total=False):
    """Keys of the result of `slack` that only some have."""

    processes: list[SlackProcess]
    """The processes, if there are several."""
    requirements: dict[str, SinkMargin]
    """By requirement, if there is any, called `PATH reaction` or `PATH age`, its margin."""


class SlackResult(SlackResultRare):
    """The result of `slack`: how much longer callbacks may take."""

    most: float
    """The largest factor that was tried."""
    callbacks: dict[str, SlackFactor]
    """By callback the factor for its execution times alone."""
    load: SlackFactor
    """The factor for the execution times of all callbacks together."""
    workers: FewerResult | None
    """How many workers are enough; null if deadlines are missed, or there are `processes`."""
    cpus: FewerResult | None
    """How many CPUs are enough; null if it is unknown, or deadlines are missed."""
    missed: dict[str, int]
    """By sink that misses deadlines now their number."""
    left_out: list[str]
    """Sinks that miss all deadlines whatever the callbacks take."""
    sinks: dict[str, SinkMargin]
    """By sink its margin."""

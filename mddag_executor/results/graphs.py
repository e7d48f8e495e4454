# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The results of `graph check`, `graph place` and `graph assign-deadlines`."""

from __future__ import annotations

from typing import Any, TypedDict

from mddag_executor.results.replays import ProcessNodes


class CheckedDag(TypedDict):
    """A DAG task; execution times are means, and null if one of them is not declared."""

    period_ns: int
    """Its period."""
    vertices: list[str]
    """Names of its vertices."""
    edges: list[list[int]]
    """Pairs of places in `vertices`: the second callback starts with a message of the first."""
    sinks: dict[str, int | None]
    """By sink its deadline, counted from the release; null: `deadline: none`."""
    rad_offset_ns: list[int]
    """By vertex the reference absolute deadline minus the release, in the order of `vertices`."""
    critical_path_ns: int | None
    """The longest path through the DAG."""
    load: float | None
    """Cores that it needs."""
    utilisation: float | None
    """The load divided by the workers."""


class NecessaryTest(TypedDict):
    """A test that a task set must pass to be schedulable."""

    test: str
    """`longest path`, `utilisation` or `demand bound`."""
    holds: bool
    """False: no scheduler can keep the deadlines."""
    figure: str
    """What was compared, in words."""
    reason: str
    """Why the test holds or fails, in words."""
    details: dict[str, Any]
    """For the longest path: by sink `deadline_ns` and `longest_path_ns`; for the utilisation: by
    DAG its load in cores; for the demand bound: `time_ns` and `work_ns`."""


class CheckedQueueEdge(TypedDict):
    """Data that a callback reads without being started by it."""

    reader: str
    """The callback that reads it."""
    topic: str | None
    """The topic; null for a variable of the node."""
    writers: list[str]
    """The callbacks that write it."""


class Bound(TypedDict):
    """A requirement of a path, and what is guaranteed."""

    required_ns: int
    """The required reaction time or data age."""
    bound_ns: int | None
    """The longest one if all sinks are in time; null: nothing bounds it."""
    why_unbounded: str | None
    """The reason, if nothing bounds it."""


class CheckResultRare(TypedDict, total=False):
    """Keys of declarations that require something of paths."""

    requirements: dict[str, dict[str, Bound]]
    """By path, and `reaction` or `age`, the requirement."""


class CheckResult(CheckResultRare):
    """The result of `graph check`: the DAG tasks of a declaration, and necessary tests."""

    dags: dict[str, CheckedDag]
    """By name the DAG tasks."""
    vertices: int
    """Number of vertices of all DAGs."""
    callbacks: int
    """Number of callbacks."""
    workers: int
    """Number of workers."""
    load: float | None
    """Cores that all DAGs need; null if an execution time is not declared."""
    utilisation: float | None
    """The load divided by the workers; null if an execution time is not declared."""
    budget: str
    """Which value of each execution time the tests use: `max`, `p99` or `mean`."""
    tests: list[NecessaryTest]
    """The necessary tests; empty if an execution time is not declared."""
    queue_edges: list[CheckedQueueEdge]
    """Data that callbacks read without being started by it."""
    paths: dict[str, list[str]]
    """By declared path its callbacks."""


class PlaceResult(TypedDict):
    """The result of `graph place`: which node runs in which process."""

    processes: list[ProcessNodes]
    """The processes."""
    loads: list[float]
    """By process the share of a core that its Python code needs."""


class MeasuredAcceptance(TypedDict):
    """How many runs kept the assigned deadlines."""

    accepted: int
    """Runs in which no deadline was missed."""
    runs: int
    """Number of runs."""
    seed: int
    """Seed of the drawn execution times."""
    ratio: float
    """Share of the accepted runs."""
    interval_95: list[float]
    """Its 95 % confidence interval."""


class AssignResultRare(TypedDict, total=False):
    """Keys of declarations that require something of paths."""

    requirements: dict[str, dict[str, Bound]]
    """By path, and `reaction` or `age`, the requirement."""


class AssignResult(AssignResultRare):
    """The result of `graph assign-deadlines`."""

    policy: str
    """The policy that the acceptance was measured with."""
    budget: str
    """Which value of each execution time is used: `max`, `p99` or `mean`."""
    deadlines_ns: dict[str, int]
    """By sink's callback the assigned deadline."""
    acceptance: MeasuredAcceptance
    """How many runs kept these deadlines."""

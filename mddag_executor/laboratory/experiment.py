# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Experiments, and how chunks of their numbered runs are evaluated.

Theory of operation
-------------------
Each run draws one execution time for each vertex (see ``draws``) and simulates its task set under
every policy with these same times, until the first miss.  A run without a miss is accepted.  As in
the paper only completions are judged by default.

An evaluation has one task set or several, each with the same number of runs.  A run has a *place*,
counted task set by task set, and a *number*: the task set's index times ``STRIDE``, plus the first
run's number, plus the run's index in its task set.  Its draw depends on the seed and this number
only.  So a run has the same outcome in every process and in every range of runs, and the outcomes
of ranges that do not overlap can be merged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from mddag_executor import defaults
from mddag_executor.core import Tables
from mddag_executor.core.jobs import is_miss
from mddag_executor.laboratory.draws import (
    Bools,
    Draws,
    feasible,
    Floats,
    Samples,
    Times,
    utilisations,
)
from mddag_executor.simulate.policies import preempts
from mddag_executor.simulate.schedule import schedule, Settings
from mddag_executor.simulate.workload import periodic_workload
from msg_graph import TaskSet
import numpy as np

STRIDE = 2 ** 40
"""The numbers of the first runs of two task sets are this far apart."""

_MOST_AT_HAND = 64  # task sets whose tables are kept


@dataclass(frozen=True)
class Experiment:
    """
    What to evaluate.

    :param policies: names of policies.
    :param preemptive: None runs each policy in its own mode of the paper's experiment.
    :param samples: measured values of each callback (ns); None draws from the quantile tables.
    :param overhead_ns: added to an execution each time it is dispatched.
    """

    task_set: TaskSet
    policies: tuple[str, ...] = defaults.POLICIES
    workers: int = defaults.WORKERS
    duration_ns: int = defaults.DURATION_NS
    seed: int = 0
    samples: Samples | None = None
    preemptive: bool | None = None
    overhead_ns: int = 0
    judge: str = 'completions'

    def settings(self, policy: str) -> Settings:
        """Return how to simulate a run under a policy."""
        preemptive = preempts(policy, self.preemptive)
        return Settings(
            policy=policy, pools=(self.workers,), duration_ns=self.duration_ns,
            preemptive=preemptive, judge=self.judge, stop_at_first_miss=True,
            dispatch_overhead_ns=self.overhead_ns)


class Chunk(NamedTuple):
    """
    The outcome of some consecutive runs.

    ``first`` is the place of the first one; ``accepted`` has a row for each policy, a column for
    each run.
    """

    first: int
    utilisation: Floats
    possible: Bools
    accepted: Bools


Judge = Callable[[Settings, Times], Bools]
"""Simulates runs of a task set; returns which of those with these times met every deadline."""


def judge_of(task_set: TaskSet, duration_ns: int, compiled: bool) -> Judge:
    """Return the function that simulates runs of a task set, each up to its first miss."""
    tables = Tables.build(task_set)
    load = periodic_workload(
        task_set, [[0] * len(dag.vertices) for dag in task_set.dags], duration_ns)
    if compiled:
        from mddag_executor.simulate.compiled import run_each

    def judge(settings: Settings, times: Times) -> Bools:
        if compiled:
            options = settings.engine_options._replace(keep_log=0)
            _, missed = run_each(
                tables, load._replace(costs=times.ravel()),  # type: ignore[arg-type]
                settings.policy, options, len(times))
            return np.logical_not(missed)
        return np.array([not any(is_miss(kind) for kind, *_ in schedule(
            tables, load._replace(costs=costs), settings, compiled=False).decisions)
            for costs in times], dtype=np.bool_)

    return judge


class Evaluator:
    """Evaluates chunks of experiments; threads may share it, and processes get a copy."""

    def __init__(
        self, experiments: Sequence[Experiment], runs: int, first_run: int, compiled: bool
    ) -> None:
        self.compiled = compiled
        self._arguments = experiments, runs, first_run, compiled
        self._parts = lru_cache(_MOST_AT_HAND)(self._make)

    def __reduce__(self) -> tuple[Any, ...]:
        return Evaluator, self._arguments

    def _make(self, index: int) -> tuple[Draws, Judge]:
        experiment = self._arguments[0][index]
        return (Draws(experiment.task_set, experiment.seed, experiment.samples),
                judge_of(experiment.task_set, experiment.duration_ns, self.compiled))

    def __call__(self, first: int, count: int) -> Chunk:
        """Evaluate ``count`` runs from the place ``first`` on."""
        _, runs, first_run, _ = self._arguments
        parts = []
        place, end = first, first + count
        while place < end:
            index, run = divmod(place, runs)
            some = min(end - place, runs - run)
            parts.append(self._evaluate(index, index * STRIDE + first_run + run, some))
            place += some
        utilisation, possible, accepted = zip(*parts)
        return Chunk(first, np.concatenate(utilisation), np.concatenate(possible),
                     np.concatenate(accepted, axis=1))

    def _evaluate(self, index: int, first: int, count: int) -> tuple[Floats, Bools, Bools]:
        one = self._arguments[0][index]
        draws, judge = self._parts(index)
        times = draws.times(first, count)
        return (
            utilisations(one.task_set, times, one.workers),
            feasible(one.task_set, times, one.workers, one.duration_ns, one.judge,
                     one.overhead_ns),
            np.array([judge(one.settings(name), times) for name in one.policies]))

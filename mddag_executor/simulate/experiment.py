# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What an evaluation consists of: experiments, and the chunks of numbered runs that they are done in.

Theory of operation
-------------------
Each run draws one execution time for each vertex (see ``draws``) and simulates its task set under
every policy with these same times, until the first miss.  A run without a miss is accepted.  As in
the paper only completions are judged, unless said otherwise.

An evaluation has one task set or many (random ones, say), each with the same number of runs.  A
run has a *place*, task set by task set, and a *number*, which its draw depends on (and on the
seed): the task set's index times ``STRIDE`` plus the run's index there.  So a run is the same
however many there are of them, in whichever process it is done, and whatever was done before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
import time
from typing import NamedTuple

from mddag_executor import defaults
from mddag_executor.core import policy as find_policy
from mddag_executor.core import Tables
from mddag_executor.core.jobs import is_miss
from mddag_executor.simulate.draws import (
    Bools,
    Draws,
    feasible,
    Floats,
    Samples,
    Times,
    utilisations,
)
from mddag_executor.simulate.load import Load
from mddag_executor.simulate.run import check
from mddag_executor.simulate.schedule import schedule, Settings
from mddag_executor.simulate.workload import declared_holds, periodic_load
from msg_graph import TaskSet
import numpy as np

STRIDE = 2 ** 40
"""The numbers of the first runs of two task sets are this far apart."""

_MOST_AT_HAND = 64  # evaluators of task sets that are kept


@dataclass(frozen=True)
class Experiment:
    """
    What to evaluate; it is sent to worker processes as a whole.

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
        preemptive = find_policy(policy).mode(self.preemptive)
        return Settings(
            policy=policy, workers=self.workers, duration_ns=self.duration_ns,
            preemptive=preemptive, judge=self.judge, stop_at_first_miss=True,
            dispatch_overhead_ns=self.overhead_ns)


class Chunk(NamedTuple):
    """
    What came of some consecutive runs.

    ``accepted`` has a row for each policy, a column for each run.
    """

    first: int
    utilisation: Floats
    possible: Bools
    accepted: Bools
    took_s: float

    def size_for(self, seconds: float) -> int:
        """Return how many runs like these take about that long."""
        return max(1, round(len(self.utilisation) * seconds / max(self.took_s, 1e-6)))


Judge = Callable[[Settings, Times], Bools]
"""Simulates runs of a task set; returns which of those with these times met every deadline."""


def plain_judge(task_set: TaskSet, duration_ns: int) -> Judge:
    """Return what simulates runs in plain Python."""
    tables = Tables.build(task_set)
    without_costs = load_without_costs(task_set, duration_ns)

    def judge(settings: Settings, times: Times) -> Bools:
        accepted = np.zeros(len(times), dtype=np.bool_)
        for row in range(len(times)):
            load = without_costs._replace(costs=times[row].tolist())
            decisions = schedule(tables, load, settings).decisions
            accepted[row] = not any(is_miss(decision[0]) for decision in decisions)
        return accepted

    return judge


def load_without_costs(task_set: TaskSet, duration_ns: int) -> Load:
    """Return the load that all runs have but for their execution times."""
    return periodic_load(
        task_set, [[0] * len(dag.vertices) for dag in task_set.dags], duration_ns)


class Evaluator:
    """
    Evaluates chunks of experiments; each worker process has one, its threads share it.

    :param runs: of each experiment.
    """

    def __init__(
        self, experiments: Sequence[Experiment], runs: int, compiled: bool = False
    ) -> None:
        self._experiments = experiments
        self._runs = runs
        self._compiled = compiled
        self._parts = lru_cache(_MOST_AT_HAND)(self._make)

    def _make(self, index: int) -> tuple[Draws, Judge]:
        one = self._experiments[index]
        draws = Draws(one.task_set, one.seed, one.samples)
        if self._compiled and not declared_holds(one.task_set):
            from mddag_executor.simulate.compiled import compiled_judge
            return draws, compiled_judge(one.task_set, one.duration_ns)
        return draws, plain_judge(one.task_set, one.duration_ns)

    def check(self) -> None:
        """Find out whether all experiments can be done."""
        for experiment in self._experiments:
            for name in experiment.policies:
                check(experiment.settings(name))
            Draws(experiment.task_set, experiment.seed, experiment.samples)

    def __call__(self, first: int, count: int) -> Chunk:
        """Evaluate ``count`` runs from the place ``first`` on."""
        begin = time.monotonic()
        parts = []
        at, end = first, first + count
        while at < end:
            index, run_index = divmod(at, self._runs)
            some = min(end - at, self._runs - run_index)
            parts.append(self._some(index, index * STRIDE + run_index, some))
            at += some
        utilisation, possible, accepted = zip(*parts)
        return Chunk(
            first, np.concatenate(utilisation), np.concatenate(possible),
            np.concatenate(accepted, axis=1), time.monotonic() - begin)

    def _some(self, index: int, first: int, count: int) -> tuple[Floats, Bools, Bools]:
        """Evaluate runs of one experiment, by their numbers."""
        one = self._experiments[index]
        draws, judge = self._parts(index)
        times = draws.times(first, count)
        return (
            utilisations(one.task_set, times, one.workers),
            feasible(one.task_set, times, one.workers, one.duration_ns, one.judge,
                     one.overhead_ns),
            np.array([judge(one.settings(name), times) for name in one.policies]))

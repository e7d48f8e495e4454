# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Outcome of an evaluation: which runs were accepted, at which utilisation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mddag_executor.simulate.acceptance import Acceptance, BINS, bins_of, Bools, WIDE_BINS
from mddag_executor.simulate.draws import Floats
from mddag_executor.simulate.experiment import Chunk, Experiment
import numpy as np


@dataclass
class Evaluation:
    """
    Outcome of one experiment, or of one with many task sets.

    Confidence intervals take runs as independent; of random task sets that holds for one run each.

    :ivar experiments: they differ in their task sets and workers only.
    :ivar runs_each: runs that were asked for, of each experiment.
    :ivar compiled: whether this machine used the compiled core.
    :ivar jobs: how many runs were simulated at a time.
    :ivar resumed: how many runs came from an evaluation before this one.
    :ivar done: which runs were done; the others' entries in the arrays mean nothing.
    """

    experiments: tuple[Experiment, ...]
    runs_each: int
    compiled: bool = False
    jobs: int = 1
    elapsed_s: float = 0.0
    interrupted: bool = False
    resumed: int = 0
    utilisation: Floats = field(init=False)
    possible: Bools = field(init=False)
    accepted: Bools = field(init=False)
    done: Bools = field(init=False)

    def __post_init__(self) -> None:
        """Make room for the runs."""
        asked = self.asked
        self.utilisation = np.zeros(asked)
        self.possible = np.zeros(asked, dtype=np.bool_)
        self.accepted = np.zeros((len(self.experiment.policies), asked), dtype=np.bool_)
        self.done = np.zeros(asked, dtype=np.bool_)

    def add(self, chunk: Chunk) -> None:
        """Take a chunk's outcome in."""
        runs = slice(chunk.first, chunk.first + len(chunk.utilisation))
        self.utilisation[runs] = chunk.utilisation
        self.possible[runs] = chunk.possible
        self.accepted[:, runs] = chunk.accepted
        self.done[runs] = True

    @property
    def experiment(self) -> Experiment:
        """Return the first experiment, for what all of them share."""
        return self.experiments[0]

    @property
    def asked(self) -> int:
        """Count the runs that were asked for."""
        return len(self.experiments) * self.runs_each

    @property
    def runs(self) -> int:
        """Count the runs that were done."""
        return int(self.done.sum())

    @property
    def bins(self) -> tuple[float, ...]:
        """Return the centres of the bins: the paper's, or wider ones for many task sets."""
        return BINS if len(self.experiments) == 1 else WIDE_BINS

    def by_policy(self) -> dict[str, Acceptance]:
        """Return the acceptance of each policy."""
        return {name: self._acceptance(self.accepted[i])
                for i, name in enumerate(self.experiment.policies)}

    def bound(self) -> Acceptance:
        """Return the acceptance that no scheduler can exceed."""
        return self._acceptance(self.possible)

    def _acceptance(self, accepted: Bools) -> Acceptance:
        bins = bins_of(self.utilisation[self.done], self.bins)
        return Acceptance(bins, accepted[self.done], len(self.bins))

    def counts(self) -> list[int]:
        """Return how many runs each bin has."""
        counts: list[int] = np.bincount(
            bins_of(self.utilisation[self.done], self.bins), minlength=len(self.bins)).tolist()
        return counts

    def result(self) -> dict[str, Any]:
        """Return the result format of ``evaluate --json``."""
        experiment = self.experiment
        acceptance, bound = self.by_policy(), self.bound()
        return {
            'runs': self.runs, 'elapsed_s': round(self.elapsed_s, 3), 'bins': list(self.bins),
            'counts': self.counts(),
            'acceptance': {name: each.ratio for name, each in acceptance.items()},
            'bound': bound.ratio,
            'policies': {
                name: {'preemptive': experiment.settings(name).preemptive, **each.result()}
                for name, each in acceptance.items()},
            'bound_total': bound.total,
            'workers': experiment.workers, 'duration_ns': experiment.duration_ns,
            'seed': experiment.seed, 'overhead_ns': experiment.overhead_ns,
            'judge': experiment.judge, 'samples': experiment.samples is not None,
            'interrupted': self.interrupted, 'compiled': self.compiled, 'jobs': self.jobs,
            'resumed': self.resumed, 'graphs': [self._graph(i) for i in range(
                len(self.experiments))]}

    def _graph(self, index: int) -> dict[str, Any]:
        """Return what came of one task set; the utilisation is the mean of its runs."""
        experiment = self.experiments[index]
        place = slice(index * self.runs_each, (index + 1) * self.runs_each)
        done = self.done[place]
        return {
            'graph': experiment.task_set.file, 'workers': experiment.workers,
            'runs': int(done.sum()),
            'utilisation': float(self.utilisation[place][done].mean()) if done.any() else None,
            'accepted': {name: int(self.accepted[i, place][done].sum())
                         for i, name in enumerate(experiment.policies)},
            'possible': int(self.possible[place][done].sum())}

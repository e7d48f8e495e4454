# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Outcome of an evaluation: how many runs met every deadline, by normalised utilisation.

The bins of one task set are the paper's: the nearest multiple of 0.05, everything below 0.525 in
0.5 and everything from 0.975 up in 1.0. Those of many task sets begin at 0.05.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import math

from mddag_executor.laboratory.draws import Bools, Floats
from mddag_executor.laboratory.experiment import Chunk, Experiment
from mddag_executor.results.simulations import EvaluateResult, GraphAcceptance, PolicyAcceptance
import numpy as np
import numpy.typing as npt

BINS = tuple(round(0.5 + 0.05 * i, 2) for i in range(11))
WIDE_BINS = tuple(round(0.05 + 0.05 * i, 2) for i in range(20))

Z_95 = 1.959963984540054
"""Half the width of the central 95 % of the normal distribution, in standard deviations."""


def bins_of(
    utilisation: npt.NDArray[np.float64], bins: Sequence[float] = BINS
) -> npt.NDArray[np.int64]:
    """Return for each utilisation the index of its bin, the one with the nearest centre."""
    edges = np.array([round(centre + 0.025, 3) for centre in bins[:-1]])
    return np.searchsorted(edges, utilisation, side='right').astype(np.int64)


def wilson(accepted: int, runs: int) -> tuple[float, float]:
    """
    Return the 95 % confidence interval of a ratio by Wilson's score method.

    Unlike the normal approximation it stays within 0 and 1 and is right near them.
    """
    z2 = Z_95 * Z_95
    ratio = accepted / runs
    centre = (ratio + z2 / (2 * runs)) / (1 + z2 / runs)
    half = Z_95 / (1 + z2 / runs) * math.sqrt(
        ratio * (1 - ratio) / runs + z2 / (4 * runs * runs))
    # At the ends rounding must not leave the ratio outside of its own interval.
    return min(ratio, max(0.0, centre - half)), max(ratio, min(1.0, centre + half))


class Acceptance:
    """
    Acceptance of one set of runs: runs, ratio and confidence interval of each bin, total ratio.

    ``ratio`` and ``interval`` are None for an empty bin.

    :param bins: number of the bin of each run.
    :param n_bins: how many bins there are.
    """

    def __init__(
        self, bins: npt.NDArray[np.int64], accepted: Bools, n_bins: int = len(BINS)
    ) -> None:
        self.runs: list[int] = np.bincount(bins, minlength=n_bins).tolist()
        self.accepted: list[int] = np.bincount(bins[accepted], minlength=n_bins).tolist()
        self.ratio: list[float | None] = []
        self.interval: list[tuple[float, float] | None] = []
        for good, runs in zip(self.accepted, self.runs):
            self.ratio.append(good / runs if runs else None)
            self.interval.append(wilson(good, runs) if runs else None)
        self.total = float(np.mean(accepted)) if len(accepted) else None

    def result(self, preemptive: bool) -> PolicyAcceptance:
        """Return the parts for machines, apart from the ratios by bin."""
        return {
            'preemptive': preemptive, 'total': self.total, 'accepted': self.accepted,
            'interval_95': [None if each is None else list(each) for each in self.interval]}


@dataclass
class Evaluation:
    """
    Outcome of one experiment, or of several.

    The confidence intervals assume independent runs; random task sets need one run each for that.

    :ivar experiments: they differ in their task sets and workers only.
    :ivar runs_each: runs that were asked for, of each experiment.
    :ivar first_run: number of the first of them.
    :ivar compiled: whether the compiled core was used.
    :ivar jobs: how many chunks were simulated at a time.
    :ivar done: which runs are done; the entries of others in the arrays mean nothing.
    """

    experiments: tuple[Experiment, ...]
    runs_each: int
    first_run: int = 0
    compiled: bool = False
    jobs: int = 1
    elapsed_s: float = 0.0
    interrupted: bool = False
    utilisation: Floats = field(init=False)
    possible: Bools = field(init=False)
    accepted: Bools = field(init=False)
    done: Bools = field(init=False)

    def __post_init__(self) -> None:
        asked = self.asked
        self.utilisation = np.zeros(asked)
        self.possible = np.zeros(asked, dtype=np.bool_)
        self.accepted = np.zeros((len(self.experiment.policies), asked), dtype=np.bool_)
        self.done = np.zeros(asked, dtype=np.bool_)

    def add(self, chunk: Chunk) -> None:
        """Add the outcome of a chunk."""
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
        """Return the acceptance that no scheduler can exceed (see ``feasible``)."""
        return self._acceptance(self.possible)

    def _acceptance(self, accepted: Bools) -> Acceptance:
        bins = bins_of(self.utilisation[self.done], self.bins)
        return Acceptance(bins, accepted[self.done], len(self.bins))

    def result(self) -> EvaluateResult:
        """Return the result format of ``evaluate --json``."""
        experiment = self.experiment
        acceptance, bound = self.by_policy(), self.bound()
        return {
            'runs': self.runs, 'first_run': self.first_run,
            'elapsed_s': round(self.elapsed_s, 3), 'bins': list(self.bins),
            'counts': bound.runs,
            'acceptance': {name: each.ratio for name, each in acceptance.items()},
            'bound': bound.ratio,
            'policies': {
                name: each.result(bool(experiment.settings(name).preemptive))
                for name, each in acceptance.items()},
            'bound_total': bound.total,
            'workers': experiment.workers, 'duration_ns': experiment.duration_ns,
            'seed': experiment.seed, 'overhead_ns': experiment.overhead_ns,
            'judge': experiment.judge, 'samples': experiment.samples is not None,
            'interrupted': self.interrupted, 'compiled': self.compiled, 'jobs': self.jobs,
            'graphs': [self._graph(i) for i in range(len(self.experiments))]}

    def _graph(self, index: int) -> GraphAcceptance:
        """Return the result of one task set; the utilisation is the mean of its runs."""
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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Deadlines for sinks: in proportion to critical paths, or the tightest that reach a target.

Theory of operation
-------------------
A sink's critical path is the longest path from the source to it, by a budget (mean, 99 % quantile
or maximum) of the execution times.  Deadlines are rounded up to whole us.  The *search*:

1. Every sink's deadline is its critical path times one scale.  A scale is *good* when the lower
   end of the 95 % confidence interval of the acceptance is at or above the target.
2. All scales are tried with the same draws of execution times, so that their difference is not
   the draws'.  The scale is doubled or halved until one is good and another is not, then the gap
   is halved (on a logarithmic scale) down to ``PRECISION``.
3. Acceptance grows with the scale, but for anomalies.  The result is a scale that was tried and
   is good; nothing is concluded about those that were not tried.
4. The draws that chose the scale favour it.  So the reported acceptance comes from as many other
   draws, of the next seed.
5. Open jobs at the end are judged too, and no deadline is longer than half of a run: else an
   overload would look good because nothing was judged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import math
from typing import Any

from mddag_executor.errors import MddagError
from mddag_executor.laboratory.acceptance import wilson, Z_95
from mddag_executor.laboratory.evaluate import compiling_pays, evaluate
from mddag_executor.laboratory.experiment import Experiment
from mddag_executor.laboratory.tasks import tasks_of
from msg_graph import TaskSet
from msg_graph.duration import whole_us
from msg_graph.edit import with_deadlines

PRECISION = 0.01
"""The result is larger than a scale that is not good by this part, at most."""

_LEAST_SCALE = 2.0 ** -20
_USUAL_SCALES = 11


class AssignError(MddagError):
    """Deadlines that cannot be found as asked."""


@dataclass(frozen=True)
class Measured:
    """The acceptance of some deadlines, with its confidence interval."""

    accepted: int
    runs: int
    seed: int

    @property
    def ratio(self) -> float:
        """Return the acceptance ratio."""
        return self.accepted / self.runs

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % confidence interval of the ratio."""
        return wilson(self.accepted, self.runs)

    def result(self) -> dict[str, Any]:
        """Return the parts for machines."""
        return {'accepted': self.accepted, 'runs': self.runs, 'seed': self.seed,
                'ratio': self.ratio, 'interval_95': list(self.interval)}


@dataclass
class Found:
    """
    Outcome of a search.

    :ivar scale: the tightest good one.
    :ivar deadlines: of each sink, ns, by its callback's key.
    :ivar tried: every scale that was tried, with its acceptance.
    :ivar check: the acceptance with draws that took no part in the search.
    """

    scale: float
    deadlines: dict[str, int]
    tried: list[tuple[float, Measured]]
    check: Measured


def proportional(task_set: TaskSet, budget: str) -> dict[str, int]:
    """
    Return a deadline (ns) for each sink by its callback's key.

    The sink of a DAG with the longest critical path gets the period, the others less in proportion
    to theirs.  A callback that is several sinks gets the shortest of theirs.

    :raises mddag_executor.laboratory.tasks.AnalysisError: an execution time is not declared.
    """
    deadlines: dict[str, int] = {}
    for task in tasks_of(task_set, budget):
        longest = max(length for _, _, length in task.sinks)
        for index, _, length in task.sinks:
            key = task.dag.vertices[index].callback.key
            deadline = whole_us(task.period * (length / longest if longest else 1.0))
            deadlines[key] = min(deadline, deadlines.get(key, deadline))
    return deadlines


def scaled(task_set: TaskSet, budget: str, scale: float) -> dict[str, int]:
    """
    Return a deadline (ns) for each sink by its callback's key: its critical path times a scale.

    A callback that is several sinks gets the longest of theirs.

    :raises mddag_executor.laboratory.tasks.AnalysisError: an execution time is not declared.
    """
    deadlines: dict[str, int] = {}
    for task in tasks_of(task_set, budget):
        for index, _, length in task.sinks:
            key = task.dag.vertices[index].callback.key
            deadlines[key] = max(whole_us(length * scale), deadlines.get(key, 0))
    return deadlines


def least_runs(target: float) -> int:
    """Return how many runs, all accepted, show an acceptance of that target."""
    runs = math.ceil(Z_95 ** 2 * target / (1.0 - target))
    while wilson(runs, runs)[0] < target:
        runs += 1
    return max(1, runs)


def measure(
    experiment: Experiment, deadlines: dict[str, int], runs: int, jobs: int = 1,
    progress: Callable[[int], None] | None = None, compiled: bool | None = None,
) -> Measured:
    """
    Return the acceptance of some deadlines, of what is open at the end too.

    :param experiment: with one policy; its task set's deadlines are ignored.
    :raises KeyboardInterrupt: it was interrupted.
    """
    task_set = with_deadlines(experiment.task_set, deadlines)
    outcome = evaluate(
        replace(experiment, task_set=task_set, judge='horizon'), runs, jobs=jobs,
        compiled=compiled, progress=progress)
    if outcome.interrupted:
        raise KeyboardInterrupt
    return Measured(int(outcome.accepted[0].sum()), runs, experiment.seed)


@dataclass
class Search:
    """
    Searches the tightest scale.

    :param experiment: with one policy; its task set's deadlines are ignored.
    :param budget: ``mean``, ``p99`` or ``max``: of what a critical path consists.
    :param runs: with each scale.
    :param progress: gets the scale, and how many of its runs are done.
    :raises AssignError: the target cannot be shown with so many runs.
    """

    experiment: Experiment
    target: float
    budget: str = 'p99'
    runs: int = 1000
    jobs: int = 1
    compiled: bool | None = None
    progress: Callable[[float, int], None] | None = None
    tried: list[tuple[float, Measured]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 0.0 < self.target < 1.0:
            raise AssignError(
                f'--target {self.target:g}: it is out of range: give a ratio above 0 and below 1')
        needed = least_runs(self.target)
        if self.runs < needed:
            raise AssignError(
                f'--target {self.target:g}: {self.runs} runs cannot show it: give --runs {needed} '
                'or more')
        if self.compiled is None:   # over all scales
            self.compiled = compiling_pays(
                (self.experiment,), self.runs * _USUAL_SCALES, self.jobs)

    def _measure(self, deadlines: dict[str, int], seed: int, scale: float) -> Measured:
        def progress(done: int) -> None:
            if self.progress is not None:
                self.progress(scale, done)

        return measure(
            replace(self.experiment, seed=seed), deadlines, self.runs, self.jobs, progress,
            self.compiled)

    def find(self) -> Found:
        """
        Search.

        :raises AssignError: no deadlines reach the target.
        """
        bad, good = self._bracket()
        while good > bad * (1.0 + PRECISION):
            middle = math.sqrt(bad * good)
            if self._is_good(middle):
                good = middle
            else:
                bad = middle
        deadlines = self._deadlines(good)
        seed = (self.experiment.seed + 1) % 2 ** 64
        return Found(good, deadlines, self.tried, self._measure(deadlines, seed, good))

    def _bracket(self) -> tuple[float, float]:
        """Return a scale that is not good, and a good one that is twice as large."""
        scale = 1.0
        if self._is_good(scale):
            while self._is_good(scale / 2):
                scale /= 2
                if scale < _LEAST_SCALE:
                    raise AssignError(
                        '--target: every deadline is good enough: is there anything to execute?')
            return scale / 2, scale
        while True:
            scale *= 2
            if self._is_good(scale):
                return scale / 2, scale

    def _deadlines(self, scale: float) -> dict[str, int]:
        return scaled(self.experiment.task_set, self.budget, scale)

    def _is_good(self, scale: float) -> bool:
        deadlines = self._deadlines(scale)
        half = self.experiment.duration_ns // 2
        if max(deadlines.values()) > half:
            best = max((measured.ratio for _, measured in self.tried), default=0.0)
            raise AssignError(
                f'--target {self.target:g}: no scale with deadlines up to half of a run reaches '
                f'it (the best accepted {100 * best:.1f} %): give a lower target, more --workers, '
                'or a longer --duration')
        measured = self._measure(deadlines, self.experiment.seed, scale)
        self.tried.append((scale, measured))
        return measured.interval[0] >= self.target

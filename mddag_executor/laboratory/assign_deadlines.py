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
2. All scales are tried with the same draws of execution times.  The scale is doubled or halved
   until one is good and another is not, then the gap is halved (on a logarithmic scale) down to
   ``PRECISION``.  Acceptance grows with the scale, but for anomalies; nothing is concluded about
   scales that were not tried.
3. The draws that chose the scale favour it.  So the reported acceptance comes from as many other
   draws, of the next seed.
4. Open jobs at the end are judged too, and no deadline is longer than half of a run: else an
   overload would look good because nothing was judged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import math
from typing import Any, NamedTuple

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.acceptance import wilson, Z_95
from mddag_executor.laboratory.evaluate import evaluate, plain_s
from mddag_executor.laboratory.experiment import Experiment
from mddag_executor.laboratory.tasks import tasks_of
from mddag_executor.simulate.schedule import compiling_pays
from msg_graph import TaskSet
from msg_graph.duration import whole_us
from msg_graph.edit import with_deadlines

PRECISION = 0.01
"""The result is larger than a scale that is not good by this part, at most."""
_LEAST_SCALE = 2.0 ** -20
_USUAL_SCALES = 11

Deadlines = dict[str, int]
"""Relative deadlines of sinks, ns, by their callbacks' keys."""


class Measured(NamedTuple):
    """The acceptance of some deadlines."""

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
        return {**self._asdict(), 'ratio': self.ratio, 'interval_95': list(self.interval)}


class Found(NamedTuple):
    """
    Outcome of a search.

    :ivar scale: the tightest good one.
    :ivar tried: every scale that was tried, with its acceptance.
    :ivar check: the acceptance with draws that took no part in the search.
    """

    scale: float
    deadlines: Deadlines
    tried: list[tuple[float, Measured]]
    check: Measured


def proportional(task_set: TaskSet, budget: str) -> Deadlines:
    """
    Return deadlines in proportion to the critical paths.

    The sink of a DAG with the longest critical path gets the period, the others less.  A callback
    that is several sinks gets the shortest one.

    :raises mddag_executor.errors.UsageError: an execution time is not declared.
    """
    deadlines: Deadlines = {}
    for task in tasks_of(task_set, budget):
        for index, _, length in task.sinks:
            key = task.dag.vertices[index].callback.key
            deadline = whole_us(task.period * (length / task.length if task.length else 1.0))
            deadlines[key] = min(deadline, deadlines.get(key, deadline))
    return deadlines


def scaled(task_set: TaskSet, budget: str, scale: float) -> Deadlines:
    """
    Return critical paths times a scale; a callback that is several sinks gets the longest.

    :raises mddag_executor.errors.UsageError: an execution time is not declared.
    """
    deadlines: Deadlines = {}
    for task in tasks_of(task_set, budget):
        for index, _, length in task.sinks:
            key = task.dag.vertices[index].callback.key
            deadlines[key] = max(whole_us(length * scale), deadlines.get(key, 0))
    return deadlines


def measure(
    experiment: Experiment, deadlines: Deadlines, runs: int, jobs: int = 1,
    progress: Callable[[int], None] | None = None, compiled: bool | None = None,
) -> Measured:
    """
    Return the acceptance of some deadlines.

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


def least_runs(target: float) -> int:
    """Return how many runs, all accepted, show an acceptance of that target."""
    runs = math.ceil(Z_95 ** 2 * target / (1.0 - target))
    while wilson(runs, runs)[0] < target:
        runs += 1
    return max(1, runs)


def search(
    experiment: Experiment, target: float, budget: str = 'p99', runs: int = 1000, jobs: int = 1,
    progress: Callable[[float, int], None] = lambda scale, done: None,
) -> Found:
    """
    Search the tightest scale that reaches a target.

    :param experiment: with one policy; its task set's deadlines are ignored.
    :param runs: with each scale.
    :param progress: gets the scale, and how many of its runs are done.
    :raises UsageError: no deadlines reach the target, or so many runs cannot show it.
    """
    if not 0.0 < target < 1.0:
        raise UsageError(
            f'--target {target:g}: it is out of range: give a ratio above 0 and below 1')
    if runs < least_runs(target):
        raise UsageError(f'--target {target:g}: {runs} runs cannot show it: give --runs '
                          f'{least_runs(target)} or more')
    compiled = compiling_pays(plain_s((experiment,), runs * _USUAL_SCALES) / jobs)
    tried: list[tuple[float, Measured]] = []

    def acceptance(scale: float, seed: int) -> Measured:
        deadlines = scaled(experiment.task_set, budget, scale)
        if max(deadlines.values()) > experiment.duration_ns // 2:
            best = max((measured.ratio for _, measured in tried), default=0.0)
            raise UsageError(
                f'--target {target:g}: no scale with deadlines up to half of a run reaches it '
                f'(the best accepted {100 * best:.1f} %): give a lower target, more --workers, '
                'or a longer --duration')
        return measure(replace(experiment, seed=seed), deadlines, runs, jobs,
                       lambda done: progress(scale, done), compiled)

    def is_good(scale: float) -> bool:
        if scale < _LEAST_SCALE:
            raise UsageError(
                '--target: any deadline can be met, because all execution times are about zero')
        tried.append((scale, acceptance(scale, experiment.seed)))
        return tried[-1][1].interval[0] >= target

    good = 1.0
    factor = 0.5 if is_good(good) else 2.0
    while is_good(good * factor) == (factor < 1.0):
        good *= factor
    bad, good = sorted((good, good * factor))
    while good > bad * (1.0 + PRECISION):
        middle = math.sqrt(bad * good)
        bad, good = (bad, middle) if is_good(middle) else (middle, good)
    return Found(good, scaled(experiment.task_set, budget, good), tried,
                 acceptance(good, (experiment.seed + 1) % 2 ** 64))

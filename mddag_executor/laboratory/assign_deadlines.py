# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Deadlines for sinks: in proportion to critical paths, and short enough for what paths require.

Theory of operation
-------------------
A sink's critical path is the longest path from the source to it, by a budget (mean, 99 % quantile
or maximum) of the execution times.  Deadlines are rounded to whole us.

1. The sink of a DAG with the longest critical path gets the period, the others less, in
   proportion.
2. A requirement of a path bounds the sum of T + D over its segments (``msg_graph.segments``).  The
   time that the periods leave is shared among the deadlines in proportion to the critical paths,
   but no sink gets more than by rule 1; the others share the rest.
3. A segment that ends before a sink is bounded by one of the sinks after it: the one with the
   shortest critical path.
4. If several paths go through a sink, the shortest deadline counts, so that all requirements
   hold.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.acceptance import wilson
from mddag_executor.laboratory.evaluate import evaluate
from mddag_executor.laboratory.experiment import Experiment
from mddag_executor.laboratory.tasks import Task, tasks_of
from mddag_executor.results.graphs import MeasuredAcceptance
from msg_graph import format_duration, Path, TaskSet
from msg_graph.duration import MICROSECOND, round_up_deadline
from msg_graph.edit import with_deadlines
from msg_graph.segments import ends_of, Segment, segments, sinks_after

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

    def result(self) -> MeasuredAcceptance:
        """Return the parts for machines."""
        return {'accepted': self.accepted, 'runs': self.runs, 'seed': self.seed,
                'ratio': self.ratio, 'interval_95': list(self.interval)}


class _Part(NamedTuple):
    """A segment of a path: its sinks, and their longest critical path, ns."""

    segment: Segment
    period: int
    sinks: frozenset[str]
    length: int


def assigned(task_set: TaskSet, budget: str) -> Deadlines:
    """
    Return deadlines for all sinks, with which each path meets what is required of it.

    :raises mddag_executor.errors.UsageError: an execution time is not declared, or a requirement
        cannot be met.
    """
    tasks = tasks_of(task_set, budget)
    deadlines = proportional(tasks)
    most = dict(deadlines)
    for path in task_set.paths:
        for what, required in path.requirements.items():
            shares = _shares(_parts(task_set, tasks, path, what), most, path, what, required)
            for key, share in shares.items():
                deadlines[key] = min(share, deadlines[key])
    return deadlines


def proportional(tasks: list[Task]) -> Deadlines:
    """Return deadlines by rule 1; a callback that is several sinks gets the shortest one."""
    deadlines: Deadlines = {}
    for task in tasks:
        for index, _, length in task.sinks:
            key = task.dag.vertices[index].callback.key
            share = length / task.length if task.length else 1.0
            deadline = round_up_deadline(task.period * share)
            deadlines[key] = min(deadline, deadlines.get(key, deadline))
    return deadlines


def _parts(task_set: TaskSet, tasks: list[Task], path: Path, what: str) -> list[_Part]:
    """Return the segments of a path with the sinks that bound them (rule 3)."""
    found = []
    every = segments(task_set, path)
    for number, segment in enumerate(every):
        periods, sinks, longest = [0], set(), 0
        for dag, last in ends_of(task_set, list(segment.callbacks)):
            lengths = {index: length for index, _, length in tasks[dag.index].sinks}
            after = sinks_after(dag, last.index)
            if not after:
                raise UsageError(
                    f'path {path.name}: {what}: no sink with a deadline comes after '
                    f'{segment.callbacks[-1]}, so nothing bounds it: give one a deadline')
            if not (dag.sporadic or dag.once):
                periods.append(dag.period_ns)
            elif number and not (what == 'age' and number == len(every) - 1):
                raise UsageError(
                    f'path {path.name}: {what}: {segment.callbacks[0]} waits for a source that is '
                    'sporadic or fires once, so nothing bounds it: start it by a timer')
            sink = min(after, key=lambda index: lengths[index])
            sinks.add(dag.vertices[sink].callback.key)
            longest = max(longest, lengths[sink])
        waits = what == 'reaction' or number < len(every) - 1
        found.append(_Part(segment, max(periods) if waits else 0, frozenset(sinks), longest))
    return found


def _shares(
    parts: list[_Part], most: Deadlines, path: Path, what: str, required: int
) -> Deadlines:
    """Return the deadlines of the sinks of a path (rule 2)."""
    left = required - sum(part.period for part in parts)
    needed = sum(part.length for part in parts)
    if needed > left or left <= 0:
        slowest, longest = (max(parts, key=lambda part: getattr(part, name))
                            for name in ('period', 'length'))
        is_period = left <= 0 or slowest.period > longest.length
        part = slowest if is_period else longest
        raise UsageError(
            f'path {path.name}: {"an" if what == "age" else "a"} {what} of '
            f'{format_duration(required)} cannot be met: its periods take '
            f'{format_duration(required - left)} and its critical paths '
            f'{format_duration(needed)}: shorten first the ' + (
                f'period of {part.segment.dag}, {format_duration(part.period)}' if is_period else
                f'critical path to {min(part.sinks)}, {format_duration(part.length)}'))
    found: Deadlines = {}
    open_parts = list(parts)
    while open_parts:
        total = sum(part.length for part in open_parts)
        shares = [left * part.length // total if total else left // len(open_parts)
                  for part in open_parts]
        bounded = [part for part, share in zip(open_parts, shares)
                   if share >= max(part.length, *(most[key] for key in part.sinks))]
        for part, share in zip(open_parts, shares):
            limit = max(part.length, *(most[key] for key in part.sinks))
            if part in bounded:
                left -= limit
            for key in part.sinks:
                deadline = max(MICROSECOND, min(share, limit) // MICROSECOND * MICROSECOND)
                found[key] = min(deadline, found.get(key, deadline))
        if not bounded:
            break
        open_parts = [part for part in open_parts if part not in bounded]
        for part in open_parts:     # they share what the others leave
            for key in part.sinks:
                found.pop(key, None)
    return found


def measure(
    experiment: Experiment, deadlines: Deadlines, runs: int, jobs: int = 1,
    progress: Callable[[int], None] | None = None, compiled: bool | None = None,
) -> Measured:
    """
    Return the acceptance of some deadlines.

    Open jobs at the end are also judged: else an overload would look good because nothing was
    judged.

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

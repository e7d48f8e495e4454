# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verdicts of all tests on a declaration, in words.

Theory of operation
-------------------
A necessary test *holds* or *fails*: if it fails, no scheduler can keep the deadlines. A sufficient
test *holds*, for its scheduler, or *says nothing*: because its figure is too large, or because one
of its assumptions is not met. No sufficient test ever fails.

All sufficient tests share the assumptions of ``SHARED``; if the declaration shows that one is not
met, they say nothing. They are proven for sinks with different deadlines and without preemption,
as the live executor schedules.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from mddag_executor.errors import UsageError
from mddag_executor.laboratory import necessary, sufficient
from mddag_executor.laboratory.sufficient import Bound
from mddag_executor.laboratory.tasks import Task, tasks_of
from mddag_executor.text import counted
from msg_graph import format_duration, TaskSet

SHARED = (
    'no execution takes longer than its budget; releases of a DAG are at least its period apart, '
    'and known when its source becomes ready; no callback group keeps ready work waiting, nor '
    "does Python's lock; no bound on open jobs ends one that is not late; nothing undeclared "
    'runs; dispatching and transport take no time')
WORK_CONSERVING = 'any work-conserving, preemptive or not'
RAD_LIVE = 'rad, not preemptive (the live executor)'

HOLDS = 'holds'
FAILS = 'fails'
NOTHING = 'says nothing'


@dataclass(frozen=True)
class Verdict:
    """
    What one test says.

    :ivar kind: ``necessary`` or ``sufficient``.
    :ivar scheduler: the schedulers that it is about.
    :ivar verdict: ``HOLDS``, ``FAILS`` or ``NOTHING``.
    :ivar figure: what was compared, in words.
    :ivar reason: why that is the verdict.
    :ivar details: figures of single sinks or DAGs, in ns.
    """

    name: str
    kind: str
    source: str
    scheduler: str
    assumption: str
    verdict: str
    figure: str
    reason: str
    details: dict[str, Any]


Outcome = tuple[str, str, str, dict[str, Any]]
"""The last four fields of a verdict."""


@dataclass(frozen=True)
class Analysis:
    """All verdicts, for so many workers and this budget."""

    workers: int
    budget: str
    load: float
    verdicts: tuple[Verdict, ...]

    def result(self) -> dict[str, Any]:
        """Return the result format of ``graph analyse --json``."""
        return {'workers': self.workers, 'budget': self.budget, 'load': self.load,
                'utilisation': self.load / self.workers, 'assumptions': SHARED,
                'tests': [asdict(verdict) for verdict in self.verdicts]}


def analyse(
    task_set: TaskSet, workers: int, budget: str = 'max',
    progress: Callable[[int], None] | None = None,
) -> Analysis:
    """Analyse a task set for a budget (see ``tasks_of``); ``progress`` gets the tests done."""
    if workers < 1:
        raise UsageError(f'workers: {workers} is too few: give at least 1')
    tasks = tasks_of(task_set, budget)
    found = [Verdict(*about, *test(tasks, workers)) for about, test in _NECESSARY]
    impossible = any(verdict.verdict == FAILS for verdict in found)
    obstacle = 'a necessary test fails' if impossible else _obstacle(tasks)
    for about, test_of in _SUFFICIENT:
        if progress is not None:
            progress(len(found))
        found.append(Verdict(*about, *test_of(tasks, workers, obstacle)))
    return Analysis(workers, budget, sum(task.utilisation for task in tasks), tuple(found))


def _sink(task: Task, sink: int) -> str:
    return f'{task.dag.name}: {task.dag.vertices[sink].name}'


def _longest_path(tasks: Sequence[Task], workers: int) -> Outcome:
    late = sum(length > deadline for task in tasks for _, deadline, length in task.sinks)
    task, sink, deadline, length = max(
        ((task, *sink) for task in tasks for sink in task.sinks),
        key=lambda each: each[3] / each[2])
    figure = (f'{format_duration(length)} of {format_duration(deadline)} at '
              f'{_sink(task, sink)}')
    reason = 'each longest path is within its deadline'
    if late:
        sinks = sum(len(t.sinks) for t in tasks)
        reason = f'too long for {late} of {counted(sinks, "sink")}'
    return FAILS if late else HOLDS, figure, reason, {
        _sink(task, sink): {'deadline_ns': deadline, 'longest_path_ns': length}
        for task in tasks for sink, deadline, length in task.sinks}


def _utilisation(tasks: Sequence[Task], workers: int) -> Outcome:
    total = sum(task.utilisation for task in tasks)
    fits = total <= workers * (1 + 1e-12)
    return (
        HOLDS if fits else FAILS, f'{total / workers:.3f} of {counted(workers, "worker")}',
        'at most 1' if fits else 'above 1: the backlog grows without end',
        {task.dag.name: task.utilisation for task in tasks})


def _demand(tasks: Sequence[Task], workers: int) -> Outcome:
    demand = necessary.largest_demand(tasks, workers)
    fits = demand.work <= workers * demand.time
    reason = 'no interval asks for more work than there is time'
    if not fits:
        reason = 'if all first releases come together, more work is due than there is time'
    elif not demand.complete:
        reason += f', in the {counted(demand.points, "instant")} that were checked'
    figure = (f'{format_duration(demand.work)} due within {format_duration(demand.time)}, '
              f'of {format_duration(workers * demand.time)}')
    if demand.time == 1:
        figure = f'{format_duration(demand.work)} due before it can have been done'
    return HOLDS if fits else FAILS, figure, reason, {
        'time_ns': demand.time, 'work_ns': demand.work}


def _obstacle(tasks: Sequence[Task]) -> str | None:
    """Return which assumption that all sufficient tests share is not met."""
    for task in tasks:
        dag = task.dag
        for vertex in dag.vertices:
            if vertex.callback.group is not None:
                return f'{vertex.callback.key} is in a callback group, which can keep it waiting'
            if vertex.callback.holds_interpreter:
                return (f'{vertex.callback.key} computes in Python, which can keep others waiting '
                        'although a worker is free')
        if dag.release_from != 'arrival':
            return (f'DAG {dag.name} is released from {dag.release_from}, so its messages come an '
                    'unknown time later')
        if dag.max_active_jobs is not None and dag.max_active_jobs <= task.deadline // task.period:
            return f'max_active_jobs of DAG {dag.name} can end a job before its deadline'
    return None


def _graham(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Outcome:
    bounds = [bound for task in tasks for bound in sufficient.graham(task, workers)]
    within = {task.dag.name: all(b.response is not None for b in bounds if b.task is task)
              for task in tasks}
    good = sum(within.values())
    verdict, reason = NOTHING, obstacle
    if obstacle is None and len(tasks) > 1:
        reason = 'the bound is for a DAG that has all workers for itself, and there are several'
    elif obstacle is None and good:
        verdict, reason = HOLDS, 'the bound of each sink is within deadline and period'
    elif obstacle is None:
        reason = 'a bound is beyond the deadline or the period'
    return (
        verdict, f'{good} of {counted(len(tasks), "DAG")} in time, each alone', reason or '',
        {name: {'alone': HOLDS if ok else NOTHING} for name, ok in within.items()})


def _response_times(
    bounds_of: Callable[[Sequence[Task], int], list[Bound]],
    tasks: Sequence[Task], workers: int, obstacle: str | None,
) -> Outcome:
    """Return the outcome of a response-time test, whose bounds ``bounds_of`` returns."""
    if obstacle is not None:
        return NOTHING, '-', obstacle, {}
    for task in tasks:
        if task.volume > workers * min(task.period, task.deadline):
            return NOTHING, '-', f'DAG {task.dag.name} alone is too much for the workers', {}
    bounds = bounds_of(tasks, workers)
    details = {_sink(b.task, b.sink): {'deadline_ns': b.deadline, 'response_bound_ns': b.response}
               for b in bounds}
    last = bounds[-1]
    if last.response is None:
        return (
            NOTHING, f'no bound for {_sink(last.task, last.sink)}',
            f'its bound is beyond its deadline of {format_duration(last.deadline)}', details)
    tight = max(bounds, key=lambda b: (b.response or 0) / b.deadline)
    figure = (f'{format_duration(tight.response or 0)} of {format_duration(tight.deadline)} at '
              f'{_sink(tight.task, tight.sink)}')
    return HOLDS, figure, 'each bound is within its deadline', details


# The first fields of a verdict, and the test.
_NECESSARY = (
    (('longest path', 'necessary', 'Graham 1969', 'any', 'executions take their budgets'),
     _longest_path),
    (('utilisation', 'necessary', 'Liu and Layland 1973', 'any',
      'releases as often as declared, executions of their budgets'), _utilisation),
    (('demand bound', 'necessary', 'Baruah, Mok and Rosier 1990, refined for each sink', 'any',
      'all DAGs may be released at one time, executions take their budgets'), _demand))
_SUFFICIENT = (
    (("Graham's bound", 'sufficient', 'Graham 1969', WORK_CONSERVING,
      'one DAG alone, done within its period'), _graham),
    (('response time, any policy', 'sufficient', 'after Melani et al. 2015', WORK_CONSERVING,
      'several and any deadlines'), partial(_response_times, sufficient.work_conserving)),
    (('response time, RAD without preemption', 'sufficient',
      'after Melani et al. 2015, Serrano et al. 2016', RAD_LIVE, 'several and any deadlines'),
     partial(_response_times, sufficient.rad)))

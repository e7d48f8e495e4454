# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verdicts of all tests on a declaration, in words.

Theory of operation
-------------------
A necessary test *holds* or *fails*: where it fails, no scheduler can keep the deadlines. A
sufficient test *holds*, for the scheduler that it is about, or *says nothing*: because its figure
is too large, or because one of its assumptions is not met. No sufficient test ever fails.

All sufficient tests here share the assumptions of ``SHARED``; where the declaration shows that one
is not met, they say nothing. Sinks of a DAG with different deadlines need a priority for each
vertex, for which only the response-time tests are proven. The live executor does not preempt: of
the tests only those whose ``scheduler`` says so speak of it (``LIVE``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from mddag_executor.analysis import necessary, sufficient
from mddag_executor.analysis.federated import federation
from mddag_executor.analysis.forced_forward import forced_forward
from mddag_executor.analysis.model import AnalysisError, Task, tasks_of
from mddag_executor.analysis.non_preemptive import rad_non_preemptive
from mddag_executor.analysis.sag import Answer, JobSet
from mddag_executor.analysis.sufficient import Bound, Slowdown
from mddag_executor.text import counted
from msg_graph import format_duration, TaskSet

SHARED = (
    'no execution takes longer than its budget; releases of a DAG are at least its period apart, '
    'and known when its source becomes ready; no callback group keeps ready work waiting; no '
    'bound on open jobs ends one that is not late; nothing undeclared runs; dispatching and '
    'transport take no time')
WORK_CONSERVING = 'any work-conserving, preemptive or not'
RAD_LIVE = 'rad, not preemptive (the live executor)'
LIVE = (WORK_CONSERVING, RAD_LIVE)

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
    details: dict[str, Any] = field(default_factory=dict)


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
    """
    Analyse a task set.

    :param budget: what of each execution time counts: ``max``, ``p99`` or ``mean``.
    :param progress: told how many tests are done.
    :raises AnalysisError: an execution time is not declared, or there are no workers.
    """
    if workers < 1:
        raise AnalysisError(f'workers: {workers} is too few: give at least 1')
    tasks = tasks_of(task_set, budget)
    found = [_longest_path(tasks), _utilisation(tasks, workers), _demand(tasks, workers)]
    impossible = any(verdict.verdict == FAILS for verdict in found)
    obstacle = 'a necessary test fails' if impossible else _obstacle(tasks)
    for test in _SUFFICIENT:
        if progress is not None:
            progress(len(found))
        found.append(test(tasks, workers, obstacle))
    return Analysis(workers, budget, sum(task.utilisation for task in tasks), tuple(found))


def with_sag(analysis: Analysis, tasks: Sequence[Task], jobs: JobSet, answer: Answer) -> Analysis:
    """Return the analysis with the verdict of a schedule-abstraction analysis in addition."""
    why = _obstacle(tasks)
    verdict = NOTHING
    if why is None and answer.timed_out:
        why = 'it ran out of time'
    elif why is None and not answer.schedulable:
        why = 'it found no proof'
    elif why is None and not jobs.for_ever:
        why = (f'proven only for the releases before {format_duration(jobs.horizon)}, as '
               'a job may go on beyond that, or beyond its period')
    elif why is None:
        verdict, why = HOLDS, 'no order in which the jobs can run misses a deadline'
    return replace(analysis, verdicts=(*analysis.verdicts, Verdict(
        'schedule abstraction', 'sufficient', 'Nasri et al. 2019', RAD_LIVE,
        'all first releases together, later ones exactly periodic', verdict,
        f'{counted(answer.jobs, "job")}, {counted(answer.states, "state")}', why,
        {'schedulable': answer.schedulable, 'timed_out': answer.timed_out,
         'horizon_ns': jobs.horizon})))


def _sink(task: Task, sink: int) -> str:
    return f'{task.dag.name}: {task.dag.vertices[sink].name}'


def _longest_path(tasks: Sequence[Task]) -> Verdict:
    late = necessary.late_paths(tasks)
    task, sink, deadline, length = max(
        ((task, *sink) for task in tasks for sink in task.sinks),
        key=lambda each: each[3] / each[2])
    figure = (f'{format_duration(length)} of {format_duration(deadline)} at '
              f'{_sink(task, sink)}')
    reason = 'each longest path is within its deadline'
    if late:
        sinks = sum(len(t.sinks) for t in tasks)
        reason = f'too long for {len(late)} of {counted(sinks, "sink")}'
    return Verdict(
        'longest path', 'necessary', 'Graham 1969', 'any', 'executions take their budgets',
        FAILS if late else HOLDS, figure, reason,
        {_sink(task, sink): {'deadline_ns': deadline, 'longest_path_ns': length}
         for task in tasks for sink, deadline, length in task.sinks})


def _utilisation(tasks: Sequence[Task], workers: int) -> Verdict:
    total = sum(task.utilisation for task in tasks)
    fits = total <= workers * (1 + 1e-12)
    return Verdict(
        'utilisation', 'necessary', 'Liu and Layland 1973', 'any',
        'releases as often as declared, executions of their budgets', HOLDS if fits else FAILS,
        f'{total / workers:.3f} of {counted(workers, "worker")}',
        'at most 1' if fits else 'above 1: work piles up without end',
        {task.dag.name: task.utilisation for task in tasks})


def _demand(tasks: Sequence[Task], workers: int) -> Verdict:
    demand = necessary.largest_demand(tasks, workers)
    fits = demand.work <= workers * demand.time
    reason = 'no interval asks for more work than there is time'
    if not fits:
        reason = 'when all first releases come together, more is due than can be done'
    elif not demand.complete:
        reason += f', in the {counted(demand.points, "instant")} that were looked at'
    figure = (f'{format_duration(demand.work)} due within {format_duration(demand.time)}, '
              f'of {format_duration(workers * demand.time)}')
    if demand.time == 1:
        figure = f'{format_duration(demand.work)} due before it can have been done'
    return Verdict(
        'demand bound', 'necessary', 'Baruah, Mok and Rosier 1990, refined for each sink', 'any',
        'all DAGs may be released at one time, executions take their budgets',
        HOLDS if fits else FAILS, figure, reason, {'time_ns': demand.time, 'work_ns': demand.work})


def _obstacle(tasks: Sequence[Task]) -> str | None:
    """Return which assumption that all sufficient tests share is not met."""
    for task in tasks:
        dag = task.dag
        for vertex in dag.vertices:
            if vertex.callback.group is not None:
                return f'{vertex.callback.key} is in a callback group, which can keep it waiting'
        if dag.release_from != 'arrival':
            return (f'DAG {dag.name} is released from {dag.release_from}, so its messages come an '
                    'unknown time later')
        if dag.max_active_jobs is not None and dag.max_active_jobs <= task.deadline // task.period:
            return f'max_active_jobs of DAG {dag.name} can end a job before its deadline'
    return None


def _several_deadlines(tasks: Sequence[Task]) -> str | None:
    task = next((task for task in tasks if not task.one_deadline), None)
    if task is None:
        return None
    return (f'sinks of DAG {task.dag.name} have different deadlines, which need a priority for '
            'each vertex; the test is proven for one deadline for each DAG')


def _graham(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    bounds = [bound for task in tasks for bound in sufficient.graham(task, workers)]
    within = {task.dag.name: all(b.response is not None for b in bounds if b.task is task)
              for task in tasks}
    good = sum(within.values())
    verdict, reason = NOTHING, obstacle
    if obstacle is None and len(tasks) > 1:
        reason = 'the bound is for a DAG that has all workers for itself, and there are several'
    elif obstacle is None:
        verdict, reason = _by(good == 1, 'the bound of each sink is within deadline and period',
                              'a bound is beyond the deadline or the period')
    return Verdict(
        "Graham's bound", 'sufficient', 'Graham 1969', WORK_CONSERVING,
        'one DAG alone, done within its period', verdict,
        f'{good} of {counted(len(tasks), "DAG")} in time, each alone', reason or '',
        {name: {'alone': HOLDS if ok else NOTHING} for name, ok in within.items()})


def _by(holds: bool, why: str, why_not: str) -> tuple[str, str]:
    return (HOLDS, why) if holds else (NOTHING, why_not)


_Bounds = Callable[[Sequence[Task], int], list[Bound]]


def _response_times(
    tasks: Sequence[Task], workers: int, obstacle: str | None, bounds_of: _Bounds
) -> tuple[str, str, str, dict[str, Any]]:
    """Return verdict, figure, reason and details of a response-time test."""
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
        return (NOTHING, f'no bound for {_sink(last.task, last.sink)}',
                f'its bound is beyond its deadline of {format_duration(last.deadline)}', details)
    tight = max(bounds, key=lambda b: (b.response or 0) / b.deadline)
    return (HOLDS, f'{format_duration(tight.response or 0)} of {format_duration(tight.deadline)} '
            f'at {_sink(tight.task, tight.sink)}', 'each bound is within its deadline', details)


def _work_conserving(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    verdict, figure, reason, details = _response_times(
        tasks, workers, obstacle, sufficient.work_conserving)
    return Verdict(
        'response time, any policy', 'sufficient', 'after Melani et al. 2015',
        WORK_CONSERVING, 'several and any deadlines', verdict, figure,
        reason, details)


def _rad(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    verdict, figure, reason, details = _response_times(
        tasks, workers, obstacle, sufficient.rad_preemptive)
    return Verdict(
        'response time, RAD', 'sufficient',
        'after Bertogna and Cirinei 2007, Melani et al. 2015', 'rad, preemptive',
        'several and any deadlines', verdict, figure, reason, details)


def _rad_live(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    verdict, figure, reason, details = _response_times(
        tasks, workers, obstacle, rad_non_preemptive)
    return Verdict(
        'response time, RAD without preemption', 'sufficient',
        'after Melani et al. 2015, Serrano et al. 2016', RAD_LIVE, 'several and any deadlines',
        verdict, figure, reason, details)


def _gedf_demand(
    name: str, source: str, test: Callable[[Sequence[Task], int], Slowdown | None],
    tasks: Sequence[Task], workers: int, obstacle: str | None,
) -> Verdict:
    obstacle = obstacle or _several_deadlines(tasks)
    verdict, figure, reason = NOTHING, '-', obstacle
    if obstacle is None:
        slowdown = test(tasks, workers)
        if slowdown is None:
            reason = 'too much work in some interval, at each speed that was tried'
        else:
            verdict = HOLDS
            figure = f'speed 1/{slowdown.factor:.3f}, {counted(slowdown.points, "instant")}'
            reason = 'in no interval the work that EDF would have to be behind with'
    return Verdict(
        name, 'sufficient', source, 'gedf or rad, preemptive',
        'one deadline for each DAG, of any length', verdict, figure, reason or '')


def _bonifaci(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    return _gedf_demand(
        'GEDF demand', 'Bonifaci et al. 2013', sufficient.bonifaci, tasks, workers, obstacle)


def _baruah(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    return _gedf_demand(
        'GEDF forced-forward demand', 'after Baruah 2014', forced_forward, tasks, workers,
        obstacle)


def _federated(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    verdict, figure, reason, details = NOTHING, '-', obstacle, dict[str, Any]()
    if obstacle is None:
        found = federation(tasks)
        if isinstance(found, str):
            reason = f'DAG {found} takes longer than its period or a deadline on any number'
        else:
            figure = f'{found.workers} of {counted(workers, "worker")}'
            verdict, reason = _by(
                found.workers <= workers, 'heavy DAGs have enough workers for themselves, and the '
                'light ones fit on the others', 'the DAGs need more workers than there are')
            details = {'own_workers': found.own, 'shared': found.shared}
    return Verdict(
        'federated scheduling', 'sufficient', 'Li et al. 2014',
        'federated: an executor for each heavy DAG, preemptive rad on a worker for light ones',
        'a job is done before the next of its DAG', verdict, figure, reason or '', details)


def _li(tasks: Sequence[Task], workers: int, obstacle: str | None) -> Verdict:
    obstacle = obstacle or _several_deadlines(tasks)
    if obstacle is None:
        other = next((task for task in tasks if task.deadline != task.period), None)
        if other is not None:
            obstacle = f'the deadline of DAG {other.dag.name} is not its period'
    bound = sufficient.capacity_bound(workers)
    total = sum(task.utilisation for task in tasks)
    path = max(task.length / task.deadline for task in tasks)
    verdict, reason = NOTHING, obstacle
    if obstacle is None:
        verdict, reason = _by(
            sufficient.li(tasks, workers), 'load <= m / b, and each longest path <= D / b',
            'load > m / b, or a longest path > D / b')
    return Verdict(
        'GEDF capacity bound', 'sufficient', 'Li et al. 2013 and 2014', 'gedf or rad, preemptive',
        'one deadline for each DAG, equal to its period', verdict,
        f'b = {bound:.3f}, m / load = {workers / total if total else float("inf"):.3f}, '
        f'D / len = {1 / path if path else float("inf"):.3f}', reason or '')


_SUFFICIENT: tuple[Callable[[Sequence[Task], int, str | None], Verdict], ...] = (
    _graham, _work_conserving, _rad_live, _rad, _bonifaci, _baruah, _li, _federated)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `graph check`: validate a declaration and show the DAG tasks that it gives.

Critical path, load and utilisation are those of the mean execution times. They are unknown (`-`,
in JSON null) if an execution time is not declared, and then the tests are left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Cell, format_ns, table, warn
from mddag_executor.text import counted, listed

if TYPE_CHECKING:
    from mddag_executor.results.graphs import Bound, CheckedDag, CheckResult, CheckResultRare
    from msg_graph import Dag, TaskSet

EXAMPLE = """\
mddag graph check config/autoware.yaml
mddag graph check config/autoware.yaml --budget p99 --workers 4 --json -
mddag graph check graph.yaml --fail-on-unschedulable
"""
DESCRIPTION = """\
Validate a declaration and show its DAGs: period, number of vertices, sinks with deadlines,
critical path, and load in cores. Critical path and load are those of the mean execution times (-
if one is not declared). The utilisation is the load of all DAGs divided by the workers.

If all execution times are declared, three tests follow. If one fails, no scheduler can keep the
deadlines, and a warning says so. If all hold, the deadlines can still be missed: the tests include
no overheads, callback groups or Python's lock."""

_HEADER = ('DAG', 'period', 'vertices', 'critical path', 'load', 'sink', 'deadline')

_BACKLOG_LOAD = 0.5
"""Cores that one DAG may need before a backlog of its jobs is likely to hurt others."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add(parser, 'graph', '--workers', '--json')
    parser.add_argument(
        '--budget', choices=defaults.BUDGETS, default='mean',
        help='which value of each execution time the tests use: its maximum, 99 %% quantile or '
        'mean (the default)')
    parser.add_argument(
        '--fail-on-unschedulable', action='store_true',
        help='exit with status 1 if a test fails, and 2 if an execution time is not declared')


def main(args: argparse.Namespace) -> int:
    task_set = common.load_graph(args.graph)
    workers = defaults.workers(args.workers, task_set)
    result = check_result(task_set, workers, args.budget)
    if args.fail_on_unschedulable:
        from mddag_executor.simulate.execution_times import check_execution_times
        check_execution_times(task_set)
    tests = result['tests']
    warn(*_warnings(task_set, result))
    common.show(args, result, (
        table(_HEADER, _rows(result), grouped=5), *_bounds(result), *_tests(task_set, result),
        _summary(task_set, result)))
    return int(args.fail_on_unschedulable and not all(test['holds'] for test in tests))


def check_result(task_set: TaskSet, workers: int, budget: str) -> CheckResult:
    """
    Return the result of `graph check` for machines.

    Times are in ns; `rad_offset_ns` is the reference absolute deadline (RAD) minus the release of
    each vertex, in the order of `vertices`. `load` is in cores, `utilisation` is load divided by
    `workers`. They and `critical_path_ns` are None if an execution time is not declared; `tests`
    is empty then. `bound_ns` is the longest reaction time or data age of a path if all sinks are
    in time; None if nothing bounds it.
    """
    from mddag_executor.core import Tables
    from mddag_executor.laboratory.necessary import necessary_tests
    tables = Tables.build(task_set)
    dags: dict[str, CheckedDag] = {}
    for dag in task_set.dags:
        first = tables.first_vertex[dag.index]
        offsets = tables.rad_offset[first:first + len(dag.vertices)]
        dags[dag.name] = _dag_result(dag, offsets, workers)
    loads = [dag['load'] for dag in dags.values() if dag['load'] is not None]
    load = sum(loads) if len(loads) == len(dags) else None
    required = required_bounds(task_set)
    more: CheckResultRare = {'requirements': required} if required else {}
    return {
        'dags': dags,
        'vertices': len(task_set.vertices),
        'callbacks': len(task_set.callbacks),
        'workers': workers,
        'load': load,
        'utilisation': None if load is None else load / workers,
        'budget': budget,
        'tests': [] if _untimed(task_set) or not task_set.dags else [
            {'test': each.test, 'holds': each.holds, 'figure': each.figure,
             'reason': each.reason, 'details': each.details}
            for each in necessary_tests(task_set, workers, budget)],
        'queue_edges': [
            {'reader': edge.reader, 'topic': edge.topic, 'writers': list(edge.writers)}
            for edge in task_set.queue_edges],
        'paths': {path.name: list(path.callbacks) for path in task_set.paths},
        **more,
    }


def required_bounds(task_set: TaskSet) -> dict[str, dict[str, Bound]]:
    """Return by path what is required of it, and how long that takes at most."""
    from msg_graph.segments import bound, why_unbounded
    return {
        path.name: {what: {'required_ns': time, 'bound_ns': bound(task_set, path, what),
                           'why_unbounded': why_unbounded(task_set, path, what)}
                    for what, time in path.requirements.items()}
        for path in task_set.paths if path.requirements}


def _dag_result(dag: Dag, rad_offsets: list[int], workers: int) -> CheckedDag:
    from msg_graph.model import load_of, mean_execution_times, path_lengths
    means, load = mean_execution_times(dag), load_of(dag)
    return {
        'period_ns': dag.period_ns,
        'vertices': [vertex.name for vertex in dag.vertices],
        'edges': [list(edge) for edge in dag.edges],
        'sinks': {v.name: v.deadline_ns for v in dag.vertices if not v.successors},
        'rad_offset_ns': rad_offsets,
        'critical_path_ns': None if means is None else max(path_lengths(dag, means)),
        'load': load,
        'utilisation': None if load is None else load / workers,
    }


def _backlog(dag: Dag, load: float | None) -> Iterator[str]:
    """Yield that jobs of a DAG can pile up, if they can and nothing bounds them."""
    source = dag.vertices[dag.source].callback
    latest = max((dag.vertices[sink].deadline_ns or 0 for sink in dag.sinks), default=0)
    if (load is not None and load > _BACKLOG_LOAD and latest > dag.period_ns
            and source.keep != 'newest' and dag.max_active_jobs is None):
        yield (f"{dag.name}: its deadline is longer than its period, and it needs {load:.2f} "
               "cores: a backlog can build up in an overload: add 'keep: newest' or "
               "'max_active_jobs:' to its source, if old data is of no use")


def _warnings(task_set: TaskSet, result: CheckResult) -> Iterator[str]:
    for test in result['tests']:
        if test['holds']:
            continue
        if test['test'] != 'longest path':
            yield (f'{task_set.file}: {test["test"]}: {test["figure"]}: {test["reason"]}: '
                   'no scheduler can keep the deadlines then')
            continue
        for sink, times in test['details'].items():
            length, deadline = times['longest_path_ns'], times['deadline_ns']
            if length > deadline:
                yield (f'{sink}: the longest path to it takes {format_ns(length)}, more than its '
                       f'deadline of {format_ns(deadline)}: no scheduler can keep it')
    for dag in task_set.dags:
        yield from _backlog(dag, result['dags'][dag.name]['load'])
    load, cpus = result['load'], defaults.processors()
    if load is not None and cpus < load <= result['workers']:
        yield (f'{task_set.file}: a load of {load:.3f} is more than the {counted(cpus, "CPU")} of '
               'this machine can do, unless callbacks wait instead of computing')


def _rows(result: CheckResult) -> Iterator[list[Cell]]:
    from mddag_executor.report.tables import short_names
    short = short_names(sink for dag in result['dags'].values() for sink in dag['sinks'])
    for name, dag in result['dags'].items():
        path, load = dag['critical_path_ns'], dag['load']
        of_dag: list[Cell] = [
            name, format_ns(dag['period_ns']), len(dag['vertices']),
            None if path is None else format_ns(path),
            None if load is None else f'{load:.4f}']
        for sink, deadline in dag['sinks'].items():
            yield [*of_dag, short[sink], 'none' if deadline is None else format_ns(deadline)]


def _bounds(result: CheckResult) -> Iterator[str]:
    from mddag_executor.report.tables import bounds_table
    if 'requirements' in result:
        yield bounds_table(result['requirements'])


def _untimed(task_set: TaskSet) -> list[str]:
    """Return the callbacks that declare no execution time."""
    return [each.key for each in task_set.callbacks if each.execution_time is None]


def _tests(task_set: TaskSet, result: CheckResult) -> Iterator[str]:
    untimed = _untimed(task_set)
    if 0 < len(untimed) < len(task_set.callbacks):
        yield ('whether the deadlines can hold is not tested, as '
               f'{counted(len(untimed), "callback declares", "callbacks declare")} no '
               f'execution_time: {listed(untimed)}')
    if result['tests']:
        yield table(
            ('test', 'verdict', f'figure ({result["budget"]} execution times)'),
            ((test['test'], 'holds' if test['holds'] else 'fails', test['figure'])
             for test in result['tests']))


def _summary(task_set: TaskSet, result: CheckResult) -> str:
    text = (
        f'{counted(len(task_set.dags), "DAG")}, '
        f'{counted(result["vertices"], "vertex", "vertices")}, '
        f'{counted(result["callbacks"], "callback")}, '
        f'{counted(len(task_set.queue_edges), "queue edge")}, '
        f'{counted(len(task_set.paths), "path")}')
    if result['utilisation'] is not None:
        text += (f', load {result["load"]:.3f}, utilisation {result["utilisation"]:.3f} of '
                 f'{counted(result["workers"], "worker")}')
    from msg_graph.blanks import open_blanks
    left = [str(each.line) for each in open_blanks(task_set.text, task_set.file)]
    if left:
        text += f'\n{counted(len(left), "blank")} left, in line {listed(left)}'
    return text

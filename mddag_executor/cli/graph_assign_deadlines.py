# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph assign-deadlines`: relative deadlines for the sinks of a declaration."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.graph_check import required_bounds
from mddag_executor.cli.text import Cell, format_ns, one_line, Progress, table
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.laboratory.assign_deadlines import Measured
    from mddag_executor.results.graphs import AssignResult, AssignResultRare
    from msg_graph import TaskSet

EXAMPLE = """\
mddag graph assign-deadlines graph.yaml -o assigned.yaml
mddag graph assign-deadlines graph.yaml --budget max --workers 4 -o assigned.yaml"""
DESCRIPTION = """\
Give each sink a relative deadline; comments, order and all else of the declaration stay (one that
includes others becomes one file), and sinks without a deadline are accepted. The deadlines are in
proportion to the critical paths: the sink of a DAG with the longest path gets the DAG's period,
the others less. If paths have requirements (`reaction`, `age`), the deadlines are so short that
each requirement holds when all sinks are in time. The acceptance of the result is measured and
reported."""
REMOVED_OPTIONS = {
    '--target': "declare what is required as 'reaction:' or 'age:' of a path"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    options.add(parser, 'graph', '--output', '--overwrite', '--workers', '--duration', '--json')
    add('--budget', choices=defaults.BUDGETS, default='p99',
        help='which value of each execution time makes the critical path (default: %(default)s)')
    options.add(parser, '--policy', only='to simulate, ')
    options.add(parser, '--preemptive', otherwise="as in the paper's experiment")
    add('--runs', type=options.positive_int, default=1000, metavar='N',
        help='runs that measure the acceptance (default: %(default)s)')
    options.add(parser, '--seed')


def main(args: argparse.Namespace) -> int:
    from msg_graph.edit import (
        deadlines_in_text,
        load_with_or_without_deadlines,
        with_deadlines,
    )
    name, text = common.read_text(args.graph)
    task_set = load_with_or_without_deadlines(text, name, None if args.graph == '-' else name)
    deadlines, measured = _assign(args, task_set)
    common.write_text(args.output, deadlines_in_text(task_set, deadlines))
    required = required_bounds(with_deadlines(task_set, deadlines))
    more: AssignResultRare = {'requirements': required} if required else {}
    result: AssignResult = {
        'policy': args.policy, 'budget': args.budget, 'deadlines_ns': deadlines, **more,
        'acceptance': measured.result()}
    common.show(args, result, _lines(args, task_set, result, measured), tables_to_stderr=True)
    return 0


def _assign(args: argparse.Namespace, task_set: TaskSet) -> tuple[dict[str, int], Measured]:
    from mddag_executor.laboratory.assign_deadlines import assigned, measure
    from mddag_executor.laboratory.experiment import Experiment
    experiment = Experiment(
        task_set, (args.policy,), workers=defaults.workers(args.workers, task_set),
        duration_ns=args.duration, seed=args.seed, preemptive=args.preemptive)
    deadlines = assigned(task_set, args.budget)
    with Progress('measuring') as line:
        return deadlines, measure(
            experiment, deadlines, args.runs, defaults.processors(),
            lambda done: line.update(done, f'of {args.runs} runs'))


def _lines(
    args: argparse.Namespace, task_set: TaskSet, result: AssignResult, measured: Measured,
) -> Iterator[str]:
    from mddag_executor.report.tables import bounds_table, short_names
    deadlines = result['deadlines_ns']
    short = short_names(vertex.name for vertex in task_set.vertices if vertex.deadline_ns)
    rows: list[list[Cell]] = [
        [dag.name, short[dag.vertices[sink].name], format_ns(dag.period_ns),
         format_ns(deadlines[dag.vertices[sink].callback.key])]
        for dag in task_set.dags for sink in dag.sinks]
    yield table(['DAG', 'sink', 'period', 'deadline'], rows, grouped=1)
    if 'requirements' in result:
        yield bounds_table(result['requirements'])
    low, high = measured.interval
    yield one_line(
        f'{args.policy} accepts {100 * measured.ratio:.1f} % (95 % confidence: {100 * low:.1f} to '
        f'{100 * high:.1f} %) of {counted(measured.runs, "run")} with seed {measured.seed}')

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph assign-deadlines`: relative deadlines for the sinks of a declaration."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any, TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Cell, format_ns, one_line, Progress, table
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.laboratory.assign_deadlines import Found, Measured
    from msg_graph import TaskSet

EXAMPLE = """\
mddag graph assign-deadlines graph.yaml -o assigned.yaml
mddag graph assign-deadlines graph.yaml --target 0.95 --runs 2000 -o assigned.yaml"""
DESCRIPTION = """\
Give each sink a relative deadline; comments, order and all else of the declaration stay (one that
includes others becomes one file), and sinks without a deadline are accepted. The deadlines are in
proportion to the critical paths: the sink of a DAG with the longest path gets the DAG's period,
the others less. With --target they are the critical paths times one scale, the tightest at which
the simulated acceptance stays above the target, with the lower end of its 95 % confidence
interval. Either way the acceptance of the result is measured and reported; after a search with
other draws of execution times."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    options.add(parser, 'graph', '--output', '--workers', '--duration', '--json')
    add('--target', type=options.positive_float, metavar='RATIO',
        help='search the tightest deadlines with at least this acceptance ratio')
    add('--budget', choices=defaults.BUDGETS, default='p99',
        help='which value of each execution time makes the critical path (default: %(default)s)')
    options.add(parser, '--policy', only='to simulate, ')
    options.add(parser, '--preemptive', otherwise="as in the paper's experiment")
    add('--runs', type=options.positive_int, default=1000, metavar='N',
        help='runs that measure the acceptance (default: %(default)s)')
    options.add(parser, '--seed')


def main(args: argparse.Namespace) -> int:
    from msg_graph.edit import deadlines_in_text, load_with_or_without_deadlines
    name, text = common.read_text(args.graph)
    task_set = load_with_or_without_deadlines(text, name, None if args.graph == '-' else name)
    deadlines, measured, found = _assign(args, task_set)
    common.write_text(args.output, deadlines_in_text(task_set, deadlines))
    result: dict[str, Any] = {
        'policy': args.policy, 'budget': args.budget, 'deadlines_ns': deadlines,
        'acceptance': measured.result()}
    if found is not None:
        result |= {'scale': found.scale, 'target': args.target, 'tried': [
            {'scale': scale, **each.result()} for scale, each in found.tried]}
    common.show(args, result, _lines(args, task_set, deadlines, measured, found), aside=True)
    return 0


def _assign(
    args: argparse.Namespace, task_set: TaskSet
) -> tuple[dict[str, int], Measured, Found | None]:
    from mddag_executor.laboratory.assign_deadlines import measure, proportional, search
    from mddag_executor.laboratory.experiment import Experiment
    experiment = Experiment(
        task_set, (args.policy,), workers=defaults.workers(args.workers, task_set),
        duration_ns=args.duration, seed=args.seed, preemptive=args.preemptive)
    jobs = defaults.processors()
    with Progress('searching' if args.target else 'measuring') as line:
        if args.target is None:
            deadlines = proportional(task_set, args.budget)
            return deadlines, measure(
                experiment, deadlines, args.runs, jobs,
                lambda done: line.update(done, f'of {args.runs} runs')), None
        found = search(
            experiment, args.target, args.budget, args.runs, jobs,
            lambda scale, done: line.update(done, f'of {args.runs} runs with scale {scale:.4g}'))
    return found.deadlines, found.check, found


def _lines(
    args: argparse.Namespace, task_set: TaskSet, deadlines: dict[str, int], measured: Measured,
    found: Found | None,
) -> Iterator[str]:
    from mddag_executor.report.tables import short_names
    short = short_names(vertex.name for vertex in task_set.vertices if vertex.deadline_ns)
    rows: list[list[Cell]] = [
        [dag.name, short[dag.vertices[sink].name], format_ns(dag.period_ns),
         format_ns(deadlines[dag.vertices[sink].callback.key])]
        for dag in task_set.dags for sink in dag.sinks]
    yield table(['DAG', 'sink', 'period', 'deadline'], rows, grouped=1)
    low, high = measured.interval
    own = '' if found is None else ', none of which the search used'
    if found is not None:
        yield (f'Each deadline is {found.scale:.4g} times the critical path ({args.budget}), '
               f'after {counted(len(found.tried), "scale")} tried.')
    yield one_line(
        f'{args.policy} accepts {100 * measured.ratio:.1f} % (95 % confidence: {100 * low:.1f} to '
        f'{100 * high:.1f} %) of {counted(measured.runs, "run")} with seed {measured.seed}{own}')

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph assign-deadlines`: relative deadlines for the sinks of a declaration."""

from __future__ import annotations

import argparse
import sys
from typing import Any, TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Cell, format_ns, one_line, Progress, table
from mddag_executor.errors import InputError, UsageError
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.laboratory.assign_deadlines import Found, Measured
    from msg_graph import TaskSet

HELP = 'give the sinks relative deadlines, by critical path or by search'
EXAMPLE = """\
mddag graph assign-deadlines graph.yaml -o assigned.yaml
mddag graph assign-deadlines graph.yaml --by search --target 0.95 --runs 2000 -o assigned.yaml
"""
DESCRIPTION = """\
Give each sink a relative deadline; comments, order and all else of the declaration stay, and sinks
without a deadline are accepted.

--by path: in proportion to the critical path. The sink of a DAG with the longest path gets the
DAG's period, or its --base, times --factor, the others less. --by search: the critical path times
one scale, the tightest at which the simulated acceptance stays above --target, that is with the
lower end of its 95 % confidence interval. Either way the acceptance of the result is measured and
reported with its confidence interval, number of runs and seed; after a search with draws that
took no part in it."""

_TARGET = 0.95


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    options.add(parser, 'graph', '--output', '--workers', '--overhead', '--duration', '--jobs',
                '--json')
    add('--by', choices=('path', 'search'), default='path',
        help='how to find them (default: %(default)s)')
    add('--base', choices=('period', 'deadline'),
        help="with --by path: what each DAG's longest path gets, its period (the default) or the "
        'longest deadline that it declares')
    add('--factor', type=options.positive_float, metavar='F',
        help='with --by path: the longest deadline of a DAG by that base (default: 1)')
    add('--target', type=options.positive_float, metavar='RATIO',
        help=f'with --by search: the least acceptance ratio (default: {_TARGET})')
    add('--budget', choices=defaults.BUDGETS, default='p99',
        help='what of each execution time makes the critical path (default: %(default)s)')
    options.add_policy(parser, 'to simulate, ')
    options.add(parser, '--preemptive', otherwise="as in the paper's experiment")
    add('--runs', type=options.positive_int, default=1000, metavar='N',
        help='runs that measure the acceptance of each scale (default: %(default)s)')
    options.add_seed(parser, 'seed of the drawn execution times')


def main(args: argparse.Namespace) -> int:
    """Assign deadlines."""
    from msg_graph.edit import deadlines_in_text, load_with_or_without_deadlines
    if args.by == 'path' and args.target is not None:
        raise UsageError("--target: '--by path' has none: give --by search, or leave it out")
    if args.by == 'search' and (args.factor is not None or args.base is not None):
        option = '--base' if args.factor is None else '--factor'
        raise UsageError(f"{option}: '--by search' has none: leave it out, or give --by path")
    name, text = common.read_text(args.graph)
    task_set, missing = load_with_or_without_deadlines(text, name)
    if args.base == 'deadline' and missing:
        raise InputError(name, 'a sink has no deadline, on which --base deadline depends',
                         "add it, or use '--base period'")
    deadlines, measured, found = _assign(args, task_set)
    common.write_text(args.output, deadlines_in_text(task_set, text, deadlines))
    common.write_result(args, _result(args, deadlines, measured, found))
    if args.json != '-':
        _show(args, task_set, deadlines, measured, found)
    return 0


def _assign(
    args: argparse.Namespace, task_set: TaskSet
) -> tuple[dict[str, int], Measured, Found | None]:
    from mddag_executor.laboratory.assign_deadlines import measure, proportional, Search
    from mddag_executor.laboratory.experiment import Experiment
    experiment = Experiment(
        task_set, (args.policy,), workers=defaults.workers(args.workers, task_set),
        duration_ns=args.duration, seed=args.seed, overhead_ns=args.overhead,
        preemptive=args.preemptive)
    jobs = args.jobs or defaults.processors()
    if args.by == 'path':
        deadlines = proportional(
            task_set, args.budget, args.factor or 1.0, args.base or 'period')
        with Progress('measuring', args.runs) as line:
            return deadlines, measure(
                experiment, deadlines, args.runs, jobs,
                lambda done: line.update(max(0, done), f'of {args.runs} runs')), None
    with Progress('searching') as line:
        def progress(scale: float, done: int) -> None:
            line.update(len(search.tried),
                        f'scales tried; {scale:.4g}: {max(0, done)} of {args.runs} runs')

        search = Search(
            experiment, _TARGET if args.target is None else args.target, args.budget, args.runs,
            jobs, progress=progress)
        found = search.find()
    return found.deadlines, found.check, found


def _result(
    args: argparse.Namespace, deadlines: dict[str, int], measured: Measured, found: Found | None
) -> dict[str, Any]:
    result: dict[str, Any] = {
        'by': args.by, 'policy': args.policy, 'budget': args.budget, 'deadlines_ns': deadlines,
        'acceptance': measured.result()}
    if found is not None:
        result['scale'] = found.scale
        result['target'] = _TARGET if args.target is None else args.target
        result['tried'] = [{'scale': scale, **each.result()} for scale, each in found.tried]
    return result


def _show(
    args: argparse.Namespace, task_set: TaskSet, deadlines: dict[str, int], measured: Measured,
    found: Found | None,
) -> None:
    """Show the deadlines, on standard error where the declaration takes the other."""
    stream = sys.stderr if args.output == '-' else sys.stdout
    rows: list[list[Cell]] = [
        [dag.name if i == 0 else '', dag.vertices[sink].name, format_ns(dag.period_ns),
         format_ns(deadlines[dag.vertices[sink].callback.key])]
        for dag in task_set.dags for i, sink in enumerate(dag.sinks)]
    print(table(['DAG', 'sink', 'period', 'deadline'], rows), file=stream)
    low, high = measured.interval
    own = '' if found is None else ', which took no part in the search'
    if found is not None:
        print(f'Each deadline is {found.scale:.4g} times the critical path ({args.budget}), after '
              f'{counted(len(found.tried), "scale")} tried.', file=stream)
    print(one_line(
        f'{args.policy} accepts {100 * measured.ratio:.1f} % (95 % confidence: {100 * low:.1f} to '
        f'{100 * high:.1f} %) of {counted(measured.runs, "run")} with seed {measured.seed}{own}'),
        file=stream)

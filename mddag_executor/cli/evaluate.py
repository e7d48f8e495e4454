# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `evaluate`: the paper's experiment, acceptance ratio against normalised utilisation.

Each run draws execution times and is simulated under every policy, until the first miss. Several
declarations (random ones, from `mddag generate`) make one sweep. Ctrl-C ends it early; the
finished runs are shown and written, and the exit status is 130.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.main import EXIT_INTERRUPTED
from mddag_executor.cli.text import Cell, Progress, table, warn
from mddag_executor.core.policies import POLICIES, SIMULATED_ONLY
from mddag_executor.errors import InputError, UsageError
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.laboratory.acceptance import Evaluation
    from mddag_executor.laboratory.draws import Samples
    from msg_graph import TaskSet

EXAMPLE = """\
mddag evaluate config/autoware.yaml --runs 5000 --plot acceptance.png
mddag evaluate graph.yaml --policies rad,gedf --workers 4 --execution-times measured.npz
mddag evaluate graph.yaml --no-preemptive --overheads 50us
mddag evaluate graph.yaml --runs 100000 --first-run 100000 --dask tcp://head:8786 --json part2.json
mddag generate --sets 400 --utilisation 0.1:1.0 -o sets && mddag evaluate sets --plot sets.svg"""

_RUNS, _RUNS_OF_EACH = 5000, 1
REMOVED_OPTIONS = {
    '--jobs': 'it is --parallel now', '--overhead': 'it is --overheads now',
    '--samples': 'it is --execution-times now'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('graph', metavar='GRAPH', nargs='+', type=options.Input,
        help="declaration ('-': standard input), or several, or a folder of them (*.yaml)")
    add('--runs', type=options.positive_int, metavar='N',
        help='runs of each GRAPH, each with execution times of its own (default: '
        f'{_RUNS}; {_RUNS_OF_EACH} if there are several)')
    add('--first-run', type=options.not_negative_int, default=0, metavar='N',
        help='number of the first run: results of ranges that do not overlap can be merged by '
        'adding their counts (default: 0)')
    add('--policies', default=','.join(defaults.POLICIES), metavar='P,P…',
        help=f'any of {", ".join((*POLICIES, *SIMULATED_ONLY))}, or MODULE:FUNCTION, which is one '
        'of your own (default: %(default)s)')
    add('--execution-times', metavar='FILE.npz', type=options.Input,
        help="measured execution times, an array of ns for each 'node:callback' (default: the "
        'quantile tables of the declaration)')
    options.add(parser, '--preemptive', otherwise='as in the paper: '
                f'{", ".join(name for name, row in POLICIES.items() if row.preemptive)} preempt')
    add('--judge', choices=('completions', 'horizon'), default='completions',
        help="which deadlines count: those of sinks that completed (the paper's way), or also "
        'those that passed before the end (default: %(default)s)')
    add('--dask', metavar='ADDRESS',
        help='have the workers of a Dask cluster simulate the runs; ADDRESS is that of its '
        "scheduler, as tcp://host:8786 (extra 'dask')")
    add('--plot', metavar='OUT', type=options.NamedFile,
        help="draw the paper's figure (.png, .svg or .pdf)")
    options.add(parser, '--workers', '--seed', '--duration', '--overheads', '--parallel', '--json')


def main(args: argparse.Namespace) -> int:
    policies = options.policies(args.policies)
    if args.plot is not None:
        from mddag_executor.laboratory.plot import check_plot
        check_plot(args.plot)
    task_sets = _load(_graphs(args.graph))
    outcome = _evaluate(args, task_sets, policies)
    if outcome.interrupted:
        warn(f'interrupted: {outcome.runs} of {outcome.asked} runs are done')
    if outcome.runs > 0:
        _write(args, outcome)
    return EXIT_INTERRUPTED if outcome.interrupted else 0


def _graphs(names: Sequence[str]) -> list[str]:
    """Return the declarations' paths, with those of a folder in the order of their names."""
    paths: list[str] = []
    for name in names:
        if name == '-' or not Path(name).is_dir():
            paths.append(name)
            continue
        inside = sorted(str(path) for path in Path(name).glob('*.yaml'))
        if not inside:
            raise InputError(
                name, 'there is no *.yaml in this folder',
                "name a declaration, or make some with 'mddag generate'")
        paths += inside
    return paths


def _load(paths: Sequence[str]) -> list[TaskSet]:
    with Progress('reading', len(paths)) as line:
        task_sets = []
        for done, path in enumerate(paths):
            line.update(done, f'of {len(paths)} declarations')
            task_sets.append(common.load_graph(path))
    common.leave_out_paths('evaluate', *task_sets)
    return task_sets


def _evaluate(
    args: argparse.Namespace, task_sets: Sequence[TaskSet], policies: tuple[str, ...]
) -> Evaluation:
    from mddag_executor.laboratory.evaluate import evaluate
    from mddag_executor.laboratory.experiment import Experiment
    if args.dask is not None and find_spec('distributed') is None:
        raise UsageError("--dask: Dask is not installed: install 'mddag_executor[dask]' with pip")
    samples = _samples(args.execution_times, task_sets)
    experiments = [
        Experiment(
            task_set, policies, workers=defaults.workers(args.workers, task_set),
            duration_ns=args.duration, seed=args.seed, samples=its_samples,
            preemptive=args.preemptive, overhead_ns=args.overheads,
            judge=args.judge)
        for task_set, its_samples in zip(task_sets, samples)]
    runs = args.runs or (_RUNS if len(task_sets) == 1 else _RUNS_OF_EACH)
    with Progress('evaluating', runs * len(task_sets)) as line:
        return evaluate(
            experiments, runs, first_run=args.first_run, dask=args.dask,
            jobs=args.parallel or defaults.processors(), progress=lambda done: line.update(
                done, f'of {runs * len(task_sets)} runs'))


def _samples(path: str | None, task_sets: Sequence[TaskSet]) -> list[Samples | None]:
    if path is None:
        return [None] * len(task_sets)
    from mddag_executor.laboratory.draws import read_samples
    file, name = common.input_path(path)
    return [read_samples(task_set, Path(file), name) for task_set in task_sets]


def _write(args: argparse.Namespace, outcome: Evaluation) -> None:
    if args.plot is not None:
        from mddag_executor.laboratory.plot import draw
        with common.output_file(args.plot) as file:
            draw(outcome, file, args.plot)
    common.show(args, outcome.result(), (table(*ratio_table(outcome)), _summary(outcome)))


def _summary(outcome: Evaluation) -> str:
    many = len(outcome.experiments)
    of_many = f' of {many} declarations' if many > 1 else ''
    each = outcome.elapsed_s / outcome.runs / len(outcome.experiment.policies)
    return (f'{counted(outcome.runs, "run")}{of_many} in {outcome.elapsed_s:.1f} s, '
            f'{1000 * each:.2f} ms for each run and policy '
            f'({"compiled" if outcome.compiled else "plain"} core, {outcome.jobs} at a time)')


def ratio_table(outcome: Evaluation) -> tuple[list[str], list[list[Cell]]]:
    """Return the table for people: acceptance ratio by bin of normalised utilisation."""
    acceptance = [*outcome.by_policy().values(), outcome.bound()]
    rows: list[list[Cell]] = []
    for i, (centre, count) in enumerate(zip(outcome.bins, acceptance[-1].runs)):
        if count == 0 and len(outcome.experiments) > 1:
            continue  # most of the many bins may be empty
        # the first and the last bin have everything beyond them
        end = {0: ' or less', len(outcome.bins) - 1: ' or more'}.get(i, '')
        rows.append([f'{centre:.2f}{end}', count,
                     *(_percent(each.ratio[i]) for each in acceptance)])
    rows.append(['all', outcome.runs, *(_percent(each.total) for each in acceptance)])
    return ['utilisation', 'runs', *outcome.experiment.policies, 'bound'], rows


def _percent(ratio: float | None) -> str | None:
    return None if ratio is None else f'{100 * ratio:.1f} %'

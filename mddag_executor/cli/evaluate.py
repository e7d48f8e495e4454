# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `evaluate`: the paper's experiment, acceptance ratio against normalised utilisation.

Each run draws execution times and is simulated under every policy, until the first miss. Several
declarations (random ones, from `mddag generate`) make one sweep. Ctrl-C ends it early; what is
done is shown and written, and the exit status is 130.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
import csv
from importlib.util import find_spec
import io
from pathlib import Path
import time
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Cell, Progress, table, warn
from mddag_executor.core import POLICIES
from mddag_executor.errors import InputError, UsageError
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.simulate.cluster import Cluster
    from mddag_executor.simulate.draws import Samples
    from mddag_executor.simulate.evaluate import Evaluation
    from msg_graph import TaskSet

EXAMPLE = """\
mddag evaluate config/autoware.yaml --runs 5000 --plot acceptance.png
mddag evaluate graph.yaml --policies rad,gedf --workers 4 --samples measured.npz --json out.json
mddag evaluate graph.yaml --non-preemptive --overhead 50us --csv -
mddag evaluate graph.yaml --runs 1000000 --resume kept.npz --dask tcp://head:8786
mddag generate --sets 400 --utilisation 0.1:1.0 -o sets && mddag evaluate sets --plot sets.svg"""

_RUNS, _RUNS_OF_EACH = 5000, 1
_EXIT_INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('graph', metavar='GRAPH', nargs='+', type=options.Input,
        help="declaration ('-': standard input), or several, or a folder of them (*.yaml)")
    add('--runs', type=options.positive_int, metavar='N',
        help='runs of each GRAPH, each with execution times of its own (default: '
        f'{_RUNS}; {_RUNS_OF_EACH} if there are several)')
    add('--policies', default=','.join(defaults.POLICIES), metavar='P,P…',
        help=f'any of {", ".join(POLICIES)} (default: %(default)s)')
    options.add_seed(parser, 'seed of the drawn execution times')
    add('--samples', metavar='FILE.npz', type=options.Input,
        help="measured execution times, an array of ns for each 'node:callback' (default: the "
        'quantile tables of the declaration)')
    add('--non-preemptive', action='store_true',
        help='run all policies without preemption, as an executor of callbacks does (default: '
        f'{", ".join(name for name, row in POLICIES.items() if row.preemptive)} preempt)')
    add('--judge', choices=('completions', 'horizon'), default='completions',
        help="which deadlines count: those of sinks that completed (the paper's way), or also "
        'those that passed before the end (default: %(default)s)')
    add('--dask', metavar='ADDRESS',
        help="let the workers of a Dask cluster do the runs; ADDRESS is its scheduler's, as "
        "tcp://host:8786, or 'local' for --jobs processes of this machine (extra 'dask')")
    add('--resume', metavar='FILE', type=options.NamedFile,
        help='keep what is done in FILE, and go on from what it holds; the result is that of an '
        'uninterrupted evaluation')
    add('--core', choices=('auto', 'compiled', 'plain'), default='auto',
        help="the scheduler core, compiled (by numba, the extra 'batch') or in plain Python: the "
        'results are the same (default: whichever is faster)')
    add('--plot', metavar='OUT', type=options.NamedFile,
        help="draw the paper's figure (.png, .svg or .pdf)")
    add('--csv', metavar='FILE', type=options.Output,
        help="write the table as CSV ('-': to standard output)")
    options.add(parser, '--workers', '--duration', '--overhead', '--jobs', '--json')


def main(args: argparse.Namespace) -> int:
    """Evaluate a declaration and print the acceptance ratios."""
    policies = options.policies(args.policies)
    if args.plot is not None:
        from mddag_executor.simulate.plot import check_plot
        check_plot(args.plot)
    task_sets = _load(_graphs(args.graph))
    outcome = _evaluate(args, task_sets, policies)
    if outcome.interrupted:
        kept = '' if args.resume is None else f', and kept in {args.resume}'
        warn(f'interrupted: {outcome.runs} of {outcome.asked} runs are done{kept}')
    if outcome.runs > 0:
        _write(args, outcome)
    return _EXIT_INTERRUPTED if outcome.interrupted else 0


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
    return task_sets


def _evaluate(
    args: argparse.Namespace, task_sets: Sequence[TaskSet], policies: tuple[str, ...]
) -> Evaluation:
    from mddag_executor.simulate.checkpoint import Checkpoint
    from mddag_executor.simulate.evaluate import evaluate, Experiment
    samples = _samples(args.samples, task_sets)
    experiments = [
        Experiment(
            task_set, policies, workers=defaults.workers(args.workers, task_set),
            duration_ns=args.duration, seed=args.seed, samples=its_samples,
            preemptive=False if args.non_preemptive else None, overhead_ns=args.overhead,
            judge=args.judge)
        for task_set, its_samples in zip(task_sets, samples)]
    runs = args.runs or (_RUNS if len(task_sets) == 1 else _RUNS_OF_EACH)
    checkpoint = None
    if args.resume is not None:
        checkpoint = Checkpoint(args.resume, lambda: common.output_file(args.resume))
    jobs, cluster = args.jobs or defaults.processors(), None
    with ExitStack() as stack:
        if args.dask is not None:
            cluster = stack.enter_context(_cluster(args.dask, jobs))
        line = stack.enter_context(Progress('evaluating', runs * len(task_sets)))
        return evaluate(
            experiments, runs, jobs=jobs, core=args.core, cluster=cluster, checkpoint=checkpoint,
            progress=_Clock(line, runs * len(task_sets)))


def _cluster(address: str, jobs: int) -> Cluster:
    if find_spec('distributed') is None:
        raise UsageError("--dask: Dask is not there: install 'mddag_executor[dask]' with pip")
    from mddag_executor.simulate.cluster import Cluster
    return Cluster(address, jobs)


class _Clock:
    """Shows how far an evaluation is, and how long the rest will take."""

    def __init__(self, line: Progress, runs: int) -> None:
        self._line = line
        self._runs = runs
        self._begin: tuple[float, int] | None = None

    def __call__(self, done: int) -> None:
        now = time.monotonic()
        if self._begin is None:  # what is done by then may come from a file
            self._begin = (now, done)
        begin, before = self._begin
        left = (now - begin) / max(1, done - before) * (self._runs - done)
        self._line.update(done, f'of {self._runs} runs, {_clock(left)} left')


def _samples(path: str | None, task_sets: Sequence[TaskSet]) -> list[Samples | None]:
    if path is None:
        return [None] * len(task_sets)
    from mddag_executor.simulate.draws import read_samples
    with common.input_file(path) as file:
        name = common.STDIN if path == '-' else path
        return [read_samples(task_set, file, name) for task_set in task_sets]


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f'{minutes} min {rest} s' if minutes else f'{rest} s'


def _write(args: argparse.Namespace, outcome: Evaluation) -> None:
    if args.csv is not None:
        common.write_text(args.csv, csv_text(outcome))
    if args.plot is not None:
        from mddag_executor.simulate.plot import draw
        with common.output_file(args.plot) as file:
            draw(outcome, file, args.plot)
    common.show(args, outcome.result(), (table(*ratio_table(outcome)), _summary(outcome)))


def _summary(outcome: Evaluation) -> str:
    many = len(outcome.experiments)
    of_many = f' of {many} task sets' if many > 1 else ''
    new = outcome.runs - outcome.resumed
    kept = f', {outcome.resumed} of them kept from before' if outcome.resumed else ''
    text = f'{counted(outcome.runs, "run")}{of_many}{kept} in {outcome.elapsed_s:.1f} s'
    if new:
        each = outcome.elapsed_s / new / len(outcome.experiment.policies)
        text += (f', {1000 * each:.2f} ms for each run and policy '
                 f'({"compiled" if outcome.compiled else "plain"} core, {outcome.jobs} at a time)')
    return text


def ratio_table(outcome: Evaluation) -> tuple[list[str], list[list[Cell]]]:
    """Return the table for people: acceptance ratio by bin of normalised utilisation."""
    acceptance = [*outcome.by_policy().values(), outcome.bound()]
    rows: list[list[Cell]] = []
    for i, (centre, count) in enumerate(zip(outcome.bins, outcome.counts())):
        if count == 0 and len(outcome.experiments) > 1:
            continue  # most of so many bins may be
        rows.append([f'{centre:.2f}', count, *(_percent(each.ratio[i]) for each in acceptance)])
    rows.append(['all', outcome.runs, *(_percent(each.total) for each in acceptance)])
    return ['utilisation', 'runs', *outcome.experiment.policies, 'bound'], rows


def _percent(ratio: float | None) -> str | None:
    return None if ratio is None else f'{100 * ratio:.1f} %'


def csv_text(outcome: Evaluation) -> str:
    """Return the ratios by bin with their 95 % confidence intervals as CSV (empty: no run)."""
    acceptance = outcome.by_policy()
    bound = outcome.bound()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow([
        'utilisation', 'runs',
        *(f'{name}{part}' for name in acceptance for part in ('', '_low', '_high')), 'bound'])
    for i, (centre, count) in enumerate(zip(outcome.bins, outcome.counts())):
        row: list[object] = [centre, count]
        for each in acceptance.values():
            row += [each.ratio[i], *(each.interval[i] or (None, None))]
        writer.writerow([*row, bound.ratio[i]])
    return text.getvalue()

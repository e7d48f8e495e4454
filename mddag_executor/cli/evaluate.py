# Copyright 2026 The mddag_executor developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The verb `evaluate`: the paper's experiment, acceptance ratio against normalised utilisation.

Each run draws execution times and is simulated under every policy, until the first miss. Ctrl-C
ends it early; what is done is shown and written, and the exit status is 130.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import sys
import time
from typing import TYPE_CHECKING

from mddag_executor.cli import common
from mddag_executor.cli.text import Cell, Progress, table
from mddag_executor.core import POLICIES
from mddag_executor.core import policy as find_policy
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.simulate.draws import Samples
    from mddag_executor.simulate.evaluate import Evaluation
    from msg_graph import TaskSet

NAME = 'evaluate'
HELP = 'measure acceptance ratios over many simulated runs'
EXAMPLE = """\
mddag evaluate config/autoware.yaml --runs 5000 --plot acceptance.png
mddag evaluate graph.yaml --policies rad,gedf --workers 4 --samples measured.npz --json out.json
mddag evaluate graph.yaml --non-preemptive --overhead 50us --csv -"""

_DEFAULT = ('rad', 'rm', 'wc', 'fifo')
_EXIT_INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('graph', metavar='GRAPH', help="the declaration, a YAML file ('-': standard input)")
    add('--runs', type=common.positive_int, default=5000, metavar='N',
        help='runs, each with execution times of its own (default: %(default)s)')
    add('--policies', default=','.join(_DEFAULT), metavar='P,P…',
        help=f'any of {", ".join(POLICIES)} (default: %(default)s)')
    add('--workers', type=common.positive_int, metavar='M',
        help="threads that run callbacks (default: the declaration's, else 7)")
    add('--duration', type=common.duration, default=3_000_000_000, metavar='TIME',
        help='virtual time of each run (default: 3s)')
    add('--seed', type=_seed, default=0, metavar='N', help='of the draws (default: %(default)s)')
    add('--samples', metavar='FILE.npz',
        help="measured execution times, an array of ns for each 'node:callback' (default: the "
        'quantile tables of the declaration)')
    add('--non-preemptive', action='store_true',
        help='run all policies as an executor of callbacks can; else all but wc and fifo preempt, '
        'as in the paper')
    add('--overhead', type=_overhead, default=0, metavar='TIME',
        help='what each dispatch of a callback takes more (default: 0)')
    add('--judge', choices=('completions', 'horizon'), default='completions',
        help="which deadlines count: those of sinks that completed (the paper's way), or also "
        'those that passed before the end (default: %(default)s)')
    add('--jobs', type=common.positive_int, metavar='N',
        help='runs to simulate at a time (default: the number of processors)')
    add('--core', choices=('auto', 'compiled', 'plain'), default='auto',
        help="the scheduler core, compiled (by numba, the extra 'batch') or in plain Python: the "
        'results are the same (default: the one that is sooner done)')
    add('--plot', metavar='OUT', help="draw the paper's figure (.png, .svg or .pdf)")
    add('--csv', metavar='FILE', help="write the table as CSV ('-': to standard output)")
    common.add_json(parser)


def _seed(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value < 2 ** 64:
        raise argparse.ArgumentTypeError(f'{text!r} is no whole number from 0 to 2**64 - 1')
    return value


def _overhead(text: str) -> int:
    return 0 if text == '0' else common.duration(text)


def main(args: argparse.Namespace) -> int:
    """
    Evaluate a declaration and print the acceptance ratios.

    :raises msg_graph.GraphError: when the declaration is wrong
    :raises mddag_executor.errors.MddagError: when anything else can not be used
    """
    policies = _policies(args.policies)
    _check_outputs(args)
    task_set = common.load_graph(args.graph)
    outcome = _evaluate(args, task_set, policies)
    if outcome.interrupted:
        print(f'warning: interrupted: {outcome.runs} of {outcome.asked} runs are done',
              file=sys.stderr)
    if outcome.runs > 0:
        _write(args, outcome)
    return _EXIT_INTERRUPTED if outcome.interrupted else 0


def _policies(text: str) -> tuple[str, ...]:
    names = [name.strip() for name in text.split(',')]
    for i, name in enumerate(names):
        find_policy(name)
        if name in names[:i]:
            raise UsageError(f"--policies: '{name}' stands there twice: name each once")
    return tuple(names)


def _check_outputs(args: argparse.Namespace) -> None:
    if args.graph == '-' and args.samples == '-':
        raise UsageError('-: standard input can be only one of GRAPH and --samples: name a file')
    if args.json == '-' and args.csv == '-':
        raise UsageError('-: standard output can take only one of --json and --csv: name a file')
    for path in (args.json, args.csv, args.plot):
        common.check_output(path)
    if args.plot is not None:
        from mddag_executor.simulate.plot import check_plot
        check_plot(args.plot)


def _evaluate(
    args: argparse.Namespace, task_set: TaskSet, policies: tuple[str, ...]
) -> Evaluation:
    from mddag_executor.simulate.evaluate import evaluate, Experiment
    experiment = Experiment(
        task_set, policies, workers=args.workers or task_set.workers or 7,
        duration_ns=args.duration, seed=args.seed, samples=_samples(args.samples, task_set),
        preemptive=False if args.non_preemptive else None, overhead_ns=args.overhead,
        judge=args.judge)
    with Progress('evaluating', args.runs) as line:
        begin = 0.0

        def progress(done: int) -> None:
            nonlocal begin
            if done < 0:
                line.update(0, 'the core is being compiled, once')
                return
            begin = begin or time.monotonic()
            left = (time.monotonic() - begin) / max(1, done) * (args.runs - done)
            line.update(done, f'of {args.runs} runs, {_clock(left)} left')

        return evaluate(
            experiment, args.runs, jobs=args.jobs or _processors(), core=args.core,
            progress=progress)


def _samples(path: str | None, task_set: TaskSet) -> Samples | None:
    if path is None:
        return None
    from mddag_executor.simulate.draws import read_samples
    with common.input_file(path) as file:
        return read_samples(task_set, file, common.STDIN if path == '-' else path)


def _processors() -> int:
    """Count the processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not every system has it
        return os.cpu_count() or 1


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f'{minutes} min {rest} s' if minutes else f'{rest} s'


def _write(args: argparse.Namespace, outcome: Evaluation) -> None:
    if args.json is not None:
        common.write_json(args.json, outcome.result())
    if args.csv is not None:
        common.write_text(args.csv, csv_text(outcome))
    if args.plot is not None:
        from mddag_executor.simulate.plot import draw
        with common.output_file(args.plot) as file:
            draw(outcome, file, args.plot)
    if common.wants_tables(args) and args.csv != '-':
        print(table(*ratio_table(outcome)))
        each = outcome.elapsed_s / outcome.runs / len(outcome.experiment.policies)
        print(f'{outcome.runs} runs in {outcome.elapsed_s:.1f} s, {1000 * each:.2f} ms for each '
              f'run and policy ({"compiled" if outcome.compiled else "plain"} core, '
              f'{outcome.jobs} at a time)')


def ratio_table(outcome: Evaluation) -> tuple[list[str], list[list[Cell]]]:
    """Return the table for people: acceptance ratio by bin of normalised utilisation."""
    from mddag_executor.simulate.acceptance import BINS
    acceptance = [*outcome.by_policy().values(), outcome.bound()]
    rows: list[list[Cell]] = []
    for i, (centre, count) in enumerate(zip(BINS, outcome.counts())):
        rows.append([f'{centre:.2f}', count, *(_percent(each.ratio[i]) for each in acceptance)])
    rows.append(['all', outcome.runs, *(_percent(each.total) for each in acceptance)])
    return ['utilisation', 'runs', *outcome.experiment.policies, 'bound'], rows


def _percent(ratio: float | None) -> str | None:
    return None if ratio is None else f'{100 * ratio:.1f} %'


def csv_text(outcome: Evaluation) -> str:
    """Return the ratios by bin with their 95 % confidence intervals as CSV (empty: no run)."""
    from mddag_executor.simulate.acceptance import BINS
    acceptance = outcome.by_policy()
    bound = outcome.bound()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow([
        'utilisation', 'runs',
        *(f'{name}{part}' for name in acceptance for part in ('', '_low', '_high')), 'bound'])
    for i, (centre, count) in enumerate(zip(BINS, outcome.counts())):
        row: list[object] = [centre, count]
        for each in acceptance.values():
            row += [each.ratio[i], *(each.interval[i] or (None, None))]
        writer.writerow([*row, bound.ratio[i]])
    return text.getvalue()

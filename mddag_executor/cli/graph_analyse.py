# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph analyse`: can the deadlines hold? Necessary and sufficient tests."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress, table
from mddag_executor.errors import UsageError
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.analysis import Analysis
    from msg_graph import TaskSet

HELP = 'test whether the deadlines can hold, before the first run'
EXAMPLE = """\
mddag graph analyse config/autoware.yaml --budget p99
mddag graph analyse config/autoware.yaml --workers 4 --json -
mddag graph analyse graph.yaml --fail-on-unschedulable
mddag graph analyse graph.yaml --sag jobs --sag-binary ~/np-schedulability-analysis/build/nptest
"""
DESCRIPTION = """\
Test whether the deadlines of a declaration can hold. Where a necessary test fails, no scheduler
can keep them; where a sufficient test holds, its scheduler does, as long as no execution takes
longer than its budget. A sufficient test that does not hold says nothing. Overheads of dispatching
are not part of any test, nor are callback groups and Python's lock."""

_HEADER = ('test', 'kind', 'verdict', 'figure', 'why')
_ABOUT = ('test', 'source', 'scheduler', 'assumption')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        '--budget', choices=defaults.BUDGETS, default='max',
        help='what of each execution time counts: its maximum (default), 99 %% quantile or mean')
    options.add(parser, 'graph', '--workers', '--json')
    parser.add_argument(
        '--fail-on-unschedulable', action='store_true',
        help='exit with status 1 if no scheduler can keep the deadlines')
    parser.add_argument(
        '--sag', metavar='DIR',
        help='write the jobs of one hyperperiod there, for schedule-abstraction analysis: '
        'jobs.csv and edges.csv for nptest, tasks.csv with what its task IDs stand for')
    parser.add_argument(
        '--sag-binary', metavar='NPTEST',
        help='run this program (nptest, from np-schedulability-analysis) on them, and show its '
        'verdict among the others')
    parser.add_argument(
        '--sag-timeout', type=options.positive_int, default=60, metavar='SECONDS',
        help='processor time that it may take (default: 60)')
    parser.add_argument(
        '--horizon', type=options.duration, metavar='TIME',
        help='with --sag or --sag-binary: only the releases before this, not of a hyperperiod')


def main(args: argparse.Namespace) -> int:
    """Analyse."""
    from mddag_executor.analysis import analyse
    task_set = common.load_graph(args.graph)
    if args.horizon is not None and args.sag is None and args.sag_binary is None:
        raise UsageError('--horizon: it is about job sets: add --sag or --sag-binary')
    with Progress('analysing') as line:
        analysis = analyse(
            task_set, defaults.workers(args.workers, task_set), args.budget,
            lambda tests: line.update(tests, 'tests'))
    if args.sag is not None or args.sag_binary is not None:
        analysis = _sag(args, task_set, analysis)
    found = analysis.verdicts
    common.show(args, analysis.result(), (
        table(_HEADER, ((v.name, v.kind, v.verdict, v.figure, v.reason) for v in found)),
        table(_ABOUT, ((v.name, v.source, v.scheduler, v.assumption) for v in found)),
        _summary(analysis)))
    return int(args.fail_on_unschedulable and _is_impossible(analysis))


def _sag(args: argparse.Namespace, task_set: TaskSet, analysis: Analysis) -> Analysis:
    """Write the job set, and let the binary judge it if there is one."""
    from mddag_executor.analysis import sag, tasks_of
    from mddag_executor.analysis.verdicts import with_sag
    tasks = tasks_of(task_set, args.budget)
    jobs = sag.job_set(tasks, args.horizon)
    with ExitStack() as stack:
        if args.sag is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='mddag-')))
        else:
            folder = Path(args.sag)
            folder.mkdir(exist_ok=True)
        for name, text in ((sag.JOBS, jobs.jobs), (sag.EDGES, jobs.edges),
                           (sag.TASKS, jobs.tasks)):
            common.write_text(str(folder / name), text)
        if args.sag_binary is None:
            return analysis
        with Progress('running nptest') as line:
            line.update(jobs.size, 'jobs')
            answer = sag.ask(args.sag_binary, folder, analysis.workers, args.sag_timeout)
    return with_sag(analysis, tasks, jobs, answer)


def _is_impossible(analysis: Analysis) -> bool:
    """Return whether a necessary test fails."""
    from mddag_executor.analysis import FAILS
    return any(each.verdict == FAILS for each in analysis.verdicts)


def _summary(analysis: Analysis) -> str:
    from mddag_executor.analysis import HOLDS
    from mddag_executor.analysis.verdicts import SHARED
    assumed = f'All sufficient tests assume: {SHARED}.\n'
    begin = f'{assumed}{counted(analysis.workers, "worker")}, budget {analysis.budget}: '
    if _is_impossible(analysis):
        return begin + 'no scheduler can keep these deadlines'
    proven = {each.scheduler: None for each in analysis.verdicts
              if each.kind == 'sufficient' and each.verdict == HOLDS}
    if proven:
        return begin + 'the deadlines hold under ' + '; '.join(proven)
    return begin + 'nothing is proven either way: simulate it'

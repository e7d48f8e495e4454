# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `diff`: two recorded runs, sink by sink.

A run is a trace of this executor, an imported recording, or a folder with the traces of all its
processes.  Without a graph each is judged by the declaration that it was recorded with, and an
imported one by the other run's.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from mddag_executor.cli import common, options, recorded, verdicts
from mddag_executor.cli.recorded import Source
from mddag_executor.cli.text import warn

if TYPE_CHECKING:
    from mddag_executor.results.replays import ReplayResult
    from msg_graph import TaskSet

EXAMPLE = """\
mddag diff before.mcap after.mcap
mddag diff before.mcap after.mcap graph.yaml --fail-on-worse --allow-growth 10% --json diff.json
mddag diff before/ after/

exit status: 0 compared; 1 with --fail-on-worse when a sink got worse; 2 bad input"""

REMOVED_OPTIONS = {'--skip': 'it is --from now', '--tolerance': 'it is --allow-growth now'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('first', metavar='A.mcap', type=options.Input,
        help="the run to compare with: a trace, recorded or imported ('-': standard input), or a "
        'folder with the traces of all its processes')
    add('second', metavar='B.mcap', type=options.Input,
        help="the other run, in the same form ('-': standard input)")
    add('graph', metavar='GRAPH', nargs='?', type=options.Input,
        help="the declaration that judges both ('-': standard input; default: each run is "
        "judged by the one that it was recorded with, or else by that of the other run)")
    add('--callbacks', action='store_true', help='also show a table of all callbacks')
    add('--fail-on-worse', action='store_true',
        help='exit with status 1 if a sink missed a larger share of its deadlines in B, was not '
        'due in B, or its p99 response time grew by more than is allowed')
    add('--allow-growth', type=_share, metavar='SHARE',
        help='with --fail-on-worse and in the tables: how much the p99 response time of a sink '
        'may grow, for instance 10%% (default: by any amount)')
    options.add(parser, '--from', '--json')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.report import diff
    task_set = None if args.graph is None else common.load_graph(args.graph)
    first, second = (
        Source(*common.input_path(common.one_run([path], ())), task_set)
        for path in (args.first, args.second))
    before, after, declared = _results(args, first, second)
    difference = diff.compare(
        before, after, args.allow_growth,
        {dag.name for dag in declared.dags if dag.sporadic or dag.once})
    common.show(args, difference, diff.lines(difference, args.callbacks))
    if not args.fail_on_worse:
        return 0
    if not difference['worse'] and not difference['compared']:
        return verdicts.unproven(
            f'{first.name} and {second.name}',
            'no sink was due in both, so nothing was compared')
    return int(difference['worse'])


def _results(
    args: argparse.Namespace, first: Source, second: Source
) -> tuple[ReplayResult, ReplayResult, TaskSet]:
    """Return both results, and the declaration that judges the second run."""
    if _has_declaration(first):
        before, declared = _result(first, args.begin or 0)
        if not _has_declaration(second):
            second = second._replace(task_set=declared)
        return before, *_result(second, args.begin or 0)
    # without one of its own it is judged by the other's, and that must have one
    if not _has_declaration(second):
        first.check_deadlines()
        second.check_deadlines()
    after, declared = _result(second, args.begin or 0)
    return _result(first._replace(task_set=declared), args.begin or 0)[0], after, declared


def _has_declaration(source: Source) -> bool:
    from mddag_executor.sources.open import has_declaration
    # several traces can be joined only if each has a declaration
    return source.task_set is not None or not isinstance(source.path, str) or (
        not source.is_bag and has_declaration(source.path, source.name))


def _result(source: Source, skip: int) -> tuple[ReplayResult, TaskSet]:
    outcome = recorded.as_recorded(source, f'replaying {source.name}', skip)
    warn(*outcome.warnings)
    return outcome.result(), outcome.task_set


def _share(text: str) -> float:
    """Return a share; `10` may mean 10 %, or ten times as much."""
    value = options.share(text)
    if value > 1 and not text.endswith('%'):
        raise argparse.ArgumentTypeError(f'{text!r} is not a share: write 10% or 0.1')
    return value

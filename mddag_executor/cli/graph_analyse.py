# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph analyse`: can the deadlines hold? Necessary and sufficient tests."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from mddag_executor import defaults
from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress, table
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.laboratory.analyse import Analysis

EXAMPLE = """\
mddag graph analyse config/autoware.yaml --budget p99
mddag graph analyse config/autoware.yaml --workers 4 --json -
mddag graph analyse graph.yaml --fail-on-unschedulable
"""
DESCRIPTION = """\
Test whether the deadlines of a declaration can hold. If a necessary test fails, no scheduler can
keep them; if a sufficient test holds, its scheduler does, as long as no execution takes longer
than its budget. Otherwise a sufficient test says nothing. No test includes overheads of
dispatching, callback groups and Python's lock."""

_HEADER = ('test', 'kind', 'verdict', 'figure')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--budget', choices=defaults.BUDGETS, default='max',
        help='what of each execution time counts: its maximum (default), 99 %% quantile or mean')
    options.add(parser, 'graph', '--workers', '--json')
    parser.add_argument(
        '--fail-on-unschedulable', action='store_true',
        help='exit with status 1 if no scheduler can keep the deadlines')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.laboratory.analyse import analyse, HOLDS
    task_set = common.load_graph(args.graph)
    with Progress('analysing') as line:
        analysis = analyse(
            task_set, defaults.workers(args.workers, task_set), args.budget,
            lambda tests: line.update(tests, 'tests'))
    found = analysis.verdicts
    common.show(args, analysis.result(), (
        table(_HEADER, ((v.name, v.kind, v.verdict, v.figure) for v in found)),
        *(f'{v.name} {v.verdict}: {v.reason}' for v in found if v.verdict != HOLDS),
        _summary(analysis)))
    return int(args.fail_on_unschedulable and _is_impossible(analysis))


def _is_impossible(analysis: Analysis) -> bool:
    """Return whether a necessary test fails."""
    from mddag_executor.laboratory.analyse import FAILS
    return any(each.verdict == FAILS for each in analysis.verdicts)


def _summary(analysis: Analysis) -> str:
    from mddag_executor.laboratory.analyse import HOLDS, SHARED
    begin = f'{counted(analysis.workers, "worker")}, budget {analysis.budget}: '
    if _is_impossible(analysis):
        return begin + 'no scheduler can keep these deadlines'
    proven = {each.scheduler: None for each in analysis.verdicts
              if each.kind == 'sufficient' and each.verdict == HOLDS}
    if proven:
        return (f'The tests that hold assume: {SHARED}.\n{begin}the deadlines hold under '
                + '; '.join(proven))
    return begin + 'nothing is proven either way: simulate it'

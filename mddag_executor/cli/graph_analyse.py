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

"""The verb `graph analyse`: can the deadlines hold? Necessary and sufficient tests."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mddag_executor.cli import common
from mddag_executor.cli.text import Cell, table

if TYPE_CHECKING:
    from mddag_executor.analysis import Analysis

HELP = 'test whether the deadlines can hold, before the first run'
EXAMPLE = """\
mddag graph analyse config/autoware.yaml --budget p99
mddag graph analyse config/autoware.yaml --workers 4 --json -
"""
DESCRIPTION = """\
Test whether the deadlines of a declaration can hold. Where a necessary test fails, no scheduler
can keep them; where a sufficient test holds, its scheduler does, as long as no execution takes
longer than its budget. A sufficient test that does not hold says nothing. Overheads of dispatching
are not part of any test."""

_WORKERS = 7
_HEADER = ('test', 'kind', 'verdict', 'figure', 'why')
_ABOUT = ('test', 'source', 'scheduler', 'assumption')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    common.add_graph(parser)
    parser.add_argument(
        '--budget', choices=('max', 'p99', 'mean'), default='max',
        help='what of each execution time counts: its maximum (default), 99 %% quantile or mean')
    parser.add_argument(
        '--workers', type=common.positive_int, metavar='M',
        help=f'number of workers; default: the declared one, else {_WORKERS}')
    common.add_json(parser)


def main(args: argparse.Namespace) -> int:
    """
    Analyse.

    :raises msg_graph.GraphError: when the declaration is wrong
    :raises mddag_executor.analysis.AnalysisError: when an execution time is not declared
    """
    from mddag_executor.analysis import analyse
    common.check_output(args.json)
    task_set = common.load_graph(args.graph)
    analysis = analyse(task_set, args.workers or task_set.workers or _WORKERS, args.budget)
    if args.json is not None:
        common.write_json(args.json, analysis.result())
    if common.wants_tables(args):
        about = ((v.name, v.source, v.scheduler, v.assumption) for v in analysis.verdicts)
        print(table(_HEADER, _rows(analysis)))
        print(table(_ABOUT, about))
        print(_summary(analysis))
    return 0


def _rows(analysis: Analysis) -> Iterator[list[Cell]]:
    for each in analysis.verdicts:
        yield [each.name, each.kind, each.verdict, each.figure, each.reason]


def _summary(analysis: Analysis) -> str:
    from mddag_executor.analysis import FAILS, HOLDS
    begin = f'{analysis.workers} workers, budget {analysis.budget}: '
    if any(each.verdict == FAILS for each in analysis.verdicts):
        return begin + 'no scheduler can keep these deadlines'
    proven = {each.scheduler: None for each in analysis.verdicts
              if each.kind == 'sufficient' and each.verdict == HOLDS}
    if proven:
        return begin + 'the deadlines hold under ' + '; '.join(proven)
    return begin + 'nothing is proven either way: simulate it'

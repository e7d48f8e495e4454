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
The verb `diff`: two recorded runs, sink by sink.

Exit status: 0 when compared, whatever came of it; with `--fail-on-worse` 1 if a sink missed a
larger share of its deadlines in the second run, or (with `--tolerance`) if its p99 response time
grew by more than that; 2 on bad input.
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any, TYPE_CHECKING

from mddag_executor.cli import common
from mddag_executor.cli.text import one_line, Progress
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from msg_graph import TaskSet

NAME = 'diff'
HELP = 'compare two recorded runs sink by sink'
EXAMPLE = """\
mddag diff before.mcap after.mcap
mddag diff before.mcap after.mcap graph.yaml --fail-on-worse --tolerance 10% --json diff.json

exit status: 0 compared; 1 with --fail-on-worse when a sink got worse; 2 bad input"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('first', metavar='A.mcap', help="the run to compare with ('-': standard input)")
    add('second', metavar='B.mcap', help="the run to compare ('-': standard input)")
    add('graph', metavar='GRAPH', nargs='?',
        help="the declaration that judges both ('-': standard input; default: each by the one "
        'that it was recorded with)')
    add('--callbacks', action='store_true', help='show a table of all callbacks, too')
    add('--fail-on-worse', action='store_true',
        help='exit with status 1 if a sink missed a larger share of its deadlines in B, or its '
        'p99 response time grew by more than the tolerance')
    add('--tolerance', type=_share, metavar='P%',
        help='with --fail-on-worse and in the tables: how much the p99 response time of a sink '
        'may grow, as 10%% (default: by any amount)')
    common.add_json(parser)


def main(args: argparse.Namespace) -> int:
    """
    Compare two runs.

    :raises mddag_executor.trace.TraceError: when a trace can not be used
    :raises msg_graph.GraphError: when the declaration is wrong
    :raises mddag_executor.errors.MddagError: when anything else can not be used
    """
    from mddag_executor.report import diff
    if (args.first, args.second, args.graph).count('-') > 1:
        raise UsageError('-: standard input can be only one of A, B and GRAPH: name the others')
    common.check_output(args.json)
    task_set = None if args.graph is None else common.load_graph(args.graph)
    difference = diff.compare(
        _replay(args.first, task_set), _replay(args.second, task_set), args.tolerance)
    if args.json is not None:
        common.write_json(args.json, difference)
    if common.wants_tables(args):
        print(diff.sinks_table(difference))
        if args.callbacks:
            print(diff.callbacks_table(difference))
        for line in diff.summary(difference):
            print(line)
    return 1 if args.fail_on_worse and difference['worse'] else 0


def _replay(given: str, task_set: TaskSet | None) -> dict[str, Any]:
    from mddag_executor.replay import replay
    with common.input_trace(given) as (path, name), Progress(f'replaying {given}') as line:
        outcome = replay(
            path, task_set, name=name,
            progress=lambda events: line.update(round(events / 1e6, 1), 'million events'))
    for warning in outcome.warnings:
        print(f'warning: {one_line(warning)}', file=sys.stderr)
    return outcome.result()


def _share(text: str) -> float:
    """Return the share that `10%` is."""
    try:
        value = float(text.removesuffix('%')) / 100
    except ValueError:
        value = math.nan
    if not text.endswith('%') or not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r} is no share from 0 % up, as 10%')
    return value

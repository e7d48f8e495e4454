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
The verb `replay`: what a recorded run did, or what the scheduler core would have done with it.

Without a graph the declaration in the trace judges.  What is missing of a trace is a warning on
standard error; everything before the damage is used.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import sys
from typing import Any, TYPE_CHECKING

from mddag_executor.cli import common
from mddag_executor.cli.text import one_line, Progress
from mddag_executor.core import POLICIES
from mddag_executor.core import policy as find_policy
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.replay import Replay, Reschedule
    from msg_graph import TaskSet

NAME = 'replay'
HELP = 'check a recorded run against its deadlines, or reschedule it'
EXAMPLE = """\
mddag replay run.mcap
mddag replay run.mcap graph.yaml --fail-on-miss
mddag replay run.mcap --reschedule --workers 2 --policy fifo --json result.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('trace', metavar='TRACE', help="a recorded run, an MCAP file ('-': standard input)")
    add('graph', metavar='GRAPH', nargs='?',
        help="the declaration that judges, a YAML file ('-': standard input; default: the one "
        'that the trace was recorded with)')
    add('--reschedule', action='store_true',
        help='run the scheduler over the recorded releases and execution times')
    add('--workers', type=common.positive_int, metavar='M',
        help='with --reschedule: threads that run callbacks (default: as recorded)')
    add('--policy', metavar='P',
        help=f'with --reschedule: one of {", ".join(POLICIES)} (default: as recorded)')
    add('--preemptive', action='store_true',
        help='with --reschedule: what is more urgent takes the worker of what runs')
    add('--callbacks', action='store_true', help='show a table of all callbacks, too')
    add('--fail-on-miss', action='store_true', help='exit with status 1 if a deadline was missed')
    common.add_json(parser)


def main(args: argparse.Namespace) -> int:
    """
    Replay a trace and print what came of its deadlines.

    :raises mddag_executor.trace.TraceError: when the trace can not be used
    :raises msg_graph.GraphError: when the declaration is wrong
    :raises mddag_executor.errors.MddagError: when anything else can not be used
    """
    common.check_output(args.json)
    _check_arguments(args)
    task_set = None if args.graph is None else common.load_graph(args.graph)
    with _trace(args.trace) as (path, name):
        outcome = _replay(args, path, name, task_set)
    for warning in outcome.warnings:
        print(f'warning: {one_line(warning)}', file=sys.stderr)
    result = outcome.result()
    if args.json is not None:
        common.write_json(args.json, result)
    if common.wants_tables(args):
        _show(args, result)
    return 1 if args.fail_on_miss and outcome.tally.missed else 0


def _check_arguments(args: argparse.Namespace) -> None:
    if args.trace == '-' and args.graph == '-':
        raise UsageError('-: standard input can be only one of TRACE and GRAPH: name the other')
    if args.policy is not None:
        find_policy(args.policy)
    if args.reschedule:
        if args.callbacks:
            raise UsageError(
                '--callbacks: it shows what was recorded: leave it or --reschedule out')
        return
    for option in ('workers', 'policy', 'preemptive'):
        if getattr(args, option) not in (None, False):
            raise UsageError(
                f'--{option}: a run is replayed as it was recorded: add --reschedule')


@contextmanager
def _trace(given: str) -> Iterator[tuple[str, str]]:
    """Give the trace's path, and what messages call it."""
    if given != '-':
        yield given, given  # as the user wrote it: pathlib would change ./a
        return
    with common.input_file(given) as path:
        yield str(path), common.STDIN


def _replay(
    args: argparse.Namespace, path: str, name: str, task_set: TaskSet | None
) -> Replay | Reschedule:
    from mddag_executor.replay import replay, reschedule
    with Progress('replaying') as line:
        def progress(events: int) -> None:
            line.update(round(events / 1e6, 1), 'million events')

        if args.reschedule:
            return reschedule(
                path, task_set, policy=args.policy, workers=args.workers,
                preemptive=args.preemptive, name=name, progress=progress)
        return replay(path, task_set, name=name, progress=progress)


def _show(args: argparse.Namespace, result: dict[str, Any]) -> None:
    from mddag_executor.report.replays import (
        callbacks_table,
        comparison_table,
        summary,
        times_table,
    )
    from mddag_executor.report.tables import sink_table
    if result['rescheduled']:
        print('Rescheduled, beside what was recorded:')
        print(comparison_table(result['dags'], result['recorded']['dags']))
    else:
        print(sink_table(result['dags']))
        print('Where the response times went: means, and the worst job of each sink:')
        print(times_table(result['dags']))
    if args.callbacks:
        print(callbacks_table(result['callbacks']))
    for line in summary(result):
        print(line)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Ordinary bags, for the verbs that take recordings: their messages as releases."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from mddag_executor.cli import common, options
from mddag_executor.cli.text import Progress
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.replay import Reschedule
    from msg_graph import TaskSet

RECORDED = -1
"""Overheads as they were recorded."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        '--overheads', type=_overheads, metavar='WHICH',
        help='with --reschedule: the time that noticing, dispatch and transport take: recorded '
        '(default), none, or a time for each dispatch (50us); of a bag: none (default) or a time')
    options.add(parser, '--execution-times', '--seed',
                only='with --reschedule of an ordinary bag: ')


def _overheads(text: str) -> int:
    if text == 'recorded':
        return RECORDED
    return 0 if text == 'none' else options.duration(text)


def check(args: argparse.Namespace) -> None:
    """Check the arguments."""
    if args.execution_times is not None and args.seed is not None:
        raise UsageError(
            '--seed: nothing is drawn where --execution-times are given: leave one out')
    if args.execution_times is not None and args.graph is None:
        raise UsageError('--execution-times: they are of a declaration: give a GRAPH')


def no_graph(name: str) -> UsageError:
    """Return the error for a bag that is not rescheduled by a graph."""
    return UsageError(
        f'{name}: no run of this executor is recorded in it, so there are no jobs: to take its '
        'messages as releases give a GRAPH and --reschedule')


def reschedule_bag(
    args: argparse.Namespace, path: str, name: str, task_set: TaskSet | None
) -> Reschedule:
    """Run the scheduler over a bag."""
    from mddag_executor.replay.bags_reschedule import reschedule_bag as run
    from mddag_executor.simulate import read_execution_times
    if task_set is None or not args.reschedule:
        raise no_graph(name)
    if args.overheads == RECORDED:
        raise UsageError('--overheads: a bag has none: give a time for each dispatch')
    times = None
    if args.execution_times is not None:
        times_name, text = common.read_text(args.execution_times)
        times = read_execution_times(task_set, text, times_name)
    with Progress('replaying'):
        return run(
            path, task_set, policy=args.policy, workers=args.workers,
            preemptive=bool(args.preemptive), times=times, seed=args.seed or 0,
            dispatch_overhead=args.overheads or 0, name=name, skip=args.skip, cpus=args.cpus)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What verbs share that judge a run: tolerances, JUnit XML, annotations and the exit status."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
import sys
from typing import Any, TYPE_CHECKING

from mddag_executor.cli import common, options
from mddag_executor.cli.text import one_line, printable
from mddag_executor.core.tally import total
from mddag_executor.core.tolerances import NO_MISS, NOTHING_DUE, Tolerance
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.replay.miss_tally import MissTally

_NEVER_DUE = ('give a declaration whose nodes, topics and namespaces are those that ran, and a '
              'run that is longer than its deadlines')


def add_fail_on_miss(parser: argparse.ArgumentParser) -> None:
    """Declare `--fail-on-miss`."""
    parser.add_argument(
        '--fail-on-miss', action='store_true',
        help='exit with status 1 if more deadlines were missed than are tolerated (`tolerate:` in '
        'the declaration), or no job was due')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--fail-on-miss` and what goes with it."""
    add = parser.add_argument
    add_fail_on_miss(parser)
    add('--tolerate-ratio', type=options.ratio, metavar='R',
        help='with --fail-on-miss, --junit or --github: the share of the jobs of a sink without '
        '`tolerate:` that may miss, 0 to 1')
    add('--tolerate-burst', type=options.or_zero(options.positive_int), metavar='B',
        help='with --fail-on-miss, --junit or --github: how many jobs of such a sink may miss in '
        'a row')
    add('--github', action='store_true',
        help='print an annotation for GitHub Actions for each sink that is not within that')
    add('--junit', metavar='OUT.xml', type=options.Output,
        help="write JUnit XML, a test case for each sink ('-': to standard output)")


def check(args: argparse.Namespace) -> None:
    """Check the arguments."""
    if args.fail_on_miss or args.junit or args.github:
        return
    for option in ('tolerate_ratio', 'tolerate_burst'):
        if getattr(args, option) is not None:
            raise UsageError(f'--{option.replace("_", "-")}: it decides about --fail-on-miss, '
                             '--junit and --github: add one of them')


def judge(args: argparse.Namespace, tally: MissTally, result: dict[str, Any]) -> int:
    """
    Add the bursts to a result, say and write what is not tolerated, and return the exit status.

    :param result: of ``replay --json``.
    """
    tally.add_bursts(result['dags'])
    tolerance = Tolerance(args.tolerate_ratio, args.tolerate_burst)
    broken = tolerance.verdicts(result['dags'])
    if args.junit is not None:
        from mddag_executor.report.junit import junit
        with common.output_file(args.junit) as file:
            file.write(junit(result, broken, str(args.trace)))
    if args.github:
        from mddag_executor.report.github import annotation_lines
        graph = None if args.graph in (None, '-') else str(args.graph)
        for line in annotation_lines(result['dags'], broken, graph):
            print(line, file=sys.stdout if common.wants_tables(args) else sys.stderr)
    if not args.fail_on_miss:
        return 0
    return exit_status(result['dags'], str(args.trace), tolerance=tolerance)


def exit_status(
    dags: Mapping[str, Any], place: str, remedy: str = _NEVER_DUE,
    tolerance: Tolerance = NO_MISS,
) -> int:
    """
    Return the exit status of `--fail-on-miss`.

    If no job was due, nothing has shown that deadlines hold: that is a failure, and is reported.
    """
    if total(dags).due:
        return int(bool(tolerance.verdicts(dags)))
    return unproven(place, NOTHING_DUE, remedy)


def unproven(place: str, what: str, remedy: str = _NEVER_DUE) -> int:
    """Say that a run proves nothing about deadlines; return the exit status."""
    print(f'error: {one_line(f"{place}: {what}: {remedy}")}', file=sys.stderr)
    return 1


def lines(args: argparse.Namespace, result: dict[str, Any]) -> Iterator[str]:
    """Yield which sinks are not within what is tolerated, where that was said."""
    if args.tolerate_ratio is None and args.tolerate_burst is None and not any(
            'tolerate' in sink for dag in result['dags'].values()
            for sink in dag['sinks'].values()):
        return
    tolerance = Tolerance(args.tolerate_ratio, args.tolerate_burst)
    broken = tolerance.verdicts(result['dags'])
    for (_, sink), why in broken.items():
        yield f'not tolerated: {printable(sink)}: {why}'
    if not broken:
        yield 'all misses, if any, are within what is tolerated'

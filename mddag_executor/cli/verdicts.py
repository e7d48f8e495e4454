# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What verbs share that judge a run: tolerances, JUnit XML, annotations and the exit status."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import sys
from typing import Any

from mddag_executor.cli import common
from mddag_executor.cli.text import one_line
from mddag_executor.core.tally import never_due, total
from mddag_executor.core.tolerances import not_tolerated, NOTHING_DUE
from mddag_executor.errors import InputError

_NEVER_DUE = ('check that the declaration has the nodes, topics and namespaces of the run, and '
              'record for longer than its deadlines')


def judge(args: argparse.Namespace, result: dict[str, Any]) -> int:
    """Print and write what is not tolerated in a result; return the exit status."""
    broken = not_tolerated(result['dags'])
    if args.junit is not None:
        from mddag_executor.report.ci import junit
        with common.output_file(args.junit) as file:
            file.write(junit(result, broken, str(args.trace)))
    if args.github:
        from mddag_executor.report.ci import annotation_lines
        graph = None if args.graph in (None, '-') else str(args.graph)
        for line in annotation_lines(result['dags'], broken, graph):
            print(line, file=sys.stdout if common.wants_tables(args) else sys.stderr)
    return exit_status(args, result['dags'], str(args.trace))


def exit_status(
    args: argparse.Namespace, dags: Mapping[str, Any], place: str, remedy: str = _NEVER_DUE
) -> int:
    """
    Return the exit status that `--fail-on-miss` asks for.

    If no job was due, nothing has shown that deadlines hold: that is a failure, and is reported.
    """
    if not args.fail_on_miss:
        return 0
    if total(dags).due:
        return int(bool(not_tolerated(dags)))
    return unproven(place, NOTHING_DUE, remedy)


def check_judged(dags: Mapping[str, Any], place: str) -> None:
    """Raise an error if a declaration has sinks with deadlines, and no job was due at any."""
    if never_due(dags) and not total(dags).due:
        raise InputError(place, NOTHING_DUE, _NEVER_DUE)


def unproven(place: str, what: str, remedy: str = _NEVER_DUE) -> int:
    """Say that a run proves nothing about deadlines; return the exit status."""
    print(f'error: {one_line(f"{place}: {what}: {remedy}")}', file=sys.stderr)
    return 1

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
from mddag_executor.core.requirements import is_never_due, not_met
from mddag_executor.core.tally import never_due, total
from mddag_executor.core.tolerances import not_tolerated, NOTHING_DUE
from mddag_executor.errors import InputError
from mddag_executor.text import listed

_NEVER_DUE = ('check that the declaration has the nodes, topics and namespaces of the run, and '
              'record for longer than its deadlines')
_NEVER_ARRIVED = 'record for longer, or see with mddag replay where the data of the path ends'


def judge(args: argparse.Namespace, result: dict[str, Any]) -> int:
    """Print and write what is not tolerated in a result; return the exit status."""
    broken = not_tolerated(result['dags'])
    late = not_met(result.get('requirements', {}))
    if args.junit is not None:
        from mddag_executor.report.ci import junit
        with common.output_file(args.junit) as file:
            file.write(junit(result, broken, late, str(args.trace)))
    if args.github:
        from mddag_executor.report.ci import annotation_lines
        graph = None if args.graph in (None, '-') else str(args.graph)
        for line in annotation_lines(result, broken, late, graph):
            print(line, file=sys.stdout if common.wants_tables(args) else sys.stderr)
    return exit_status(args, result, str(args.trace))


def exit_status(
    args: argparse.Namespace, result: Mapping[str, Any], place: str, remedy: str = _NEVER_DUE
) -> int:
    """
    Return the exit status that `--fail-on-miss` asks for.

    If no job was due, nothing has shown that deadlines hold: that is a failure, and is reported.
    The same holds for each requirement of a path without a result.
    """
    if not args.fail_on_miss:
        return 0
    dags, requirements = result['dags'], result.get('requirements', {})
    late = not_met(requirements)
    never = [f'path {name}: {reason}' for (name, what), reason in late.items()
             if is_never_due(requirements[name][what])]
    if not total(dags).due and (never or not requirements):
        return unproven(place, NOTHING_DUE, remedy)
    if never:
        return unproven(place, listed(never), _NEVER_ARRIVED)
    return int(bool(late or total(dags).due and not_tolerated(dags)))


def check_judged(dags: Mapping[str, Any], place: str) -> None:
    """Raise an error if a declaration has sinks with deadlines, and no job was due at any."""
    if never_due(dags) and not total(dags).due:
        raise InputError(place, NOTHING_DUE, _NEVER_DUE)


def unproven(place: str, what: str, remedy: str = _NEVER_DUE) -> int:
    """Say that a run proves nothing about deadlines; return the exit status."""
    print(f'error: {one_line(f"{place}: {what}: {remedy}")}', file=sys.stderr)
    return 1

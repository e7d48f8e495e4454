# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `replay`: a recorded run, or what the scheduler core would have done with it.

Without a graph the declaration in the trace judges.  A warning says what is missing of a damaged
trace; everything before the damage is used.

An ordinary bag (a folder with metadata.yaml, or one of its files) has no jobs; with a graph and
`--reschedule` its messages are the releases.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from mddag_executor.cli import common, options, recorded, verdicts
from mddag_executor.cli.text import printable, warn

EXAMPLE = """\
mddag replay run.mcap
mddag replay run.mcap graph.yaml --fail-on-miss
mddag replay run.mcap --reschedule --workers 2 --policy fifo --json result.json
mddag replay run.mcap --from 90s --to 100s --report part.html
mddag replay drive/ graph.yaml --reschedule --execution-times measured.json
mddag replay run.mcap --fail-on-miss --junit junit.xml"""

REMOVED_OPTIONS = {'--skip': 'it is --from now'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    options.add_recording(
        parser, "a recorded run, an MCAP file ('-': standard input); with --reschedule also an "
        'ordinary bag, which is a folder or a file')
    recorded.add_arguments(parser)
    add('--callbacks', action='store_true', help='also show a table of all callbacks')
    options.add(parser, '--fail-on-miss')
    add('--github', action='store_true',
        help='print an annotation for GitHub Actions for each sink that missed more deadlines '
        'than are tolerated')
    add('--junit', metavar='OUT.xml', type=options.Output,
        help="write JUnit XML, a test case for each sink ('-': to standard output)")
    options.add(parser, '--from', '--to', '--report', '--json')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.analysis.as_recorded import Replay
    common.recording_and_graph(args)
    recorded.check(args)
    outcome = recorded.outcome_of(args, recorded.source_of(args))
    drift = outcome.drift() if isinstance(outcome, Replay) else []
    warn(*outcome.warnings)
    result: dict[str, Any] = {**outcome.result()}
    if not args.reschedule:
        result['drift'] = [each.result() for each in drift]
    status = verdicts.judge(args, result)
    if args.report is not None:
        from mddag_executor.report.html import of_outcome
        common.write_report(args.report, of_outcome(outcome, result))
    common.show(args, result, _lines(args, result))
    if not args.fail_on_miss:
        verdicts.check_judged(result['dags'], str(args.trace))
    return status


def _lines(args: argparse.Namespace, result: dict[str, Any]) -> Iterator[str]:
    from mddag_executor.report.replays import (
        recorded_tables,
        summary,
        times_tables,
    )
    from mddag_executor.report.tables import drift_lines, sink_table
    if result['rescheduled'] and result['recorded'] is None:
        yield sink_table(result['dags'])
        yield from map(printable, result['notes'])
        yield ('transport, dispatch and other load are not in a bag: they are left out '
               '(--overheads)')
    elif result['rescheduled']:
        from mddag_executor.report.diff import compare_requirements, compare_sinks, sinks_table
        yield 'The recording (A) and the same rescheduled (B):'
        yield sinks_table(compare_sinks(result['recorded']['dags'], result['dags']))
        if result.get('requirements'):
            yield sinks_table(compare_requirements(result['recorded'], result), 'path')
    elif result['dags'] or 'recorded_callbacks' not in result:
        yield sink_table(result['dags'])
        yield from times_tables(result['dags'])
    yield from recorded_tables(result, args.callbacks)
    yield from summary(result)
    yield from drift_lines(result.get('drift', ()))

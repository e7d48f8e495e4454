# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `explain`: why each deadline of a recorded run was missed.

The run is judged as `replay` does it; `mddag_executor.analysis.causes` says what the causes are.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mddag_executor.cli import common, options, recorded, verdicts
from mddag_executor.cli.text import printable, warn
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.analysis.as_recorded import Replay
    from mddag_executor.results.replays import LatePath, MissedJob
    from msg_graph import TaskSet

EXAMPLE = """\
mddag explain run.mcap
mddag explain run.mcap --sink /fusion:publish --job 17
mddag explain run.mcap graph.yaml --json -"""

MOST_SHOWN = 20

REMOVED_OPTIONS = {'--skip': 'it is --from now'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    options.add_recording(parser, "a recorded run, an MCAP file ('-': standard input)")
    add('--sink', metavar='SINK',
        help='only jobs of this sink: /node:callback, or the end of its name, as tables show it')
    add('--job', type=options.not_negative_int, metavar='N',
        help='only the job with this number')
    options.add(parser, '--from', '--to', '--json')


def main(args: argparse.Namespace) -> int:
    common.recording_and_graph(args)
    source = recorded.source_of(args)
    if source.task_set is None:
        source.check_deadlines()
    outcome = recorded.as_recorded(source, 'explaining', begin=args.begin, end=args.end)
    sink = None if args.sink is None else _sink(args.sink, outcome.task_set)
    if args.job is not None:
        _check_job(args.job, outcome, sink)
    warn(*outcome.warnings)
    every = sink is None and args.job is None
    late_paths = outcome.requirements.breakdown() if every else {}
    result = outcome.explanation.result(sink, args.job, late_paths)
    common.show(args, result, (
        _lines(outcome, late_paths) if every else _job_lines(result['jobs'])))
    verdicts.check_judged(outcome.result()['dags'], str(args.trace))
    return 0


def _sink(name: str, task_set: TaskSet) -> int:
    """Return the global vertex of a sink, given by its name or a unique end of it."""
    from msg_graph.errors import did_you_mean, listed, quoted
    sinks = {v.name: i for i, v in enumerate(task_set.vertices) if v.deadline_ns is not None}
    found = [name] if name in sinks else [each for each in sinks if each.endswith(name)]
    if len(found) > 1:
        raise UsageError(f'--sink: {quoted(name)} fits {listed(found)}: write more of the name')
    if not found:
        raise UsageError(f'--sink: there is no sink {quoted(name)}: ' + did_you_mean(
            name, sinks, 'mddag graph check lists them'))
    return sinks[found[0]]


def _check_job(job: int, outcome: Replay, sink: int | None) -> None:
    """Check that a job is in the recording: one that leads to the sink, if that is given."""
    judged, vertices = outcome.judged, outcome.task_set.vertices
    dags = judged.jobs if sink is None else [judged.jobs[vertices[sink].dag]]
    numbers = {number for jobs in dags for number in jobs.number.tolist()}
    if job not in numbers:
        raise UsageError(
            f'--job: there is no job {job}' + (
                '' if sink is None else f' of {printable(vertices[sink].name)}') + (
                f': choose one from {min(numbers)} to {max(numbers)}' if numbers
                else ', since no job was released: leave --job out'))


def _lines(outcome: Replay, late_paths: dict[str, dict[str, LatePath]]) -> Iterator[str]:
    from mddag_executor.report.explained import (
        assumed_line,
        causes_line,
        causes_table,
        job_lines,
        paths_tables,
        sinks_table,
        stalls_table,
    )
    from mddag_executor.report.tables import verdicts_line
    explanation = outcome.explanation
    summary = explanation.summary()
    if summary['missed']:
        yield causes_table(summary)
        yield from assumed_line(summary)
        yield 'Where that time went:'
        yield sinks_table(explanation.mostly())
        if summary['stalls']:
            yield stalls_table(summary['stalls'], outcome.recording.start or 0)
        worst = explanation.worst()
        if worst is not None:
            yield from job_lines(worst)
    yield from paths_tables(late_paths)
    yield verdicts_line(outcome.tally.result()['dags'])
    yield from causes_line(summary)


def _job_lines(jobs: list[MissedJob]) -> Iterator[str]:
    from mddag_executor.report.explained import job_lines
    for each in jobs[:MOST_SHOWN]:
        yield from job_lines(each)
    if not jobs:
        yield 'no such job missed its deadline'
    elif len(jobs) > MOST_SHOWN:
        yield f'{len(jobs) - MOST_SHOWN} more: see --job or --json'

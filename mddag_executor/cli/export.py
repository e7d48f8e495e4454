# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `export`: a trace as a file for other tools.

The end of the file's name says which: `.pftrace` for Perfetto's viewer, `.csv` for spreadsheets,
`.parquet` for data frames.  The run is judged as `replay` does it, and recordings are of the same
kinds: traces of this executor, imported ones, and with `--reschedule` ordinary bags.
"""

from __future__ import annotations

import argparse
from pathlib import PurePath
from typing import TYPE_CHECKING

from mddag_executor.cli import common, options, recorded
from mddag_executor.cli.text import printable, warn
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.replay.run import Recording
    from mddag_executor.report.export import Target
    from msg_graph import TaskSet

EXAMPLE = """\
mddag export run.mcap -o run.pftrace
mddag export run.mcap graph.yaml -o jobs.csv --rows jobs
mddag export run.mcap -o executions.parquet
mddag export drive/ graph.yaml --reschedule --workers 4 -o drive.pftrace"""

FORMS = ('pftrace', 'csv', 'parquet')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    options.add_recording(
        parser, "a recorded run, an MCAP file ('-': standard input); with --reschedule also an "
        'ordinary bag, a folder or a file')
    add('-o', '--output', metavar='OUT.{pftrace,csv,parquet}', required=True,
        help='the file to write: for Perfetto (ui.perfetto.dev; needs mddag_executor[export]), '
        "as CSV ('-': CSV to standard output), or as Parquet (needs mddag_executor[export])")
    add('--rows', choices=('executions', 'jobs'),
        help='for CSV and Parquet: one row for each execution of a callback (default), or for '
        'each job at each sink')
    recorded.add_arguments(
        parser, 'export what the scheduler would have done with the recorded releases and '
        'execution times')


def main(args: argparse.Namespace) -> int:
    """
    Export a trace.

    :raises mddag_executor.trace.TraceError: when the trace cannot be used
    :raises msg_graph.GraphError: when the declaration is wrong
    :raises mddag_executor.errors.MddagError: when anything else cannot be used
    """
    from mddag_executor.report.export import check_available, target
    common.recording_and_graph(args)
    form = _form(args)
    common.check_output(args.output)
    check_available(form)
    task_set = None if args.graph is None else common.load_graph(args.graph)
    with common.input_recording(args.trace) as (path, name), \
            common.output_file(args.output) as file:
        warnings = _export(args, path, name, task_set, target(form, file, args.rows == 'jobs'))
    for warning in warnings:
        warn(warning)
    if args.output != '-':
        print(f'exported: {printable(args.output)}')
    return 0


def _export(
    args: argparse.Namespace, path: Recording, name: str, task_set: TaskSet | None, target: Target
) -> list[str]:
    """Write what a recording holds; return what is missing or doubtful of it."""
    from mddag_executor.report.export import Exporter
    exporter = Exporter(target)
    if args.reschedule or recorded.is_bag(path):
        computed = recorded.rescheduled(args, path, name, task_set)
        exporter.of_computed(computed.computed())
        return computed.warnings
    if args.rows == 'jobs' and task_set is None:
        recorded.check_declared(path, name)
    outcome = recorded.as_recorded(path, name, task_set, exporter.of, doing='exporting')
    exporter.finish()
    return outcome.warnings


def _form(args: argparse.Namespace) -> str:
    """Return what is to be written."""
    if args.trace == '-' and args.graph == '-':
        raise UsageError('-: standard input can be only one of TRACE and GRAPH: name the other')
    form = 'csv' if args.output == '-' else PurePath(args.output).suffix[1:].lower()
    if form not in FORMS:
        raise UsageError(
            f'-o {args.output}: it is not known what to write: let the name end in '
            f'{", ".join("." + each for each in FORMS[:-1])} or .{FORMS[-1]}')
    if form == 'pftrace' and args.rows is not None:
        raise UsageError('--rows: Perfetto gets both, executions and jobs: leave it out')
    recorded.check(args, args.trace, args.graph)
    return form

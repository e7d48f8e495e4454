# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `export`: a trace as a file for other tools.

The end of the file's name says which: `.pftrace` for Perfetto's viewer, `.csv` for spreadsheets,
`.parquet` for data frames, `.foxglove.mcap` for Foxglove, Lichtblick and PlotJuggler.  The run is
judged as `replay` does it, and recordings are of the same kinds: traces of this executor, imported
ones, and with `--reschedule` ordinary bags.  A name that ends in `/` is a folder, for a session as
LTTng records it, with the events of the trace as they are.
"""

from __future__ import annotations

import argparse
from pathlib import PurePath
from typing import TYPE_CHECKING

from mddag_executor.cli import common, options, recorded
from mddag_executor.cli.text import printable, Progress, warn
from mddag_executor.errors import UsageError

if TYPE_CHECKING:
    from mddag_executor.replay.run import Recording
    from mddag_executor.report.export import Target
    from msg_graph import TaskSet

EXAMPLE = """\
mddag export run.mcap -o run.pftrace
mddag export run.mcap graph.yaml -o jobs.csv --rows jobs
mddag export run.mcap -o executions.parquet
mddag export run.mcap -o run.foxglove.mcap
mddag export run.mcap -o session/
mddag export drive/ graph.yaml --reschedule --workers 4 -o drive.pftrace"""

FORMS = {'.pftrace': 'pftrace', '.csv': 'csv', '.parquet': 'parquet', '.foxglove.mcap': 'mcap'}
_FOXGLOVE, _FOLDER = 'mcap', 'folder'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    options.add_recording(
        parser, "a recorded run, an MCAP file ('-': standard input); with --reschedule also an "
        'ordinary bag, a folder or a file')
    add('-o', '--output', metavar='OUT', type=options.Export, required=True,
        help='the file to write: OUT.pftrace for Perfetto (ui.perfetto.dev; needs '
        "mddag_executor[export]), OUT.csv ('-': CSV to standard output), OUT.parquet (needs "
        'mddag_executor[export]), OUT.foxglove.mcap with a layout OUT.foxglove.json, or OUT/, a '
        'new folder in the Common Trace Format (babeltrace2, Trace Compass, tracetools_analysis)')
    add('--caret', action='store_true',
        help="with OUT/: the events that CARET's analysis takes, with what its tracer sees filled "
        'in, instead of those of the trace')
    add('--rows', choices=('executions', 'jobs'),
        help='for CSV and Parquet: one row for each execution of a callback (default), or for '
        'each job at each sink')
    recorded.add_arguments(
        parser, 'export what the scheduler would have done with the recorded releases and '
        'execution times')
    options.add(parser, '--overwrite')


def main(args: argparse.Namespace) -> int:
    """Export a trace."""
    from mddag_executor.report.export import check_available, layout_of, target
    common.recording_and_graph(args)
    form = _form(args)
    if form == _FOLDER:
        return _export_session(args)
    common.check_output(args.output, form == _FOXGLOVE, args.overwrite)
    check_available(form)
    with recorded.opened(args) as (path, name, task_set), \
            common.output_file(args.output) as file:
        writes = target(form, file, args.rows == 'jobs')
        try:
            warnings = _export(args, path, name, task_set, writes)
        except BaseException:
            writes.abandon()
            raise
    warn(*warnings)
    if form == _FOXGLOVE:
        common.write_json(str(PurePath(args.output).with_suffix('.json')), layout_of(writes))
    if args.output != '-':
        print(f'exported: {printable(args.output)}')
    return 0


def _export(
    args: argparse.Namespace, path: Recording, name: str, task_set: TaskSet | None, target: Target
) -> list[str]:
    """Write what a recording holds; return what is missing or doubtful of it."""
    from mddag_executor.replay import Reschedule
    from mddag_executor.report.export import Exporter
    exporter = Exporter(target)
    if args.rows == 'jobs' and task_set is None and not args.reschedule:
        recorded.check_declared(path, name)
    outcome = recorded.outcome_of(
        args, path, name, task_set, args.reschedule, exporter.of, 'exporting')
    if isinstance(outcome, Reschedule):
        exporter.of_computed(outcome.computed())
    else:
        exporter.finish()
    return outcome.warnings


def _export_session(args: argparse.Namespace) -> int:
    """Write a session in the Common Trace Format."""
    from mddag_executor.replay import caret_events
    from mddag_executor.trace.ctf_out import export_ctf, export_dicts
    if args.graph is not None or args.reschedule or args.rows is not None:
        raise UsageError(
            f'-o {args.output}: a session has the events of the trace as they are: leave GRAPH, '
            '--reschedule and --rows out')
    if not isinstance(args.trace, str):
        raise UsageError(f'-o {args.output}: a session has the events of one trace: name one')
    with common.input_recording(args.trace) as (path, name), Progress('exporting') as line:
        if args.caret:
            export_dicts(caret_events(path), args.output, line.events)
        else:
            warn(*export_ctf(path, args.output, name=name, progress=line.events))
    print(f'exported: {printable(args.output)}')
    return 0


def _form(args: argparse.Namespace) -> str:
    """Return what is to be written."""
    if args.output.endswith('/'):
        return _FOLDER
    if args.caret:
        raise UsageError("--caret: it is for a folder: let the name of -o end in '/'")
    name = PurePath(args.output).name.lower()
    form = 'csv' if args.output == '-' else next(
        (form for ending, form in FORMS.items() if name.endswith(ending)), None)
    if form is None:
        raise UsageError(
            f'-o {args.output}: it is not known what to write: let the name end in '
            f'{", ".join(FORMS)} or /')
    if form in ('pftrace', _FOXGLOVE) and args.rows is not None:
        raise UsageError(
            f'--rows: a .{form} gets both, executions and jobs: leave the option out')
    recorded.check(args)
    return form

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The verb `export`: a recording as a file for other tools.

The end of the file's name says which: `.pftrace` for Perfetto's viewer, `.csv` for spreadsheets,
`.parquet` for data frames.  A name that ends in `/` is a folder for the tables of the
recording and of its results, one Parquet file for each.  The run is judged as
`replay` does it.
"""

from __future__ import annotations

import argparse
from pathlib import PurePath

from mddag_executor.cli import common, options, recorded
from mddag_executor.cli.text import printable, say, warn
from mddag_executor.errors import UsageError
from mddag_executor.output_rules import check_output

EXAMPLE = """\
mddag export run.mcap -o run.pftrace
mddag export run.mcap graph.yaml -o jobs.csv --rows jobs
mddag export run.mcap -o executions.parquet --from 90s --to 100s
mddag export run.mcap -o tables/"""

_TABLES = 'tables'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    options.add_recording(
        parser, "a recorded run, an MCAP file ('-': standard input)")
    add('-o', '--output', metavar='OUT', type=options.Export, required=True,
        help="the file to write: OUT.pftrace for Perfetto (ui.perfetto.dev), OUT.csv ('-': CSV to "
        'standard output), OUT.parquet, or OUT/, a folder with a Parquet file for each table of '
        'the recording and its results (Parquet needs mddag_executor[export])')
    add('--rows', choices=('executions', 'jobs'),
        help='for CSV and Parquet: one row for each execution of a callback (default), or for '
        'each job at each sink')
    options.add(parser, '--from', '--to')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.report.export import check_available, table_files, write, write_tables
    common.recording_and_graph(args)
    form = _form(args)
    check_available(form)
    if form == _TABLES:
        common.check_folder(args.output, table_files())
    else:
        check_output(args.output)
    source = recorded.source_of(args)
    if args.rows == 'jobs' and source.task_set is None:
        source.check_deadlines()
    replay = recorded.as_recorded(source, 'exporting', begin=args.begin, end=args.end)
    if form == _TABLES:
        with common.output_folder(args.output, table_files()) as folder:
            write_tables(replay, folder)
    else:
        with common.output_file(args.output) as file:
            write(form, file, replay, args.rows or 'executions')
    warn(*replay.warnings)
    if args.output != '-':
        say(f'exported: {printable(args.output)}')
    return 0


def _form(args: argparse.Namespace) -> str:
    from mddag_executor.report.export import FORMS
    form = 'csv' if args.output == '-' else PurePath(args.output).suffix[1:].lower()
    if args.output.endswith('/'):
        form = _TABLES
    if form not in (*FORMS, _TABLES):
        raise UsageError(
            f'-o {args.output}: it is not known what to write: let the name end in '
            f'{", ".join("." + each for each in FORMS)} or /')
    if form in ('pftrace', _TABLES) and args.rows is not None:
        raise UsageError(
            f'--rows: {"a .pftrace gets" if form == "pftrace" else "the tables are"} both, '
            'executions and jobs: leave the option out')
    return form

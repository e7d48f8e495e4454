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
The verb `export`: a trace as a file for other tools.

The end of the file's name says which: `.pftrace` for Perfetto's viewer, `.csv` for spreadsheets,
`.parquet` for data frames.  The run is judged as `replay` does it.
"""

from __future__ import annotations

import argparse
from pathlib import PurePath
import sys

from mddag_executor.cli import common
from mddag_executor.cli.text import one_line, printable, Progress
from mddag_executor.errors import UsageError

NAME = 'export'
HELP = 'turn a trace into a file for Perfetto, spreadsheets or data frames'
EXAMPLE = """\
mddag export run.mcap -o run.pftrace
mddag export run.mcap graph.yaml -o jobs.csv --rows jobs
mddag export run.mcap -o executions.parquet"""

FORMS = ('pftrace', 'csv', 'parquet')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('trace', metavar='TRACE', help="a recorded run, an MCAP file ('-': standard input)")
    add('graph', metavar='GRAPH', nargs='?',
        help="the declaration that judges, a YAML file ('-': standard input; default: the one "
        'that the trace was recorded with)')
    add('-o', '--output', metavar='OUT.{pftrace,csv,parquet}', required=True,
        help='the file to write: for Perfetto (ui.perfetto.dev; needs mddag_executor[export]), '
        "as CSV ('-': CSV to standard output), or as Parquet (needs mddag_executor[export])")
    add('--rows', choices=('executions', 'jobs'),
        help='for CSV and Parquet: one row for each execution of a callback (default), or for '
        'each job at each sink')


def main(args: argparse.Namespace) -> int:
    """
    Export a trace.

    :raises mddag_executor.trace.TraceError: when the trace can not be used
    :raises msg_graph.GraphError: when the declaration is wrong
    :raises mddag_executor.errors.MddagError: when anything else can not be used
    """
    from mddag_executor.report.export import check_available, Exporter, target
    form = _form(args)
    common.check_output(args.output)
    check_available(form)
    task_set = None if args.graph is None else common.load_graph(args.graph)
    with common.input_trace(args.trace) as (path, name), \
            common.output_file(args.output) as file, Progress('exporting') as line:
        from mddag_executor.replay import replay
        exporter = Exporter(target(form, file, args.rows == 'jobs'))
        outcome = replay(
            path, task_set, name=name, watcher=exporter,
            progress=lambda events: line.update(round(events / 1e6, 1), 'million events'))
        exporter.finish()
    for warning in outcome.warnings:
        print(f'warning: {one_line(warning)}', file=sys.stderr)
    if args.output != '-':
        print(f'exported: {printable(args.output)}')
    return 0


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
    return form

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `import ctf`: a recording of CARET or ros2_tracing becomes a trace."""

from __future__ import annotations

import argparse

from mddag_executor.cli import options
from mddag_executor.cli.text import printable, Progress, say, warn
from mddag_executor.text import counted

DESCRIPTION = """\
Turn a session that LTTng recorded (with CARET or ros2_tracing) into a trace, with all its
processes and events. No other program is needed. Several sessions of one run, of one or several
computers, become one trace. A damaged session is read up to the damage."""
EXAMPLE = """\
mddag import ctf ~/.ros/tracing/session-20261121101500 -o drive.mcap
mddag replay drive.mcap graph.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'session', metavar='SESSION', nargs='+',
        help='the folder that was recorded to; if a run had several computers, name the folder of '
        'each')
    parser.add_argument('-o', '--output', metavar='OUT.mcap', required=True, type=options.Trace,
                        help='the trace to write')
    options.add(parser, '--overwrite')


def main(args: argparse.Namespace) -> int:
    from mddag_executor.trace import import_ctf
    with Progress('importing') as line:
        imported = import_ctf(
            args.session, args.output, overwrite=args.overwrite,
            progress=lambda events: line.update(events, 'events'))
    warn(*imported.warnings)
    say(f'{counted(imported.events, "event")} of {counted(imported.kinds, "kind")} from '
          f'{counted(len(imported.processes), "process", "processes")}: {printable(args.output)}')
    return 0

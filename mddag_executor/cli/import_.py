# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `import`: recordings of other tools become traces."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from mddag_executor.cli import common
from mddag_executor.cli.text import printable, Progress, warn
from mddag_executor.errors import UsageError
from mddag_executor.text import counted

if TYPE_CHECKING:
    from mddag_executor.trace import Imported

EXAMPLE = """\
mddag import ctf ~/.ros/tracing/session-20261121101500 -o drive.mcap
mddag replay drive.mcap graph.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the formats and their arguments."""
    formats = parser.add_subparsers(
        dest='format', metavar='FORMAT', required=True, title='formats')
    ctf = formats.add_parser(
        'ctf', help='a session that LTTng recorded', allow_abbrev=False,
        description='Turn a session that LTTng recorded (CARET, ros2_tracing), all its processes '
        'and events, into a trace. It is read with the Python bindings of babeltrace2 '
        '(apt install python3-bt2), in whichever Python of this machine has them.',
        epilog='example:\n  ' + EXAMPLE.replace('\n', '\n  '),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    ctf.add_argument('session', metavar='SESSION', help='the folder that was recorded to')
    ctf.add_argument('-o', '--output', metavar='OUT.mcap', required=True,
                     help='the trace to write')


def main(args: argparse.Namespace) -> int:
    """Import a session and say what was in it."""
    if args.output == '-':
        raise UsageError('-o -: a trace is not written to standard output: name a file')
    common.check_output(args.output)
    imported = _import(args.session, args.output)
    for warning in imported.warnings:
        warn(warning)
    print(f'{counted(imported.events, "event")} of {counted(imported.kinds, "kind")} from '
          f'{counted(len(imported.processes), "process", "processes")}: {printable(args.output)}')
    if imported.unread:
        named = ', '.join(f'{printable(provider)} ({count})'
                          for provider, count in imported.unread.most_common())
        print(f'replay does not use the events of these providers: {named}')
    return 0


def _import(session: str, output: str) -> Imported:
    """Write the trace as a whole or not at all."""
    from mddag_executor.trace import import_ctf, TraceError
    with common.output_file(output) as file, Progress('importing') as line:
        try:
            return import_ctf(session, file.name,
                              progress=lambda events: line.update(events, 'events'))
        except TraceError as error:
            if error.file != file.name:
                raise
            raise TraceError(output, error.problem, error.remedy) from None

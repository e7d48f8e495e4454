# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The verb `graph draw`: the DAGs of a declaration as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path
import shutil

from mddag_executor.cli import common, options
from mddag_executor.cli.text import one_line, run_program
from mddag_executor.errors import InputError, UsageError

EXAMPLE = """\
mddag graph draw config/autoware.yaml -o autoware.svg
mddag graph draw config/autoware.yaml -o autoware.mmd
"""
DESCRIPTION = """\
Draw the DAGs of a declaration, each in a frame. Timers are ellipses, subscriptions rounded boxes,
sync callbacks hexagons, services parallelograms. Sinks have a double border and their deadline.
Solid arrows are trigger edges with their topics (tool tips in graphs of more than 30 callbacks).
Dotted arrows are queue edges; they begin at the name of the data and of its writer. The colour
is the RAD offset: the time from the release of a job to the earliest deadline that a callback
leads to; red is the most urgent. DAGs are in the order of the file, many of them in a grid.

The ending of OUT selects the format: .svg, .png and .pdf need Graphviz (Debian, Ubuntu:
'sudo apt install graphviz'); .dot (Graphviz's language) and .mmd (Mermaid) need nothing.
Mermaid viewers limit the size: raise maxEdges and maxTextSize there for large graphs.
Graphs of more than 1000 vertices, or of ten arrows for each, get straight lines, and a PNG at most
16000 dots in a row."""

_BY_GRAPHVIZ = ('.svg', '.png', '.pdf')
_ENDINGS = (*_BY_GRAPHVIZ, '.dot', '.mmd')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add(parser, 'graph')
    parser.add_argument(
        '-o', '--output', metavar='OUT', type=options.Output, required=True,
        help=f'the picture; its name ends in {", ".join(_ENDINGS)}')


def main(args: argparse.Namespace) -> int:
    ending = Path(args.output).suffix.lower()
    if ending not in _ENDINGS:
        raise UsageError(
            f'{args.output}: unsupported file extension: use one of {", ".join(_ENDINGS)}')
    program = _find_dot(args.output) if ending in _BY_GRAPHVIZ else ''
    task_set = common.load_graph(args.graph)
    from mddag_executor.report.picture import picture
    drawn = picture(task_set)
    if ending == '.mmd':
        from mddag_executor.report.mermaid import to_mermaid
        common.write_text(args.output, to_mermaid(drawn))
        return 0
    from mddag_executor.report.dot import to_dot
    text = to_dot(drawn)
    if ending == '.dot':
        common.write_text(args.output, text)
    else:
        data = _render(program, text, ending[1:], args.output)
        with common.output_file(args.output) as file:
            file.write(data)
    return 0


def _find_dot(output: str) -> str:
    program = shutil.which('dot')
    if program is None:
        raise InputError(
            output, "this needs Graphviz, whose program 'dot' was not found",
            "install it with 'sudo apt install graphviz', or name an OUT.dot or OUT.mmd")
    return program


def _render(program: str, text: str, kind: str, output: str) -> bytes:
    done = run_program(
        [program, f'-T{kind}'], 'drawing', given=text.encode(),
        slow=f'{output}: Graphviz takes long, perhaps hours if arrows cross many others: wait, or '
        'end it with Ctrl-C and write OUT.dot or OUT.mmd instead')
    if done.returncode != 0:
        said = one_line(done.stderr.decode('utf-8', 'replace')) or f'status {done.returncode}'
        raise InputError(output, f'Graphviz failed ({said})',
                         "write OUT.dot and try other programs on it, for instance 'sfdp'")
    return done.stdout

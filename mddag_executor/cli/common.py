# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Files of the verbs: reading files and standard input, and writing results (see also `options`).

`check_output` is called before long work starts, so a mistyped path costs nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import sys
from typing import Any, BinaryIO, cast, TYPE_CHECKING, TypeVar

from mddag_executor import __version__
from mddag_executor.cli.options import Input, NamedFile, Output, Report
from mddag_executor.cli.text import is_quiet, warn
from mddag_executor.errors import InputError, UsageError
from mddag_executor.output_rules import (
    check_distinct,
    check_output,
    check_parent,
    check_results,
    is_declaration,
    remove_results,
    whole_file,
)
from mddag_executor.text import listed

if TYPE_CHECKING:
    from mddag_executor.report.html_data import ReportData
    from mddag_executor.sources.open import Traces
    from msg_graph import TaskSet

R = TypeVar('R', bound='str | Traces')
FORMAT = 2
"""Version of the results for machines; a change of the meaning of a key raises it."""
STDIN = '<stdin>'
MOST_BYTES = 64 << 20
"""The largest declaration, architecture file or table of execution times."""
_copy: Any = None  # of standard input


def read_text(path: str) -> tuple[str, str]:
    """Return the name for messages and the text of a file, or of standard input for `-`."""
    if path != '-':
        name = path
        with open(path, 'rb') as file:
            data = file.read(MOST_BYTES + 1)
    else:
        name, data = STDIN, _stdin().read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise InputError(name, f'it is larger than {MOST_BYTES >> 20} MiB', 'name the right file')
    try:
        return name, data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        line = data.count(b'\n', 0, error.start) + 1
        raise InputError(name, 'this is not UTF-8 text', 'save the file as UTF-8',
                         line=line) from None


def load_graph(path: str) -> TaskSet:
    """Return the task set that a declaration gives, from a file or from standard input for `-`."""
    import msg_graph
    if path != '-':
        return msg_graph.load(path)
    name, text = read_text(path)
    return msg_graph.loads(text, name=name)


def input_path(given: R) -> tuple[R | str, str]:
    """
    Return the path of a file or recording, and its name for messages.

    Standard input (`-`) is copied to a file without a name, which can be read more than once.
    """
    global _copy
    if given != '-':
        return given, str(given)  # as the user wrote it: pathlib would change ./a
    import shutil
    import tempfile
    source, _copy = _stdin(), tempfile.TemporaryFile()
    shutil.copyfileobj(source, _copy, 1 << 20)
    _copy.flush()
    return f'/proc/self/fd/{_copy.fileno()}', STDIN


def recording_and_graph(args: argparse.Namespace) -> None:
    """
    Separate TRACE… from GRAPH, which `options.add_recording` leaves together.

    The last one is the declaration if it is named like one, or is standard input.
    """
    traces = args.trace
    if len(traces) > 1 and (traces[-1] == '-' or is_declaration(traces[-1])):
        *traces, args.graph = traces
    args.trace = one_run(traces, args.offset)


def leave_out_paths(doing: str, *task_sets: TaskSet) -> None:
    """Warn that a verb leaves out what is required of paths."""
    names = [path.name for task_set in task_sets for path in task_set.paths if path.requirements]
    if names:
        warn(f'{doing}: the requirements of paths are left out, only deadlines of sinks count: '
             + listed(names))


def one_run(paths: Sequence[str], offsets: Sequence[tuple[str, int]]) -> str | Traces:
    """
    Return the one recording that is given, or the several traces of one run.

    One folder means all traces in it, as `mddag run --trace FOLDER` writes them.
    """
    if len(paths) == 1:
        paths = _traces_in(paths[0])
    if len(paths) == 1:
        if offsets:
            raise UsageError('--offset: one trace has one clock: give the traces of all '
                             'processes, or leave the option out')
        return paths[0]
    if '-' in paths:
        raise UsageError('-: of several traces none can be standard input: name them')
    from mddag_executor.sources.open import Traces
    return Traces(paths, dict(offsets))


def _traces_in(path: str) -> Sequence[str]:
    if os.path.isdir(path):
        from mddag_executor.sources.kinds import is_ordinary
        names = os.listdir(path)
        found = sorted(name for name in names if name.endswith('.mcap'))
        if found and 'metadata.yaml' not in names and not is_ordinary(path):
            return [os.path.join(path, name) for name in found]
    return [path]


def _stdin() -> BinaryIO:
    if sys.stdin is None:
        raise UsageError("-: there is no standard input: name a file instead of '-'")
    return cast(BinaryIO, getattr(sys.stdin, 'buffer', sys.stdin))


def check_files(args: argparse.Namespace) -> None:
    """Check that the files of a command line can be written (see `output_rules`)."""
    for kind, stream in ((Input, 'input'), (Output, 'output')):
        same = sorted(name for name, each in _files(args)
                      if isinstance(each, kind) and each == '-')
        if len(same) > 1:
            raise UsageError(f'-: {" and ".join(same)} cannot all be standard {stream}: '
                             'name a file for all but one')
    check_distinct(*([(name, each) for name, each in _files(args)
                      if isinstance(each, kind) and each != '-'] for kind in (Input, Output)))
    for name, each in _files(args):
        if isinstance(each, NamedFile) and each == '-':
            raise UsageError(f'--{name} -: it cannot be written to standard output: name a file')
        if isinstance(each, Output) and each.checked_early:
            check_output(each, each.is_kept, getattr(args, 'overwrite', False))
        if isinstance(each, Report):
            _check_report(each)


def _files(args: argparse.Namespace) -> Iterator[tuple[str, Input | Output]]:
    for name, value in vars(args).items():
        for each in value if isinstance(value, list) else (value,):
            if isinstance(each, (Input, Output)):
                yield name.replace('_', ' '), each


def _check_report(path: Report) -> None:
    # `replay run.mcap --report graph.yaml` must not replace a declaration.
    if os.path.splitext(path)[1].lower() not in ('', '.html', '.htm'):
        raise UsageError(f'--report {path}: a report is an HTML file: let its name end in .html')


@contextmanager
def output_file(path: str) -> Iterator[BinaryIO]:
    """Give a binary file that becomes `path` (`-`: standard output) if the block ends well."""
    if path == '-':
        sys.stdout.flush()
        yield cast(BinaryIO, sys.stdout.buffer)
        sys.stdout.buffer.flush()
        return
    with whole_file(path) as file:
        yield file


def check_folder(path: str, names: Collection[str]) -> None:
    """Find out whether a folder of results with files of these names can be written."""
    check_results(Path(path), names)
    check_parent(path)


@contextmanager
def output_folder(path: str, names: Collection[str]) -> Iterator[Path]:
    """Give a folder that becomes `path` when the block ends well, and vanishes otherwise."""
    target = Path(path).resolve()   # a symbolic link stays one
    part = target.with_name(f'.{target.name}.part')
    remove_results(part, names)     # of a command that was killed
    part.mkdir()
    try:
        yield part
        remove_results(target, names)
        part.rename(target)
    except BaseException as error:
        remove_results(part, names)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = path  # a full disk
        raise


def write_text(path: str, text: str) -> None:
    """Write a text file as a whole, or to standard output for `-`."""
    with output_file(path) as file:
        file.write(text.encode('utf-8', 'surrogateescape'))


def write_json(path: str, value: Any) -> None:
    """Write a result for machines as a whole, or to standard output for `-`."""
    import json
    encoder = json.JSONEncoder(indent=2, allow_nan=False, default=_plain)
    with output_file(path) as file:
        file.writelines(part.encode() for part in encoder.iterencode(value))
        file.write(b'\n')


def _plain(value: Any) -> Any:
    if hasattr(value, 'tolist'):  # numpy's scalars and arrays
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f'{type(value).__name__} has no JSON form')


def write_report(path: str, data: ReportData) -> None:
    """Write an HTML report as a whole."""
    from mddag_executor.report.html import write
    with output_file(path) as file:
        write(file, data)


def write_result(args: argparse.Namespace, result: Any) -> bool:
    """Write a result and its versions to the file of `--json`; return whether to show tables."""
    if args.json is not None:
        head = {'mddag': __version__, 'format': FORMAT}
        write_json(args.json, {**head, **result} if isinstance(result, Mapping) else result)
    return wants_tables(args)


def show(
    args: argparse.Namespace, result: Any, lines: Iterable[str], tables_to_stderr: bool = False
) -> None:
    """
    Write a result to the file of `--json`, and print its lines if people read the output.

    The lines are also printed if the file cannot be written: a run is not lost with it.

    :param tables_to_stderr: if the file of `--output` is standard output, print the lines on
        standard error.
    """
    tables_to_stderr = tables_to_stderr and args.output == '-' and not is_quiet()
    try:
        write_result(args, result)
    finally:
        if wants_tables(args) or tables_to_stderr:
            for line in lines:
                print(line, file=sys.stderr if tables_to_stderr else sys.stdout)


def wants_tables(args: argparse.Namespace) -> bool:
    """Return whether standard output is for people, and not taken by a result."""
    return not is_quiet() and not is_output_taken(args)


def is_output_taken(args: argparse.Namespace) -> bool:
    """Return whether a result takes standard output."""
    return any(isinstance(each, Output) and each == '-' for _, each in _files(args))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The kinds of recorded files: the first bytes of a file, not its name, say what it is."""

from __future__ import annotations

import os
from pathlib import Path
import re

from mddag_executor.errors import InputError
from mddag_executor.trace import TraceReader
from mddag_executor.trace.blocks import other_kind
from mddag_executor.trace.errors import unreadable

METADATA = 'metadata.yaml'
MCAP, SQLITE, ZSTD = b'\x89MCAP0\r\n', b'SQLite format 3\0', b'\x28\xb5\x2f\xfd'
REMEDY = 'give a folder with metadata.yaml that ros2 bag record wrote, or one of its files'
BAG_FILE = re.compile(r'.*\.(mcap|db3)(\.zstd)?')


class BagError(InputError):
    """A bag that cannot be used; its text is `FILE: what is wrong: what to do`."""


def is_ordinary(path: str) -> bool:
    """
    Return whether a path is a bag without traced events, so without jobs.

    :raises mddag_executor.trace.TraceError: if a folder cannot be read.
    """
    files, is_bag = [path], False
    if os.path.isdir(path):
        names = names_in(path)
        files = [os.path.join(path, name) for name in names if BAG_FILE.fullmatch(name)]
        is_bag = METADATA in names     # even if its files are damaged or gone
    found = [_trace_or_bag(file) for file in files]
    return (is_bag or any(found)) and not any(isinstance(each, TraceReader) for each in found)


def names_in(folder: str) -> list[str]:
    """Return the names of the files in a folder."""
    try:
        return os.listdir(folder)
    except OSError as error:
        raise unreadable(folder, error) from None


def opened_trace(path: str) -> TraceReader | None:
    """Return the trace in a file; None for other files, and for damage."""
    found = _trace_or_bag(path)
    return found if isinstance(found, TraceReader) else None


def _trace_or_bag(path: str) -> TraceReader | bool:
    """Return the trace in a file, else whether it is a bag; what is left of a trace is none."""
    try:
        if kind_of(Path(path)) != MCAP:
            return True
        reader = TraceReader(path)
        return reader if reader.written_here or reader.has_events() else True
    except InputError:
        return False


def kind_of(file: Path) -> bytes:
    """Return the first bytes of a bag file, which say its kind."""
    try:
        if not file.is_file():
            raise BagError(str(file), 'is not a file', REMEDY)
        with open(file, 'rb') as stream:
            head = stream.read(32)
    except OSError as error:
        raise BagError(str(file), f'cannot be read ({error.strerror})', REMEDY) from None
    except ValueError:
        raise BagError(str(file), 'is not a file name', REMEDY) from None
    for kind in (MCAP, SQLITE, ZSTD):
        if head.startswith(kind):
            return kind
    raise BagError(str(file), *(other_kind(head) or ('is not a rosbag2 recording', REMEDY)))

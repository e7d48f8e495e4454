# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
What an output may replace: the one rule for all verbs and for the Python API.

1. A recording cannot be made again, and a declaration may have been edited. So a new recording or
   declaration replaces no file unless the user asks for it: `--overwrite` on the command line,
   `overwrite=True` in Python. No other output replaces a file that holds a recording or is named
   like a declaration. A recording that is still being written is never replaced, as two writers of
   one file would damage both recordings: the writer locks the file (`flock`) until it closes it.
2. An output is never an input of the same command, and no two outputs are the same file.
3. Other results (tables, pictures) replace what was there, as with every tool.
4. Pipes, devices and empty files hold nothing that could be lost.
5. A folder of results replaces a folder that is empty or holds files with the names of such
   results only: those of an earlier command, or what a killed one left. Other folders stay.
6. A result is written to a temporary file in the folder of its target, which is renamed when it is
   complete. So an interrupted or failed run leaves no incomplete file, and an earlier file intact.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
import fcntl
from itertools import count
import os
from pathlib import Path
import stat
from typing import BinaryIO, cast

from mddag_executor.errors import InputError, UsageError

EXISTS = 'there is a file already'
IS_WRITTEN = 'another run is writing this file'
REMEDY_IF_WRITTEN = 'name another file, or end that run first'
REMEDY = 'name another file, or replace this one with --overwrite (in Python overwrite=True)'
_RECORDINGS = (b'\x89MCAP', b'SQLite format 3\0')
_ENDINGS = ('.mcap', '.db3')
_DECLARATIONS = ('.yaml', '.yml')


def check_replaced(path: str, *, is_kept: bool, overwrite: bool = False) -> None:
    """
    Raise InputError if an output may not replace an existing file (rule 1).

    :param is_kept: whether the output is a recording or a declaration.
    """
    if is_kept and _is_locked(path):
        raise InputError(path, IS_WRITTEN, REMEDY_IF_WRITTEN)
    if overwrite or not holds_data(path):
        return
    if is_kept:
        raise InputError(path, EXISTS, REMEDY)
    for what, is_such in (('recording', is_recording), ('declaration', is_declaration)):
        if is_such(path):
            raise InputError(path, f'this file is a {what}', 'name another file for the result')


def check_output(path: str | None, is_kept: bool = False, overwrite: bool = False) -> None:
    """
    Check that a file can be written: `-` always.

    :param is_kept: whether it is a recording or a declaration, which may need `overwrite`.
    """
    if path is None or path == '-':
        return
    if os.path.isdir(path) or path.endswith('/'):
        raise InputError(path, 'this is a directory', 'name a file')
    if not is_special(path):
        check_parent(path)
        check_replaced(path, is_kept=is_kept, overwrite=overwrite)


def check_parent(path: str) -> None:
    """Raise InputError if there is no folder for an output that can be written to."""
    # not by Path.resolve, which raises if links lead in a circle
    folder = os.path.dirname(os.path.realpath(path))
    if not os.path.isdir(folder):
        raise InputError(path, f'there is no directory {Path(path).parent}', 'make it first')
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(path, 'the directory cannot be written to', 'name another one')


def create_recording(path: str, overwrite: bool = False) -> BinaryIO:
    """
    Open a new recording for writing, unbuffered, and lock it (rule 1).

    :raises FileExistsError: if it would replace a file.
    :raises BlockingIOError: if another writer has locked it.
    """
    try:
        stream = cast(BinaryIO, open(path, 'xb', buffering=0))
    except FileExistsError:
        if not overwrite and holds_data(path):
            raise
        if is_special(path):
            return cast(BinaryIO, open(path, 'wb', buffering=0))
        # not emptied before it is locked
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
        stream = cast(BinaryIO, open(number, 'wb', buffering=0))
    if not _lock(stream, fcntl.LOCK_EX):
        stream.close()
        raise BlockingIOError
    stream.truncate()
    return stream


def close_recording(stream: BinaryIO) -> None:
    """
    Close a new recording, and unlock it: a forked process may have it open as well.

    A second call does nothing.
    """
    if stream.closed:
        return
    with suppress(OSError):
        fcntl.flock(stream, fcntl.LOCK_UN)
    stream.close()


def _lock(file: BinaryIO, kind: int) -> bool:
    """Lock a file; return False if its writer has locked it."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:     # this file system has no locks
        pass
    return True


def _is_locked(path: str) -> bool:
    """Return whether a recording is still being written."""
    if is_special(path):
        return False
    try:
        with open(path, 'rb') as file:
            return not _lock(file, fcntl.LOCK_SH)
    except (OSError, ValueError):   # there is none, or it cannot be read
        return False


@contextmanager
def whole_file(path: str) -> Iterator[BinaryIO]:
    """Give a binary file that becomes `path` if the block ends well (rule 6)."""
    if is_special(path):
        try:
            with open(path, 'wb') as special:
                yield special
        except OSError as error:
            error.filename = error.filename or path
            raise
        return
    target = Path(os.path.realpath(path))  # a symbolic link stays one
    part = _name_of_part(target)
    try:
        with part.open('xb') as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            import shutil
            shutil.copymode(target, part)
        part.replace(target)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(part)):
            error.filename = path  # a full disk, or the folder
        raise


def _name_of_part(target: Path) -> Path:
    """Return a new name for a temporary file next to a file."""
    begin = os.fsdecode(os.fsencode(target.name)[:200])     # a name may have 255 bytes
    for number in count():
        part = target.with_name(f'.{begin}.{os.getpid()}-{number}.part')
        if not os.path.lexists(part):   # one of a killed process, perhaps of another container
            return part
    raise AssertionError


def check_results(folder: Path, names: Collection[str]) -> None:
    """Raise InputError if a folder of results may not replace what is there (rule 5)."""
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise InputError(str(folder), EXISTS, 'name a new folder, or remove this file')
    others = sorted(set(os.listdir(folder)).difference(names))
    if others:
        raise InputError(
            str(folder), f'this folder holds other files, for instance {others[0]}',
            'name a new folder, or remove this one')


def remove_results(folder: Path, names: Collection[str]) -> None:
    """Remove a folder of results, if one is there; see ``check_results``."""
    check_results(folder, names)
    if folder.exists():
        for file in list(folder.iterdir()):
            file.unlink()
        folder.rmdir()


def check_distinct(inputs: Sequence[tuple[str, str]], outputs: Sequence[tuple[str, str]]) -> None:
    """Raise UsageError unless each output (name, path) is a file of its own (rule 2)."""
    for i, (name, path) in enumerate(outputs):
        for other, there in (*inputs, *outputs[:i]):
            if _same_file(path, there):
                raise UsageError(
                    f'{path}: it cannot be both {other} and {name}: name another file for {name}')


def holds_data(path: str) -> bool:
    """Return whether a file is there that is not empty (rule 4)."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return False
    return stat.S_ISREG(status.st_mode) and status.st_size > 0


def is_special(path: str) -> bool:
    """Return whether it is a pipe or device (`/dev/stdout`), which is never replaced."""
    try:
        return not stat.S_ISREG(os.stat(path).st_mode)
    except OSError:
        return False


def version_of(path: str) -> tuple[int, ...] | None:
    """Return what differs when a file is written again; None: there is no file."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def remove_recording(path: str, earlier: tuple[int, ...] | None) -> None:
    """
    Remove what a run has recorded that could not begin (rule 4).

    :param earlier: ``version_of`` the file before the run, which the run may not have replaced.
    """
    if os.path.isfile(path) and version_of(path) != earlier:
        os.unlink(path)


def is_recording(path: str) -> bool:
    """Return whether a file holds a recording, or is named like one: it may be damaged."""
    if path.lower().endswith(_ENDINGS):
        return True
    try:
        with open(path, 'rb') as file:
            return file.read(16).startswith(_RECORDINGS)
    except OSError:
        return False


def is_declaration(path: str) -> bool:
    """Return whether a file is named like a declaration."""
    return path.lower().endswith(_DECLARATIONS)


def _same_file(one: str, other: str) -> bool:
    try:
        first, second = os.stat(one), os.stat(other)
    except (OSError, ValueError):   # one of them is not there yet
        return os.path.realpath(one) == os.path.realpath(other)
    return stat.S_ISREG(first.st_mode) and os.path.samestat(first, second)

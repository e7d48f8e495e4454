# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Imports CARET and ros2_tracing recordings: LTTng sessions in the Common Trace Format (CTF).

Theory of operation:

1. babeltrace2 reads the session, through its Python bindings in a separate process (`ctf_helper`),
   because the bindings usually belong to the system's Python and abort on some damage. Python
   interpreters are tried one after the other, the running one first, until one has the bindings.
2. All traces of a session (processes, kernel, rotated chunks) are read as one stream in the order
   of time.  A folder with several sessions is refused, because they may be of different runs.
   Sessions of one run on several computers are given one by one, and written one after the other;
   readers sort events by time.  CARET's cache `caret_converted` in the session's folder is a
   Python pickle of the same events. It is not read, because unpickling can run any code.
3. Every event becomes one event of the trace, with all fields of its payload. An event of the
   table (`schema.EVENTS`) has the table's types for the table's fields: integer flags become bool,
   unsigned times become int64 of the same bits. Other events and fields keep their types. A name
   that ROS does not allow is changed; a name that the preamble or the table uses otherwise gets
   `_` appended.
4. The contexts `vpid` and `vtid` become the preamble.  If sessions of several computers or
   containers have the same ids, those of later sessions are changed (`numbers`).  An event
   `mddag:process` with `procname` precedes the first event of a thread, and each change of its
   name.
5. Events discarded by the tracer become an event `mddag:lost` at the end of the gap; a lost packet
   counts as at least one event, and a warning reports it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import re
import shutil
import signal
import struct
import subprocess
import sys
from typing import Any, IO

from mddag_executor.text import counted, listed
from mddag_executor.trace.cdr import FieldType
from mddag_executor.trace.ctf_helper import PATIENCE_S
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.numbers import Numbers
from mddag_executor.trace.schema import EVENTS, EventType, PREAMBLE
from mddag_executor.trace.trace_file import TraceFile, whole_trace

INSTALL = 'apt install python3-bt2'
_HELPER = Path(__file__).with_name('ctf_helper.py')
_CACHE = 'caret_converted'
_RECORD = 'check the recording, or record it again'
_UNREADABLE = 'check the recording (CTF 2 needs babeltrace2 2.1), or record it again'

Row = list[Any]
Converters = list[Callable[[Any], Any] | None]


@dataclass
class Imported:
    """The result of an import."""

    events: int = 0
    kinds: int = 0
    processes: set[int] = field(default_factory=set)
    #: Number of events that the tracer discarded, as far as it counted them.
    discarded: int = 0
    #: Missing data, one line each.
    warnings: list[str] = field(default_factory=list)


def import_ctf(
    session: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str], *, progress: Callable[[int], None] | None = None,
    overwrite: bool = False,
) -> Imported:
    """
    Write the events of a CTF session into a trace file.

    :param session: the folder of the session, searched recursively for traces. Several sessions
        are one run that was recorded on several computers.
    :param output: the trace; after an exception what was there before is there
    :param progress: called regularly with the number of events
    :param overwrite: whether an existing file may be replaced
    :raises TraceError: if the session or the file cannot be used, or babeltrace2 is missing
    """
    paths = [os.fspath(path) for path in (
        [session] if isinstance(session, (str, os.PathLike)) else session)]
    found = [os.path.realpath(metadata) for path in paths for metadata in _metadata_of(path)]
    name = ', '.join(paths)
    if len(set(found)) < len(found):
        raise TraceError(name, 'a session is named twice', 'name each once')
    with whole_trace(os.fspath(output), overwrite) as part, TraceFile(
            part, overwrite=True) as file:
        importer = _Importer(name, file)
        for path in paths:
            importer.begin()
            for row in _rows(path):
                importer.take(row)
                events = importer.result.events
                if progress is not None and row[0] == 'event' and events % 5000 == 0:
                    progress(events)
        if importer.result.events == 0:
            raise TraceError(name, 'no event is recorded in it', _RECORD)
        importer.finish()
    return importer.result


def _metadata_of(path: str) -> list[str]:
    """
    Return the metadata files of the traces of a session.

    :param path: its folder.
    :raises TraceError: if there is none, or of several sessions; babeltrace2's own message would
        be unclear, and it hangs on cut metadata
    """
    remedy = 'name the folder that LTTng recorded to, such as ~/.ros/tracing/SESSION'
    if '\0' in path or not os.path.exists(path):
        raise TraceError(path, 'there is no such folder', remedy)
    if not os.path.isdir(path):
        raise TraceError(path, 'is no folder', remedy)
    folders = sorted(folder for folder, _, names in os.walk(path) if 'metadata' in names)
    if not folders:
        what = 'holds no CTF recording (no file called metadata is in it or below)'
        if os.path.exists(os.path.join(path, _CACHE)):
            what = f'holds only what CARET converted ({_CACHE}), not the recording itself'
        raise TraceError(path, what, remedy)
    sessions = set()
    for folder in folders:
        parts = os.path.relpath(folder, path).split(os.sep)
        below = [place for place, part in enumerate(parts) if part in _PARTS]
        if below:
            sessions.add(os.sep.join(parts[:below[0]]))
    if len(sessions) > 1:
        raise TraceError(
            path, f'it holds {len(sessions)} sessions: {listed(sorted(sessions))}',
            'name the folder of one, or, if they are of one run on several computers, each of '
            'their folders')
    found = [os.path.join(folder, 'metadata') for folder in folders]
    for metadata in found:
        _check_metadata(metadata)
    return found


# The folders that LTTng makes in a session's folder.
_PARTS = {'ust', 'kernel', 'archives'}

# The head of a metadata packet: magic, UUID, checksum, sizes of content and packet in bits, and
# compression, encryption, checksum scheme, major, minor (CTF 1.8.3, 7.1).
_PACKET = '16sIII5B'
_MAGIC = 0x75D11D57


def _check_metadata(path: str) -> None:
    """Check that the packets of metadata are whole; metadata may also be plain text."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise TraceError(path, f'cannot be read ({error.strerror})', _RECORD) from None
    if not data:
        raise TraceError(path, 'the metadata is empty', _RECORD)
    order = next((order for order in '<>' if data[:4] == struct.pack(f'{order}I', _MAGIC)), None)
    position = 0 if order else len(data)
    while position < len(data):
        head = struct.Struct(f'{order}I{_PACKET}')
        packet = data[position:position + head.size].ljust(head.size, b'\0')
        magic, _, _, content, size, *_ = head.unpack(packet)
        if magic != _MAGIC or not head.size * 8 <= content <= size or (
                position + size // 8 > len(data)):
            raise TraceError(
                path, f'the metadata is cut or damaged at byte {position}', _RECORD)
        position += size // 8


# --- the helper process --------------------------------------------------------------------------


def interpreters() -> list[str]:
    """Return the Python interpreters that may have babeltrace2's bindings, this one first."""
    system = sorted(str(path) for path in Path('/usr/bin').glob('python3.[0-9]*')
                    if re.fullmatch(r'python3\.\d+', path.name))
    found = [sys.executable, '/usr/bin/python3', shutil.which('python3'), *reversed(system)]
    return list(dict.fromkeys(name for name in found if name and os.access(name, os.X_OK)))


def _rows(path: str) -> Iterator[Row]:
    """Yield the rows from the first Python interpreter with bindings."""
    for interpreter in interpreters():
        rows = _rows_of(interpreter, path)
        first = next(rows, None)
        if first is not None and first[0] == 'ready':
            yield from rows
            return
        rows.close()
    raise TraceError(
        path, "babeltrace2's Python bindings, which read it, are not installed", INSTALL)


def _rows_of(interpreter: str, path: str) -> Generator[Row, None, None]:
    # PYTHONHOME of one interpreter breaks another. Without bytecode nothing is written.
    environment = {name: value for name, value in os.environ.items() if name != 'PYTHONHOME'}
    environment['PYTHONDONTWRITEBYTECODE'] = '1'
    try:
        process = subprocess.Popen(
            [interpreter, str(_HELPER), os.path.abspath(path)], env=environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    except OSError:
        return      # try the next interpreter
    assert process.stdout is not None
    ready = False
    try:
        for row in _read(process.stdout):
            if row[0] == 'error':
                raise TraceError(path, f'cannot be read ({row[1]})', _UNREADABLE)
            if row[0] == 'end':
                return
            ready = ready or row[0] == 'ready'
            yield row
        if ready:
            raise TraceError(path, f'babeltrace2 gave up ({_end_of(process)})', _UNREADABLE)
    finally:
        process.kill()
        process.stdout.close()
        process.wait()


def _read(stream: IO[bytes]) -> Iterator[Row]:
    """Yield all rows, up to the end of the stream or the first line that is not the helper's."""
    for line in stream:
        try:
            row = json.loads(line)
        except ValueError:
            return
        if not isinstance(row, list) or not row:
            return
        yield row


def _end_of(process: subprocess.Popen[bytes]) -> str:
    try:
        status = process.wait(10)
    except subprocess.TimeoutExpired:
        return 'it does not answer'
    if status == -signal.SIGALRM:
        return f'it did nothing for {PATIENCE_S} s'
    return f'exit status {status}' if status >= 0 else f'ended by {signal.Signals(-status).name}'


# --- from rows to events -------------------------------------------------------------------------


class _Importer:
    """Writes the rows of the sessions of a run as events."""

    def __init__(self, path: str, file: TraceFile) -> None:
        self.result = Imported()
        self._path = path
        self._file = file
        self._place = 0             # number of the session
        self._processes, self._threads = Numbers(), Numbers()
        # by number of an event's class: its name, and the converters of its values
        self._kinds: dict[int, tuple[str, Converters]] = {}
        self._names: set[str] = set()       # of events
        self._procnames: dict[tuple[int, int], str] = {}
        self._nameless = 0                          # events without process or thread
        self._uncounted = 0                         # gaps of an unknown number of events
        self._time = 0

    def begin(self) -> None:
        """Begin with the next session."""
        self._place += 1
        self._kinds, self._time = {}, 0

    def take(self, row: Row) -> None:
        """Write a row."""
        if row[0] == 'event':
            self._event(*row[1:])
        elif row[0] == 'class':
            self._class(*row[1:])
        elif row[0] == 'discarded':
            self._discarded(*row[1:])

    def _event(self, number: int, time: int, vpid: int | None, vtid: int | None,
               procname: str | None, values: list[Any]) -> None:
        if vpid is None or vtid is None:
            self._nameless += 1
            vpid, vtid = vpid or 0, vtid or 0
        name, converts = self._kinds[number]
        vpid = self._processes.of(self._place, vpid)
        vtid = self._threads.of(self._place, vtid)
        if procname and self._procnames.get((vpid, vtid)) != procname:
            self._procnames[vpid, vtid] = procname
            self._file.extend((('mddag:process', time, vtid, procname),), vpid)
        if converts:
            values = [value if convert is None else convert(value)
                      for convert, value in zip(converts, values)]
        self._file.extend(((name, time, vtid, *values),), vpid)
        self.result.events += 1
        self.result.processes.add(vpid)
        self._time = time

    def _discarded(self, time: int, count: int) -> None:
        if count < 0:
            self._uncounted += 1
        self.result.discarded += max(count, 1)
        self._file.extend((('mddag:lost', max(time, self._time), 0, max(count, 1)),), 0)

    def _class(self, number: int, original: str, fields: list[tuple[str, str]]) -> None:
        provider, colon, name = original.partition(':')
        if not colon:
            provider, name = 'ctf', original
        key = f'{_legal(provider)}:{_legal(name)}'
        self._names.add(key)
        event, converts = event_type(key, fields)
        self._kinds[number] = self._file.define(event), converts if any(converts) else []

    def finish(self) -> None:
        """Note what is missing or was changed."""
        result, path = self.result, self._path
        result.kinds = len(self._names)
        if result.discarded:
            about = ' at least' if self._uncounted else ''
            result.warnings.append(
                f'{path}: the tracer discarded {counted(result.discarded, "event")}{about}: what '
                'followed from them is missing; record with larger or more sub-buffers')
        if self._nameless:
            result.warnings.append(
                f'{path}: no process or thread is known of {counted(self._nameless, "event")}: '
                'add the contexts vpid and vtid when recording')
        if self._file.rejected:
            result.warnings.append(
                f'{path}: left out {counted(self._file.rejected, "event")}, the first because of: '
                f'{self._file.rejection}')


def _legal(name: str) -> str:
    name = re.sub(r'[^A-Za-z0-9_]', '_', name).lstrip('_') or 'unnamed'
    return name if name[0].isalpha() else f'n{name}'


def event_type(
    name: str, fields: Sequence[tuple[str, str]]
) -> tuple[EventType, Converters]:
    """
    Return the type of a session's event in the trace, and the converters of its fields.

    :param name: its full name, legal in ROS
    :param fields: names and types in the session; a converter of None keeps the value
    """
    table = dict(EVENTS[name].fields) if name in EVENTS else {}
    preamble = {preamble_name for preamble_name, _ in PREAMBLE}
    chosen: dict[str, str] = {}
    converts: Converters = []
    for given, kind in fields:
        field_name, convert = _legal(given), None
        if field_name in table:
            fit = _fit(kind, table[field_name])
            if fit is None:
                field_name += '_'
            else:
                kind, convert = fit
        while field_name in preamble or field_name in chosen:
            field_name += '_'
        chosen[field_name] = kind
        converts.append(convert)
    provider, _, short = name.partition(':')
    return EventType(provider, short, tuple(chosen.items())), converts


def _fit(given: str, wanted: str) -> tuple[str, Callable[[Any], Any] | None] | None:
    """Return the type for a field of the table and its converter, None if there is none."""
    if given == wanted:
        return given, None
    have, want = FieldType.parse(given), FieldType.parse(wanted)
    if wanted == 'bool' and have.kind == 'int':
        return wanted, bool
    if want.kind == 'int' and have.kind in ('int', 'bool'):
        bits = _bits(wanted)
        if have.kind == 'int' and _bits(given) > bits:
            return given, None      # a reader accepts any integer
        half = 0 if wanted.startswith('u') else 1 << bits - 1
        return wanted, lambda value: (value + half) % (1 << bits) - half
    return (given, None) if have.kind == want.kind else None


def _bits(kind: str) -> int:
    return int(re.sub(r'\D', '', kind))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Imports CARET and ros2_tracing recordings: LTTng sessions in the Common Trace Format (CTF).

Theory of operation:

1. babeltrace2 reads the session, through its Python bindings in a separate process (`ctf_helper`),
   because the bindings usually belong to the system's Python and abort on some damage. Python
   interpreters are tried one after the other, the running one first, until one has the bindings.
2. All traces of a session (processes, kernel, rotated chunks) are read as one stream in the order
   of time, and so are several sessions of one host: the metadata has its name, and the UUID of its
   clock, which is that of its boot.  The sessions of several hosts are written one after the
   other; readers sort events by time.  A folder with several sessions is refused, because they may
   be of different runs, unless they are the two of `ros2 trace --dual-session`: `snapshot`, which
   has the events of the initialisation, and `runtime`.  CARET's cache `caret_converted` in the
   session's folder is a Python pickle of the same events. It is not read, because unpickling can
   run any code.
3. Every event becomes one event of the trace, with all fields of its payload. An event of the
   table (`schema.EVENTS`) has the table's types for the table's fields: integer flags become bool,
   unsigned times become int64 of the same bits. Other events and fields keep their types. A name
   that ROS does not allow is changed; a name that the preamble or the table uses otherwise gets
   `_` appended.
4. The contexts `vpid` and `vtid` become the preamble.  Events of one host and process id belong to
   one process, in whichever session they are.  If several hosts have the same ids, those of later
   hosts and containers are changed (`numbers`).  An event `mddag:process` with `procname` precedes
   the first event of a thread, and each change of its name.
5. Events discarded by the tracer become an event `mddag:lost` at the end of the gap; a lost packet
   counts as at least one event, and a warning reports it.
6. A tracepoint writes to all sessions that record it before its thread goes on.  So an event that
   equals the one before it in its thread, and that another session recorded, is the same event: it
   is written once (`_Repeats`).
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
from typing import Any, IO, NamedTuple

from mddag_executor.text import counted, listed
from mddag_executor.trace.cdr import FieldType
from mddag_executor.trace.ctf_helper import PATIENCE_S
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.numbers import Numbers
from mddag_executor.trace.schema import (
    BEFORE_HUMBLE,
    BEFORE_HUMBLE_PROBLEM,
    BEFORE_HUMBLE_REMEDY,
    EVENTS,
    EventType,
    PREAMBLE,
)
from mddag_executor.trace.trace_file import TraceFile, whole_trace

INSTALL = 'apt install python3-bt2'
_HELPER = Path(__file__).with_name('ctf_helper.py')
_CACHE = 'caret_converted'
_RECORD = 'check the recording, or record it again'
_UNREADABLE = 'check the recording (CTF 2 needs babeltrace2 2.1), or record it again'

# When sessions take turns, one or two events of each thread may look strange.
_STRANGE = 100

Row = list[Any]
_Thread = tuple[int, int, int]
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


_Host = tuple[str, str]
"""The name of a host, and the UUID of its clock; of a session without them its path."""


class _Session(NamedTuple):
    """
    A session, or the two of `ros2 trace --dual-session`.

    :ivar traces: the folders of its traces.
    :ivar parts: how many sessions it is.
    """

    path: str
    traces: list[str]
    parts: int
    host: _Host


def import_ctf(
    session: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str], *, progress: Callable[[int], None] | None = None,
    overwrite: bool = False,
) -> Imported:
    """
    Write the events of a CTF session into a trace file.

    :param session: the folder of the session, searched recursively for traces. Several sessions
        are of one run, which one or several hosts recorded.
    :param output: the trace; after an exception what was there before is there
    :param progress: called regularly with the number of events
    :param overwrite: whether an existing file may be replaced
    :raises TraceError: if the session or the file cannot be used, or babeltrace2 is missing
    """
    paths = [os.fspath(path) for path in (
        [session] if isinstance(session, (str, os.PathLike)) else session)]
    sessions = [_session_in(path) for path in paths]
    found = [os.path.realpath(trace) for each in sessions for trace in each.traces]
    name = ', '.join(paths)
    if len(set(found)) < len(found):
        raise TraceError(name, 'a session is named twice', 'name each once')
    hosts: dict[_Host, list[_Session]] = {}
    for each in sessions:
        hosts.setdefault(each.host, []).append(each)
    try:
        return _written(name, list(hosts.values()), os.fspath(output), progress, overwrite)
    except _OtherHosts:
        return _written(name, [[each] for each in sessions], os.fspath(output), progress,
                        overwrite)


def _written(
    name: str, hosts: list[list[_Session]], output: str,
    progress: Callable[[int], None] | None, overwrite: bool,
) -> Imported:
    """Write the sessions of some hosts into a trace."""
    with whole_trace(output, overwrite) as part, TraceFile(part, overwrite=True) as file:
        importer = _Importer(name, file)
        for sessions in hosts:
            importer.begin(several=sum(each.parts for each in sessions) > 1)
            for row in _rows([each.path for each in sessions]):
                importer.take(row)
                events = importer.result.events
                if progress is not None and row[0] == 'event' and events % 5000 == 0:
                    progress(events)
        if importer.result.events == 0:
            raise TraceError(name, 'no event is recorded in it', _RECORD)
        importer.finish()
    return importer.result


def _session_in(path: str) -> _Session:
    """
    Return the session in a folder.

    :raises TraceError: if there is none, or several; babeltrace2's own message would be unclear,
        and it hangs on cut metadata
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
            above = parts[:below[0]]
            sessions.add(os.sep.join(above[:-1] if above and _SNAPSHOT.fullmatch(above[-1])
                                     else above))
    hosts = {_host_of(os.path.join(folder, 'metadata')) for folder in folders}
    if len(sessions) > 1 and (sessions != _DUAL or len(hosts) > 1):
        raise TraceError(
            path, f'it holds {len(sessions)} sessions: {listed(sorted(sessions))}',
            'name the folder of one, or, if they are of one run, each of their folders')
    host = hosts.pop() if len(hosts) == 1 else None
    return _Session(path, folders, max(1, len(sessions)), host or (os.path.realpath(path), ''))


# The folders that LTTng makes in a session's folder; that of each snapshot is above them.
_PARTS = {'ust', 'kernel', 'archives'}
_SNAPSHOT = re.compile(r'.+-\d{8}-\d{6}-\d+')
_DUAL = {'snapshot', 'runtime'}

# The head of a metadata packet: magic, UUID, checksum, sizes of content and packet in bits, and
# compression, encryption, checksum scheme, major, minor (CTF 1.8.3, 7.1).
_PACKET = '16sIII5B'
_MAGIC = 0x75D11D57


# In the TSDL of CTF 1.8 and in the JSON of CTF 2.
_HOSTNAME = re.compile(rb'\bhostname"?\s*[=:]\s*"([^"]*)"')
_CLOCK_UUID = re.compile(rb'\bclock\s*\{[^}]*?\buuid\s*=\s*"([^"]*)"')


def _host_of(path: str) -> _Host | None:
    """Return the host that wrote metadata; None if the metadata does not say it."""
    text = _text_of_metadata(path)
    name, clock = _HOSTNAME.search(text), _CLOCK_UUID.search(text)
    if name is None:
        return None
    return name[1].decode(errors='replace'), clock[1].decode(errors='replace') if clock else ''


def _text_of_metadata(path: str) -> bytes:
    """
    Return the text of metadata without the heads of its packets; it may also be plain text.

    :raises TraceError: if a packet is not whole.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise TraceError(path, f'cannot be read ({error.strerror})', _RECORD) from None
    if not data:
        raise TraceError(path, 'the metadata is empty', _RECORD)
    order = next((order for order in '<>' if data[:4] == struct.pack(f'{order}I', _MAGIC)), None)
    if order is None:
        return data
    head, text, position = struct.Struct(f'{order}I{_PACKET}'), b'', 0
    while position < len(data):
        packet = data[position:position + head.size].ljust(head.size, b'\0')
        magic, _, _, content, size, *_ = head.unpack(packet)
        if magic != _MAGIC or not head.size * 8 <= content <= size or (
                position + size // 8 > len(data)):
            raise TraceError(
                path, f'the metadata is cut or damaged at byte {position}', _RECORD)
        text += data[position + head.size:position + content // 8]
        position += size // 8
    return text


# --- the helper process --------------------------------------------------------------------------


def interpreters() -> list[str]:
    """Return the Python interpreters that may have babeltrace2's bindings, this one first."""
    system = sorted(str(path) for path in Path('/usr/bin').glob('python3.[0-9]*')
                    if re.fullmatch(r'python3\.\d+', path.name))
    found = [sys.executable, '/usr/bin/python3', shutil.which('python3'), *reversed(system)]
    return list(dict.fromkeys(name for name in found if name and os.access(name, os.X_OK)))


def _rows(paths: list[str]) -> Iterator[Row]:
    """Yield the rows of the sessions of a host from the first Python interpreter with bindings."""
    for interpreter in interpreters():
        rows = _rows_of(interpreter, paths)
        first = next(rows, None)
        if first is not None and first[0] == 'ready':
            yield from rows
            return
        rows.close()
    raise TraceError(
        ', '.join(paths), "babeltrace2's Python bindings, which read it, are not installed",
        INSTALL)


def _rows_of(interpreter: str, paths: list[str]) -> Generator[Row, None, None]:
    path = ', '.join(paths)
    # PYTHONHOME of one interpreter breaks another. Without bytecode nothing is written.
    environment = {name: value for name, value in os.environ.items() if name != 'PYTHONHOME'}
    environment['PYTHONDONTWRITEBYTECODE'] = '1'
    try:
        process = subprocess.Popen(
            [interpreter, str(_HELPER), *map(os.path.abspath, paths)], env=environment,
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


class _OtherHosts(Exception):
    """Sessions are not of one host, though their metadata says so."""


class _Several:
    """
    Tells what several sessions of a host have in common (rule 6).

    Containers may share the name and clock of a host, and number their processes for themselves.
    If one thread has another name in another session, its process is another one.  If two sessions
    record the same kinds of events of a thread, but not the same events, they are not of one host.
    """

    def __init__(self) -> None:
        self.repeated = 0
        self._strange = 0
        self._last: dict[_Thread, tuple[str, list[Any], set[int]]] = {}     # and its traces
        self._kinds: set[tuple[int, str]] = set()
        self._named: dict[tuple[int, int], dict[str, int]] = {}
        self._which: dict[tuple[int, int], int] = {}

    def process(self, trace: int, vpid: int, vtid: int, procname: str | None) -> int:
        """Return which of the processes with an id an event belongs to."""
        names = self._named.setdefault((vpid, vtid), {})
        which = self._which.get((trace, vpid))
        if which is None:
            which = names.get(procname or '', len(set(names.values())))
            self._which[trace, vpid] = which
        names.setdefault(procname or '', which)
        return which

    def is_repeat(self, thread: _Thread, trace: int, name: str, values: list[Any]) -> bool:
        """
        Return whether an event is the last one of its thread, recorded by another session.

        :raises _OtherHosts: if the sessions contradict each other.
        """
        last = self._last.get(thread)
        if last is not None and trace not in last[2] and last[0] == name and last[1] == values:
            last[2].add(trace)
            self.repeated += 1
            return True
        self._kinds.add((trace, name))
        if last is not None and trace not in last[2] and any(
                (other, name) in self._kinds for other in last[2]):
            self._strange += 1
            if self._strange > max(_STRANGE, self.repeated):
                raise _OtherHosts
        self._last[thread] = name, values, {trace}
        return False


class _Importer:
    """Writes the rows of the sessions of a run as events, those of one host after another."""

    def __init__(self, path: str, file: TraceFile) -> None:
        self.result = Imported()
        self._path = path
        self._file = file
        self._place = 0             # number of the host
        self._several: _Several | None = None       # if the host has several sessions
        self._repeated = 0
        self._processes, self._threads = Numbers(), Numbers()
        # by number of an event's class: its name, the converters of its values, and its trace
        self._kinds: dict[int, tuple[str, Converters, int]] = {}
        self._names: set[str] = set()       # of events
        self._procnames: dict[tuple[int, int], str] = {}
        self._nameless = 0                          # events without process or thread
        self._uncounted = 0                         # gaps of an unknown number of events
        self._time = 0

    def begin(self, several: bool) -> None:
        """
        Begin with the next host.

        :param several: whether it has several sessions.
        """
        self._place += 1
        self._kinds, self._time = {}, 0
        self._repeated += self._several.repeated if self._several else 0
        self._several = _Several() if several else None

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
        name, converts, trace = self._kinds[number]
        place = self._place, 0
        if self._several is not None:
            which = self._several.process(trace, vpid, vtid, procname)
            if self._several.is_repeat((which, vpid, vtid), trace, name, values):
                return
            place = self._place, which
        vpid = self._processes.of(place, vpid)
        vtid = self._threads.of(place, vtid)
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

    def _class(
        self, number: int, original: str, fields: list[tuple[str, str]], trace: int
    ) -> None:
        provider, colon, name = original.partition(':')
        if not colon:
            provider, name = 'ctf', original
        key = f'{_legal(provider)}:{_legal(name)}'
        self._names.add(key)
        if key in BEFORE_HUMBLE:
            raise TraceError(self._path, BEFORE_HUMBLE_PROBLEM, BEFORE_HUMBLE_REMEDY)
        event, converts = event_type(key, fields)
        self._kinds[number] = self._file.define(event), converts if any(converts) else [], trace

    def finish(self) -> None:
        """Note what is missing or was changed."""
        result, path = self.result, self._path
        result.kinds = len(self._names)
        self._repeated += self._several.repeated if self._several else 0
        if self._repeated:
            result.warnings.append(
                f'{path}: {counted(self._repeated, "event")} in more than one session of a host: '
                'each is used once')
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

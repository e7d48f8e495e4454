# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Imports CARET and ros2_tracing recordings: LTTng sessions in the Common Trace Format (CTF).

Theory of operation:

1. The packets of the session are read here, on columns (`ctf_stream`, `ctf_decoder`), as the
   metadata of CTF 1.8 or 2 describes them (`tsdl`, `ctf2_metadata`); no other program is needed.
   A damaged file is read up to the damage, with a warning.
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
   hosts and containers are changed (`numbers`).  An event `mddag:host` precedes the first event of
   a process, if the metadata names its host, and an event `mddag:process` with `procname` the
   first event of a thread, and each change of its name.
5. Events discarded by the tracer become an event `mddag:lost` at the end of the gap, which has the
   time of its begin: the end of the packet before in the same stream.  So do packets that are not
   in the files, and damage; a warning reports each of the three.
6. A tracepoint writes to all sessions that record it before its thread goes on.  So an event that
   equals the one before it in its thread, and that another session recorded, is the same event: it
   is written once (`_Repeats`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
import os
from pathlib import Path
import re
import struct
from typing import Any, NamedTuple

from mddag_executor.text import counted, listed
from mddag_executor.trace.cdr import FieldType
from mddag_executor.trace.columns import Columns, ColumnWriter
from mddag_executor.trace.ctf2_metadata import is_ctf2, parse_ctf2
from mddag_executor.trace.ctf_events import (
    Array,
    described,
    Events,
    Ints,
    Kind,
    Lost,
    Rows,
)
from mddag_executor.trace.ctf_layout import text_of
from mddag_executor.trace.ctf_stream import Reading
from mddag_executor.trace.ctf_types import Metadata, MetadataError, MOST_BYTES
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.numbers import Numbers
from mddag_executor.trace.schema import (
    BEFORE_HUMBLE,
    BEFORE_HUMBLE_PROBLEM,
    BEFORE_HUMBLE_REMEDY,
    DISCARDED,
    EVENTS,
    EventType,
    HOST,
    MISSING,
    PREAMBLE,
    PROCESS,
)
from mddag_executor.trace.trace_file import TraceFile, whole_trace
from mddag_executor.trace.tsdl import parse_tsdl
import numpy as np

CARET_CACHE = 'caret_converted'
_RECORD = 'check the recording, or record it again'
_LOST = 'mddag:lost'

# When sessions take turns, one or two events of each thread may look strange.
_STRANGE = 100
_MOST_DAMAGES = 5

_Thread = tuple[int, int, int]
Converters = list[Callable[[Any], Any] | None]


@dataclass
class Imported:
    """The result of an import."""

    events: int = 0
    kinds: int = 0
    processes: set[int] = field(default_factory=set)
    #: Number of events that the tracer discarded.
    discarded: int = 0
    #: Number of packets that are not in the files.
    packets_missing: int = 0
    #: Missing data, one line each.
    warnings: list[str] = field(default_factory=list)


_Host = tuple[str, str]
"""The name of a host, and the UUID of its clock; of a session without them its path."""


class _Session(NamedTuple):
    """
    A session, or the two of `ros2 trace --dual-session`.

    :ivar traces: what the metadata of its traces says, by their folders.
    :ivar parts: how many sessions it is.
    """

    path: str
    traces: dict[str, Metadata]
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
    :raises TraceError: if the session or the file cannot be used
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
        known = [sessions[0].host for sessions in hosts]
        for sessions, host in zip(hosts, known):
            several = sum(each.parts for each in sessions) > 1
            try:
                reading = Reading({folder: metadata for each in sessions
                                   for folder, metadata in each.traces.items()}, raw=several)
            except MetadataError as error:
                raise TraceError(
                    name, f'its metadata cannot be read ({error})', _RECORD) from None
            # sessions that name one host, but contradict each other, are of unknown hosts
            importer.begin(several, host if host[1] and known.count(host) == 1 else None,
                           reading.offsets)
            for events, lost in reading.batches():
                importer.take(events, lost)
                if progress is not None:
                    progress(importer.result.events)
            importer.damages += described(reading.damages)
        importer.finish()
    return importer.result


def _metadata_in(folder: str) -> Metadata:
    """
    Return what the metadata in a folder says.

    :raises TraceError: if it is not understood
    """
    path = os.path.join(folder, 'metadata')
    data = _text_of_metadata(path)
    try:
        if len(data) > MOST_BYTES:
            raise MetadataError(f'it is larger than {MOST_BYTES // 2 ** 20} MiB')
        text = data.decode()
        return parse_ctf2(text) if is_ctf2(text) else parse_tsdl(text)
    except UnicodeDecodeError as error:
        raise TraceError(path, f'cannot be read (it is not text at byte {error.start})',
                         _RECORD) from None
    except MetadataError as error:
        raise TraceError(path, f'cannot be read ({error})', _RECORD) from None


def _session_in(path: str) -> _Session:
    """
    Return the session in a folder.

    :raises TraceError: if there is none, or several
    """
    remedy = 'name the folder that LTTng recorded to, such as ~/.ros/tracing/SESSION'
    if '\0' in path or not os.path.exists(path):
        raise TraceError(path, 'there is no such folder', remedy)
    if not os.path.isdir(path):
        raise TraceError(path, 'is not a folder', remedy)
    folders = sorted(folder for folder, _, names in os.walk(path) if 'metadata' in names)
    if not folders:
        what = 'holds no CTF recording (no file called metadata is in it or below)'
        if os.path.exists(os.path.join(path, CARET_CACHE)):
            what = f'holds only what CARET converted ({CARET_CACHE}), not the recording itself'
        raise TraceError(path, what, remedy)
    sessions = set()
    for folder in folders:
        parts = os.path.relpath(folder, path).split(os.sep)
        below = [place for place, part in enumerate(parts) if part in _PARTS]
        if below:
            above = parts[:below[0]]
            sessions.add(os.sep.join(above[:-1] if above and _SNAPSHOT.fullmatch(above[-1])
                                     else above))
    several = TraceError(
        path, f'it holds {len(sessions)} sessions: {listed(sorted(sessions))}',
        'name the folder of one, or, if they are of one run, each of their folders')
    if len(sessions) > 1 and sessions != _DUAL:
        raise several
    traces = {folder: _metadata_in(folder) for folder in folders}
    hosts = {_host_of(metadata) for metadata in traces.values()}
    if len(sessions) > 1 and len(hosts) > 1:
        raise several
    host = hosts.pop() if len(hosts) == 1 else None
    return _Session(path, traces, max(1, len(sessions)), host or (os.path.realpath(path), ''))


# The folders that LTTng makes in a session's folder; that of each snapshot is above them.
_PARTS = {'ust', 'kernel', 'archives'}
_SNAPSHOT = re.compile(r'.+-\d{8}-\d{6}-\d+')
_DUAL = {'snapshot', 'runtime'}

# The head of a metadata packet: magic, UUID, checksum, sizes of content and packet in bits, and
# compression, encryption, checksum scheme, major, minor (CTF 1.8.3, 7.1).
_PACKET = '16sIII5B'
_MAGIC = 0x75D11D57


def _host_of(metadata: Metadata) -> _Host | None:
    """Return the host of a trace; None if its metadata does not say it."""
    name = metadata.environment.get('hostname')
    return None if name is None else (name, metadata.clock.uuid)


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
    head, parts, position = struct.Struct(f'{order}I{_PACKET}'), [], 0
    while position < len(data):
        packet = data[position:position + head.size].ljust(head.size, b'\0')
        magic, _, _, content, size, *_ = head.unpack(packet)
        if magic != _MAGIC or not head.size * 8 <= content <= size or (
                position + size // 8 > len(data)):
            raise TraceError(
                path, f'the metadata is cut or damaged at byte {position}', _RECORD)
        parts.append(data[position + head.size:position + content // 8])
        position += size // 8
    return b''.join(parts)


# --- from columns to a trace ---------------------------------------------------------------------


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
        self._last: dict[_Thread, tuple[str, bytes, set[int]]] = {}     # and its traces
        self._kinds: set[tuple[int, str]] = set()
        self._named: dict[tuple[int, int], dict[bytes, int]] = {}
        self._which: dict[tuple[int, int], int] = {}

    def process(self, trace: int, vpid: int, vtid: int, procname: bytes) -> int:
        """Return which of the processes with an id an event belongs to."""
        names = self._named.setdefault((vpid, vtid), {})
        which = self._which.get((trace, vpid))
        if which is None:
            which = names.get(procname, len(set(names.values())))
            self._which[trace, vpid] = which
        names.setdefault(procname, which)
        return which

    def is_repeat(self, thread: _Thread, trace: int, name: str, values: bytes) -> bool:
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


class _Target(NamedTuple):
    """
    A kind of event in the trace.

    :ivar kind: the kind in the session.
    :ivar event: its name for the writer.
    """

    kind: Kind
    event: str
    converters: Converters


class _Importer:
    """Writes the events of the sessions of a run, those of one host after another."""

    def __init__(self, path: str, file: TraceFile) -> None:
        self.result = Imported()
        #: What is wrong in files, one line each.
        self.damages: list[str] = []
        self._path = path
        self._file = file
        self._writer = ColumnWriter(file)
        self._place = 0             # number of the host
        self._several: _Several | None = None       # if the host has several sessions
        self._repeated = 0
        self._processes, self._threads = Numbers(), Numbers()
        self._targets: dict[int, _Target] = {}      # by identity of the kind
        self._names: set[str] = set()               # of events
        self._host: _Host | None = None
        self._offsets: Mapping[int, int] = {}       # of its clock, by trace
        self._hosted: set[int] = set()              # processes of which the host is written
        self._procnames: dict[int, bytes] = {}      # by process and thread in one number
        self._nameless = 0                          # events without process or thread
        self._impossible = 0                        # events of impossible processes or threads

    def begin(self, several: bool, host: _Host | None, offsets: Mapping[int, int]) -> None:
        """
        Begin with the next host.

        :param several: whether it has several sessions.
        :param host: what it is called; None: unknown.
        :param offsets: by number of a trace from the 0 of its clock to that of its times, ns.
        """
        self._place += 1
        self._host, self._offsets = host, offsets
        self._repeated += self._several.repeated if self._several else 0
        self._several = _Several() if several else None

    def take(self, events: Events, lost: Sequence[Lost]) -> None:
        """Write events, which are in the order of time, and gaps up to the last of them."""
        possible = ((events.vpid == events.vpid.astype(np.int32))
                    & (events.vtid == events.vtid.astype(np.int32)))
        if not possible.all():
            self._impossible += int(np.count_nonzero(~possible))
            events = events.picked(np.flatnonzero(possible))
        self._nameless += int(np.count_nonzero(~events.known))
        which = np.zeros(len(events), dtype=np.int64)
        if self._several is not None:
            which, new = self._merge(events)
            events, which = events.picked(new), which[new]
        vpid = self._numbered(self._processes, which, events.vpid)
        vtid = self._numbered(self._threads, which, events.vtid)
        self.result.events += len(events)
        self.result.processes.update(np.unique(vpid).tolist())
        met = self._met(vpid)
        renamed, names = self._renamed(vpid, vtid, events.procname)
        gaps = sorted(lost)
        # hosts and names come just before their events, gaps after all that is not later
        keys = np.concatenate((
            4 * np.arange(len(events)) + 2, 4 * met + 1, 4 * renamed + 1,
            4 * np.searchsorted(events.time, [gap.time for gap in gaps], side='right')))
        order = np.empty(len(keys), dtype=np.int64)
        order[np.argsort(keys, kind='stable')] = np.arange(len(keys))
        of_events, of_hosts, of_names, of_gaps = np.split(order, np.cumsum([
            len(events), len(met), len(renamed)]))
        name = self._host or ('', '')
        tables = [Columns(HOST, of_hosts, events.time[met], vpid[met], vtid[met],
                          [(*name, self._offsets.get(each, 0) if name[1] else 0)
                           for each in events.trace[met].tolist()]),
                  Columns(PROCESS, of_names, events.time[renamed], vpid[renamed], vtid[renamed],
                          [(name,) for name in names]),
                  self._gaps(gaps, of_gaps)]
        merged: dict[str, list[Columns]] = {}
        for number, rows in enumerate(events.tables):
            if rows.count:
                mine = np.empty(rows.count, dtype=np.int64)
                here = np.flatnonzero(events.table == number)
                mine[events.row[here]] = here
                target = self._target(rows.kind)
                merged.setdefault(target.event, []).append(Columns(
                    target.event, of_events[mine], events.time[mine], vpid[mine], vtid[mine],
                    self._fields(target, rows)))
        self._writer.write([*tables, *map(_merged, merged.values())])

    def _merge(self, events: Events) -> tuple[Ints, Ints]:
        """Return which of the processes of its number each event is of, and the new events."""
        assert self._several is not None
        process, is_repeat = self._several.process, self._several.is_repeat
        names = [self._target(rows.kind).event if rows.count else '' for rows in events.tables]
        found, new = [], []
        for place, (trace, vpid, vtid, procname, table, raw) in enumerate(zip(
                events.trace.tolist(), events.vpid.tolist(), events.vtid.tolist(),
                events.procname.tolist(), events.table.tolist(), events.raw.tolist())):
            which = process(trace, vpid, vtid, procname)
            found.append(which)
            if not is_repeat((which, vpid, vtid), trace, names[table], raw):
                new.append(place)
        return np.array(found, dtype=np.int64), np.array(new, dtype=np.int64)

    def _numbered(self, numbers: Numbers, which: Ints, ids: Ints) -> Ints:
        """Return unique ids, in the order in which they are met."""
        keys, first, inverse = np.unique(
            which << 32 | ids & 0xFFFFFFFF, return_index=True, return_inverse=True)
        found = np.zeros(len(keys), dtype=np.int64)
        for at in np.argsort(first).tolist():
            event = first[at]
            found[at] = numbers.of((self._place, int(which[event])), int(ids[event]))
        return found[inverse]

    def _met(self, vpid: Ints) -> Ints:
        """Return the first events of processes whose host is known and not written yet."""
        if self._host is None:
            return np.zeros(0, dtype=np.int64)
        pids, first = np.unique(vpid, return_index=True)
        new = np.array([pid not in self._hosted for pid in pids.tolist()], dtype=np.bool_)
        self._hosted.update(pids.tolist())
        return np.sort(first[new])

    def _renamed(self, vpid: Ints, vtid: Ints, procname: Array) -> tuple[Ints, list[str]]:
        """Return the events before which their thread has a new name, and the names."""
        threads = vpid << 32 | vtid & 0xFFFFFFFF
        order = np.argsort(threads, kind='stable')
        thread, name = threads[order], procname[order]
        changed = np.ones(len(order), dtype=np.bool_)
        changed[1:] = (thread[1:] != thread[:-1]) | (name[1:] != name[:-1])
        found = []
        for at, key, text in zip(order[changed].tolist(), thread[changed].tolist(),
                                 name[changed].tolist()):
            text = text.split(b'\0', 1)[0]
            if text and self._procnames.get(key) != text:
                self._procnames[key] = text
                found.append((at, text_of(text)))
        found.sort()
        return np.array([at for at, _ in found], dtype=np.int64), [text for _, text in found]

    def _gaps(self, gaps: Sequence[Lost], order: Ints) -> Columns:
        """Return events that say what is missing."""
        for gap in gaps:
            self.result.discarded += gap.number * (gap.cause == DISCARDED)
            self.result.packets_missing += gap.number * (gap.cause == MISSING)
        counts, causes = (np.array([each[at] for each in gaps], dtype=np.uint64) for at in (3, 2))
        zeros = np.zeros(len(gaps), dtype=np.int64)
        begins = np.array([max(1, gap.begin) for gap in gaps], dtype=np.int64)
        return Columns(_LOST, order, np.array([gap.time for gap in gaps], dtype=np.int64), zeros,
                       zeros, [np.minimum(counts, 2 ** 62), begins, causes])

    def _target(self, kind: Kind) -> _Target:
        """Return a kind of event in the trace, which is defined when it is met."""
        found = self._targets.get(id(kind))
        if found is not None:
            return found
        provider, colon, name = kind.name.partition(':')
        if not colon:
            provider, name = 'ctf', kind.name
        key = f'{_legal(provider)}:{_legal(name)}'
        self._names.add(key)
        if key in BEFORE_HUMBLE:
            raise TraceError(self._path, BEFORE_HUMBLE_PROBLEM, BEFORE_HUMBLE_REMEDY)
        event, converts = event_type(key, [(each.name, each.kind) for each in kind.fields])
        self._targets[id(kind)] = _Target(
            kind, self._file.define(event), converts if any(converts) else [])
        return self._targets[id(kind)]

    def _fields(self, target: _Target, rows: Rows) -> list[Array] | list[tuple[Any, ...]]:
        """Return the fields of events of a kind as the writer wants them."""
        if self._writer.has_columns(target.event):
            if rows.columns is not None:
                return rows.columns     # the writer converts them as the converters do
            return [np.array(values, dtype=each.kind.partition('[')[0])
                    for each, values in zip(target.kind.fields, zip(*rows.tuples))]
        tuples = rows.tuples
        if rows.columns is not None:
            lists = [[text_of(each) for each in column.tolist()] if column.dtype.kind == 'S'
                     else column.tolist() for column in rows.columns]
            tuples = list(zip(*lists)) if lists else [()] * rows.count
        if target.converters:
            tuples = [tuple([value if convert is None else convert(value)
                             for convert, value in zip(target.converters, values)])
                      for values in tuples]
        return tuples

    def finish(self) -> None:
        """Note what is missing or was changed."""
        result, path = self.result, self._path
        if result.events == 0:
            raise TraceError(
                path, f'no event can be read ({self.damages[0]})' if self.damages
                else 'no event is recorded in it', _RECORD)
        result.kinds = len(self._names)
        self._repeated += self._several.repeated if self._several else 0
        if self._repeated:
            result.warnings.append(
                f'{path}: {counted(self._repeated, "event")} in more than one session of a host: '
                'each is used once')
        if result.discarded:
            result.warnings.append(
                f'{path}: the tracer discarded {counted(result.discarded, "event")}: what '
                'followed from them is missing; record with larger or more sub-buffers')
        if result.packets_missing:
            result.warnings.append(
                f'{path}: {counted(result.packets_missing, "packet")} of events not in it: the '
                'tracer has overwritten them (flight recorder), or their files are gone (rotated '
                'away): what followed from them is missing')
        if self.damages:
            result.warnings += self.damages[:_MOST_DAMAGES]
            if len(self.damages) > _MOST_DAMAGES:
                result.warnings.append(
                    f'{path}: {len(self.damages) - _MOST_DAMAGES} more files are damaged')
        if self._nameless:
            result.warnings.append(
                f'{path}: no process or thread is known of {counted(self._nameless, "event")}: '
                'add the contexts vpid and vtid when recording')
        if self._impossible:
            result.warnings.append(
                f'{path}: left out {counted(self._impossible, "event")} with '
                'impossible numbers of processes or threads')


def _merged(tables: Sequence[Columns]) -> Columns:
    """Return the events of a kind as one table."""
    first = tables[0]
    if len(tables) == 1:
        return first
    order, time, vpid, vtid = (np.concatenate(each) for each in list(zip(*(
        table[1:5] for table in tables))))
    fields: Any = [each for table in tables for each in table.fields]
    if fields and isinstance(fields[0], np.ndarray):
        fields = [np.concatenate(each) for each in zip(*(table.fields for table in tables))]
    return Columns(first.event, order, time, vpid, vtid, fields)


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

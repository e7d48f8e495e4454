# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Events as a CTF 1.8 session, as LTTng records it: for babeltrace2, Trace Compass and CARET.

Theory of operation
-------------------
A session is a folder with `ust/metadata`, a text that says what events there are, and one stream
of packets, `ust/channel0`.  All values are little endian and aligned to bytes; a boolean is an
integer of 8 bits, as LTTng has it.  Process, thread and process name are each event's context.
Processes are named by `mddag:process` events in a trace; such an event becomes that context.

Times are the trace's, so the session's clock has no offset.  Events come in the order of time.

tracetools_analysis asks for an ``rcl_init``: one stands first where the trace has none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import os
from pathlib import Path
import shutil
import struct
import tempfile
from types import TracebackType
from typing import Any, BinaryIO

from mddag_executor.trace.cdr import FieldType
from mddag_executor.trace.errors import renamed, TraceError
from mddag_executor.trace.reader import TraceReader
from mddag_executor.trace.schema import EVENTS, PREAMBLE, PROCESS

_MAGIC = 0xC1FC1FC1
_PACKET_BYTES = 256 * 1024
_HEADER = struct.Struct('<IIQQQQQI')
_EVENT = struct.Struct('<IQii')
_LENGTH = struct.Struct('<I')
_LATEST = 2 ** 63 - 1
_INIT = 'ros2:rcl_init'
_INIT_FIELDS = {'context_handle': FieldType('uint64'), 'version': FieldType('string')}
_CODES = {'byte': 'B', 'char': 'B', 'bool': 'B', 'float32': 'f', 'float64': 'd', **{
    f'{sign}int{bits}': code if sign else code.lower()
    for bits, code in ((8, 'B'), (16, 'H'), (32, 'I'), (64, 'Q')) for sign in ('u', '')}}
_STRING = 'string { encoding = UTF8; }'
_METADATA = """/* CTF 1.8 */
typealias integer { size = 32; align = 8; signed = false; } := uint32_t;
typealias integer { size = 64; align = 8; signed = false; } := uint64_t;
trace {
  major = 1; minor = 8; byte_order = le;
  packet.header := struct { uint32_t magic; uint32_t stream_id; };
};
env {
  domain = "ust"; tracer_name = "lttng-ust"; tracer_major = 2; tracer_minor = 13;
};
clock { name = monotonic; freq = 1000000000; offset = 0; absolute = true; };
typealias integer { size = 64; align = 8; signed = false; map = clock.monotonic.value; } := time_t;
stream {
  id = 0;
  packet.context := struct { time_t timestamp_begin; time_t timestamp_end; uint64_t content_size;
    uint64_t packet_size; uint64_t events_discarded; uint32_t cpu_id; };
  event.header := struct { uint32_t id; time_t timestamp; };
  event.context := struct {
    integer { size = 32; align = 8; signed = true; } _vpid;
    integer { size = 32; align = 8; signed = true; } _vtid;
    string { encoding = UTF8; } _procname; };
};
"""


def export_ctf(
    path: str | os.PathLike[str], folder: str | os.PathLike[str], *,
    name: str | None = None, progress: Callable[[int], None] | None = None,
) -> list[str]:
    """
    Write all events of a trace as a session; return what is missing of the trace.

    :param folder: the session; there must be none yet.
    """
    reader = TraceReader(path)
    with CtfSession(folder) as session:
        for number, (layout, time, vpid, vtid, *values) in enumerate(reader.layout_events(None)):
            if number == 0 and not reader.may_have(_INIT):
                session.add(_INIT, time, vpid, vtid, tuple(_INIT_FIELDS),
                            tuple(_INIT_FIELDS.values()), (0, ''))
            session.add(layout.name, time, vpid, vtid, layout.fields, layout.types, values)
            if progress is not None and number % 5000 == 0:
                progress(number)
    return [renamed(text, reader.path, name or reader.path) for text in reader.warnings]


def export_dicts(
    events: Iterator[dict[str, Any]], folder: str | os.PathLike[str],
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write events as ``trace.read_events`` has them as a session."""
    with CtfSession(folder) as session:
        for number, event in enumerate(events):
            key = event['_name']
            table = dict(EVENTS[key].fields) if key in EVENTS else {}
            fields = tuple(each for each in event if not each.startswith('_'))
            types = tuple(FieldType.parse(table.get(each) or (
                'string' if isinstance(event[each], str) else 'uint64')) for each in fields)
            session.add(key, event['_timestamp'], event['_vpid'], event['_vtid'], fields, types,
                        [event[each] for each in fields])
            if progress is not None and number % 5000 == 0:
                progress(number)


class CtfSession:
    """A session being written; the folder appears when the block ends well."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._target = Path(os.fspath(folder))
        self._kinds: dict[tuple[Any, ...], tuple[int, Callable[[Sequence[Any]], bytes]]] = {}
        self._metadata = [_METADATA]
        self._names: dict[tuple[int, int], bytes] = {}
        self._packet: list[bytes] = []
        self._size = 0
        self._begin = self._end = 0
        self._file: BinaryIO

    def __enter__(self) -> CtfSession:
        """Make the folder, under another name for now."""
        if self._target.exists() and (
                not self._target.is_dir() or any(self._target.iterdir())):
            raise TraceError(str(self._target), 'is there already', 'name another folder')
        try:
            self._part = Path(tempfile.mkdtemp(
                prefix=f'.{self._target.name}.', suffix='.part', dir=self._target.parent))
            (self._part / 'ust').mkdir()
            self._part.chmod(0o755)
            self._file = open(self._part / 'ust' / 'channel0', 'wb')
        except OSError as error:
            raise self._error(error) from None
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Complete the session, or take it away when an exception leaves the block."""
        try:
            if kind is None:
                self._flush()
                text = ''.join(self._metadata)
                (self._part / 'ust' / 'metadata').write_text(text, encoding='utf-8')
            self._file.close()
            if kind is None:
                os.replace(self._part, self._target)
        except OSError as failed:
            raise self._error(failed) from None
        finally:
            shutil.rmtree(self._part, ignore_errors=True)

    def _error(self, error: OSError) -> TraceError:
        return TraceError(str(self._target), f'cannot be written ({error.strerror})',
                          'name a folder where you may write')

    def add(
        self, name: str, time: int, vpid: int, vtid: int, fields: tuple[str, ...],
        types: tuple[FieldType, ...], values: Sequence[Any],
    ) -> None:
        """Add an event; times never decrease."""
        if name == PROCESS and len(values) == 1:
            self._names[vpid, vtid] = _text(values[0])
            return
        kind = self._kinds.get((name, fields, types))
        if kind is None:
            kind = self._define(name, fields, types)
        number, pack = kind
        time = min(max(time, self._end), _LATEST)
        if not self._packet:
            self._begin = time
        self._end = time
        data = (_EVENT.pack(number, time, vpid, vtid)
                + self._names.get((vpid, vtid), b'\0') + pack(values))
        self._packet.append(data)
        self._size += len(data)
        if self._size >= _PACKET_BYTES:
            self._flush()

    def _define(
        self, name: str, fields: tuple[str, ...], types: tuple[FieldType, ...]
    ) -> tuple[int, Callable[[Sequence[Any]], bytes]]:
        number = len(self._kinds)
        self._metadata.append(
            f'event {{ name = "{name}"; id = {number}; stream_id = 0; loglevel = 13; '
            'fields := struct { '
            + ' '.join(_declared(_original(name, fields), kind)
                       for name, kind in zip(fields, types)) + ' }; };\n')
        kind = self._kinds[name, fields, types] = number, _packer(types)
        return kind

    def _flush(self) -> None:
        """Write a packet."""
        if not self._packet:
            return
        bits = 8 * (_HEADER.size + self._size)
        try:
            self._file.write(_HEADER.pack(
                _MAGIC, 0, self._begin, self._end, bits, bits, 0, 0) + b''.join(self._packet))
        except OSError as error:
            raise self._error(error) from None
        self._packet, self._size = [], 0


def _original(name: str, fields: Sequence[str]) -> str:
    """Return the name that a field had before the import gave way to a field of each event."""
    given = name.removesuffix('_')
    return given if given in dict(PREAMBLE) and given not in fields else name


def _declared(name: str, kind: FieldType) -> str:
    """Return the declaration of a field."""
    base = _base(kind.base)
    if kind.count is None:
        return f'{base} _{name};'
    if kind.count < 0:
        return f'{_base("uint32")} __{name}_length; {base} _{name}[ __{name}_length ];'
    return f'{base} _{name}[{kind.count}];'


def _base(base: str) -> str:
    if base == 'string':
        return _STRING
    if base.startswith('float'):
        exponent, mantissa = (8, 24) if base == 'float32' else (11, 53)
        return (f'floating_point {{ exp_dig = {exponent}; mant_dig = {mantissa}; '
                'byte_order = le; align = 8; }')
    signed = 'true' if base.startswith('int') else 'false'
    bits = 8 * struct.calcsize(_CODES[base])
    return f'integer {{ size = {bits}; align = 8; signed = {signed}; }}'


def _packer(types: tuple[FieldType, ...]) -> Callable[[Sequence[Any]], bytes]:
    """Return what packs the values of an event."""
    if all(kind.count is None and kind.base != 'string' for kind in types):
        whole = struct.Struct('<' + ''.join(_CODES[kind.base] for kind in types))
        return lambda values: whole.pack(*values)
    return lambda values: b''.join(_packed(*each) for each in zip(types, values))


def _packed(kind: FieldType, value: Any) -> bytes:
    several = (value,) if kind.count is None else value
    head = _LENGTH.pack(len(several)) if kind.count is not None and kind.count < 0 else b''
    if kind.base == 'string':
        return head + b''.join(_text(each) for each in several)
    return head + struct.pack(f'<{len(several)}{_CODES[kind.base]}', *several)


def _text(value: str) -> bytes:
    """Return a text with its end; it cannot hold one inside."""
    return value.replace('\0', '\\0').encode('utf-8', 'backslashreplace') + b'\0'

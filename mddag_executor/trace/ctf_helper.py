# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads CTF sessions with babeltrace2 and streams their events to `ctf`; a separate process.

Theory of operation:

1. This file runs as a program in any Python that has the module `bt2`; it imports nothing of this
   project and needs Python 3.9 or later. If babeltrace2 aborts on damaged input, only this process
   ends.
2. Standard output has one JSON row a line:
   `["missing", reason]` (no bt2 here; the only row), `["ready"]` (the first row),
   `["class", number, name, [[field, type], ...], trace]` (before its first event),
   `["event", number, timestamp, vpid, vtid, procname, [value, ...]]`,
   `["discarded", timestamp, count]` (-1: unknown count),
   `["error", reason]` or `["end"]` (the last row). Output without a last row is incomplete.
3. Types are those of ros2msg: integers by sign and size, `float32`, `float64`, `string`, `bool`,
   arrays and sequences of these. A structure becomes its members, `outer_inner`. Other types
   (variants, arrays of structures) become JSON text: nothing is lost.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
import json
import os
import signal
import sys
from typing import Any, BinaryIO, NamedTuple

PATIENCE_S = 60     # seconds until the next row; on some damage babeltrace2 2.0 hangs

Member = tuple[str, str, Callable[[Any, Any], Any]]
"""Name, type, and getter from a structure: its native field, and its object of bt2."""


def rows_to(stream: BinaryIO) -> Callable[..., None]:
    """Return a function that writes a row to a binary stream."""
    encode = json.JSONEncoder(separators=(',', ':')).encode

    def add(*row: Any) -> None:
        signal.alarm(0)             # no limit while the importer reads
        stream.write(encode(row).encode('ascii') + b'\n')
        signal.alarm(PATIENCE_S)    # SIGALRM ends a hanging process

    return add


def plain(field: Any) -> Any:
    """Return any field as a value that JSON can hold."""
    kind = type(field).__name__
    if 'Structure' in kind:
        return {name: plain(value) for name, value in field.items()}
    if 'Variant' in kind:
        return plain(field.selected_option)
    if 'Option' in kind:
        return None if field.field is None else plain(field.field)
    if 'Array' in kind and 'BitArray' not in kind:
        return [plain(value) for value in field]
    return scalar(kind)[1](field)


def scalar(kind: str, size: int = 64) -> tuple[str, Callable[[Any], Any]]:
    """
    Return the type of a primitive and its converter.

    :param kind: the name of its class in bt2, of the field or of the field's class
    :param size: an integer's bits
    :raises ValueError: if it is not a primitive
    """
    if 'String' in kind:
        return 'string', str
    if 'Bool' in kind:
        return 'bool', bool
    if 'Real' in kind:
        return ('float32' if 'SinglePrecision' in kind else 'float64'), float
    if 'Integer' in kind or 'Enumeration' in kind or 'BitArray' in kind:
        bits = next(bits for bits in (8, 16, 32, 64) if bits >= size)
        sign = 'int' if 'Signed' in kind else 'uint'
        return f'{sign}{bits}', int
    raise ValueError(kind)


def primitive(cls: Any) -> tuple[str, Callable[[Any], Any]]:
    """Return the type of a primitive's class and its converter; raise ValueError otherwise."""
    kind = type(cls).__name__
    return scalar(kind, getattr(cls, 'field_value_range', 0) or getattr(cls, 'length', 64))


def member(cls: Any) -> tuple[str, Callable[[Any], Any]]:
    """Return the message type of the fields of a class, and their converter."""
    kind = type(cls).__name__
    try:
        if 'Array' not in kind or 'BitArray' in kind:
            return primitive(cls)
        base, convert = primitive(cls.element_field_class)
    except ValueError:
        return 'string', lambda field: json.dumps(plain(field))
    length = cls.length if 'Static' in kind else 0

    def convert_all(field: Any) -> list[Any]:
        return [convert(value) for value in field]

    return f'{base}[{length or ""}]', convert_all


def members(native: Any, cls: Any, prefix: str = '') -> list[Member]:
    """
    Return the members of a structure's class; nested structures are flattened.

    :param native: the functions of babeltrace2 itself; its objects take ten times as long.
    """
    found: list[Member] = []
    if cls is None:
        return found
    for place, name in enumerate(cls):
        inner = cls[name].field_class
        if 'Structure' in type(inner).__name__:
            found += [(deeper, kind, _within(native, place, get))
                      for deeper, kind, get in members(native, inner, f'{prefix}{name}_')]
        else:
            kind, convert = member(inner)
            value = _plain_value(native, type(inner).__name__)
            get = (lambda _, field, place=place, convert=convert:
                   convert(field().member_at_index(place))) if value is None else (
                lambda pointer, _, place=place, value=value:
                    value(native.field_structure_borrow_member_field_by_index_const(
                        pointer, place)))
            found.append((prefix + name, kind, get))
    return found


def _plain_value(native: Any, kind: str) -> Callable[[Any], Any] | None:
    """Return the native getter of a number's or text's class; None: it needs its object."""
    getter: Callable[[Any], Any] | None = None
    if 'String' in kind:
        getter = native.field_string_get_value
    elif 'Integer' in kind or 'Enumeration' in kind:
        getter = native.field_integer_unsigned_get_value if 'Unsigned' in kind \
            else native.field_integer_signed_get_value
    return getter


def _within(native: Any, place: int, get: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    inner = native.field_structure_borrow_member_field_by_index_const
    return lambda pointer, field: get(
        inner(pointer, place), lambda: field().member_at_index(place))


class _Class(NamedTuple):
    """A class of events: its number, itself, and the getters of fields and identity."""

    number: int
    cls: Any
    getters: list[Callable[[Any, Any], Any]]
    identity: list[Callable[[Any, Any], Any] | None]


class Sessions:
    """The events of the sessions of a host, as rows."""

    def __init__(self, bt2: Any, add: Callable[..., None]) -> None:
        self._bt2 = bt2
        self._add = add
        native = self._native = import_module('bt2.native_bt')
        self._event_of = native.message_event_borrow_event_const
        self._class_of = native.event_borrow_class_const
        self._payload_of = native.event_borrow_payload_field_const
        self._context_of = native.event_borrow_common_context_field_const
        # By address of the event's class, which is kept so that its address is not reused.
        self._known: dict[int, _Class] = {}
        self._traces: dict[Any, int] = {}       # their numbers

    def read(self, paths: list[str]) -> None:
        """Write a row for each event below some folders, in the order of time."""
        bt2 = self._bt2
        discarded = (bt2._DiscardedEventsMessageConst, bt2._DiscardedPacketsMessageConst)
        for message in bt2.TraceCollectionMessageIterator(paths):
            if type(message) is bt2._EventMessageConst:
                self._event(message)
            elif isinstance(message, discarded):
                self._discarded(message)

    def _event(self, message: Any) -> None:
        event = self._event_of(message._ptr)
        known = self._known.get(int(self._class_of(event)))
        if known is None:
            known = self._define(message.event)
        payload, context = self._payload_of(event), self._context_of(event)
        self._add(
            'event', known.number, message.default_clock_snapshot.ns_from_origin,
            *[get and get(context, lambda: message.event.common_context_field)
              for get in known.identity],
            [get(payload, lambda: message.event.payload_field) for get in known.getters])

    def _define(self, event: Any) -> _Class:
        cls = event.cls         # belongs to one trace
        fields = members(self._native, cls.payload_field_class)
        context = {name: get for name, _, get in members(
            self._native, cls.stream_class.event_common_context_field_class)}
        known = self._known[cls.addr] = _Class(
            len(self._known), cls, [get for _, _, get in fields],
            [next((context[name] for name in names if name in context), None)
             for names in _IDENTITY])
        trace = event.stream.trace      # the chunks of a session are one trace
        self._add('class', known.number, cls.name or '', [field[:2] for field in fields],
                  self._traces.setdefault(trace.uuid or trace.addr, len(self._traces)))
        return known

    def _discarded(self, message: Any) -> None:
        """Report discarded events; a packet counts as an unknown number of events."""
        packets = isinstance(message, self._bt2._DiscardedPacketsMessageConst)
        count = None if packets else message.count
        try:
            time = message.end_default_clock_snapshot.ns_from_origin
        except (AttributeError, ValueError):
            time = -1       # the stream has no times for it
        self._add('discarded', time, -1 if count is None else count)


# Process, thread and name: of user space first, then of the kernel.
_IDENTITY = (('vpid', 'pid'), ('vtid', 'tid'), ('procname',))


def reason(error: BaseException) -> str:
    """Return the first cause of an error in one line, without babeltrace2's chain of causes."""
    causes = list(getattr(error, '_causes', None) or ())
    text = getattr(causes[0], 'message', None) if causes else None
    return ' '.join(str(text or error or type(error).__name__).split())


def main(sessions: list[str]) -> int:
    """Read the sessions of a host; the last row has the outcome."""
    # Output of libraries must not mix with the rows.
    with os.fdopen(os.dup(1), 'wb') as stream:
        os.dup2(2, 1)
        add = rows_to(stream)
        try:
            bt2 = import_module('bt2')      # type checkers may not have it
        except Exception as error:      # includes bindings that do not fit their library
            add('missing', f'{type(error).__name__}: {error}')
            return 0
        add('ready')
        stream.flush()
        try:
            Sessions(bt2, add).read(sessions)
            add('end')
        except BrokenPipeError:
            os._exit(1)     # the importer has ended
        except Exception as error:      # any error must be reported to the importer
            add('error', reason(error))
    return 0


if __name__ == '__main__':
    # Don't import from this file's folder: it has modules of the project.
    _here = os.path.dirname(os.path.abspath(__file__))
    sys.path[:] = [_path for _path in sys.path if os.path.abspath(_path or '.') != _here]
    sys.exit(main(sys.argv[1:]))

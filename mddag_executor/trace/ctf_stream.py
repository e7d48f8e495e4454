# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the packets of CTF traces, and merges their events in the order of time.

Theory of operation:

1. A stream (of a processor, in a trace) is packets, one after another; of a session that was
   rotated it continues in the next file.  A packet says its size and that of its content, its
   first and last time, its number, and how many events were discarded so far.
2. Packets are taken in the order of their first times, about `_WINDOW` bytes at once.  All events
   before the first time of any later packet are known then: they are sorted, and yielded as
   columns.  The rest, at most that of a packet of each stream, waits.  So the memory is bounded.
3. Events follow each other without an index.  A loop steps from one to the next, by the size of
   each kind; the fields are gathered later, a kind at a time (`ctf_layout`).  Events without a
   known size are read one by one.
4. A time in an event has only its last bits; it is the first such time after the one before it.
5. *Damage.*  What comes from the file is checked before it is used.  Of a packet in which an event
   cannot be read, the events before it are used; of a file in which the head of a packet cannot be
   read, the packets before it.  Both are noted (`Damage`), and count as discarded events.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
import heapq
import os
import stat
import struct
from typing import Any, NamedTuple

from mddag_executor.text import counted
from mddag_executor.trace.ctf_layout import (
    aligned,
    Bytes,
    Cursor,
    Damaged,
    Field,
    fields_of,
    Layout,
    layout_of,
    Reader,
    reader_of,
    values_of,
)
from mddag_executor.trace.ctf_types import (
    Enumeration,
    Integer,
    Metadata,
    MetadataError,
    StreamClass,
    Struct,
    Type,
    Variant,
)
import numpy as np
import numpy.typing as npt

_WINDOW = 4 * 1024 * 1024
_HEAD = 4096            # the head of a packet is in these bytes
_MAGIC = 0xC1FC1FC1
_NS = 10 ** 9
_NEVER = 2 ** 63 - 1
_LONGEST_NAME = 255
_PER_STREAM = 2 ** 40
"""Streams have different places, which are numbers of their events and this times their own."""

Ints = npt.NDArray[np.int64]
Array = npt.NDArray[Any]

# process, thread and name: of user space first, then of the kernel
_INTEGERS = frozenset(f'{sign}int{bits}' for sign in ('', 'u') for bits in (8, 16, 32, 64))
_IDENTITY = ((('vpid', 'pid'), _INTEGERS), (('vtid', 'tid'), _INTEGERS),
             (('procname',), frozenset({'string'})))
_STRUCT = {f'{order}u{size}': order + code
           for order in '<>' for size, code in ((1, 'B'), (2, 'H'), (4, 'I'))}


class Kind(NamedTuple):
    """A kind of event: its name and what it consists of."""

    name: str
    fields: tuple[Field, ...]


@lru_cache(65536)
def _kind(name: str, payload: Struct | None) -> Kind:
    """Return a kind of event, which is the same object for all traces."""
    return Kind(name, fields_of(payload))


@dataclass
class Rows:
    """Events of a kind: columns by field, or a tuple for each event."""

    kind: Kind
    count: int
    columns: list[Array] | None
    tuples: list[tuple[Any, ...]]

    def picked(self, rows: Ints) -> Rows:
        """Return some of the events."""
        if self.columns is not None:
            return Rows(self.kind, len(rows), [column[rows] for column in self.columns], [])
        return Rows(self.kind, len(rows), None, [self.tuples[row] for row in rows.tolist()])


@dataclass
class Events:
    """
    Events of several kinds, as columns.

    :ivar place: in the order of their stream.
    :ivar rows: event by event its place in a table of ``tables``, whose number is ``table``.
    :ivar known: whether process and thread are recorded.
    :ivar raw: the bytes of each event's fields, if they are wanted.
    """

    time: Ints
    place: Ints
    vpid: Ints
    vtid: Ints
    procname: Array
    known: npt.NDArray[np.bool_]
    trace: Ints
    table: Ints
    row: Ints
    raw: Array
    tables: list[Rows] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.time)

    def picked(self, which: Array) -> Events:
        """Return some of the events, in the order given; tables have no others."""
        found = Events(**{name: getattr(self, name)[which] for name in _COLUMNS})
        row = found.row.copy()
        order = np.argsort(found.table, kind='stable')
        bounds = np.searchsorted(found.table[order], np.arange(len(self.tables) + 1))
        for number, rows in enumerate(self.tables):
            mine = order[bounds[number]:bounds[number + 1]]
            found.tables.append(rows.picked(found.row[mine]))
            row[mine] = np.arange(len(mine))
        found.row = row
        return found


_COLUMNS = ('time', 'place', 'vpid', 'vtid', 'procname', 'known', 'trace', 'table', 'row', 'raw')


def joined(parts: Sequence[Events]) -> Events:
    """Return the events of several parts; each kind has one table."""
    tables: dict[tuple[int, bool], list[Rows]] = {}
    numbers: dict[tuple[int, bool], int] = {}
    sizes: dict[tuple[int, bool], int] = {}
    table, row = [], []
    for part in parts:
        shifts, places = [], []
        for rows in part.tables:
            key = id(rows.kind), rows.columns is None
            places.append(numbers.setdefault(key, len(numbers)))
            shifts.append(sizes.get(key, 0))
            sizes[key] = shifts[-1] + rows.count
            tables.setdefault(key, []).append(rows)
        table.append(np.array(places, dtype=np.int64)[part.table])
        row.append(part.row + np.array(shifts, dtype=np.int64)[part.table])
    columns = {name: np.concatenate([getattr(part, name) for part in parts])
               for name in _COLUMNS if name not in ('table', 'row')}
    return Events(table=np.concatenate(table), row=np.concatenate(row),
                  tables=[_one_table(each) for each in tables.values()], **columns)


def _one_table(parts: Sequence[Rows]) -> Rows:
    first = parts[0]
    if len(parts) == 1:
        return first
    columns = None if first.columns is None else [
        np.concatenate(each) for each in zip(*(part.columns or () for part in parts))]
    return Rows(first.kind, sum(part.count for part in parts), columns,
                [values for part in parts for values in part.tuples])


def _no_events() -> Events:
    none = np.zeros(0, dtype=np.int64)
    return Events(none, none, none, none, none.astype('S1'), none.astype('?'), none, none, none,
                  none.astype(object))


class Lost(NamedTuple):
    """
    Events that are missing.

    :ivar time: at the end of the gap; ``begin``: at its begin.
    :ivar number: how many; -1: unknown.
    :ivar damage: whether a file is damaged; otherwise the tracer discarded them.
    """

    time: int
    begin: int
    number: int
    damage: bool = False


class Damage(NamedTuple):
    """What is wrong in a file, where, and how many bytes are not used because of it."""

    file: str
    offset: int
    what: str
    lost: int


def described(damages: Sequence[Damage]) -> list[str]:
    """Return a line for each file that is damaged."""
    by_file: dict[str, list[Damage]] = {}
    for damage in damages:
        by_file.setdefault(damage.file, []).append(damage)
    lines = []
    for file, found in by_file.items():
        first, lost = min(found), sum(damage.lost for damage in found)
        more = f', and it is damaged at {counted(len(found) - 1, "more place")}' * (len(found) > 1)
        missing = f'{counted(lost, "byte")} are not used' if lost else 'what followed is missing'
        lines.append(f'{file}: {first.what} (at byte {first.offset}){more}: {missing}')
    return lines


@dataclass
class Packet:
    """
    A packet.

    :ivar begin: first and last time, in ticks of the clock.
    :ivar body: where its events begin and end, bytes from ``offset``.
    """

    file: str
    offset: int
    begin: int
    end: int
    body: int
    content: int
    decoder: Decoder
    stream: int

    def load(self) -> bytes:
        """Return the content."""
        with open(self.file, 'rb', buffering=0) as stream:
            return os.pread(stream.fileno(), self.content, self.offset)


class Trace:
    """
    A trace: what its metadata says, and the streams in its folders.

    :ivar number: which trace of a host it is.
    """

    def __init__(self, metadata: Metadata, number: int, raw: bool) -> None:
        self.metadata, self.number = metadata, number
        self.decoders = {number: Decoder(self, stream, raw)
                         for number, stream in metadata.streams.items()}
        self.files: list[str] = []
        environment = metadata.environment
        version = tuple(int(environment.get(f'tracer_{part}', '0')[:6]) if environment.get(
            f'tracer_{part}', '0').isdecimal() else 0 for part in ('major', 'minor'))
        #: By how much events may be after the end of their packet: earlier tracers noted it before
        #: the last events.
        self.slack = 0 if version == (0, 0) or version >= (2, 13) else metadata.clock.frequency

    def ns(self, ticks: int) -> int:
        """Return a time of its clock as ns of the epoch, in the range of times."""
        clock = self.metadata.clock
        return min(max(ticks * _NS // clock.frequency + clock.offset, 0), _NEVER - 1)

    def all_ns(self, ticks: npt.NDArray[np.uint64]) -> Ints:
        """Return times as ns; -1: impossible."""
        clock = self.metadata.clock
        low, high = (max(0, -(-(bound - clock.offset) * clock.frequency // _NS))
                     for bound in (0, _NEVER - _NS))
        if high > 2 ** 64 - 1:
            high = 2 ** 64 - 1
        possible = (ticks >= np.uint64(min(low, 2 ** 64 - 1))) & (ticks <= np.uint64(high))
        frequency = np.uint64(clock.frequency)
        found = ticks.copy()
        if clock.frequency != _NS:
            found = (ticks // frequency * np.uint64(_NS)
                     + ticks % frequency * np.uint64(_NS) // frequency)
        found += np.uint64(clock.offset % 2 ** 64)
        return np.where(possible, found.view(np.int64), -1)


class _Form(NamedTuple):
    """
    A form of the head of an event.

    :ivar low: the first and last tag that have this form.
    """

    low: int
    high: int
    head: Struct
    number: tuple[str, ...]     # path of the event's number
    stamp: tuple[str, ...]      # and of its time; empty: it has none
    bits: int                   # of the time


class _Head(NamedTuple):
    """Head and context of an event at a place: their layout, and the paths in it."""

    layout: Layout
    number: tuple[str, ...]
    stamp: tuple[str, ...]
    bits: int


class _Slow(NamedTuple):
    """An event that was read by itself."""

    at: int
    number: int
    stamp: int
    bits: int
    identity: tuple[Any, ...]
    payload: tuple[int, int]
    values: tuple[Any, ...]


class Decoder:
    """Reads the events of a stream's class."""

    def __init__(self, trace: Trace, stream: StreamClass, raw: bool) -> None:
        self.trace, self._stream, self._raw = trace, stream, raw
        self._classes = stream.events
        header = stream.header
        self._header = reader_of(header) if header else None
        self._forms = _forms_of(header) if header and header.members else []
        short = {form.bits for form in self._forms if form.stamp and form.bits < 64}
        if len(short) > 1:
            raise MetadataError('the times of its events are of several sizes')
        #: Bits of the times that are not whole.
        self.short_bits = min(short, default=0)
        self._context = reader_of(stream.context) if stream.context else None
        #: The paths of `_IDENTITY` in the context.
        self.identity = [
            next((each.path for name in names for each in fields_of(stream.context)
                  if each.name == name and each.kind in kinds), None)
            for names, kinds in _IDENTITY]
        self.known = all(path is not None for path in self.identity[:2])
        self._readers: dict[int, tuple[Reader | None, Reader | None, Kind]] = {}
        self._align = max(8, header.align if header else 8)
        self._tag = _tag_of(header) if self._forms and header and header.align % 8 == 0 else None
        self._unpack = struct.Struct(_STRUCT[self._tag.code]).unpack_from if self._tag else None
        # by place within 8 bytes: by tag the step to the next event, if it is known
        self._steps: list[dict[int, int]] | None = None

    # --- stepping --------------------------------------------------------------------------------

    def walk(self, data: bytes, at: int, end: int, fast: list[int], slow: list[_Slow]
             ) -> tuple[int, str] | None:
        """
        Note the places of events of known sizes, and read the others.

        :param at: where the events begin, and ``end`` where the content ends.
        :returns: where an event cannot be read, and why.
        """
        if self._steps is None:
            self._steps = self._all_steps()
        steps, one, add = self._steps, self._one, fast.append
        at = aligned(at * 8, self._align) // 8
        if self._tag is None or self._unpack is None:
            while at < end:
                after = one(data, at, end, slow)
                if isinstance(after, str):
                    return at, after
                at = after
            return None
        unpack, (_, shift, mask) = self._unpack, self._tag
        while at < end:
            tag, = unpack(data, at)
            step = steps[at & 7].get(tag >> shift & mask)
            if step is None:
                step = self._long_step(data, at, tag >> shift & mask)
                if step is None:
                    after = one(data, at, end, slow)
                    if isinstance(after, str):
                        return at, after
                    at = after
                    continue
            add(at)
            at += step
        return None

    def _all_steps(self) -> list[dict[int, int]]:
        """Return by place and tag the bytes from an event of the form to the next one."""
        tables: list[dict[int, int]] = []
        for place in range(8):
            tables.append({})
            for form in self._forms:
                if form.number == form.head.members[0][:1]:
                    head = self.head(form, place)
                    tables[-1].update({
                        number: step for number in self._classes
                        if form.low <= number <= form.high
                        and (step := self._step(head, place, number))})
        return tables

    def _step(self, head: _Head | None, place: int, number: int) -> int | None:
        """Return the bytes from an event to the next one; None if its size is not known."""
        if head is None or number not in self._classes:
            return None
        payload = self.payload(number, (place + head.layout.size // 8) % 8)
        if payload is None:
            return None
        bits = head.layout.size + payload.size
        return aligned(place * 8 + bits, self._align) // 8 - place

    def _long_step(self, data: bytes, at: int, tag: int) -> int | None:
        """Return the step of an event whose number is not its tag."""
        form = next((each for each in self._forms if each.low <= tag <= each.high), None)
        if form is None or form.number == form.head.members[0][:1]:
            return None
        head = self.head(form, at % 8)
        if head is None or at + head.layout.width > len(data):
            return None
        window = np.frombuffer(data, np.uint8, head.layout.width, at)
        rows = head.layout.rows(window, np.zeros(1, dtype=np.int64))
        return self._step(head, at % 8, int(head.layout.column(rows, head.number)[0]))

    def head(self, form: _Form, place: int) -> _Head | None:
        """Return the layout of the head of an event; None if it has none."""
        inner: list[tuple[str, Type]] = [('head', form.head)]
        if self._stream.context is not None:
            inner.append(('context', self._stream.context))
        layout = layout_of((Struct(tuple(inner), form.head.align, 1),), place)
        if layout is None or layout.size % 8:
            return None
        return _Head(layout, ('head', *form.number), form.stamp and ('head', *form.stamp),
                     form.bits)

    def payload(self, number: int, place: int) -> Layout | None:
        """Return the layout of the fields of a kind of event; None if it has none."""
        event = self._classes[number]
        inner: list[tuple[str, Type]] = []
        if event.context is not None:
            inner.append(('context', event.context))
        if event.payload is not None:
            inner.append(('payload', event.payload))
        layout = layout_of((Struct(tuple(inner), max([1, *(
            kind.align for _, kind in inner)]), 1),), place)
        if layout is not None and any(
                ('payload', *each.path) not in layout.paths for each in self.kind(number).fields):
            return None
        return layout

    def kind(self, number: int) -> Kind:
        """Return a kind of event."""
        return self._reader(number)[2]

    def _reader(self, number: int) -> tuple[Reader | None, Reader | None, Kind]:
        found = self._readers.get(number)
        if found is None:
            event = self._classes.get(number)
            if event is None:
                raise Damaged(f'an event has the unknown number {number}')
            found = self._readers[number] = (
                reader_of(event.context) if event.context else None,
                reader_of(event.payload) if event.payload else None,
                _kind(event.name, event.payload))
        return found

    def _one(self, data: bytes, at: int, end: int, slow: list[_Slow]) -> int | str:
        """Read an event, and return the place of the next one, or what is wrong."""
        cursor = Cursor(data, at * 8, end * 8)
        try:
            number = stamp = bits = 0
            if self._header is not None:
                head = cursor.read('event-record-header', self._header)
                number, stamp, bits = self._read_head(head)
            context: dict[str, Any] = {}
            if self._context is not None:
                context = cursor.read('event-record-common-context', self._context)
            special, payload, kind = self._reader(number)
            if special is not None:
                cursor.read('event-record-specific-context', special)
            start = cursor.at
            values: tuple[Any, ...] = ()
            if payload is not None:
                values = values_of(kind.fields, cursor.read('event-record-payload', payload))
            identity = tuple(_within(context, path) for path in self.identity)
        except (Damaged, struct.error, KeyError, TypeError) as error:
            return str(error) if isinstance(error, Damaged) else 'an event is not understood'
        if cursor.at == at * 8:
            return 'an event has no size'
        slow.append(_Slow(at, number, stamp, bits, identity,
                          (start // 8, -(-cursor.at // 8)), values))
        return aligned(cursor.at, self._align) // 8

    def _read_head(self, head: dict[str, Any]) -> tuple[int, int, int]:
        """Return number and time of an event, and the bits of the time."""
        number = stamp = bits = 0
        for form in self._forms:
            if form.low <= head.get('id', form.low) <= form.high:
                number = _within(head, form.number) if form.number else 0
                stamp = _within(head, form.stamp) if form.stamp else 0
                bits = form.bits
                break
        else:
            raise Damaged('the head of an event is not understood')
        return number, stamp, bits

    # --- gathering -------------------------------------------------------------------------------

    def events(self, packets: Sequence[Packet], first: int, damages: list[Damage],
               lost: list[Lost]) -> Events | None:
        """
        Return the events of packets of this decoder, those of a stream in its order.

        :param first: the number of the first event, for places.
        """
        data = bytearray()
        starts: list[int] = []
        for packet in packets:
            starts.append(len(data))
            content = packet.load()
            data += content
            data += bytes(packet.content - len(content) + -packet.content % 8)
        data += bytes(16)
        whole = bytes(data)
        fast: list[int] = []
        slow: list[_Slow] = []
        bad: dict[int, tuple[int, str]] = {}        # by packet where it is damaged
        counts = np.zeros((len(packets), 2), dtype=np.int64)
        for number, (packet, start) in enumerate(zip(packets, starts)):
            before = len(fast), len(slow)
            wrong = self.walk(whole, start + packet.body, start + packet.content, fast, slow)
            counts[number] = len(fast) - before[0], len(slow) - before[1]
            if wrong is not None:
                bad[number] = wrong
        builder = _Builder(self, whole, packets, np.array(starts, dtype=np.int64), self._raw)
        builder.take(np.array(fast, dtype=np.int64), np.repeat(
            np.arange(len(packets)), counts[:, 0]), self._forms, self._tag)
        builder.take_slow(slow, np.repeat(np.arange(len(packets)), counts[:, 1]))
        found = builder.finish(first, bad)
        for number, (at, what) in sorted(bad.items()):
            packet, at = packets[number], at - starts[number]
            damages.append(Damage(packet.file, packet.offset + at, what, packet.content - at))
            begin, end = (self.trace.ns(each) for each in (
                packet.begin, max(packet.begin, packet.end)))
            lost.append(Lost(end, begin, -1, True))
        return found


def _within(found: Any, path: Sequence[str] | None) -> Any:
    if path is None:
        return None
    for name in path:
        found = found[name]
    return found


class _Tag(NamedTuple):
    """How the first field of an event is read: numpy's name of the bytes, shift and mask."""

    code: str
    shift: int
    mask: int


def _tag_of(header: Struct) -> _Tag | None:
    """Return how the number of an event is read, if it comes first."""
    name, kind = header.members[0]
    kind = kind.container if isinstance(kind, Enumeration) else kind
    if name != 'id' or not isinstance(kind, Integer) or kind.bits > 32 or kind.signed:
        return None
    size = next(size for size in (1, 2, 4) if size * 8 >= kind.bits)
    return _Tag(f'{">" if kind.big else "<"}u{size}', size * 8 - kind.bits if kind.big else 0,
                (1 << kind.bits) - 1)


def _forms_of(header: Struct) -> list[_Form]:
    """
    Return the forms of an event's head.

    LTTng's heads are a number, and a variant that it chooses: for small numbers only a time of few
    bits, otherwise the number and the whole time.

    :raises MetadataError: if it has others
    """
    variants = [(name, inner) for name, inner in header.members if isinstance(inner, Variant)]
    if not variants:
        return [_form(header, 0, 2 ** 64)]
    (name, choice), tag = variants[0], dict(header.members).get('id')
    options = dict(choice.options)
    forms: list[_Form] = []
    ranges = choice.ranges or (tag.labels if isinstance(tag, Enumeration) else ())
    if len(variants) == 1 and choice.tag.path == ('id',):
        for label, low, high in ranges[:16]:
            if label in options:
                members = tuple((each, options[label] if each == name else inner)
                                for each, inner in header.members)
                forms.append(_form(Struct(members, header.align, 1), low, high))
    taken = sorted((form.low, form.high) for form in forms)
    if not forms or any(after[0] <= before[1] for before, after in zip(taken, taken[1:])):
        raise MetadataError('the heads of its events are not those of LTTng')
    return forms


def _form(head: Struct, low: int, high: int) -> _Form:
    number: tuple[str, ...] = ()
    stamp: tuple[str, ...] = ()
    bits = 0
    todo: list[tuple[tuple[str, ...], Type]] = [((name,), inner) for name, inner in head.members]
    while todo:
        path, kind = todo.pop(0)
        if isinstance(kind, Struct):
            todo += [((*path, name), inner) for name, inner in kind.members]
        elif path[-1] == 'id':
            number = path       # the last one, which is the whole one
        kind = kind.container if isinstance(kind, Enumeration) else kind
        if isinstance(kind, Integer) and (kind.clock or path[-1] == 'timestamp'):
            stamp, bits = path, kind.bits
    return _Form(low, high, head, number, stamp, bits)


class _Builder:
    """Makes columns of the events of some packets."""

    def __init__(self, decoder: Decoder, data: bytes, packets: Sequence[Packet], starts: Ints,
                 raw: bool) -> None:
        self._decoder, self._data, self._packets, self._raw = decoder, data, packets, raw
        self._bytes: Bytes = np.frombuffer(data, np.uint8)
        self._ends = starts + np.array([packet.content for packet in packets], dtype=np.int64)
        self._parts: list[Events] = []
        # of each part place, packet, and the time's bits and their number
        self._marks: list[tuple[Ints, Ints, npt.NDArray[np.uint64], Ints]] = []
        self._cut: dict[int, tuple[int, str]] = {}

    def take(self, at: Ints, packet: Ints, forms: Sequence[_Form], tag: _Tag | None) -> None:
        """Take events of known sizes at some places."""
        if not len(at) or tag is None:
            return
        code, shift, mask = tag.code, tag.shift, tag.mask
        tags = np.lib.stride_tricks.sliding_window_view(
            self._bytes, np.dtype(code).itemsize)[at].view(code).reshape(len(at)).astype(
                np.int64) >> shift & mask
        places = at & 7
        for form in forms:
            of_form = (tags >= form.low) & (tags <= form.high)
            for place in np.unique(places[of_form]).tolist():
                head = self._decoder.head(form, place)
                assert head is not None     # otherwise the step was not known
                mine = np.flatnonzero(of_form & (places == place))
                self._group(at[mine], packet[mine], place, head)

    def _group(self, at: Ints, packet: Ints, place: int, head: _Head) -> None:
        """Take events whose heads have one layout."""
        decoder, layout = self._decoder, head.layout
        size = layout.size // 8
        fits = self._fit(at, packet, at + size)
        at, packet = at[fits], packet[fits]
        rows = layout.rows(self._bytes, at)
        numbers = layout.column(rows, head.number)
        stamps = (layout.column(rows, head.stamp).astype(np.uint64) if head.stamp
                  else np.zeros(len(at), dtype=np.uint64))
        ids = [None if path is None else layout.column(rows, ('context', *path))
               for path in decoder.identity]
        for number in np.unique(numbers).tolist():
            payload = decoder.payload(number, (place + size) % 8)
            assert payload is not None
            mine = np.flatnonzero(numbers == number)
            begins = at[mine] + size
            fits = self._fit(at[mine], packet[mine], begins - (-payload.size // 8))
            mine, begins = mine[fits], begins[fits]
            if not len(mine):
                continue
            kind = decoder.kind(number)
            values = payload.rows(self._bytes, begins)
            columns = [payload.column(values, ('payload', *each.path)) for each in kind.fields]
            ends = begins - (-payload.size // 8)
            self._add(at[mine], packet[mine], stamps[mine], np.full(len(mine), head.bits),
                      [None if each is None else each[mine] for each in ids],
                      list(zip(begins.tolist(), ends.tolist())) if self._raw else [],
                      Rows(kind, len(mine), columns, []))

    def _fit(self, at: Ints, packet: Ints, ends: Ints) -> npt.NDArray[np.bool_]:
        """Return which events are in their packets, and note those that are not."""
        fits: npt.NDArray[np.bool_] = ends <= self._ends[packet]
        for where, number in zip(at[~fits].tolist(), packet[~fits].tolist()):
            self._cut[number] = where, 'an event is cut'
        return fits

    def take_slow(self, slow: Sequence[_Slow], packet: Ints) -> None:
        """Take events that were read one by one."""
        by_number: dict[int, list[int]] = {}
        for row, event in enumerate(slow):
            by_number.setdefault(event.number, []).append(row)
        for number, rows in by_number.items():
            events = [slow[row] for row in rows]
            ids: list[Array | None] = [
                np.array([_as_int64(event.identity[each]) for event in events], dtype=np.int64)
                for each in (0, 1)]
            if self._decoder.identity[2] is not None:
                ids.append(np.array([event.identity[2].encode('utf-8', 'replace')[:_LONGEST_NAME]
                                     for event in events], dtype=np.bytes_))
            else:
                ids.append(None)
            self._add(
                np.array([event.at for event in events], dtype=np.int64), packet[rows],
                np.array([event.stamp for event in events], dtype=np.uint64),
                np.array([event.bits for event in events], dtype=np.int64), ids,
                [event.payload for event in events] if self._raw else [],
                Rows(self._decoder.kind(number), len(events), None,
                     [event.values for event in events]))

    def _add(self, at: Ints, packet: Ints, stamps: npt.NDArray[np.uint64], bits: Ints,
             ids: Sequence[Array | None], payload: list[tuple[int, int]], rows: Rows) -> None:
        count = len(at)
        nothing = np.zeros(count, dtype=np.int64)
        vpid, vtid = (nothing if each is None else each.astype(np.int64) for each in ids[:2])
        procname = ids[2] if ids[2] is not None else np.zeros(count, dtype='S1')
        if procname.dtype.itemsize > _LONGEST_NAME:
            procname = procname.astype(f'S{_LONGEST_NAME}')
        raw = np.zeros(count, dtype=object)
        raw[:] = [self._data[begin:end] for begin, end in payload] or 0
        self._marks.append((at, packet, stamps, bits))
        self._parts.append(Events(
            nothing, nothing, vpid, vtid, procname,
            np.full(count, self._decoder.known), np.full(count, self._decoder.trace.number),
            nothing, np.arange(count), raw, [rows]))

    def finish(self, first: int, bad: dict[int, tuple[int, str]]) -> Events | None:
        """
        Return all events in the order of their places, without those after damage.

        :param first: the number of the first event.
        :param bad: by packet where it is damaged; more is added.
        """
        for number, damage in self._cut.items():
            bad[number] = min(damage, bad.get(number, damage))
        if not self._parts:
            return None
        found = joined(self._parts)
        at, packet, stamps, bits = (np.concatenate(each) for each in zip(*self._marks))
        order = np.argsort(at, kind='stable')
        at, packet, stamps, bits = at[order], packet[order], stamps[order], bits[order]
        ticks, possible = self._times(packet, stamps, bits)
        times = self._decoder.trace.all_ns(ticks)
        for where in np.flatnonzero(~possible | (times < 0)).tolist()[::-1]:
            damage = int(at[where]), 'an event has an impossible time'
            number = int(packet[where])
            bad[number] = min(damage, bad.get(number, damage))
        limits = np.full(len(self._packets), _NEVER)
        for number, (where, _) in bad.items():
            limits[number] = where
        good = at < limits[packet]
        found = found.picked(order[good])
        found.time = times[good]
        streams = np.array([each.stream for each in self._packets], dtype=np.int64)
        found.place = streams[packet[good]] * _PER_STREAM + first + np.arange(len(found))
        return found

    def _times(self, packet: Ints, stamps: npt.NDArray[np.uint64], bits: Ints
               ) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.bool_]]:
        """Return the times of events, in ticks, and which are possible."""
        begins = np.array([each.begin for each in self._packets], dtype=np.uint64)
        slack = self._decoder.trace.slack
        ends = np.array([min(each.end + slack, 2 ** 64 - 1) if each.end else 2 ** 64 - 1
                         for each in self._packets], dtype=np.uint64)
        used = int(self._decoder.short_bits)
        if not used and not bits.any():
            return begins[packet], np.ones(len(packet), dtype=np.bool_)
        heads = np.flatnonzero(np.diff(packet, prepend=-1))
        # the first time of each packet comes before its events
        all_stamps = np.insert(stamps, heads, begins[packet[heads]])
        whole = np.insert(bits, heads, 64) >= 64
        mask, shift = np.uint64((1 << used) - 1), np.uint64(used)
        low = all_stamps & mask
        wrapped = np.cumsum(~whole & (low < np.concatenate((low[:1], low[:-1]))))
        base = np.maximum.accumulate(np.where(whole, np.arange(len(whole)), 0))
        turns = (wrapped - wrapped[base]).astype(np.uint64)
        ticks = np.where(whole, all_stamps, (
            ((all_stamps[base] >> shift) + turns) << shift) | low)
        possible = ticks >= np.concatenate((ticks[:1], ticks[:-1]))
        kept = np.ones(len(ticks), dtype=np.bool_)
        kept[heads + np.arange(len(heads))] = False
        ticks, possible = ticks[kept], possible[kept]
        return ticks, possible & (ticks <= ends[packet])


def _as_int64(value: Any) -> int:
    return (int(value or 0) + 2 ** 63) % 2 ** 64 - 2 ** 63


# --- packets -------------------------------------------------------------------------------------


class _HeadOfPacket(NamedTuple):
    packet: Packet
    size: int               # bytes, of the packet
    instance: int           # of the stream
    number: int             # of the packet; -1: unknown
    discarded: int          # events so far; -1: unknown
    is_cut: bool


def read_head(trace: Trace, file: str, offset: int, size: int) -> _HeadOfPacket:
    """
    Return what the head of a packet says.

    :param size: of the file.
    :raises Damaged: if it says what cannot be
    """
    metadata = trace.metadata
    with open(file, 'rb', buffering=0) as stream:
        data = os.pread(stream.fileno(), _HEAD, offset)
    cursor = Cursor(data, 0, len(data) * 8)
    header: dict[str, Any] = {}
    context: dict[str, Any] = {}
    try:
        if metadata.packet_header is not None:
            header = cursor.read('packet-header', reader_of(metadata.packet_header))
        if header.get('magic', _MAGIC) != _MAGIC:
            raise Damaged('a packet does not begin as packets do')
        uuid = header.get('uuid')
        if metadata.uuid and isinstance(uuid, list) and (
                bytes(uuid).hex() != metadata.uuid.replace('-', '').lower()):
            raise Damaged('a packet is of another trace')
        number = header.get('stream_id', next(iter(metadata.streams), 0))
        if number not in trace.decoders:
            raise Damaged(f'a packet is of an unknown stream ({number})')
        of_stream = metadata.streams[number].packet_context
        if of_stream is not None:
            context = cursor.read('packet-context', reader_of(of_stream))
        values = {name: context.get(name, default) for name, default in (
            ('packet_size', (size - offset) * 8), ('timestamp_begin', 0), ('timestamp_end', 0),
            ('events_discarded', -1), ('packet_seq_num', -1))}
        values['content_size'] = context.get('content_size', values['packet_size'])
        values['instance'] = header.get('stream_instance_id', -1)
        if not all(isinstance(value, int) for value in values.values()):
            raise Damaged('the head of a packet is not understood')
    except (struct.error, KeyError, TypeError, ValueError) as error:
        raise Damaged(
            str(error).replace('an event', 'the head of a packet') if isinstance(error, Damaged)
            else 'the head of a packet is not understood') from None
    whole, content = values['packet_size'], values['content_size']
    begin, end = values['timestamp_begin'], values['timestamp_end']
    if whole % 8 or not cursor.at <= content <= whole or not whole or (
            not 0 <= begin < 2 ** 64 or not 0 <= end < 2 ** 64 or 0 < end < begin):
        raise Damaged('sizes or times of a packet are wrong')
    left = size - offset
    packet = Packet(file, offset, begin, end, -(-cursor.at // 8), min(-(-content // 8), left),
                    trace.decoders[number], 0)
    return _HeadOfPacket(packet, whole // 8, values['instance'], values['packet_seq_num'],
                         values['events_discarded'], whole // 8 > left)


class _Stream:
    """The packets of a stream, which may be in several files."""

    def __init__(self, trace: Trace, number: int) -> None:
        self._trace, self._number = trace, number
        #: First time and path of each file.
        self.files: list[tuple[int, str]] = []

    def packets(self, reading: Reading) -> Iterator[Packet]:
        """Yield the packets, in the order of time."""
        number, discarded, begin, end = -1, 0, 0, 0
        for _, file in sorted(self.files):
            size, offset = os.stat(file).st_size, 0
            while offset < size:
                try:
                    head = read_head(self._trace, file, offset, size)
                except Damaged as error:
                    reading.damaged(file, str(error), offset, size, self._trace.ns(end))
                    break
                packet = head.packet
                packet.stream = self._number
                offset += head.size
                # what was discarded was not in the packet before
                since = self._trace.ns(min(end, packet.begin) if number >= 0 else packet.begin)
                if number >= 0 and 0 <= head.number <= number and packet.begin <= begin:
                    continue        # a snapshot has packets of the one before
                if 0 <= number < head.number - 1:
                    reading.lost.append(Lost(self._trace.ns(packet.begin), since, -1))
                # an empty packet, written when a buffer is flushed, may say 0
                if head.discarded > discarded:
                    reading.lost.append(Lost(
                        self._trace.ns(packet.end), since, head.discarded - discarded))
                    discarded = head.discarded
                number, begin, end = head.number, packet.begin, max(packet.begin, packet.end)
                yield packet
                if head.is_cut:
                    reading.damaged(file, 'the file ends within a packet', size, size,
                                    self._trace.ns(begin))


class Reading:
    """
    The events of the traces of a host.

    :param folders: the metadata of each of their folders, by folder.
    :param raw: whether the bytes of each event are wanted.
    :ivar damages: what is wrong, after the events were read.
    """

    def __init__(self, folders: dict[str, Metadata], raw: bool) -> None:
        self.damages: list[Damage] = []
        self.lost: list[Lost] = []
        self._missing_from: int | None = None       # up to the end; None: nothing is missing
        self._count = 0
        self._streams: dict[Any, _Stream] = {}
        traces: dict[str, Trace] = {}
        for folder, metadata in folders.items():
            # each process of a user has a trace; the chunks of a session are one
            key = metadata.uuid or folder
            if key not in traces or traces[key].metadata != metadata:
                number = traces[key].number if key in traces else len(traces)
                traces[key] = Trace(metadata, number, raw)
            self._add(traces[key], folder)

    def _add(self, trace: Trace, folder: str) -> None:
        """Take the files of a trace in a folder."""
        for entry in sorted(os.scandir(folder), key=lambda each: each.name):
            if entry.name == 'metadata' or entry.name.startswith('.'):
                continue
            status = entry.stat()
            if not stat.S_ISREG(status.st_mode) or not status.st_size:
                continue
            try:
                head = read_head(trace, entry.path, 0, status.st_size)
            except Damaged as error:
                self.damaged(entry.path, str(error), 0, status.st_size, 0)
                continue
            key = (trace.number, entry.path) if head.instance < 0 else (
                trace.number, id(head.packet.decoder), head.instance)
            stream = self._streams.setdefault(key, _Stream(trace, len(self._streams)))
            stream.files.append((head.packet.begin, entry.path))

    def damaged(self, file: str, what: str, offset: int, size: int, since: int) -> None:
        """
        Note damage after which nothing of a file is used.

        :param since: the time up to which it was used, ns.
        """
        self.damages.append(Damage(file, offset, what, size - offset))
        self._missing_from = since if self._missing_from is None else min(
            since, self._missing_from)

    def batches(self) -> Iterator[tuple[Events, list[Lost]]]:
        """Yield events in the order of time, and what is missing up to the last of them."""
        heap: list[tuple[int, int, Packet, Iterator[Packet]]] = []

        def advance(packets: Iterator[Packet]) -> None:
            packet = next(packets, None)
            if packet is not None:
                heapq.heappush(heap, (
                    packet.decoder.trace.ns(packet.begin), packet.stream, packet, packets))

        for stream in self._streams.values():
            advance(stream.packets(self))
        window: dict[int, list[Packet]] = {}
        waiting: Events | None = None
        size, last = 0, 0
        while heap:
            _, _, packet, packets = heapq.heappop(heap)
            window.setdefault(id(packet.decoder), []).append(packet)
            size += packet.content
            advance(packets)
            if heap and size < _WINDOW:
                continue
            parts = [] if waiting is None else [waiting]
            for of_decoder in window.values():
                found = of_decoder[0].decoder.events(
                    of_decoder, self._count, self.damages, self.lost)
                if found is not None:
                    self._count += len(found)
                    parts.append(found)
            window, size, waiting = {}, 0, None
            until = heap[0][0] if heap else _NEVER
            if not parts:
                continue
            events = joined(parts)
            order = np.lexsort((events.place, events.time))
            ready = int(np.searchsorted(events.time[order], until))
            waiting = events.picked(order[ready:]) if ready < len(order) else None
            events = events.picked(order[:ready])
            last = int(events.time[-1]) if len(events) else last
            yield events, self._take_lost(until)
        if self._missing_from is not None:
            self.lost.append(Lost(last, self._missing_from, -1, True))
        if self.lost:
            yield _no_events(), self._take_lost(_NEVER)

    def _take_lost(self, until: int) -> list[Lost]:
        found = sorted(lost for lost in self.lost if lost.time < until)
        self.lost = [lost for lost in self.lost if lost.time >= until]
        return found

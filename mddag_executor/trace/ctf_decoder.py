# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the events in packets of CTF traces.

Theory of operation:

1. Events follow each other without an index.  A loop steps from one to the next: by the size of
   its kind, or, if it has texts or sequences, by the end of each of them.
2. The fields are gathered later, a kind at a time, as columns (`ctf_layout`).  Events with
   variants, or with arrays of structures, are read one by one.
3. A time in an event has only its last bits; it is the first such time after the one before it.
4. Sizes and offsets in the file are checked before they are used.  Of a packet in which an event
   cannot be read, the events before it are used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import os
import struct
from typing import Any, NamedTuple

from mddag_executor.trace.ctf_events import (
    Array,
    Damage,
    Events,
    Ints,
    joined,
    Kind,
    kind_of,
    Lost,
    NEVER,
    Rows,
    time_of,
    times_of,
)
from mddag_executor.trace.ctf_layout import (
    aligned,
    Bytes,
    Cursor,
    Damaged,
    fields_of,
    Path,
    Reader,
    reader_of,
    Run,
    runs_of,
    Tail,
    text_of,
    Unpacker,
    values_of,
)
from mddag_executor.trace.ctf_types import (
    Clock,
    Enumeration,
    Integer,
    MetadataError,
    StreamClass,
    Struct,
    Type,
    Variant,
)
from mddag_executor.trace.schema import DAMAGED
import numpy as np
import numpy.typing as npt

_LONGEST_NAME = 255
_PER_STREAM = 2 ** 40
"""Streams have different places, which are numbers of their events and this times their own."""
_PACKET_ALIGN = 512     # bytes: the largest alignment of a type

# process, thread and name: of user space first, then of the kernel
_INTEGERS = frozenset(f'{sign}int{bits}' for sign in ('', 'u') for bits in (8, 16, 32, 64))
_IDENTITY = ((('vpid', 'pid'), _INTEGERS), (('vtid', 'tid'), _INTEGERS),
             (('procname',), frozenset({'string'})))
_STRUCT = {f'{order}u{size}': order + code
           for order in '<>' for size, code in ((1, 'B'), (2, 'H'), (4, 'I'))}


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

    @property
    def is_short(self) -> bool:
        """Return whether the tag is the number of the event."""
        return self.number == self.head.members[0][:1]


class _Chain:
    """
    How the events of a kind are read whose heads have one form.

    :ivar head: the runs of head and context, and ``payload`` those of the fields.
    :ivar stamp: the path of the time; empty: the events have none.
    """

    def __init__(self, kind: Kind, form: _Form, head: tuple[Run, ...], payload: tuple[Run, ...],
                 align: int) -> None:
        self.kind, self.form = kind, form
        self.head, self.payload = head, payload
        self.stamp: Path = form.stamp and ('head', *form.stamp)
        # by field of unknown size, by place of the run before it: the bytes before it; of an array
        # where its number of elements is, and what reads it; the size of an element
        self._tails: list[tuple[list[int], list[Unpacker], int]] = []
        sizes = [0] * 8
        for run in (*head, *payload):
            counts = [(size + offset, unpack) for place, size in enumerate(sizes)
                      for offset, unpack in run.counts[place + size & 7:][:1]]
            before, sizes = sizes, [size + run.sizes[place + size & 7]
                                    for place, size in enumerate(sizes)]
            if run.tail is not None:
                self._tails.append((sizes, counts, run.tail.size))
                before = sizes = [0] * 8
        # by place after the last of these fields: the bytes to the end, and to the next event
        self._left = sizes
        self._steps = [
            aligned((place + size) * 8 + payload[-1].layouts[place + size & 7].size, align) // 8
            - place for place, size in enumerate(before)]

    @property
    def tails(self) -> int:
        """Return how many of the fields have no known size."""
        return len(self._tails)

    def step(self, place: int) -> int:
        """Return the bytes from an event of a known size to the next one."""
        return self._steps[place]

    def follow(self, data: bytes, at: int, end: int, marks: list[int]) -> int:
        """
        Return where the next event is; 0: the event is not whole.

        :param marks: its place and the ends of its fields of unknown size are added.
        """
        found, position = [at], at
        for sizes, counts, size in self._tails:
            begin, place = position, position & 7
            position += sizes[place]
            if counts:
                offset, unpack = counts[place]
                count = unpack(data, begin + offset)[0] if position <= end else -1
                position += count * size
                if count < 0 or position > end:
                    return 0
            else:
                position = data.find(b'\0', position, end) + 1
                if not position:
                    return 0
            found.append(position)
        place = position & 7
        if position + self._left[place] > end:
            return 0
        marks += found
        return position + self._steps[place]


class _Found:
    """
    The events of some packets.

    :ivar fast: the places of those of known sizes.
    :ivar marks: of those with texts or sequences what ``_Chain.follow`` notes, by chain;
        ``followed``: by tag this function and these notes.
    :ivar slow: those that were read one by one.
    """

    def __init__(self) -> None:
        self.fast: list[int] = []
        self.marks: dict[_Chain, list[int]] = {}
        self.followed: dict[int, tuple[Callable[..., int], list[int]]] = {}
        self.slow: list[_Slow] = []


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
    """
    Reads the events of a stream's class.

    :param number: of the trace; ``slack``: by how many ticks events may be after the end of their
        packet.
    :param raw: whether the bytes of each event are wanted.
    """

    def __init__(self, clock: Clock, number: int, slack: int, stream: StreamClass, raw: bool
                 ) -> None:
        self.clock, self.number, self.slack = clock, number, slack
        self._stream, self._raw = stream, raw
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
        # by first tag of the form: runs of the head; and by number: how events are read
        self._heads: dict[int, tuple[Run, ...] | None] = {}
        self._chains: dict[tuple[int, int], _Chain | None] = {}
        # by place within 8 bytes: by tag the step to the next event, if it is known
        self._steps: list[dict[int, int]] = [{} for _ in range(8)]

    def ns(self, ticks: int) -> int:
        """Return a time of its clock as ns of the epoch, in the range of times."""
        return time_of(self.clock, ticks)

    # --- stepping --------------------------------------------------------------------------------

    def walk(self, data: bytes, at: int, end: int, found: _Found) -> tuple[int, str] | None:
        """
        Note the places of events, and read those that are read one by one.

        :param at: where the events begin, and ``end`` where the content ends.
        :returns: where an event cannot be read, and why.
        """
        at = aligned(at * 8, self._align) // 8
        after: int | str
        if self._tag is None or self._unpack is None:
            while at < end:
                after = self._one(data, at, end, found.slow)
                if isinstance(after, str):
                    return at, after
                at = after
            return None
        unpack, (_, shift, mask) = self._unpack, self._tag
        steps, other, add = self._steps, self._other, found.fast.append
        followed = found.followed
        while at < end:
            tag, = unpack(data, at)
            tag = tag >> shift & mask
            step = steps[at & 7].get(tag)
            if step:
                add(at)
                at += step
                continue
            if tag in followed:
                follow, marks = followed[tag]
                after = follow(data, at, end, marks)
                if after:
                    at = after
                    continue
            after = other(data, at, end, tag, found)
            if isinstance(after, str):
                return at, after
            at = after
        return None

    def _other(self, data: bytes, at: int, end: int, tag: int, found: _Found) -> int | str:
        """Take an event without a known step, and return the next one, or what is wrong."""
        form = next((each for each in self._forms if each.low <= tag <= each.high), None)
        chain = None if form is None else self._chain_at(data, at, tag, form)
        if form is not None and chain is not None:
            if not chain.tails:
                step = chain.step(at & 7)
                if form.is_short:
                    self._steps[at & 7][tag] = step
                found.fast.append(at)
                return at + step
            marks = found.marks.setdefault(chain, [])
            if form.is_short:
                found.followed[tag] = chain.follow, marks
            after = chain.follow(data, at, end, marks)
            if after:
                return after
        return self._one(data, at, end, found.slow)

    def _chain_at(self, data: bytes, at: int, tag: int, form: _Form) -> _Chain | None:
        """Return how an event is read; None: by itself."""
        if form.is_short:
            return self.chain(form, tag)
        head = self._head(form)
        if head is None or at + head[0].layouts[at & 7].width > len(data):
            return None
        offset, unpack = head[0].unpackers(('head', *form.number))[at & 7]
        return self.chain(form, unpack(data, at + offset)[0])

    def numbers(self, form: _Form, data: Bytes, at: Ints) -> list[int]:
        """Return the numbers of events whose heads have a form that is not short."""
        head = self._head(form)
        assert head is not None     # otherwise the events were read one by one
        column, = head[0].columns(data, at, [('head', *form.number)])
        found: list[int] = column.tolist()
        return found

    def chain(self, form: _Form, number: int) -> _Chain | None:
        """Return how a kind of event is read; None: one by one."""
        key = form.low, number
        if key not in self._chains:
            self._chains[key] = self._new_chain(form, number)
        return self._chains[key]

    def _new_chain(self, form: _Form, number: int) -> _Chain | None:
        head, event = self._head(form), self._classes.get(number)
        if head is None or event is None:
            return None
        inner: list[tuple[str, Type]] = []
        if event.context is not None:
            inner.append(('context', event.context))
        if event.payload is not None:
            inner.append(('payload', event.payload))
        payload = runs_of(Struct(tuple(inner), 1, 1))
        kind = self.kind(number)
        if payload is None or not _have(payload, [('payload', *each.path)
                                                  for each in kind.fields]):
            return None
        return _Chain(kind, form, head, payload, self._align)

    def _head(self, form: _Form) -> tuple[Run, ...] | None:
        """Return the runs of the head of an event and its context; None: they are not known."""
        if form.low not in self._heads:
            self._heads[form.low] = self._new_head(form)
        return self._heads[form.low]

    def _new_head(self, form: _Form) -> tuple[Run, ...] | None:
        inner: list[tuple[str, Type]] = [('head', form.head)]
        if self._stream.context is not None:
            inner.append(('context', self._stream.context))
        runs = runs_of(Struct(tuple(inner), 1, 1))
        if runs is None or not runs[-1].is_whole:
            return None
        in_first = [('head', *path) for path in (form.number, form.stamp) if path]
        wanted = [('context', *path) for path in self.identity if path is not None]
        if any(path not in runs[0].paths for path in in_first) or not _have(runs, wanted) or (
                not form.is_short and not runs[0].unpackers(in_first[0])):
            return None
        return runs

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
                kind_of(event.name, event.payload))
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
            data += bytes(packet.content - len(content) + -packet.content % _PACKET_ALIGN)
        data += bytes(_LONGEST_NAME)    # more than any field is looked at beyond its end
        whole = bytes(data)
        del data
        found = _Found()
        bad: dict[int, tuple[int, str]] = {}        # by packet where it is damaged
        for number, (packet, start) in enumerate(zip(packets, starts)):
            wrong = self.walk(whole, start + packet.body, start + packet.content, found)
            if wrong is not None:
                bad[number] = wrong
        builder = _Builder(self, whole, packets, np.array(starts, dtype=np.int64), self._raw)
        builder.take(found.fast, self._forms, self._tag)
        for chain, marks in found.marks.items():
            at, *ends = np.array(marks, dtype=np.int64).reshape(-1, 1 + chain.tails).T
            builder.gather(chain, at, ends)
        builder.take_slow(found.slow)
        events = builder.finish(first, bad)
        for number, (place, what) in sorted(bad.items()):
            packet, offset = packets[number], place - starts[number]
            damages.append(Damage(
                packet.file, packet.offset + offset, what, packet.content - offset))
            begin, end = (self.ns(each) for each in (
                packet.begin, max(packet.begin, packet.end)))
            lost.append(Lost(end, begin, DAMAGED))
        return events


def _have(runs: Sequence[Run], paths: Sequence[Path]) -> bool:
    """Return whether all fields with some paths are in some runs."""
    found = {path for run in runs for path in run.paths}
    return found.union(run.tail.path for run in runs if run.tail).issuperset(paths)


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
        self._starts = starts
        self._ends = starts + np.array([packet.content for packet in packets], dtype=np.int64)
        self._parts: list[Events] = []
        # of each part place, packet, and the time's bits and their number
        self._marks: list[tuple[Ints, Ints, npt.NDArray[np.uint64], Ints]] = []
        self._cut: dict[int, tuple[int, str]] = {}

    def take(self, fast: Sequence[int], forms: Sequence[_Form], tag: _Tag | None) -> None:
        """Take events of known sizes at some places."""
        if not fast or tag is None:
            return
        at = np.array(fast, dtype=np.int64)
        code, shift, mask = tag.code, tag.shift, tag.mask
        tags = np.lib.stride_tricks.sliding_window_view(
            self._bytes, np.dtype(code).itemsize)[at].view(code).reshape(len(at)).astype(
                np.int64) >> shift & mask
        for form in forms:
            mine = np.flatnonzero((tags >= form.low) & (tags <= form.high))
            if not len(mine):
                continue
            numbers = tags[mine] if form.is_short else np.array(
                self._decoder.numbers(form, self._bytes, at[mine]))
            for number in np.unique(numbers).tolist():
                chain = self._decoder.chain(form, number)
                assert chain is not None    # otherwise the step was not known
                self.gather(chain, at[mine[numbers == number]], [])

    def gather(self, chain: _Chain, at: Ints, ends: Sequence[Ints]) -> None:
        """
        Take events of a kind at some places.

        :param ends: where each of their fields of unknown size ends.
        """
        packet = np.searchsorted(self._starts, at, 'right') - 1
        if not ends:
            last = chain.payload[-1].ends(chain.head[-1].ends(at))
            fits = last <= self._ends[packet]
            for where, number in zip(at[~fits].tolist(), packet[~fits].tolist()):
                self._cut[number] = where, 'an event is cut'
            at, packet = at[fits], packet[fits]
        if not len(at):
            return
        decoder, left = self._decoder, list(ends)
        ids = [path and ('context', *path) for path in decoder.identity]
        columns: dict[Path, Array] = {}
        payload = self._read(chain.head, at, left, columns, [
            path for path in (chain.stamp, *ids) if path], ids[2])
        paths = [('payload', *each.path) for each in chain.kind.fields]
        last = self._read(chain.payload, payload, left, columns, paths)
        stamps = (columns[chain.stamp].astype(np.uint64) if chain.stamp
                  else np.zeros(len(at), dtype=np.uint64))
        self._add(at, packet, stamps, np.full(len(at), chain.form.bits),
                  [columns[path] if path else None for path in ids],
                  list(zip(payload.tolist(), last.tolist())) if self._raw else [],
                  Rows(chain.kind, len(at), [columns[path] for path in paths], []))

    def _read(self, runs: Sequence[Run], begins: Ints, ends: list[Ints],
              columns: dict[Path, Array], wanted: Sequence[Path], name: Path | None = None
              ) -> Ints:
        """
        Add columns of the fields of some runs, and return where the runs end.

        :param ends: where fields of unknown size end, those of these runs first: taken from it.
        :param name: the field of which the bytes are wanted instead of a text.
        """
        for run in runs:
            paths = [path for path in wanted if path in run.paths]
            columns.update(zip(paths, run.columns(self._bytes, begins, paths)))
            begins = run.ends(begins)
            if run.tail is not None:
                begin, begins = begins, ends.pop(0)
                if run.tail.path in wanted:
                    columns[run.tail.path] = self._tails(
                        run.tail, begin, begins, run.tail.path == name)
        return begins

    def _tails(self, tail: Tail, begins: Ints, ends: Ints, is_name: bool) -> Array:
        """Return texts or arrays; names as bytes."""
        data = self._data
        if is_name:
            width = min(_LONGEST_NAME, max(1, int((ends - begins).max())))
            names = np.lib.stride_tricks.sliding_window_view(self._bytes, width)[begins]
            names[np.arange(width) >= (ends - begins)[:, np.newaxis]] = 0
            names *= np.logical_and.accumulate(names != 0, axis=1)
            return names.view(f'S{width}').reshape(len(names))
        places = list(zip(begins.tolist(), ends.tolist()))
        values: list[Any]
        if not tail.code or tail.text:
            values = [text_of(data[begin:end]) for begin, end in places]
        else:
            values = [np.frombuffer(data, tail.code, (end - begin) // tail.size, begin).tolist()
                      for begin, end in places]
        return np.fromiter(values, object, len(values))

    def take_slow(self, slow: Sequence[_Slow]) -> None:
        """Take events that were read one by one."""
        packet = np.searchsorted(
            self._starts, np.array([event.at for event in slow], dtype=np.int64), 'right') - 1
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
            np.full(count, self._decoder.known), np.full(count, self._decoder.number),
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
        times = times_of(self._decoder.clock, ticks)
        for where in np.flatnonzero(~possible | (times < 0)).tolist()[::-1]:
            damage = int(at[where]), 'an event has an impossible time'
            number = int(packet[where])
            bad[number] = min(damage, bad.get(number, damage))
        limits = np.full(len(self._packets), NEVER)
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
        slack = self._decoder.slack
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

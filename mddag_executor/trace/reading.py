# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One pass over a trace file, in the order of the file or of time.

Theory of operation:

1. The file is read block by block (`blocks`).  Where a block's messages begin, its message indexes
   are used, if they fit what is there; else the records are walked over.  In memory are some
   chunks, whatever the file's length.
2. In the order of the file the events of one thread are in order, those of different threads are
   not: each thread appends an event after it took its time, whenever it gets to run.
3. In the order of time, chunks are loaded by the least time that their heads state, some at a
   time, and an event is given out once no chunk that is still to be loaded can hold an earlier
   one. That is exact for any disorder; it takes memory only for chunks that overlap in time, and
   there is a limit to it. A head that states a time after its chunk's first event would break the
   order: that is damage. Events of equal time come in the order of the file.
4. In both orders a block is used only when everything before it in the file is sound, so what
   damage leaves is always the beginning of the recording. It is kept in `damage`, not raised.
5. In the order of time an event before 1970 or after 2116 (`times`) is left out and counted.
6. A message in a sound chunk that does not decode is left out and counted.
7. The messages of other topics are given out as they are, in the order of the file.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterator
import struct
from typing import Any, BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mddag_executor.text import counted
from mddag_executor.trace import records
from mddag_executor.trace.blocks import Block, Damage, load
from mddag_executor.trace.cdr import ENCAPSULATION
from mddag_executor.trace.channels import Channels, Topic
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.events import Event, Events, Ints, OTHER, rows_at
from mddag_executor.trace.times import Times
import numpy as np

_BATCH = 16                     # blocks that are loaded at a time in the order of time
_PENDING_LIMIT = 2_000_000      # events in memory while putting them into the order of time

# The beginning of a message's record, and where the fields of its content begin.
_HEAD = np.dtype({
    'names': ['opcode', 'length', 'channel', 'encapsulation'], 'itemsize': 33,
    'formats': ['u1', '<u8', '<u2', '<u2'], 'offsets': [0, 1, 9, 31]})
_MESSAGE = np.dtype({
    'names': ['length', 'channel', 'log_time', 'publish_time'], 'itemsize': 31,
    'formats': ['<u8', '<u2', '<u8', '<u8'], 'offsets': [1, 9, 15, 23]})
_CONTENT = records.RECORD.size
_FIELDS = _CONTENT + records.MESSAGE_HEAD.size + 4      # 4: the encapsulation header
_LITTLE_ENDIAN = 0x0100         # plain CDR, little endian, as _HEAD reads it
_CHANNEL = np.dtype({'names': ['channel'], 'formats': ['<u2'], 'offsets': [9], 'itemsize': 11})
_INDEX_ROOM = 1 << 16           # an index takes a third of its messages, and a head a channel
_INDEX_ENTRY = np.dtype([('time', '<u8'), ('offset', '<u8')])


class Message(NamedTuple):
    """A message: its channel, its times (ns) and its bytes."""

    topic: Topic
    log_time: int
    publish_time: int
    data: memoryview


class _Loaded(NamedTuple):
    """What is left of a block: its events in the order of time (of the file, with `by_file`)."""

    data: bytes
    times: Ints
    channels: Any
    positions: Ints
    others: list[Event]

    def some(self, which: Any) -> _Loaded:
        """Return it with some of the events."""
        return self._replace(times=self.times[which], channels=self.channels[which],
                             positions=self.positions[which])


class Reading:
    """One pass over a file: what it found, and what it could not use."""

    def __init__(self, path: str, channels: Channels) -> None:
        """Begin; `channels` decides what becomes of the messages."""
        self.chunks = 0             # used
        self.messages = 0           # in what was used, of all channels
        self.damage: Damage | None = None
        self.restored = False       # whether a copy stood in for a damaged chunk
        self._path = path
        self._channels = channels
        self._undecoded: Counter[str] = Counter()       # by topic and reason
        self._times = Times()
        self._sizes = np.full(1 << 16, 1 << 62, dtype=np.uint64)
        self._met = (0, 0)

    def by_file(self, stream: BinaryIO, blocks: Iterator[Block]) -> Iterator[Events]:
        """Yield the events in the order of the file."""
        try:
            for block in blocks:
                yield self._events([self._decode(stream, block)])
        except Damage as damage:
            self._keep(damage)

    def messages_of(
        self, stream: BinaryIO, blocks: Iterator[Block], topics: Collection[str],
        times: array[int],
    ) -> Iterator[Message]:
        """Yield the messages of some topics; add the times of all messages to `times`."""
        try:
            for block in blocks:
                data, starts = self._starts(stream, block)
                heads = rows_at(data, _MESSAGE, starts)
                if (heads['length'] < records.MESSAGE_HEAD.size).any():
                    raise Damage('a message is shorter than its head', block.offset)
                of = self._channels.topics
                if not np.isin(heads['channel'], list(of)).all():
                    raise Damage('a message is of no channel', block.offset)
                times.frombytes(heads['log_time'].tobytes())
                wanted = np.isin(heads['channel'], [n for n in of if of[n].name in topics])
                view = memoryview(data)
                for start, (length, channel, log_time, publish_time) in zip(
                        starts[wanted].tolist(), heads[wanted].tolist()):
                    yield Message(of[channel], log_time, publish_time,
                                  view[start + _FIELDS - 4:start + _CONTENT + length])
        except Damage as damage:
            self._keep(damage)

    def by_time(self, stream: BinaryIO, blocks: Iterator[Block]) -> Iterator[Events]:
        """Yield the events in the order of time."""
        known = self._scan(blocks)
        order = sorted(range(len(known)), key=lambda number: known[number].start_time)
        sound = 0                       # blocks before this one have been found sound,
        usable = len(known)             # those from this one on have not and are not used
        loaded: dict[int, _Loaded] = {}
        for place, number in enumerate(order, 1):
            if number < usable:
                try:
                    while sound < number:
                        # This pass counts nothing: the block's turn is still to come.
                        Reading(self._path, self._channels)._in_order(stream, known[sound])
                        sound += 1
                    loaded[number] = self._in_order(stream, known[number])
                    sound = max(sound, number + 1)
                except Damage as damage:
                    self._keep(damage)
                    usable = min(sound, number)
            if place == len(order):
                yield self._events(_taken(loaded, None))
            elif place % _BATCH == 0 or _pending(loaded) > _PENDING_LIMIT // 2:
                yield self._events(_taken(loaded, known[order[place]].start_time))
                if _pending(loaded) > _PENDING_LIMIT:
                    raise TraceError(
                        self._path, 'holds too much in disorder to put it into order of time',
                        'sort it first, as with `mcap sort`')

    def _events(self, parts: list[_Loaded]) -> Events:
        """Return parts, which are in the order of the file, as one batch."""
        fixed = self._channels.fixed
        if len(parts) == 1:
            part = parts[0]
            return Events(part.data, part.channels, part.positions, part.others, fixed)
        if not parts:
            return Events(b'', np.empty(0, np.uint16), np.empty(0, np.int64), [], fixed)
        positions: list[Ints] = []
        others: list[Event] = []
        length = 0
        for part in parts:
            other = part.channels == OTHER
            positions.append(np.where(other, len(others), length) + part.positions)
            others += part.others
            length += len(part.data)
        # stable, so that what has the same time stays in the order of the file
        order = np.argsort(np.concatenate([part.times for part in parts]), kind='stable')
        return Events(
            b''.join(part.data for part in parts),
            np.concatenate([part.channels for part in parts])[order],
            np.concatenate(positions)[order], others, fixed)

    def _keep(self, damage: Damage) -> None:
        self.damage = damage.with_traceback(None)       # which would keep the chunk in memory

    def _scan(self, blocks: Iterator[Block]) -> list[Block]:
        known = []
        try:
            for block in blocks:
                known.append(block)
        except Damage as damage:
            self._keep(damage)
        return known

    def _in_order(self, stream: BinaryIO, block: Block) -> _Loaded:
        """Return the events of a block in the order of time."""
        found = self._decode(stream, block)
        times = found.times
        if not len(times):
            return found
        wrong = self._times.out_of_range(times)
        if wrong.any():
            found = found.some(~wrong)
            times = found.times
        if (times[1:] < times[:-1]).any():
            found = found.some(np.argsort(times, kind='stable'))
        if len(times) and found.times[0] < block.start_time:
            raise Damage('a chunk holds an event from before the time in its head', block.offset)
        return found

    def _load(self, stream: BinaryIO, block: Block) -> tuple[bytes, Block]:
        """Return a block's records, and the block that they are of: it, or its copy."""
        try:
            return load(stream, block), block
        except Damage:
            if block.copy is None:
                raise
        self.restored = True
        return load(stream, block.copy), block.copy

    def _starts(self, stream: BinaryIO, block: Block) -> tuple[bytes, Ints]:
        """Return the records of a block, and where messages begin in them."""
        data, source = self._load(stream, block)
        end = len(data)
        data += bytes(_HEAD.itemsize)       # a head can be read at any record, however short
        starts = self._indexed(stream, source, data, end)
        if starts is None:
            starts = self._walk(data, 0, end, block, True)
        self.messages += len(starts) * block.copies
        self.chunks += block.chunk * block.copies
        return data, starts

    def _decode(self, stream: BinaryIO, block: Block) -> _Loaded:
        """Return the events of a block in the order of the file; raise Damage where malformed."""
        data, starts = self._starts(stream, block)
        sizes = self._least_sizes()
        least = sizes[rows_at(data, _CHANNEL, starts)['channel']]
        wanted = least != 0
        if not wanted.all():
            starts, least = starts[wanted], least[wanted]
        heads = rows_at(data, _HEAD, starts)
        channels = heads['channel']
        fixed = (heads['encapsulation'] == _LITTLE_ENDIAN) & (least <= heads['length'])
        others: list[Event] = []
        positions = starts + _FIELDS
        if not fixed.all():
            channels, known = channels.copy(), np.ones(len(starts), dtype=np.bool_)
            for place in np.flatnonzero(~fixed).tolist():
                start, before = int(starts[place]), len(others)
                after = start + _CONTENT + int(heads['length'][place])
                self._add_any(others, int(channels[place]), data[start:after])
                known[place] = len(others) > before
                channels[place], positions[place] = OTHER, before
            channels, positions = channels[known], positions[known]
        times = np.empty(len(positions), dtype=np.int64)
        other = channels == OTHER
        times[~other] = rows_at(data, np.dtype('<i8'), positions[~other])
        times[other] = [event[1] for event in others]
        return _Loaded(data, times, channels, positions, others)

    def _least_sizes(self) -> Any:
        """Return by channel the least length of its messages, 0 for those passed over."""
        channels = self._channels
        met = len(channels.passed_over), len(channels.fixed)
        if met != self._met:
            self._met = met
            self._sizes[:] = 1 << 62
            self._sizes[list(channels.passed_over)] = 0
            for number, (_, kind, _) in channels.fixed.items():
                self._sizes[number] = kind.itemsize + _FIELDS - _CONTENT
        return self._sizes

    def _indexed(self, stream: BinaryIO, block: Block, data: bytes, end: int) -> Any:
        """Return where a chunk's messages begin by its indexes; None where these are not sound."""
        if not block.chunk:
            return None
        parts = []
        stream.seek(block.end)
        content = stream.read(end // 3 + _INDEX_ROOM)
        at = 0
        while at + _CONTENT <= len(content) and content[at] == Opcode.MESSAGE_INDEX:
            length = records.RECORD.unpack_from(content, at)[1]
            first, at = at + _CONTENT + 6, at + _CONTENT + length
            if length % _INDEX_ENTRY.itemsize != 6 or at > len(content):
                return None
            parts.append(np.frombuffer(
                content, _INDEX_ENTRY, length // _INDEX_ENTRY.itemsize, first)['offset'])
        if not parts:
            return None
        starts = np.sort(np.concatenate(parts).astype(np.int64))
        if not len(starts) or starts[0] < 0 or starts[-1] > end - _CONTENT:
            return None
        lengths = np.minimum(rows_at(data, np.dtype('<u8'), starts + 1), end).astype(np.int64)
        befores, afters = np.empty(len(starts) + 1, np.int64), np.empty(len(starts) + 1, np.int64)
        befores[0], afters[-1] = 0, end
        befores[1:] = starts + _CONTENT + lengths
        afters[:-1] = starts
        if (rows_at(data, np.dtype('u1'), starts) != Opcode.MESSAGE).any():
            return None
        # what is between messages are definitions
        gaps = np.flatnonzero(befores != afters).tolist()
        if any(befores[gap] > afters[gap] for gap in gaps):
            return None
        found = [self._walk(data, int(befores[gap]), int(afters[gap]), block, False)
                 for gap in gaps]
        if any(map(len, found)):
            return None
        for gap in gaps:
            self._walk(data, int(befores[gap]), int(afters[gap]), block, True)
        return starts

    def _walk(self, data: bytes, position: int, end: int, block: Block, define: bool) -> Ints:
        """Return where messages begin between two records; take in what is defined there."""
        unpack = records.RECORD.unpack_from
        starts = []
        while position < end:
            opcode, length = unpack(data, position)
            after = position + _CONTENT + length
            if after > end:
                raise Damage('the records of a chunk do not fit into it', block.offset)
            if opcode == Opcode.MESSAGE:
                starts.append(position)
            elif define and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, data[position + _CONTENT:after], block)
            position = after
        return np.array(starts, dtype=np.int64)

    def _add_any(self, events: list[Event], channel: int, message: bytes) -> None:
        """Add the event in a message record; count it where it cannot be decoded."""
        try:
            if message[_FIELDS - 4:_FIELDS - 2] != ENCAPSULATION[:2]:
                raise ValueError('it is not plain little endian CDR')
            head, unpack = self._channels.decoder(channel)
            events.append(head + unpack(message[_FIELDS:]))
        except (ValueError, struct.error) as error:
            topic = self._channels.topics.get(channel)
            name = f'channel {channel}' if topic is None else topic.name
            self._undecoded[f'{name}: {error}'] += 1

    def _define(self, opcode: int, content: bytes, block: Block) -> None:
        try:
            if opcode == Opcode.SCHEMA:
                self._channels.add_schema(content)
            else:
                self._channels.add_channel(content)
        except ValueError as error:
            raise Damage(str(error), block.offset) from None

    def odd_times(self) -> list[str]:
        """Return the lines about times that cannot be, or that jump."""
        return [f'{self._path}: {text}' for text in self._times.lines('event')]

    def undecoded(self) -> str | None:
        """Return the line about messages that could not be decoded, None where all could."""
        if not self._undecoded:
            return None
        reason, count = self._undecoded.most_common(1)[0]
        total = sum(self._undecoded.values())
        return (f'{self._path}: left out {counted(total, "message")} that cannot be decoded, '
                f'most of them ({count}) of {reason}')


def _pending(loaded: dict[int, _Loaded]) -> int:
    """Count the events that are loaded and not given out."""
    return sum(len(part.times) for part in loaded.values())


def _taken(loaded: dict[int, _Loaded], before: int | None) -> list[_Loaded]:
    """Take out the events before a time (None: all), in the order of the file."""
    taken = []
    for number in sorted(loaded):
        part = loaded[number]
        count = len(part.times) if before is None else int(np.searchsorted(part.times, before))
        if count:
            taken.append(part.some(slice(None, count)))
            loaded[number] = part.some(slice(count, None))
        if count == len(part.times):
            del loaded[number]
    return taken

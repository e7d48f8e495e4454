# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads a trace file once, in the order of the file or of time.

Theory of operation
-------------------
1. The file is read block by block (``blocks``), some megabytes at a time.  Message indexes locate
   the messages.  They are used if messages are there that do not overlap.  The records between
   these, or all records, are read one after the other.
2. In the order of the file the events of one thread are ordered.  Those of different threads are
   not: a thread appends an event after it has read its clock.
3. In the order of time all events are in memory.  Events of equal time are in the order of the
   file.
4. A block is used only if all blocks before it are valid.  So the beginning of a damaged
   recording is used.  ``damage`` has the damage; it is not raised.  If the records of a block are
   wrong, those before it are used, unless the block is a chunk without CRC.
5. An undecodable message in a valid block is skipped and counted.  In the order of time, events
   before 1970 or after 2116 are skipped as well: a simulation of them would never end.
6. If messages of some topics are wanted, a chunk is only unpacked if its message indexes name one
   of these, or a channel that the summary does not have.  Its times are then those of the indexes.
7. The indexes of several chunks are used at once; if anything in them is wrong, chunk by chunk.
8. A small file can say that it has a lot.  A file with more messages than bytes, or with very many
   records that have none, is damaged: equal messages would have different times.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from operator import itemgetter
import struct
from typing import Any, BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mddag_executor.text import counted
from mddag_executor.trace import records
from mddag_executor.trace.blocks import (
    Block,
    blocks,
    Damage,
    MOST_OTHERS,
    NO_MEMORY,
    Summary,
)
from mddag_executor.trace.cdr import ENCAPSULATION
from mddag_executor.trace.channels import Channels, Topic, UNDEFINED
from mddag_executor.trace.events import Batch, Event, Ints, rows_at, Table, with_fields
from mddag_executor.trace.times import NEVER
import numpy as np

_BATCH_BYTES = 1 << 22
_HEAD = np.dtype([('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2')])
"""The begin of a message's record; its times follow after four bytes."""
_TIMES_AT, _TIMES = 15, np.dtype([('log_time', '<u8'), ('publish_time', '<u8')])
_CONTENT = records.RECORD.size
_ROW = 16               # records that are compared at once; then eight times as many
_FEW = 100_000          # messages that a file may have whatever its size
_LEAST = _CONTENT + records.MESSAGE_HEAD.size       # bytes of a message's record
_FIELDS = _LEAST + len(ENCAPSULATION)       # bytes before the fields of an event
_PLAIN = int.from_bytes(ENCAPSULATION[:2], 'little')
_INDEX_HEAD = 6         # bytes: channel, size of the entries
_INDEX_ENTRY = np.dtype([('time', '<u8'), ('offset', '<u8')])


class Messages(NamedTuple):
    """
    Messages of a channel, valid until the next ones are read.

    :ivar log_time: their times (ns), and ``publish_time``.
    :ivar starts: where their bytes begin in ``data``; ``sizes``: how many these are.
    """

    topic: Topic
    log_time: Any
    publish_time: Any
    starts: Ints
    sizes: Ints
    data: bytearray

    def content(self, number: int) -> bytes:
        """Return the bytes of a message."""
        start = int(self.starts[number])
        return bytes(self.data[start:start + int(self.sizes[number])])

    def heads(self, size: int) -> Any:
        """Return the first bytes of each message as a row; all of a shorter one are 255."""
        found = np.full((len(self.starts), size), 255, dtype=np.uint8)
        long = self.sizes >= size
        found[long] = rows_at(self.data, np.dtype(f'V{size}'), self.starts[long]).view(
            np.uint8).reshape(-1, size)
        return found


class _Loaded(NamedTuple):
    """
    The data of some blocks; valid until the next ones are loaded.

    :ivar data: their records.
    :ivar at: positions of the messages in the data, ascending.
    :ivar lengths: of their contents; ``channels``: their channels.
    """

    data: bytearray
    at: Ints
    lengths: Ints
    channels: Any


class _Defect(NamedTuple):
    """A wrong record in a block, and its position there."""

    what: str
    position: int


class Reading:
    """
    One pass over a file: its data, and the unusable parts.

    :param channels: decides which messages are decoded.
    :param start: start of the data section; ``size``: size of the file.
    :ivar damage: the damage that ends the data, if any.
    """

    def __init__(
        self, path: str, channels: Channels, stream: BinaryIO, start: int, size: int
    ) -> None:
        self.chunks = 0             # used
        self.messages = 0           # in used chunks, of all channels
        self._packed = 0            # bytes of the used chunks, packed
        self.damage: Damage | None = None
        self._path, self._channels, self._size = path, channels, size
        self._blocks = blocks(stream, start, size)
        self._undecoded: Counter[str] = Counter()       # by topic and reason
        self._left_out: list[int] = []      # impossible times
        self._place = 0             # of the next batch in the order of the file
        self._until = start         # in the file, of the blocks that were read last
        self._buffer = bytearray()  # of a batch
        #: The channels of which messages are wanted, of all known ones; None: all are wanted.
        self._wanted: tuple[set[int], set[int]] | None = None
        #: By block, in the order of the file, the log times of its messages; None: not wanted.
        self._times: list[Any] | None = None

    def by_file(self) -> Iterator[Batch]:
        """Yield the events in the order of the file."""
        for loaded in self._messages():
            yield self._decoded(loaded)

    def by_time(self) -> Iterator[Event]:
        """Yield the events in the order of time."""
        found = [event for batch in self.by_file() for event in batch.tuples()]
        possible = [event for event in found if 0 <= event[1] < NEVER]
        if len(possible) < len(found):
            self._left_out = [event[1] for event in found if not 0 <= event[1] < NEVER]
        yield from sorted(possible, key=itemgetter(1))

    def messages_of(
        self, topics: Collection[str], times: array[int], summary: Summary | None
    ) -> Iterator[list[Messages]]:
        """
        Yield messages of some topics, by channel.

        :param times: receives the times of all messages at the end, in the order of the file.
        """
        self._times = []
        known = self._channels.topics
        self._choose(topics, summary)
        for data, at, lengths, channels in self._messages():
            heads = rows_at(data, _TIMES, at + _TIMES_AT)
            undefined = channels[~np.isin(channels, list(known))]
            self._undecoded.update(
                f'channel {channel}: {UNDEFINED}' for channel in undefined.tolist())
            found = []
            for channel, mine in _by_channel(channels):
                if channel in known and known[channel].name in topics:
                    found.append(Messages(
                        known[channel], heads['log_time'][mine], heads['publish_time'][mine],
                        at[mine] + _LEAST, lengths[mine] - records.MESSAGE_HEAD.size, data))
            yield found
        for each in self._times:
            times.frombytes(each.tobytes())

    def _choose(self, topics: Collection[str], summary: Summary | None) -> None:
        """Choose the channels of topics; without a sound summary all messages are read."""
        if summary is None or not summary.channels:
            return
        try:
            for schema in summary.schemas:
                self._channels.add_schema(schema)
            for channel in summary.channels:
                self._channels.add_channel(channel)
        except ValueError:
            return      # the data section has the last word
        known = self._channels.topics
        self._wanted = {n for n in known if known[n].name in topics}, set(known)

    def _is_skipped(self, block: Block) -> bool:
        """Return whether no message of a block is wanted, and keep their times then."""
        if self._times is None or self._wanted is None:
            return False
        if block.chunk is None or not block.indexes:
            return False
        wanted, known = self._wanted
        channels = {int.from_bytes(index[:2], 'little') for index in block.indexes}
        if channels & wanted or channels - known:
            return False
        try:
            entries = np.concatenate([
                np.frombuffer(index, _INDEX_ENTRY, offset=_INDEX_HEAD)
                for index in block.indexes])
        except ValueError:      # not a number of whole entries
            return False
        times = entries['time'][np.argsort(entries['offset'], kind='stable')]
        if len(times) and not block.chunk.start <= times.min() <= times.max() <= block.chunk.end:
            return False
        self._times.append(times)
        self._count([block], len(times))
        return True

    # --- positions of messages -------------------------------------------------------------------

    def _messages(self) -> Iterator[_Loaded]:
        """Yield the messages of all blocks, some blocks at a time."""
        some: list[Block] = []      # in the buffer, one after another
        size = 0
        damage: Damage | None = None
        left = iter(self._blocks)
        while damage is None:
            block = None
            try:
                block = next(left, None)
                if block is None:
                    break
                if self._is_skipped(block):
                    continue
                if size and size + block.size > _BATCH_BYTES:
                    loaded, damage = self._loaded(some, size)
                    yield loaded
                    self._place += size
                    some, size = [], 0
                    if damage is not None:
                        break
                if size + block.size > len(self._buffer):   # only the first of a batch
                    self._buffer = bytearray(max(block.size, _BATCH_BYTES))
                block.unpack(memoryview(self._buffer)[size:size + block.size])
                some.append(block)
                if self._times is not None:
                    block.place = len(self._times)
                    self._times.append(np.empty(0, dtype=np.uint64))
                size += block.size
            except Damage as error:
                damage = Damage(error.what, error.offset)   # no traceback: it keeps the data
            except MemoryError:
                damage = Damage(NO_MEMORY, block.offset if block else 0)
        if some:
            loaded, earlier = self._loaded(some, size)
            damage = earlier or damage
            yield loaded
        self.damage = damage

    def _loaded(self, some: Sequence[Block], size: int) -> tuple[_Loaded, Damage | None]:
        """Return the messages of unpacked blocks, and the first damage in these."""
        none = np.empty(0, dtype=np.int64)
        places: list[tuple[Ints, Ints, Any]] = [(none, none, none.astype(np.uint16))]
        begins = np.append(0, np.cumsum([block.size for block in some], dtype=np.int64))
        data = memoryview(self._buffer)[:size]
        self._until = some[-1].offset + some[-1].packed
        damage = None
        try:
            at, lengths, channels, defect = self._located(data, some, begins)
            if defect is None:
                places.append((at, lengths, channels))
                self._count(some, len(at))
                self._keep_times(data, some, begins, at)
            else:
                damage = self._some(data, some, begins, places)
        except MemoryError:
            damage = Damage(NO_MEMORY, some[0].offset)
        if damage is None and self.messages > _FEW + self._packed:
            damage = Damage('up to it there are more messages than bytes, as in no recording',
                            some[-1].offset)
        return _Loaded(self._buffer, *map(np.concatenate, zip(*places))), damage

    def _some(self, data: memoryview, some: Sequence[Block], begins: Ints,
              places: list[tuple[Ints, Ints, Any]]) -> Damage | None:
        """Add the messages of blocks before the first defect, and return this."""
        for block, begin, end in zip(some, begins.tolist(), begins[1:].tolist()):
            at, lengths, channels, defect = self._located(
                data[begin:end], [block], np.array([0, end - begin]))
            if defect is not None and block.chunk is not None and not block.is_checked:
                return Damage(defect.what, block.offset)
            places.append((at + begin, lengths, channels))
            self._count([block] if defect is None else [], len(at))
            self._keep_times(data[begin:end], [block], np.array([0, end - begin]), at)
            if defect is not None:
                return Damage(defect.what, block.offset + (
                    defect.position if block.chunk is None else 0))
        return None

    def _keep_times(self, data: memoryview, some: Sequence[Block], borders: Ints, at: Ints
                    ) -> None:
        """Keep the times of the messages of blocks, if they are wanted."""
        if self._times is None:
            return
        times = rows_at(data, _TIMES, at + _TIMES_AT)['log_time']
        ends = np.searchsorted(at, borders).tolist()
        for block, begin, end in zip(some, ends, ends[1:]):
            self._times[block.place] = times[begin:end].copy()

    def _count(self, some: Sequence[Block], messages: int) -> None:
        """Count what is used."""
        self.chunks += sum(block.chunk is not None for block in some)
        self._packed += sum(block.packed for block in some)
        self.messages += messages

    def _located(
        self, data: memoryview, some: Sequence[Block], borders: Ints
    ) -> tuple[Ints, Ints, Any, _Defect | None]:
        """
        Return positions, lengths and channels of the messages in blocks; read their definitions.

        Those of messages before the first wrong record, which is also returned.

        :param borders: where the blocks begin in the data, and where the last one ends.
        """
        at, lengths, channels, limits = _indexed(data, some, borders)
        # definitions are between the messages; without usable indexes, so are all messages
        first = np.append(at, borders[-1])[np.searchsorted(at, borders[:-1])]
        ends = np.append(borders[:-1], at + _CONTENT + lengths)
        begins = np.append(np.minimum(first, borders[1:]), limits)
        gaps = np.flatnonzero(ends < begins)
        gaps = gaps[np.argsort(ends[gaps])]
        found: list[Ints] = []
        defect = None
        for begin, until in zip(ends[gaps].tolist(), begins[gaps].tolist()):
            defect = self._walk(data, begin, until, found)
            if defect is not None:
                at = at[at < defect.position]
                break
        if found or defect is not None:
            at = np.sort(np.concatenate([at, *found])).astype(np.int64)
            heads = rows_at(data, _HEAD, at)
            lengths, channels = heads['length'].astype(np.int64), heads['channel']
        return at, lengths, channels, defect

    def _walk(
        self, data: memoryview, position: int, end: int, found: list[Ints]
    ) -> _Defect | None:
        """
        Add the positions of messages between two positions to ``found``; read definitions.

        Return the first wrong record.
        """
        others, single = 0, list[int]()
        what = None
        while position < end and what is None:
            opcode, length = data[position], data[position + 1:position + _CONTENT]
            size = _CONTENT + int.from_bytes(length, 'little')
            if position + size > end:
                what = 'the records of a chunk do not fit into it'
            elif opcode == Opcode.MESSAGE:
                if size < _LEAST:
                    what = 'a message is shorter than its head'
                    break
                single.append(position)
                row = _row(data, position, size, end)
                if len(row):
                    found.append(row)
                    position = int(row[-1])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                content = bytes(data[position + _CONTENT:position + size])
                add = self._channels.add_schema if opcode == Opcode.SCHEMA else \
                    self._channels.add_channel
                try:
                    add(content)
                except ValueError as error:
                    what = str(error)
            elif opcode <= Opcode.DATA_END:     # 0, or a record that is never in a chunk
                what = 'a record is where it cannot be'
            else:
                others += 1
                if others > MOST_OTHERS:
                    what = 'a chunk is full of records that do not belong there'
            position += size if what is None else 0
        if single:
            found.append(np.array(single, dtype=np.int64))
        return None if what is None else _Defect(what, position)

    # --- contents of messages --------------------------------------------------------------------

    def _decoded(self, loaded: _Loaded) -> Batch:
        """Return the events of some blocks; count undecodable ones."""
        tables, others = list[Table](), list[tuple[int, Event]]()
        for channel, mine in _by_channel(loaded.channels):
            if channel in self._channels.passed_over:
                continue
            reason = self._channels.undecodable(channel)
            if reason is not None:
                self._undecoded[f'{self._named(channel)}: {reason}'] += len(mine)
                continue
            at, lengths = loaded.at[mine], loaded.lengths[mine] + _CONTENT
            fixed = self._channels.fixed.get(channel)
            if fixed is not None:
                plain = lengths >= _LEAST + fixed.kind.itemsize
                rows = rows_at(loaded.data, fixed.kind, _chosen(at, plain) + _LEAST)
                is_plain = np.ndarray(len(rows), '<u2', rows, 0, rows.strides) == _PLAIN
                plain[plain] = is_plain
                tables.append(Table(
                    fixed.head, with_fields(_chosen(rows, is_plain), fixed.missing),
                    _chosen(at, plain) + self._place))
                at, lengths = at[~plain], lengths[~plain]
            for start, length in zip(at.tolist(), lengths.tolist()):
                event = self._any(channel, bytes(loaded.data[start:start + length]))
                if event is not None:
                    others.append((self._place + start, event))
        others.sort(key=itemgetter(0))
        return Batch(tables, others, self._until / self._size)

    def _any(self, channel: int, message: bytes) -> Event | None:
        """Return the event in a message record; None, and count it, if it cannot be decoded."""
        try:
            if message[_LEAST:_LEAST + 2] != ENCAPSULATION[:2]:
                raise ValueError('it is not plain little endian CDR')
            head, unpack = self._channels.decoder(channel)
            return head + unpack(message[_FIELDS:])
        except (ValueError, struct.error) as error:
            self._undecoded[f'{self._named(channel)}: {error}'] += 1
            return None

    def _named(self, channel: int) -> str:
        topic = self._channels.topics.get(channel)
        return f'channel {channel}' if topic is None else topic.name

    def impossible_times(self) -> str | None:
        """Return the warning about events with impossible times, None if there are none."""
        if not self._left_out:
            return None
        return (f'{self._path}: left out: {counted(len(self._left_out), "event")} at an '
                f'impossible time, the first at {self._left_out[0]} ns')

    def undecoded(self) -> str | None:
        """Return the warning about messages that could not be decoded, None if all could."""
        if not self._undecoded:
            return None
        reason, count = self._undecoded.most_common(1)[0]
        total = sum(self._undecoded.values())
        return (f'{self._path}: left out {counted(total, "message")} that cannot be decoded, '
                f'most of them ({count}) of {reason}')


def _row(data: memoryview, position: int, size: int, end: int) -> Ints:
    """Return the positions of the records behind one that begin in the same way, one by one."""
    most = (end - position) // size - 1
    first = bytes(data[position:position + _CONTENT])
    count, wanted = 0, _ROW
    while count < most and data[position + (count + 1) * size:][:_CONTENT] == first:
        wanted = min(wanted, most - count)
        heads = np.ndarray((wanted, _CONTENT), 'u1', data, position + (count + 1) * size,
                           (size, 1))
        different = np.flatnonzero((heads != heads[0]).any(axis=1))
        if len(different):
            count += int(different[0])
            break
        count, wanted = count + wanted, wanted * 8
    return position + size * np.arange(1, count + 1, dtype=np.int64)


def _by_channel(channels: Any) -> Iterator[tuple[int, Ints]]:
    """Yield each channel, and which messages are of it."""
    order = np.argsort(channels, kind='stable')
    counts = np.bincount(channels)
    ends = np.cumsum(counts)
    for channel in np.flatnonzero(counts).tolist():
        end = int(ends[channel])
        yield channel, order[end - int(counts[channel]):end]


def _chosen(column: Any, which: Any) -> Any:
    """Return the chosen rows of a column, which mostly are all rows."""
    return column if which.all() else column[which]


def _indexed(
    data: memoryview, some: Sequence[Block], borders: Ints
) -> tuple[Ints, Ints, Any, Ints]:
    """
    Return what the message indexes say of blocks' messages; nothing if they are wrong.

    :returns: positions, lengths, channels, and where the next message or the end of the block is.
    """
    none = np.empty(0, dtype=np.int64)
    nothing = none, none, none.astype(np.uint16), none
    parts = [none]
    for block, begin in zip(some, borders.tolist()):
        for index in block.indexes:
            try:
                offsets = np.frombuffer(index, _INDEX_ENTRY, offset=_INDEX_HEAD)['offset']
            except ValueError:      # not a number of whole entries
                return nothing
            parts.append(offsets.astype(np.int64) + begin)
    at = np.concatenate(parts)
    at.sort(kind='stable')      # fast: each index ascends
    if not len(at) or at[0] < 0 or at[-1] > len(data) - _LEAST:
        return nothing
    heads = rows_at(data, _HEAD, at)
    lengths = heads['length'].astype(np.int64)
    limits = np.repeat(borders[1:], np.diff(np.searchsorted(at, borders)))
    limits[:-1] = np.minimum(limits[:-1], at[1:])
    fits = (heads['opcode'] == Opcode.MESSAGE) & (lengths >= records.MESSAGE_HEAD.size) & (
        lengths <= len(data)) & (at + _CONTENT + lengths <= limits)
    return (at, lengths, heads['channel'], limits) if fits.all() else nothing

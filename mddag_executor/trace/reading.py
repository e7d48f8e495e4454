# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads a trace file once, in the order of the file or of time.

Theory of operation
-------------------
1. The file is read block by block (``blocks``), some megabytes at a time.  Message indexes locate
   the messages of each channel.  They are used if they match the data: every message has its
   channel, and messages and definitions together fill the data.  Otherwise the records are read
   one after the other.
2. In the order of the file the events of one thread are ordered.  Those of different threads are
   not: a thread appends an event after it has read its clock.
3. In the order of time all events are in memory.  Events of equal time are in the order of the
   file.
4. A block is used only if everything before it in the file is valid.  So the beginning of a
   damaged recording is used.  ``damage`` has the damage; it is not raised.
5. An undecodable message in a valid block is skipped and counted.  In the order of time, events
   before 1970 or after 2116 are skipped, too: a simulation of them would never end.
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from operator import itemgetter
import struct
from typing import Any, BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mddag_executor.text import counted
from mddag_executor.trace import records
from mddag_executor.trace.blocks import Block, Damage, load
from mddag_executor.trace.cdr import ENCAPSULATION
from mddag_executor.trace.channels import Channels, Topic
from mddag_executor.trace.events import Batch, Column, Event, FIELDS, Ints, rows_at
from mddag_executor.trace.times import NEVER
import numpy as np

_BATCH_BYTES = 1 << 21
_HEAD = np.dtype({
    'names': ['opcode', 'length', 'channel', 'log_time', 'publish_time', 'encapsulation'],
    'formats': ['u1', '<u8', '<u2', '<u8', '<u8', '<u2'], 'offsets': [0, 1, 9, 15, 23, 31],
    'itemsize': 33})
"""The begin of a message's record."""
_CONTENT = records.RECORD.size
_LITTLE_ENDIAN = 0x0100         # plain CDR, little endian, as read by _HEAD
_INDEX_HEAD = struct.Struct('<BQHI')     # opcode, length, channel, bytes of entries
_INDEX_ENTRY = np.dtype([('time', '<u8'), ('offset', '<u8')])


class Message(NamedTuple):
    """A message: its channel, its times (ns) and its bytes."""

    topic: Topic
    log_time: int
    publish_time: int
    data: bytes


class _Loaded(NamedTuple):
    """
    The data of some blocks, the begin of each block, and the end.

    The buffer is larger than the data and is reused for the next blocks.
    """

    blocks: list[Block]
    data: bytearray
    begins: list[int]
    indexes: list[bytes]

    @property
    def end(self) -> int:
        """Return the end of the data."""
        return self.begins[-1]

    def block_at(self, position: int) -> Block:
        """Return the block of a position in the data."""
        return self.blocks[bisect_right(self.begins, position) - 1]

    def until(self, offset: int) -> _Loaded:
        """Return the same without the blocks from a position in the file on."""
        count = sum(block.offset < offset for block in self.blocks)
        return _Loaded(self.blocks[:count], self.data, self.begins[:count + 1], self.indexes)


_Places = dict[int, tuple[Ints, Any]]
"""By channel the positions of its message records in the data, ascending, and their heads."""


class Reading:
    """
    One pass over a file: its data, and the unusable parts.

    :param channels: decides which messages are decoded.
    :param damage: the damage that ends the blocks.
    """

    def __init__(
        self, path: str, channels: Channels, blocks: Sequence[Block], damage: Damage | None
    ) -> None:
        self.chunks = 0             # used
        self.messages = 0           # in used chunks, of all channels
        self.damage = damage
        self._path, self._channels, self._blocks = path, channels, blocks
        self._undecoded: Counter[str] = Counter()       # by topic and reason
        self._left_out: list[int] = []      # impossible times
        self._place = 0             # of the next batch in the order of the file
        self._used = 0              # blocks
        self._buffer = bytearray()

    def by_file(self, stream: BinaryIO) -> Iterator[Batch]:
        """Yield the events in the order of the file."""
        for loaded, heads in self._messages(stream):
            yield self._decoded(loaded, heads)

    def by_time(self, stream: BinaryIO) -> Iterator[Event]:
        """Yield the events in the order of time."""
        found = [event for batch in self.by_file(stream) for event in batch]
        possible = [event for event in found if 0 <= event[1] < NEVER]
        if len(possible) < len(found):
            self._left_out = [event[1] for event in found if not 0 <= event[1] < NEVER]
        yield from sorted(possible, key=itemgetter(1))

    def messages_of(
        self, stream: BinaryIO, topics: Collection[str], times: array[int]
    ) -> Iterator[Message]:
        """Yield the messages of some topics; add the times of all messages to ``times``."""
        known = self._channels.topics
        for loaded, by_channel in self._messages(stream):
            at, heads = _in_order(loaded, by_channel)
            unknown = at[~np.isin(heads['channel'], list(known))]
            if len(unknown):
                self._end(Damage('a message is of no channel',
                                 loaded.block_at(int(unknown[0])).offset))
                at, heads = at[at < unknown[0]], heads[at < unknown[0]]
            times.frombytes(heads['log_time'].tobytes())
            wanted = np.isin(heads['channel'], [n for n in known if known[n].name in topics])
            for start, (_, length, channel, log_time, publish_time, _) in zip(
                    at[wanted].tolist(), heads[wanted].tolist()):
                yield Message(known[channel], log_time, publish_time,
                              bytes(loaded.data[start + FIELDS - 4:start + _CONTENT + length]))

    # --- positions of messages -------------------------------------------------------------------

    def _messages(self, stream: BinaryIO) -> Iterator[tuple[_Loaded, _Places]]:
        """Yield the data of some blocks, and by channel the positions of its messages."""
        while self._used < len(self._blocks):
            loaded = self._load(stream)
            while loaded.blocks:
                try:
                    found = self._located(loaded)
                    break
                except Damage as damage:
                    self._end(damage)
                    loaded = loaded.until(damage.offset)
            else:
                return
            self._used += len(loaded.blocks)
            self.chunks += sum(block.chunk for block in loaded.blocks)
            self.messages += sum(len(at) for at, _ in found.values())
            yield loaded, found
            self._place += loaded.end

    def _end(self, damage: Damage) -> None:
        """Ignore all data from the damage on."""
        # the traceback would keep the data in memory
        self.damage, damage.__context__ = damage.with_traceback(None), None
        self._blocks = [block for block in self._blocks if block.offset < damage.offset]

    def _load(self, stream: BinaryIO) -> _Loaded:
        """Return the data of the next blocks."""
        blocks, begins = list[Block](), [0]
        for block in self._blocks[self._used:]:
            if blocks and begins[-1] + block.size > _BATCH_BYTES:
                break
            blocks.append(block)
            begins.append(begins[-1] + block.size)
        # a head can be read at any record, even a short one
        room = begins[-1] + _HEAD.itemsize
        if len(self._buffer) < room:
            self._buffer.clear()    # frees its memory: batches that refer to it are over
            try:
                self._buffer = bytearray(room)
            except MemoryError:
                self._end(Damage('a chunk does not fit into the memory', blocks[0].offset))
                return _Loaded([], self._buffer, [0], [])
        loaded = _Loaded(blocks, self._buffer, begins, [])
        view = memoryview(self._buffer)
        for block, begin, end in zip(blocks, begins, begins[1:]):
            try:
                loaded.indexes.append(load(stream, block, view[begin:end]))
            except Damage as damage:
                self._end(damage)
                return loaded.until(damage.offset)
        return loaded

    def _located(self, loaded: _Loaded) -> _Places:
        """
        Return by channel the positions of its messages.

        :raises Damage: if the records are invalid.
        """
        found = self._by_index(loaded)
        if found is not None:
            return found
        walked: dict[int, list[int]] = {}
        for begin, end in zip(loaded.begins, loaded.begins[1:]):
            for channel, at in self._walk(loaded, begin, end):
                walked.setdefault(channel, []).append(at)
        places = {channel: np.array(at, dtype=np.int64) for channel, at in walked.items()}
        return {channel: (at, rows_at(loaded.data, _HEAD, at)) for channel, at in places.items()}

    def _by_index(self, loaded: _Loaded) -> _Places | None:
        """Return positions from the message indexes; None if these do not fit (rule 1)."""
        entries: dict[int, list[tuple[int, bytes]]] = {}
        for begin, index in zip(loaded.begins, loaded.indexes):
            end = 0
            while end < len(index):
                _, length, channel, size = _INDEX_HEAD.unpack_from(index, end)
                first = end + _INDEX_HEAD.size
                end += _CONTENT + length
                if size % _INDEX_ENTRY.itemsize or first + size != end:
                    return None
                entries.setdefault(channel, []).append((begin, index[first:end]))
        found: _Places = {}
        total = 0
        for channel, parts in entries.items():
            at = np.frombuffer(b''.join(part for _, part in parts), _INDEX_ENTRY)['offset']
            at = at.astype(np.int64) + np.repeat(
                [begin for begin, _ in parts],
                [len(part) // _INDEX_ENTRY.itemsize for _, part in parts])
            if not len(at):
                continue
            if (at[1:] <= at[:-1]).any() or at[0] < 0 or at[-1] >= loaded.end:
                return None
            heads = rows_at(loaded.data, _HEAD, at)
            lengths = heads['length']
            if (heads['opcode'] != Opcode.MESSAGE).any() or (heads['channel'] != channel).any() \
                    or (lengths < records.MESSAGE_HEAD.size).any() or (
                        lengths > loaded.end).any():
                return None
            found[channel] = at, heads
            total += int(lengths.sum()) + _CONTENT * len(at)
        if total == loaded.end:
            return found
        return found if total < loaded.end and self._define_between(loaded, found) else None

    def _define_between(self, loaded: _Loaded, found: _Places) -> bool:
        """Read definitions between messages; return whether only these are there and all fits."""
        starts, heads = _in_order(loaded, found)
        lengths = heads['length'].astype(np.int64)
        ends, begins = np.append(0, starts + _CONTENT + lengths), np.append(starts, loaded.end)
        if (ends > begins).any():
            return False
        gaps = np.flatnonzero(ends < begins)
        return not any(
            True for begin, end in zip(ends[gaps].tolist(), begins[gaps].tolist())
            for _ in self._walk(loaded, begin, end))

    def _walk(self, loaded: _Loaded, position: int, end: int) -> Iterator[tuple[int, int]]:
        """Yield channels and positions of messages between two records; read definitions."""
        unpack, data = records.RECORD.unpack_from, loaded.data
        while position < end:
            opcode, length = unpack(data, position)
            after = position + _CONTENT + length
            if after > end:
                raise Damage('the records of a chunk do not fit into it',
                             loaded.block_at(position).offset)
            if opcode == Opcode.MESSAGE:
                if length < records.MESSAGE_HEAD.size:
                    raise Damage('a message is shorter than its head',
                                 loaded.block_at(position).offset)
                yield int.from_bytes(data[position + 9:position + 11], 'little'), position
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, bytes(data[position + _CONTENT:after]),
                             loaded.block_at(position))
            position = after

    def _define(self, opcode: int, content: bytes, block: Block) -> None:
        try:
            if opcode == Opcode.SCHEMA:
                self._channels.add_schema(content)
            else:
                self._channels.add_channel(content)
        except ValueError as error:
            raise Damage(str(error), block.offset) from None

    # --- contents of messages --------------------------------------------------------------------

    def _decoded(self, loaded: _Loaded, found: _Places) -> Batch:
        """Return the events of some blocks; count undecodable ones."""
        columns, others = [], list[tuple[int, Event]]()
        for channel, (at, heads) in found.items():
            if channel in self._channels.passed_over:
                continue
            fixed = self._channels.fixed.get(channel)
            lengths = heads['length'].astype(np.int64) + _CONTENT
            if fixed is not None:
                plain = (heads['encapsulation'] == _LITTLE_ENDIAN) & (
                    lengths >= FIELDS + fixed.kind.itemsize)
                mine = at if plain.all() else at[plain]
                size = int(lengths[0]) if (lengths == lengths[0]).all() else 0
                columns.append(Column(fixed, mine, size))
                at, lengths = at[~plain], lengths[~plain]
            for start, length in zip(at.tolist(), lengths.tolist()):
                event = self._any(channel, bytes(loaded.data[start:start + length]))
                if event is not None:
                    others.append((start, event))
        others.sort(key=itemgetter(0))
        return Batch(loaded.data, self._place, columns, others)

    def _any(self, channel: int, message: bytes) -> Event | None:
        """Return the event in a message record; None, and count it, if it cannot be decoded."""
        try:
            if message[FIELDS - 4:FIELDS - 2] != ENCAPSULATION[:2]:
                raise ValueError('it is not plain little endian CDR')
            head, unpack = self._channels.decoder(channel)
            return head + unpack(message[FIELDS:])
        except (ValueError, struct.error) as error:
            topic = self._channels.topics.get(channel)
            name = f'channel {channel}' if topic is None else topic.name
            self._undecoded[f'{name}: {error}'] += 1
            return None

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


def _in_order(loaded: _Loaded, found: _Places) -> tuple[Ints, Any]:
    """Return the positions of all messages, in the order of the file, and their heads."""
    at = np.sort(np.concatenate([*(at for at, _ in found.values()), np.empty(0, dtype=np.int64)]))
    return at, rows_at(loaded.data, _HEAD, at)

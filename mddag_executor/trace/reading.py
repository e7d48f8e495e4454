# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
One pass over a trace file, in the order of the file or of time.

Theory of operation:

1. The file is read block by block (`blocks`), and a block's events are decoded some thousand at a
   time; what is in memory is one chunk, whatever the file's length.
2. In the order of the file the events of one thread are in order, those of different threads are
   not: each thread appends an event after it took its time, whenever it gets to run.
3. In the order of time, chunks are loaded by the least time that their heads state, and an event
   is given out once no chunk that is still to be loaded can hold an earlier one. That is exact for
   any disorder; it takes memory only for chunks that overlap in time, and there is a limit to it.
   A head that states a time after its chunk's first event would break the order: that is damage.
   Events of equal time come in the order of the file.
4. In both orders a block is used only when everything before it in the file is sound, so what
   damage leaves is always the beginning of the recording. It is kept in `damage`, not raised.
5. In the order of time an event at a time that cannot be (`times`) is left out and counted.
6. A message in a sound chunk that does not decode is left out and counted.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from operator import itemgetter
import struct
from typing import Any, BinaryIO

from mddag_executor.text import counted
from mddag_executor.trace import records
from mddag_executor.trace.blocks import Block, Damage, load
from mddag_executor.trace.cdr import ENCAPSULATION
from mddag_executor.trace.channels import Channels, Event
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.times import Times

_SOME = 4096                     # events decoded at a time
_PENDING_LIMIT = 2_000_000      # events in memory while putting them into the order of time

# Opcode, length, channel; then, behind sequence and times, how the message is encoded.
_HEAD = struct.Struct('<BQH20xH')
_CONTENT = records.RECORD.size
_FIELDS = _CONTENT + records.MESSAGE_HEAD.size + 4      # 4: the encapsulation header
_LITTLE_ENDIAN = 0x0100         # plain CDR, little endian, as _HEAD reads it
_time_of = itemgetter(1)


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

    def by_file(self, stream: BinaryIO, blocks: Iterator[Block]) -> Iterator[Event]:
        """Yield the events in the order of the file."""
        try:
            for block in blocks:
                for events in self._decode(self._load(stream, block), block):
                    yield from events
        except Damage as damage:
            self._keep(damage)

    def by_time(self, stream: BinaryIO, blocks: Iterator[Block]) -> Iterator[Event]:
        """
        Yield the events in the order of time.

        :raises TraceError: where too many chunks overlap in time
        """
        for events in self._by_time(stream, blocks):
            yield from events

    def _by_time(self, stream: BinaryIO, blocks: Iterator[Block]) -> Iterator[Any]:
        """Yield what ``_take`` makes of what ``_in_order`` returns, in the order of time."""
        known = self._scan(blocks)
        order = sorted(range(len(known)), key=lambda number: known[number].start_time)
        starts = [known[number].start_time for number in order]
        sound = 0                       # blocks before this one have been found sound,
        usable = len(known)             # those from this one on have not and are not used
        loaded: dict[int, Any] = {}
        for number, next_start in zip(order, (*starts[1:], None)):
            if number < usable:
                try:
                    while sound < number:
                        # This pass counts nothing: the block's turn is still to come.
                        Reading(self._path, self._channels)._in_order(stream, known[sound], 0)
                        sound += 1
                    pending = sum(map(len, loaded.values()))
                    loaded[number] = self._in_order(stream, known[number], pending)
                    sound = max(sound, number + 1)
                except Damage as damage:
                    self._keep(damage)
                    usable = min(sound, number)
            yield self._take(loaded, next_start)

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

    def _take(self, loaded: dict[int, Any], before: int | None) -> Any:
        return _take(loaded, before)

    def _in_order(self, stream: BinaryIO, block: Block, pending: int) -> Any:
        """Return the events of a block in the order of time."""
        room = self._room(pending)
        events: list[Event] = []
        for some in self._decode(self._load(stream, block), block):
            events += some
            if len(events) > room:
                raise self._too_unordered()
        self._leave_out(events)
        events.sort(key=_time_of)
        if events and events[0][1] < block.start_time:
            raise Damage('a chunk holds an event from before the time in its head', block.offset)
        return events

    def _load(self, stream: BinaryIO, block: Block) -> bytes:
        try:
            return load(stream, block)
        except Damage:
            if block.copy is None:
                raise
        self.restored = True
        return load(stream, block.copy)

    def _leave_out(self, events: list[Event]) -> None:
        """Take those at an impossible time out of events in the order of the file."""
        for place in reversed(self._times.impossible([event[1] for event in events])):
            del events[place]

    def _room(self, pending: int) -> int:
        """Return how many events may be loaded beside those that are."""
        return _PENDING_LIMIT - pending

    def _too_unordered(self) -> TraceError:
        return TraceError(
            self._path, 'holds too much in disorder to put it into order of time',
            'sort it first, as with `mcap sort`')

    def _decode(self, data: bytes, block: Block) -> Iterator[list[Event]]:
        """Yield the events of a block's records, some at a time; raise Damage where malformed."""
        fast, passed_over = self._channels.fast, self._channels.passed_over
        unpack_head, find, message = _HEAD.unpack_from, fast.get, records.MESSAGE
        end = len(data)
        data += bytes(_HEAD.size)       # a head can be read at any record, however short
        position = 0
        messages = 0
        events: list[Event] = []
        add = events.append
        while position < end:
            opcode, length, channel, encapsulation = unpack_head(data, position)
            after = position + _CONTENT + length
            if after > end:
                yield events
                raise Damage('the records of a chunk do not fit into it', block.offset)
            if opcode == message:
                messages += 1
                decoder = find(channel)
                if decoder is not None:
                    head, size, unpack = decoder
                    fields = position + _FIELDS
                    if encapsulation == _LITTLE_ENDIAN and fields + size <= after:
                        add(head + unpack(data, fields))
                    else:
                        self._add_any(events, channel, data[position:after])
                elif channel not in passed_over:
                    self._add_any(events, channel, data[position:after])
                if not messages % _SOME:
                    yield events
                    events = []
                    add = events.append
            elif opcode in (records.SCHEMA, records.CHANNEL):
                yield events
                events = []
                add = events.append
                self._define(opcode, data[position + _CONTENT:after], block)
            position = after
        self.messages += messages * block.copies
        self.chunks += block.chunk * block.copies
        yield events

    def _add_any(self, events: list[Event], channel: int, message: bytes) -> None:
        """Add the event in a message record; count it where it cannot be decoded."""
        try:
            if message[_FIELDS - 4:_FIELDS - 2] != ENCAPSULATION[:2]:
                raise ValueError('it is not plain little endian CDR')
            head, unpack = self._channels.decoder(channel)
            events.append(head + unpack(message[_FIELDS:]))
        except (ValueError, struct.error) as error:
            topic = self._channels.topics.get(channel, f'channel {channel}')
            self._undecoded[f'{topic}: {error}'] += 1

    def _define(self, opcode: int, content: bytes, block: Block) -> None:
        try:
            if opcode == records.SCHEMA:
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


def _take(loaded: dict[int, list[Event]], before: int | None) -> list[Event]:
    """Take out the events before a time (None: all), in the order of time, then of the file."""
    taken = []
    for number in sorted(loaded):
        events = loaded[number]
        count = len(events) if before is None else bisect_left(events, before, key=_time_of)
        if count:
            taken += events[:count]
            loaded[number] = events[count:]
        if not loaded[number]:
            del loaded[number]
    taken.sort(key=_time_of)
    return taken

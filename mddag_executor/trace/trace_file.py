# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A trace file being written: events are encoded, gathered into chunks, and written.

Theory of operation:

1. Everything that a reader needs stands inside chunks, where a CRC protects it: the schema and the
   channel of an event are put into the chunk of its first message, just before that message.
2. A chunk is at most 256 KiB before compression (a single larger event has a chunk of its own). It
   goes to the operating system with its message indexes in one piece, so a process that is killed
   leaves a file of whole chunks and at most one that is cut off.
3. The summary (schemas, channels, statistics, chunk indexes) and the footer follow only when the
   file is finished. They make seeking possible and show a reader what should be there; nothing
   else depends on them.
4. When writing fails the file is cut back to its last whole chunk.

All methods are for one thread; `TraceWriter` is what many threads may call.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
import functools
import os
import struct
from types import TracebackType
from typing import Any
import zlib

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
)
from mddag_executor.output_rules import create_recording, EXISTS, REMEDY
from mddag_executor.trace import cdr, records
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.groups import Group, GROUPS
from mddag_executor.trace.schema import camel_case, EVENTS, EventType
import zstandard

CHUNK_LIMIT = 256 * 1024
KEPT = 'what was written before is there; '
"""What the remedy begins with where events are in the file that failed."""
_COMPRESSION_LEVEL = 1      # of zstd; higher levels cost more than they save on such data


def written(what: McapRecord) -> bytes:
    """Return one of mcap's records as it stands in a file."""
    builder = RecordBuilder()
    what.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


class _Channel:
    """What the writer knows of one kind of event."""

    __slots__ = ('channel', 'count', 'encode', 'event', 'index', 'number', 'schema',
                 'schema_name', 'undefined')

    def __init__(self, event: EventType, number: int, schema_name: str) -> None:
        self.event = event
        self.schema_name = schema_name
        self.number = number            # of the channel and of its schema
        self.schema = written(
            Schema(number, event.text.encode(), 'ros2msg', schema_name))
        self.channel = written(Channel(number, event.topic, 'cdr', {}, number))
        self.undefined = len(self.schema) + len(self.channel)   # 0 once they are in the file
        self.count = 0                  # messages so far
        self.index: list[int] = []      # log_time and offset of each message in the open chunk
        self.encode = _encoder(event, number)


def _encoder(event: EventType, number: int) -> Callable[..., bytes]:
    """
    Return what makes a message record.

    It takes sequence, log_time, publish_time, encapsulation, then the values of the message.
    """
    layout = cdr.fixed_layout(event.types)
    if layout is not None:
        packer = struct.Struct('<BQHIQQ4s' + layout)
        length = packer.size - records.RECORD.size
        return _completed(event, functools.partial(
            packer.pack, Opcode.MESSAGE, length, number))

    types = event.types

    def encode(sequence: int, log_time: int, publish_time: int, encapsulation: bytes,
               *values: Any) -> bytes:
        head = records.MESSAGE_HEAD.pack(number, sequence, log_time, publish_time)
        return records.record(Opcode.MESSAGE, head + encapsulation + cdr.encode(types, values))

    return _completed(event, encode)


def _completed(event: EventType, pack: Callable[..., bytes]) -> Callable[..., bytes]:
    """Return a packer that also does without the optional fields of an event."""
    if not event.optional:
        return pack
    whole = len(event.types)

    def encode(sequence: int, log_time: int, publish_time: int, encapsulation: bytes,
               *values: Any) -> bytes:
        missing = whole - len(values)
        return pack(sequence, log_time, publish_time, encapsulation, *values,
                    *(event.optional[-missing:] if missing else ()))

    return encode


def _channels(events: Iterable[EventType]) -> dict[str, _Channel]:
    """Return the channels by full and by short event name; of equal short names the first wins."""
    channels: dict[str, _Channel] = {}
    taken: set[str] = set()
    for number, event in enumerate(events, 1):
        channel = _Channel(event, number, _schema_name(event, taken))
        taken.add(channel.schema_name)
        channels[event.key] = channel
        channels.setdefault(event.name, channel)
    return channels


def _schema_name(event: EventType, taken: Collection[str], number: int = 1) -> str:
    """Return a name for an event's message: with its provider, then numbers, if it is taken."""
    name = camel_case(event.name)
    stem = found = f'mddag_trace/msg/{name}'
    if found in taken:
        stem = found = f'mddag_trace/msg/{camel_case(event.provider)}{name}'
    while found in taken:
        number += 1
        found = f'{stem}V{number}'
    return found


class TraceFile:
    """
    A trace file being written, event by event, by one thread.

    For importers and simulations; what runs live uses `TraceWriter`. The file is complete after
    `finish()`; leaving a `with` block does that, or gives the file up when an exception leaves it.
    """

    def __init__(self, path: str | os.PathLike[str], *,
                 extra_events: Iterable[EventType] = (), overwrite: bool = False) -> None:
        """
        Open the file.

        :param extra_events: events beyond the table, or other fields for one of the table
        :param overwrite: whether it may replace a file that is there
        :raises TraceError: when it cannot be written, or must not be replaced
        """
        self.path = os.fspath(path)
        #: Events that are in the file, in whole chunks.
        self.written = 0
        #: Events that `extend` was given, those that could not be encoded among them.
        self.given = 0
        #: Events that could not be encoded, and the reason of the first.
        self.rejected = 0
        self.rejection: str | None = None
        events = {**EVENTS, **{event.key: event for event in extra_events}}
        self._channels = _channels(events.values())
        self._in_order = list(dict.fromkeys(self._channels.values()))
        self._groups = {  # unless a caller gave one of their events other fields
            name: Group(name, self._channels) for name, keys in GROUPS.items()
            if all(self._channels[key].event == EVENTS[key] for key in keys)}
        self._zstd = zstandard.ZstdCompressor(level=_COMPRESSION_LEVEL)
        self._records: list[bytes] = []     # of the open chunk
        self._size = 0                      # their total size
        self._offset = 0                    # what has been written of the file
        self._chunk_indexes: list[bytes] = []
        self._start: int | None = None      # least and greatest time of all messages
        self._end = 0
        try:
            self._stream = create_recording(self.path, overwrite)
        except FileExistsError:
            raise TraceError(self.path, EXISTS, REMEDY) from None
        except (OSError, ValueError) as error:
            reason = getattr(error, 'strerror', None) or str(error)
            raise TraceError(self.path, f'cannot be written ({reason})',
                             'name a file in an existing folder that you may write') from None
        self._write(records.MAGIC + written(Header('ros2', records.LIBRARY)))

    def define(self, event: EventType) -> str:
        """
        Make a kind of event known while the file is being written.

        Where there are events of its name with other fields already, its own go to another channel
        of the same topic.

        :returns: the name that `add` and `extend` know it by
        """
        key, number = event.key, 1
        while key in self._channels and self._channels[key].event != event:
            number += 1
            key = f'{event.key}#{number}'
        if key not in self._channels:
            taken = {channel.schema_name for channel in self._in_order}
            channel = _Channel(
                event, len(self._in_order) + 1, _schema_name(event, taken, number))
            self._channels[key] = channel
            self._in_order.append(channel)
        return key

    def add(self, event: str, timestamp: int, vpid: int, vtid: int, *fields: Any) -> None:
        """
        Write one event.

        :param event: its full name (`ros2:callback_start`), or its short one where that is unique
        :param timestamp: ns on the trace's clock
        :param vpid: process id
        :param vtid: native thread id
        :param fields: the values of its fields, in the order of its type
        :raises TraceError: for an unknown event, unfit values, or where writing fails
        """
        if self._stream.closed:
            raise TraceError(self.path, 'is closed', 'write events before finishing it')
        rejected = self.rejected
        self.rejection = None
        self.extend(((event, timestamp, vtid, *fields),), vpid)
        if self.rejected > rejected:
            raise TraceError(self.path, str(self.rejection),
                             'give an event of the table, and its fields with their types')

    def extend(self, entries: Iterable[Sequence[Any]], vpid: int) -> None:
        """
        Write events, given as name, timestamp, thread id and fields, or as entries of `groups`.

        An event that is unknown or does not fit its type is left out and counted in `rejected`.

        :raises TraceError: where writing fails
        """
        channels, groups = self._channels, self._groups
        for entry in entries:
            self.given += 1
            try:
                channel = channels.get(entry[0])
                if channel is None:
                    self._extend_group(groups[entry[0]], entry, vpid)
                    continue
                timestamp = entry[1]
                message = channel.encode(channel.count & 0xFFFFFFFF, timestamp, timestamp,
                                         cdr.ENCAPSULATION, timestamp, vpid, *entry[2:])
            except TraceError:              # of writing, on the way
                raise
            except Exception as error:      # whatever a caller gave: it costs this event only
                self._reject(entry, error)
                continue
            if self._size + len(message) + channel.undefined > CHUNK_LIMIT:
                self.flush()
            if channel.undefined:
                self._define(channel)
            channel.index += (timestamp, self._size)
            channel.count += 1
            self._records.append(message)
            self._size += len(message)

    def _extend_group(self, group: Group, entry: Sequence[Any], vpid: int) -> None:
        parts = group.parts
        self.given += len(parts) - 1
        try:
            data, times = group.encode(entry, vpid)
        except Exception as error:
            self._reject(entry, error, len(parts))
            return
        undefined = 0 if group.defined else sum(part.undefined for part in parts)
        if self._size + len(data) + undefined > CHUNK_LIMIT:
            self.flush()
        if not group.defined:
            group.defined = True
            for part in parts:
                if part.undefined:
                    self._define(part)
        offset = self._size
        for part, size, time in zip(parts, group.sizes, times):
            part.index += (time, offset)
            part.count += 1
            offset += size
        self._records.append(data)
        self._size = offset

    def _reject(self, entry: Sequence[Any], error: Exception, events: int = 1) -> None:
        self.rejected += events
        if self.rejection is None:
            name = entry[0] if entry else ''
            reason = 'no such event' if isinstance(error, KeyError) else str(error)
            self.rejection = f'event {name!r} cannot be written ({reason})'

    def _define(self, channel: _Channel) -> None:
        self._records += (channel.schema, channel.channel)
        self._size += channel.undefined
        channel.undefined = 0

    def flush(self) -> None:
        """
        Write what there is as a chunk and hand it to the operating system.

        :raises TraceError: where writing fails
        """
        if not self._records:
            return
        used = [channel for channel in self._in_order if channel.index]
        start = min(min(channel.index[::2]) for channel in used)
        end = max(max(channel.index[::2]) for channel in used)
        data = b''.join(self._records)
        packed = self._zstd.compress(data)
        chunk = written(Chunk('zstd', packed, end, start, zlib.crc32(data), len(data)))
        messages = 0
        indexes = b''
        offsets = {}
        for channel in used:
            offsets[channel.number] = self._offset + len(chunk) + len(indexes)
            # not with mcap's MessageIndex: a live run's writer takes the interpreter for this
            entries = struct.pack(f'<{len(channel.index)}Q', *channel.index)
            indexes += records.record(
                Opcode.MESSAGE_INDEX, struct.pack('<HI', channel.number, len(entries)) + entries)
            messages += len(channel.index) // 2
            channel.index = []
        self._chunk_indexes.append(written(ChunkIndex(
            chunk_length=len(chunk), chunk_start_offset=self._offset, compression='zstd',
            compressed_size=len(packed), message_end_time=end, message_index_length=len(indexes),
            message_index_offsets=offsets, message_start_time=start,
            uncompressed_size=len(data))))
        self._start = start if self._start is None else min(self._start, start)
        self._end = max(self._end, end)
        self._records = []
        self._size = 0
        self._write(chunk + indexes)
        self.written += messages

    def finish(self) -> None:
        """
        Write the rest, the summary and the footer, and close the file; a second call does nothing.

        :raises TraceError: where writing fails
        """
        if self._stream.closed:
            return
        self.flush()
        self._write(written(DataEnd(0)))
        summary_start = self._offset
        summary = self._summary()
        footer = written(Footer(summary_start, 0, 0))[:-4]
        crc = zlib.crc32(summary + footer)      # of all from the summary's start to the CRC itself
        self._write(summary + footer + records.UINT32.pack(crc) + records.MAGIC)
        self._stream.close()

    def _summary(self) -> bytes:
        defined = [channel for channel in self._in_order if not channel.undefined]
        counts = {channel.number: channel.count for channel in defined}
        statistics = Statistics(
            attachment_count=0, channel_count=len(defined), channel_message_counts=counts,
            chunk_count=len(self._chunk_indexes), message_count=sum(counts.values()),
            message_end_time=self._end, message_start_time=self._start or 0, metadata_count=0,
            schema_count=len(defined))
        return b''.join((
            *(channel.schema for channel in defined),
            *(channel.channel for channel in defined),
            written(statistics),
            *self._chunk_indexes))

    def abandon(self) -> None:
        """Close the file without what is not yet written, without summary and footer."""
        self._stream.close()

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._stream.write(rest):]      # a full disk may take only a part
        except (OSError, ValueError) as error:
            self._cut_back()
            reason = getattr(error, 'strerror', None) or str(error)
            raise TraceError(self.path, f'writing failed ({reason})',
                             f'{KEPT if self.written else ""}free space, then try again'
                             ) from None
        self._offset += len(data)

    def _cut_back(self) -> None:
        try:
            self._stream.truncate(self._offset)
        except (OSError, ValueError):
            pass        # not a plain file, or gone: a reader copes with a cut chunk
        self._stream.close()

    def __enter__(self) -> TraceFile:
        """Return the file itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Finish the file, or give it up when an exception leaves the block."""
        if kind is None:
            self.finish()
        else:
            self.abandon()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes a trace file: encodes events, collects them in chunks, and writes the chunks.

Theory of operation:

1. All data that a reader needs is inside chunks, which have a CRC: the schema and the channel of
   an event are in the chunk of its first message, just before that message.
2. A chunk is at most 256 KiB before compression (a larger event has its own chunk). It is written
   with its message indexes in one piece, so a killed process leaves whole chunks and at most one
   truncated chunk.
3. The summary (schemas, channels, statistics, chunk indexes) and the footer are written when the
   file is finished. They allow seeking and show what should be there; nothing else depends on
   them.
4. If writing fails, the file is truncated after its last whole chunk.

All methods must be called by one thread; `TraceWriter` is for many threads.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import functools
import os
import struct
from types import TracebackType
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel as ChannelRecord,
)
from mcap.records import (
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
)
from mddag_executor.output_rules import (
    close_recording,
    create_recording,
    EXISTS,
    holds_data,
    IS_WRITTEN,
    REMEDY,
    REMEDY_IF_WRITTEN,
    whole_file,
)
from mddag_executor.trace import cdr, records
from mddag_executor.trace.checksum import crc32
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.groups import Group, GROUPS
from mddag_executor.trace.schema import camel_case, EVENTS, EventType
import zstandard

CHUNK_LIMIT = 256 * 1024
KEPT = 'what was written before is there; '
"""Begin of the remedy if the failed file has events."""
_COMPRESSION_LEVEL = 1      # of zstd; higher levels cost more than they save for this data


def written(what: McapRecord) -> bytes:
    """Return one of mcap's records as bytes of the file."""
    builder = RecordBuilder()
    what.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


class Channel:
    """The writer's state of one kind of event."""

    __slots__ = ('channel', 'count', 'encode', 'event', 'index', 'number', 'schema',
                 'schema_name', 'undefined', 'width')

    def __init__(self, event: EventType, number: int, schema_name: str) -> None:
        self.event = event
        self.schema_name = schema_name
        self.number = number            # of the channel and of its schema
        self.schema = written(
            Schema(number, event.text.encode(), 'ros2msg', schema_name))
        self.channel = written(ChannelRecord(number, event.topic, 'cdr', {}, number))
        self.undefined = len(self.schema) + len(self.channel)   # 0 after they were written
        self.count = 0                  # messages so far
        self.index: list[int] = []      # log_time and offset of each message in the open chunk
        self.encode = _encoder(event, number)
        self.width = 1 + len(event.fields)      # values of an event after its time


def _encoder(event: EventType, number: int) -> Callable[..., bytes]:
    """
    Return the function that encodes a message record.

    Its arguments are sequence, log_time, publish_time, encapsulation, then the message's values.
    """
    layout = cdr.fixed_layout(event.types)
    if layout is not None:
        packer = struct.Struct('<BQHIQQ4s' + layout)
        return functools.partial(
            packer.pack, Opcode.MESSAGE, packer.size - records.RECORD.size, number)
    encode_fields = cdr.Encoder(event.types)

    def encode(sequence: int, log_time: int, publish_time: int, encapsulation: bytes,
               *values: Any) -> bytes:
        head = records.MESSAGE_HEAD.pack(number, sequence, log_time, publish_time)
        return records.record(Opcode.MESSAGE, head + encapsulation + encode_fields(values))

    return encode


def _schema_name(event: EventType, taken: Collection[str], number: int = 1) -> str:
    """Return a name for an event's message; used names get the provider, then numbers."""
    name = camel_case(event.name)
    stem = found = f'mddag_trace/msg/{name}'
    if found in taken:
        stem = found = f'mddag_trace/msg/{camel_case(event.provider)}{name}'
    while found in taken:
        number += 1
        found = f'{stem}V{number}'
    return found


@contextmanager
def whole_trace(path: str, overwrite: bool = False) -> Iterator[str]:
    """
    Give a file that becomes ``path`` when the block ends well; errors name ``path``.

    :raises TraceError: if the file must not be replaced.
    """
    if not overwrite and holds_data(path):
        raise TraceError(path, EXISTS, REMEDY)
    with whole_file(path) as file:
        try:
            yield file.name
        except TraceError as error:
            if error.file != file.name:
                raise
            raise TraceError(path, error.problem, error.remedy.removeprefix(KEPT)) from None


class TraceFile:
    """
    A trace file that one thread writes, event by event.

    For importers and simulations; live runs use `TraceWriter`. The file is complete after
    `finish()`; a `with` block finishes it, or abandons it after an exception.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """
        Open the file.

        :param overwrite: whether an existing file may be replaced
        :raises TraceError: if the file cannot be written, or must not be replaced
        """
        self.path = os.fspath(path)
        #: Number of events in the file, in whole chunks.
        self.written = 0
        #: Number of events passed to `extend`, including those that could not be encoded.
        self.given = 0
        #: Number of events that could not be encoded, and the reason of the first.
        self.rejected = 0
        self.rejection: str | None = None
        self._in_order = [Channel(event, number, _schema_name(event, ()))
                          for number, event in enumerate(EVENTS.values(), 1)]
        #: By the event's full name, and by its short name.
        self._channels = {
            name: channel for channel in self._in_order
            for name in (channel.event.key, channel.event.name)}
        self._groups = {name: Group(name, self._channels) for name in GROUPS}
        self._zstd = zstandard.ZstdCompressor(level=_COMPRESSION_LEVEL)
        self._records: list[bytes] = []     # of the open chunk
        self._size = 0                      # their total size
        self._offset = 0                    # bytes written so far
        self._chunk_indexes: list[bytes] = []
        self._start: int | None = None      # minimum and maximum time of all messages
        self._end = 0
        try:
            self._stream = create_recording(self.path, overwrite)
        except FileExistsError:
            raise TraceError(self.path, EXISTS, REMEDY) from None
        except BlockingIOError:
            raise TraceError(self.path, IS_WRITTEN, REMEDY_IF_WRITTEN) from None
        except (OSError, ValueError) as error:
            reason = getattr(error, 'strerror', None) or str(error)
            raise TraceError(self.path, f'cannot be written ({reason})',
                             'name a file in an existing folder that you may write') from None
        self._write(records.MAGIC + written(Header('ros2', records.LIBRARY)))

    def define(self, event: EventType) -> str:
        """
        Define a kind of event that is not in the table, or with other fields than there.

        If its name is already used with other fields, its events go to another channel of the same
        topic.

        :returns: its name for `add` and `extend`
        """
        key, number = event.key, 1
        while key in self._channels and self._channels[key].event != event:
            number += 1
            key = f'{event.key}#{number}'
        if key not in self._channels:
            taken = {channel.schema_name for channel in self._in_order}
            channel = Channel(
                event, len(self._in_order) + 1, _schema_name(event, taken, number))
            self._channels[key] = channel
            self._in_order.append(channel)
        return key

    def add(self, event: str, timestamp: int, vpid: int, vtid: int, *fields: Any) -> None:
        """
        Write one event.

        :param event: its full name (`ros2:callback_start`), or its short one if it is in the table
        :param timestamp: ns on the trace's clock
        :param vpid: process id
        :param vtid: native thread id
        :param fields: the values of its fields, in the order of its type
        :raises TraceError: for an unknown event, unfit values, or if writing fails
        """
        if self._stream.closed:
            raise TraceError(self.path, 'is closed', 'write events before finishing it')
        rejected = self.rejected
        self.rejection = None
        self.extend(((event, timestamp, vtid, *fields),), vpid)
        if self.rejected > rejected:
            raise TraceError(self.path, str(self.rejection),
                             'give an event of the table, and its fields with their types')

    def extend(self, entries: Iterable[tuple[Any, ...]], vpid: int) -> None:
        """
        Write events: name, timestamp, thread id and fields; or entries of `groups`.

        An event that is unknown or does not fit its type is skipped and counted in `rejected`.

        :raises TraceError: if writing fails
        """
        channels, groups = self._channels, self._groups
        for entry in entries:
            self.given += 1
            try:
                channel = channels.get(entry[0])
                if channel is None:
                    self._extend_group(groups[entry[0]], entry, vpid)
                    continue
                timestamp, values = entry[1], entry[2:]
                if len(values) < channel.width:
                    values += channel.event.optional[len(values) - channel.width:]
                message = channel.encode(channel.count & 0xFFFFFFFF, timestamp, timestamp,
                                         cdr.ENCAPSULATION, timestamp, vpid, *values)
            except TraceError:              # writing failed
                raise
            except Exception as error:      # wrong values of a caller lose only this event
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

    def channel(self, name: str) -> Channel:
        """Return the channel of a kind of event, by its name for `extend`."""
        return self._channels[name]

    def room(self, channels: Iterable[Channel], wanted: int) -> int:
        """
        Return how many bytes of messages of some channels fit into the open chunk.

        If ``wanted`` bytes do not fit, the chunk is written, and a new one opened.

        :raises TraceError: if writing fails
        """
        undefined = sum(channel.undefined for channel in channels)
        if self._size + undefined + wanted > CHUNK_LIMIT:
            self.flush()
        return CHUNK_LIMIT - self._size - undefined

    def append(self, data: bytes, messages: Mapping[Channel, list[int]]) -> None:
        """
        Add encoded messages to the open chunk, in which there must be room for them.

        :param messages: by channel time and offset in the data of each message, in turns.
        """
        for channel in messages:
            if channel.undefined:
                self._define(channel)
        for channel, index in messages.items():
            index[1::2] = [offset + self._size for offset in index[1::2]]
            channel.index += index
            channel.count += len(index) // 2
            self.given += len(index) // 2
        self._records.append(data)
        self._size += len(data)

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

    def _define(self, channel: Channel) -> None:
        self._records += (channel.schema, channel.channel)
        self._size += channel.undefined
        channel.undefined = 0

    def flush(self) -> None:
        """Write the collected events as a chunk to the operating system, or raise TraceError."""
        if not self._records:
            return
        used = [channel for channel in self._in_order if channel.index]
        start = min(min(channel.index[::2]) for channel in used)
        end = max(max(channel.index[::2]) for channel in used)
        data = b''.join(self._records)
        packed = self._zstd.compress(data)
        chunk = written(Chunk('zstd', packed, end, start, crc32(data), len(data)))
        messages = 0
        indexes = b''
        offsets = {}
        for channel in used:
            offsets[channel.number] = self._offset + len(chunk) + len(indexes)
            # mcap's MessageIndex would hold the GIL of a live run for longer
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

        :raises TraceError: if writing fails
        """
        if self._stream.closed:
            return
        self.flush()
        self._write(written(DataEnd(0)))
        summary_start = self._offset
        summary = self._summary()
        footer = written(Footer(summary_start, 0, 0))[:-4]
        crc = crc32(summary + footer)      # from the summary's start to the CRC itself
        self._write(summary + footer + records.UINT32.pack(crc) + records.MAGIC)
        close_recording(self._stream)

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
        """Close the file without unwritten events, summary and footer."""
        close_recording(self._stream)

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._stream.write(rest):]      # a full disk may accept only a part
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
            pass        # not a plain file, or removed: readers can handle a truncated chunk
        close_recording(self._stream)

    def __enter__(self) -> TraceFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Finish the file, or abandon it after an exception."""
        if kind is None:
            self.finish()
        else:
            self.abandon()

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the data of an MCAP file in blocks.

Theory of operation
-------------------
1. A file is a sequence of records.  A block is the content of a chunk with its message indexes, or
   a run of messages and definitions outside of chunks.
2. ``blocks`` reads one after the other.  The first defect ends it with ``Damage``; later data is
   not used.
3. Every length is compared with the available bytes before it is used.  No memory is allocated for
   an unchecked length.
4. A message index follows its chunk.  Elsewhere it shows that the opcode of a chunk has changed.
5. A chunk's CRC of 0 means no CRC (MCAP specification).  Records outside of chunks have no CRC.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
import os
from typing import BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Statistics
from mddag_executor.trace import records
from mddag_executor.trace.errors import TraceError
import zstandard

MAX_CHUNK = 256 * 1024 * 1024
"""Bytes before compression; a larger chunk is damage."""
_PLAIN_BLOCK = 256 * 1024
_LZ4_PIECE = 1 << 20
NO_MEMORY = 'a chunk does not fit into the memory'
_WRONG_SIZE = 'a chunk does not have the size that its head says'
_PLAIN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_FOOTER_SIZE = records.RECORD.size + records.FOOTER_CONTENT.size + len(records.MAGIC)
_REMEDY = 'give a trace written by this program or another MCAP recording'


class Damage(Exception):
    """A defect of a file's data, and its byte position; used inside this package only."""

    def __init__(self, what: str, offset: int) -> None:
        super().__init__(what)
        self.what = what
        self.offset = offset


class Content(ReadDataStream):
    """
    The content of a record, for mcap's readers.

    Reading past the end raises ValueError, so wrong lengths are harmless.
    """

    def __init__(self, data: bytes) -> None:
        super().__init__(BytesIO(data))
        self._size = len(data)

    def read(self, length: int) -> bytes:
        """Return the next bytes."""
        self._count += length
        if self._count > self._size:
            raise ValueError('a record is shorter than what it should hold')
        return self._stream.read(length)


@dataclass
class Block:
    """
    A chunk, or records outside of chunks.

    :ivar offset: position of its first byte in the file.
    :ivar indexes: contents of its message indexes.
    :ivar chunk: the chunk; its data is packed.
    :ivar plain: records outside of chunks.
    """

    offset: int
    indexes: list[bytes]
    chunk: Chunk | None = None
    plain: bytearray = field(default_factory=bytearray)

    @property
    def size(self) -> int:
        """Return the size of its records, unpacked."""
        return len(self.plain) if self.chunk is None else int(self.chunk.uncompressed_size)

    def unpack(self, room: memoryview) -> None:
        """
        Write its records into a buffer of its size.

        :raises Damage: if the records do not match the head of the chunk.
        """
        if self.chunk is None:
            room[:] = self.plain
            return
        try:
            _decompress(self.chunk.data, self.chunk.compression, room)
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
            raise Damage('a chunk cannot be decompressed', self.offset) from None
        except ValueError as error:
            raise Damage(str(error), self.offset) from None
        if self.chunk.uncompressed_crc and zlib.crc32(room) != self.chunk.uncompressed_crc:
            raise Damage('the CRC of a chunk is wrong', self.offset)


class Summary(NamedTuple):
    """The contents of a file according to its summary section."""

    messages: int
    chunks: int
    topics: frozenset[str]


def open_data(stream: BinaryIO, path: str) -> tuple[int, str]:
    """Check the beginning of a file; return the start of its data section, and its writer."""
    magic = stream.read(len(records.MAGIC))
    if not magic:
        raise TraceError(path, 'is empty', _REMEDY)
    if magic != records.MAGIC:
        raise TraceError(path, 'is no MCAP file', _REMEDY)
    head = stream.read(records.RECORD.size)
    if len(head) == records.RECORD.size:
        opcode, length = records.RECORD.unpack(head)
        content = Content(stream.read(min(length, 1 << 16)))
        try:
            library: str = Header.read(content).library
        except ValueError:
            opcode = 0
        # A wrong length could skip the first chunk.
        if opcode == Opcode.HEADER and content.count == length:
            return len(magic) + len(head) + int(length), library
    raise TraceError(path, 'ends or is damaged before its first event', _REMEDY)


def blocks(stream: BinaryIO, start: int, size: int) -> Iterator[Block]:
    """
    Yield the blocks of the data section, in the order of the file.

    :param start: start of the data section; ``size``: size of the file.
    :raises Damage: at the first defect; all blocks before it have been yielded.
    """
    block: Block | None = None
    try:
        for opcode, offset, content in _records(stream.fileno(), start, size):
            if opcode == Opcode.MESSAGE_INDEX:
                if block is None or block.chunk is None:
                    raise Damage('a message index belongs to no chunk', offset)
                block.indexes.append(content)
                continue
            plain = records.record(opcode, content) if opcode in _PLAIN else b''
            if plain and block is not None and block.chunk is None and (
                    block.size < _PLAIN_BLOCK):
                block.plain += plain
                continue
            if block is not None:
                yield block
            block = None
            if opcode == Opcode.CHUNK:
                block = Block(offset, [], chunk=_chunk(content, offset))
            elif plain:
                block = Block(offset, [], plain=bytearray(plain))
    except Damage:
        if block is not None:
            yield block
        raise
    if block is not None:
        yield block


def _records(file: int, position: int, size: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield the records of the data section: opcode, position, content of those that are used."""
    while True:
        head = os.pread(file, records.RECORD.size, position)
        if len(head) < records.RECORD.size:
            raise Damage('the file ends without a finish record', position)
        opcode, length = records.RECORD.unpack(head)
        start = position + records.RECORD.size
        if start + length > size:
            raise Damage('a record is cut off, or its length is wrong', position)
        if opcode in (0, Opcode.HEADER, Opcode.FOOTER):     # 0: a tail of zeros
            raise Damage('a record is where it cannot be', position)
        if opcode == Opcode.DATA_END:
            return
        content = b''
        if opcode in (*_PLAIN, Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            if length > MAX_CHUNK:
                raise Damage('a record is too large', position)
            try:
                content = os.pread(file, length, start)
            except MemoryError:
                raise Damage(NO_MEMORY, position) from None
            if len(content) < length:
                raise Damage('the file has become shorter', position)
        yield opcode, position, content
        position = start + length


def _chunk(content: bytes, offset: int) -> Chunk:
    """Return a chunk; raise Damage if its head is wrong."""
    stream = Content(content)
    try:
        chunk: Chunk = Chunk.read(stream)
    except (ValueError, MemoryError) as error:
        raise Damage(str(error) or NO_MEMORY, offset) from None
    if stream.count < len(content) or chunk.uncompressed_size > MAX_CHUNK:
        raise Damage('the lengths in the head of a chunk are wrong', offset)
    return chunk


def _decompress(data: bytes, compression: str, room: memoryview) -> None:
    """Decompress data into a buffer; raise ValueError if it does not fill the buffer exactly."""
    size = len(room)
    if compression == '':
        filled = len(data)
        if filled == size:
            room[:] = data
    elif compression == 'zstd':
        if zstandard.frame_content_size(data) not in (size, -1):    # -1: not stated
            raise ValueError(_WRONG_SIZE)
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            filled = reader.readinto(room) + len(reader.read(1))
    elif compression == 'lz4':
        stream = lz4.frame.open(BytesIO(data))
        filled = 0
        while piece := stream.read(_LZ4_PIECE):     # one large read takes thrice the memory
            if filled + len(piece) > size:
                raise ValueError(_WRONG_SIZE)
            room[filled:filled + len(piece)] = piece
            filled += len(piece)
    else:
        raise ValueError(f'the compression of a chunk, {compression[:20]!r}, is unknown')
    if filled != size:
        raise ValueError(_WRONG_SIZE)


def read_summary(stream: BinaryIO, size: int) -> Summary | None:
    """
    Return the summary of a file; None if it is finished without one.

    The summary's CRC is also wrong if bytes were inserted or removed before it, because the
    summary is then not at the position in the footer.

    :raises ValueError: if the file is not finished, or its summary is damaged.
    """
    footer_start = size - _FOOTER_SIZE
    stream.seek(max(0, footer_start))
    footer = stream.read(_FOOTER_SIZE)
    expected = records.RECORD.pack(Opcode.FOOTER, records.FOOTER_CONTENT.size)
    if not (footer.endswith(records.MAGIC) and footer.startswith(expected)):
        raise ValueError('there is no footer')
    start, _, crc = records.FOOTER_CONTENT.unpack(
        footer[records.RECORD.size:-len(records.MAGIC)])
    if start == 0:
        return None
    if start > footer_start:
        raise ValueError('the summary is behind the footer')
    stream.seek(start)
    data = stream.read(footer_start - start)
    if crc and crc != zlib.crc32(footer[:records.RECORD.size + 16], zlib.crc32(data)):
        raise ValueError('the CRC of the summary is wrong')
    content = Content(data)
    statistics, topics = None, set()
    while content.count < len(data):
        opcode, length = records.RECORD.unpack(content.read(records.RECORD.size))
        record = Content(content.read(length))
        if opcode == Opcode.STATISTICS:
            statistics = Statistics.read(record)
        elif opcode == Opcode.CHANNEL:
            topics.add(Channel.read(record).topic)
    if statistics is None:
        return None
    return Summary(statistics.message_count, statistics.chunk_count, frozenset(topics))

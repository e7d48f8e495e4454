# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds the data blocks of an MCAP file and checks them.

Theory of operation
-------------------
A file is a sequence of records.  ``scan`` reads their headers and finds the blocks: a chunk with
its message indexes, or a run of plain messages and definitions.  ``load`` reads one block and
checks its sizes and its CRC.  The first defect ends both with ``Damage``; later data is not used.

1. Every length is compared with the available bytes before it is used.  No memory is allocated for
   an unchecked length.
2. The lengths inside a chunk or a message index must add up to the length of its record.
   Otherwise a wrong length could skip the next chunk.
3. Message indexes follow their chunk.  A message index after another record shows that the opcode
   of a chunk has changed.
4. A file has its messages inside or outside of chunks, not both.  A plain message after a chunk is
   a record whose opcode has changed.
5. A chunk's CRC of 0 means no CRC (MCAP specification).  Plain messages have no CRC.
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
import os
import struct
from typing import BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Statistics
from mddag_executor.trace import records
from mddag_executor.trace.errors import TraceError
import zstandard

MAX_CHUNK = 256 * 1024 * 1024
"""Bytes before compression; a larger chunk is damage."""
_PLAIN_BLOCK = 256 * 1024
_CHUNK_HEAD = 1024              # bytes; more than the head of a chunk
_FOOTER_SIZE = records.RECORD.size + records.FOOTER_CONTENT.size + len(records.MAGIC)
_LZ4_PIECE_BYTES = 4 * 1024 * 1024
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

    def read(self, length: int) -> bytes:
        """Return the next bytes."""
        data = self._stream.read(length)
        if len(data) < length:
            raise ValueError('a record is shorter than what it should hold')
        self._count += length
        return data


@dataclass
class Block:
    """
    A chunk with its message indexes, or a run of plain records; not yet read.

    :ivar offset: position of its first byte in the file; ``end``: position after its records.
    :ivar after: position after its message indexes.
    :ivar data_offset: position of its (compressed) records in the file.
    :ivar size: size of its records, uncompressed; ``crc``: CRC of these, 0: none.
    """

    offset: int
    end: int
    after: int
    chunk: bool
    compression: str
    data_offset: int
    size: int
    crc: int


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


def scan(stream: BinaryIO, start: int, size: int) -> tuple[list[Block], Damage | None]:
    """
    Return the blocks of the data section, in the order of the file, and the first damage.

    :param start: start of the data section; ``size``: size of the file.
    """
    blocks: list[Block] = []
    try:
        _scan(stream.fileno(), start, size, blocks)
    except Damage as damage:
        return blocks, damage.with_traceback(None)      # whose frames would keep the data
    return blocks, None


def _scan(file: int, position: int, size: int, blocks: list[Block]) -> None:
    previous = 0            # opcode of the previous record
    chunks_seen = False
    while True:
        head = os.pread(file, records.RECORD.size + 6, position)
        if len(head) < records.RECORD.size:
            raise Damage('the file ends without a finish record', position)
        opcode, length = records.RECORD.unpack_from(head)
        end = position + records.RECORD.size + length
        if end > size:
            raise Damage('a record is cut off, or its length is wrong', position)

        if opcode == Opcode.MESSAGE_INDEX:
            if previous not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
                raise Damage('a message index belongs to no chunk', position)
            if length < 6 or length != 6 + records.UINT32.unpack_from(
                    head, records.RECORD.size + 2)[0]:
                raise Damage('the lengths in a message index are wrong', position)
            blocks[-1].after = end
        elif opcode == Opcode.CHUNK:
            blocks.append(_chunk(file, position, end))
            chunks_seen = True
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            if chunks_seen and opcode == Opcode.MESSAGE:
                raise Damage('a message is outside of the chunks', position)
            blocks.append(_plain(file, position, size, messages=not chunks_seen))
            end = blocks[-1].end
        elif opcode == Opcode.DATA_END:
            if length != 4:
                raise Damage('the finish record is damaged', position)
            return
        elif opcode in (0, Opcode.HEADER, Opcode.FOOTER):    # 0: a tail of zeros
            raise Damage('a record is where it cannot be', position)
        previous = opcode
        position = end


def _chunk(file: int, position: int, end: int) -> Block:
    """Return the chunk whose record starts at a position; reads only its head."""
    start = position + records.RECORD.size
    content = Content(os.pread(file, min(end - start, _CHUNK_HEAD), start))
    try:
        _, _, size, crc = records.CHUNK_HEAD.unpack(content.read(records.CHUNK_HEAD.size))
        compression, length = content.read_prefixed_string(), content.read8()
    except ValueError:
        raise Damage('the head of a chunk is damaged', position) from None
    data_offset = start + content.count
    if data_offset + length != end or size > MAX_CHUNK or length > MAX_CHUNK + _CHUNK_HEAD:
        raise Damage('the lengths in the head of a chunk are wrong', position)
    return Block(position, end, end, True, compression, data_offset, size, crc)


def _plain(file: int, position: int, size: int, messages: bool) -> Block:
    """Return the run of plain records from a position on, at least one."""
    allowed = [Opcode.SCHEMA, Opcode.CHANNEL] + [Opcode.MESSAGE] * messages
    end = position
    while True:
        head = os.pread(file, records.RECORD.size, end)
        if len(head) < records.RECORD.size:
            break       # ``scan`` reports the damage
        opcode, length = records.RECORD.unpack_from(head)
        after = end + records.RECORD.size + length
        if opcode not in allowed or after > size:
            break
        if end > position and after - position > _PLAIN_BLOCK:
            break
        if after - position > MAX_CHUNK:
            raise Damage('a record is too large', position)
        end = after
    return Block(position, end, end, False, '', position, end - position, 0)


def load(stream: BinaryIO, block: Block, room: memoryview) -> bytes:
    """
    Read the records of a block into a buffer of its size; return its message indexes.

    :raises Damage: if the records do not match the block's head.
    """
    read = os.pread(stream.fileno(), block.after - block.data_offset, block.data_offset)
    length = block.end - block.data_offset
    if len(read) < block.after - block.data_offset:
        raise Damage('the file has become shorter', block.offset)
    try:
        fits = _decompress(memoryview(read)[:length], block.compression, room)
    except (zstandard.ZstdError, RuntimeError, MemoryError):
        raise Damage('a chunk cannot be decompressed', block.offset) from None
    except ValueError as error:
        raise Damage(str(error), block.offset) from None
    if not fits:
        raise Damage('a chunk does not have the size that its head says', block.offset)
    if block.crc and zlib.crc32(room) != block.crc:
        raise Damage('the CRC of a chunk is wrong', block.offset)
    return read[length:]


def _decompress(data: memoryview, compression: str, room: memoryview) -> bool:
    """Decompress data into a buffer; return whether it fills the buffer exactly."""
    size = len(room)
    if compression == 'zstd' and (size or data):
        # compare the frame's size before memory is allocated for it
        if zstandard.frame_content_size(data) not in (size, -1):
            return False
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            return reader.readinto(room) == size and not reader.read(1)
    if compression == 'lz4' and (size or data):
        return _decompress_lz4(bytes(data), room)
    if compression not in ('', 'zstd', 'lz4'):
        raise ValueError(f'the compression of a chunk, {compression[:20]!r}, is unknown')
    if len(data) == size:
        room[:] = data
    return len(data) == size


def _decompress_lz4(data: bytes, room: memoryview) -> bool:
    """Do the same piece by piece, so that memory is needed for the buffer only."""
    frame = lz4.frame.LZ4FrameDecompressor()
    filled = 0
    while True:
        piece = frame.decompress(data, max_length=_LZ4_PIECE_BYTES)
        data = b''
        if filled + len(piece) > len(room):
            return False
        room[filled:filled + len(piece)] = piece
        filled += len(piece)
        if frame.eof or frame.needs_input:
            return filled == len(room)


def read_summary(stream: BinaryIO, size: int) -> tuple[bool, Summary | None]:
    """
    Return whether the file is finished, and its summary if it has one.

    A summary with a wrong CRC is ignored.  The CRC is also wrong if bytes were inserted or
    removed, because the summary is then not at the position in the footer.
    """
    footer_start = size - _FOOTER_SIZE
    if footer_start < 0:
        return False, None
    stream.seek(footer_start)
    footer = stream.read(_FOOTER_SIZE)
    content = footer[records.RECORD.size:-len(records.MAGIC)]
    expected = records.RECORD.pack(Opcode.FOOTER, records.FOOTER_CONTENT.size)
    if not (footer.endswith(records.MAGIC) and footer.startswith(expected)):
        return False, None
    start, _, crc = records.FOOTER_CONTENT.unpack(content)
    if start == 0:
        return True, None
    if start > footer_start:
        return False, None
    stream.seek(start)
    data = stream.read(footer_start - start)
    if crc and crc != zlib.crc32(footer[:records.RECORD.size + 16], zlib.crc32(data)):
        return False, None
    try:
        return True, _parse_summary(data)
    except (ValueError, struct.error):
        return False, None


def _parse_summary(data: bytes) -> Summary | None:
    statistics = None
    topics = set()
    at = 0
    while at < len(data):
        opcode, length = records.RECORD.unpack_from(data, at)
        at += records.RECORD.size
        content = Content(data[at:at + length])
        if opcode == Opcode.STATISTICS:
            statistics = Statistics.read(content)
        elif opcode == Opcode.CHANNEL:
            topics.add(Channel.read(content).topic)
        at += length
    if at != len(data):
        raise ValueError('the summary does not end at the footer')
    if statistics is None:
        return None
    return Summary(statistics.message_count, statistics.chunk_count, frozenset(topics))

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
6. Records may have more bytes than is known of them; these are ignored (MCAP specification).
7. The content of a chunk is read when it is unpacked, so a chunk that is not wanted costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
import os
import struct
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mddag_executor.trace import records
from mddag_executor.trace.checksum import crc32
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.records import Channel, Content, counts_of, library_of
import zstandard

MAX_CHUNK = 256 * 1024 * 1024
"""Bytes before compression; a larger chunk is damage."""
_PLAIN_BLOCK = 256 * 1024
_LZ4_PIECE = 1 << 20
NO_MEMORY = 'a chunk does not fit into the memory'
_WRONG_SIZE = 'a chunk does not have the size that its head says'
_SHORTER = 'the file has become shorter'
_PLAIN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_USED = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)
_SUMMARY = (*_USED, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX,
            Opcode.SUMMARY_OFFSET)
_PRIVATE = 0x80     # opcodes from here on belong to others
_CHUNK_HEAD = 256   # bytes; the name of the compression is short
_AHEAD = 1 << 15    # bytes that are read at once: heads of records, and short records
MOST_OTHERS = 50_000
"""Records without messages, or definitions of these, of a file or of a block."""
_MOST_INDEXES = 1 << 16     # of a chunk: one for each channel
_CHUNK = struct.Struct('<QQQI')     # times of the first and last message, size, CRC
_CRC_PIECE = 1 << 20
_NUMBER = 2         # bytes of the number of a schema or channel, which comes first
_FOOTER_SIZE = records.RECORD.size + records.FOOTER_CONTENT.size + len(records.MAGIC)
_REMEDY = 'give a trace written by this program or another MCAP recording'


class Damage(Exception):
    """A defect of a file's data, and its byte position; used inside this package only."""

    def __init__(self, what: str, offset: int) -> None:
        super().__init__(what)
        self.what = what
        self.offset = offset


class ChunkHead(NamedTuple):
    """
    The head of a chunk, and where its packed records are.

    :ivar start, end: the times of its first and last message.
    :ivar size: of the records, unpacked; ``crc``: of these, or 0.
    """

    start: int
    end: int
    size: int
    crc: int
    compression: str
    file: int
    position: int
    length: int

    def data(self) -> bytes:
        """Return the packed records; ValueError: the file has become shorter."""
        data = os.pread(self.file, self.length, self.position)
        if len(data) < self.length:
            raise ValueError(_SHORTER)
        return data


@dataclass
class Block:
    """
    A chunk, or records outside of chunks.

    :ivar offset: position of its first byte in the file.
    :ivar indexes: contents of its message indexes.
    :ivar chunk: the head of the chunk.
    :ivar plain: records outside of chunks.
    :ivar place: among the blocks whose times are kept.
    """

    offset: int
    indexes: list[bytes]
    chunk: ChunkHead | None = None
    plain: bytearray = field(default_factory=bytearray)
    place: int = 0

    @property
    def size(self) -> int:
        """Return the size of its records, unpacked."""
        return len(self.plain) if self.chunk is None else self.chunk.size

    @property
    def packed(self) -> int:
        """Return how many bytes of the file it is."""
        return sum(map(len, self.indexes)) + (
            len(self.plain) if self.chunk is None else self.chunk.length)

    @property
    def is_checked(self) -> bool:
        """Return whether a CRC says that its records are what was written."""
        return self.chunk is not None and self.chunk.crc != 0

    def unpack(self, room: memoryview) -> None:
        """
        Write its records into a buffer of its size.

        :raises Damage: if the records do not match the head of the chunk.
        """
        if self.chunk is None:
            room[:] = self.plain
            return
        try:
            _decompress(self.chunk.data(), self.chunk.compression, room)
        except MemoryError:
            raise Damage(NO_MEMORY, self.offset) from None
        except (zstandard.ZstdError, RuntimeError, EOFError):
            raise Damage('a chunk cannot be decompressed', self.offset) from None
        except ValueError as error:
            raise Damage(str(error), self.offset) from None
        if self.is_checked and crc32(room) != self.chunk.crc:
            raise Damage('the CRC of a chunk is wrong', self.offset)


class Summary(NamedTuple):
    """
    The contents of a file according to its summary section.

    :ivar topics: the topics of all channels; None if not all of them are repeated there.
    :ivar schemas, channels: contents of the records of all schemas and channels.
    """

    messages: int
    chunks: int
    topics: frozenset[str] | None
    schemas: tuple[bytes, ...]
    channels: tuple[bytes, ...]


# By the first bytes of a file: what it is, and what to do.
_OTHERS = (
    (b'version https://git-lfs', 'is a pointer to a file in Git LFS, not the file itself',
     "get the file with 'git lfs pull'"),
    (b'#ROSBAG V', 'is a bag of ROS 1', "convert it, as with 'rosbags-convert'"),
)


def other_kind(head: bytes) -> tuple[str, str] | None:
    """Return what a file is, and what to do, by its first 32 bytes; None: unknown."""
    return next(((what, remedy) for magic, what, remedy in _OTHERS if head.startswith(magic)),
                None)


def open_data(stream: BinaryIO, path: str, size: int) -> tuple[int, str]:
    """Check the beginning of a file; return the start of its data section, and its writer."""
    start = stream.read(32)
    if not start:
        raise TraceError(path, 'is empty', _REMEDY)
    if not start.startswith(records.MAGIC):
        raise TraceError(path, *(other_kind(start) or ('is not an MCAP file', _REMEDY)))
    stream.seek(len(records.MAGIC))
    head = stream.read(records.RECORD.size)
    if len(head) == records.RECORD.size:
        opcode, length = records.RECORD.unpack(head)
        content = Content(stream.read(min(length, 1 << 16)))
        try:
            library = library_of(content)
        except ValueError:
            opcode = 0
        end = len(records.MAGIC) + len(head) + int(length)
        # A wrong length could skip the first chunk.
        if opcode == Opcode.HEADER and (
                content.at == length or _is_record(stream, end, size)):
            return end, library
    raise TraceError(path, 'ends or is damaged before its first event', _REMEDY)


def _is_record(stream: BinaryIO, position: int, size: int) -> bool:
    """Return whether a whole record of the data section is at a position."""
    stream.seek(min(position, size))
    head = stream.read(records.RECORD.size)
    if len(head) < records.RECORD.size:
        return False
    opcode, length = records.RECORD.unpack(head)
    known = (*_PLAIN, Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END)
    fits: bool = position + len(head) + length <= size
    return fits and (opcode in known or opcode >= _PRIVATE)


def blocks(stream: BinaryIO, start: int, size: int) -> Iterator[Block]:
    """
    Yield the blocks of the data section, in the order of the file.

    :param start: start of the data section; ``size``: size of the file.
    :raises Damage: at the first defect; all blocks before it have been yielded.
    """
    block: Block | None = None
    others = 0      # records of no use
    try:
        for opcode, offset, content, length in _records(stream.fileno(), start, size):
            if opcode == Opcode.MESSAGE_INDEX:
                if block is None or block.chunk is None:
                    raise Damage('a message index belongs to no chunk', offset)
                if len(block.indexes) >= _MOST_INDEXES:
                    raise Damage('a chunk has more message indexes than channels', offset)
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
                block = Block(offset, [], chunk=_chunk(stream.fileno(), offset, content, length))
            elif plain:
                block = Block(offset, [], plain=bytearray(plain))
            others += block is None or not block.size
            if others > MOST_OTHERS:
                raise Damage(f'there are more than {MOST_OTHERS} records without messages before '
                             'it', offset)
    except Damage:
        if block is not None:
            yield block
        raise
    if block is not None:
        yield block


class _Ahead:
    """Reads pieces of a file that mostly follow each other; short ones from the memory."""

    def __init__(self, file: int) -> None:
        self._file, self._data, self._begin = file, b'', 0

    def read(self, position: int, length: int) -> bytes:
        """Return bytes from a position on; fewer at the end of the file."""
        at = position - self._begin
        if at < 0 or at + length > len(self._data):
            if length > _AHEAD:
                return os.pread(self._file, length, position)
            self._data, self._begin, at = os.pread(self._file, _AHEAD, position), position, 0
        return self._data[at:at + length]


def _records(file: int, position: int, size: int) -> Iterator[tuple[int, int, bytes, int]]:
    """
    Yield the records of the data section: opcode, position, content, length of the content.

    Only those that are used have their contents, and chunks only the begin.
    """
    read = _Ahead(file).read
    while True:
        head = read(position, records.RECORD.size)
        if len(head) < records.RECORD.size:
            raise Damage('the file ends without a finish record', position)
        opcode, length = records.RECORD.unpack(head)
        start = position + records.RECORD.size
        if start + length > size:
            raise Damage('a record is cut off, or its length is wrong', position)
        if opcode in (0, Opcode.HEADER, Opcode.FOOTER):     # 0: a tail of zeros
            raise Damage('a record is where it cannot be', position)
        if opcode == Opcode.DATA_END:
            _check_tail(file, start + length, size)
            return
        content = b''
        if opcode in (*_PLAIN, Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            if length > MAX_CHUNK:
                raise Damage('a record is too large', position)
            wanted = min(length, _CHUNK_HEAD) if opcode == Opcode.CHUNK else length
            try:
                content = read(start, wanted)
            except MemoryError:
                raise Damage(NO_MEMORY, position) from None
            if len(content) < wanted:
                raise Damage(_SHORTER, position)
        yield opcode, position, content, length
        position = start + length


def _check_tail(file: int, position: int, size: int) -> None:
    """Check that a file ends behind its footer; another one may have been appended to it."""
    read = _Ahead(file).read
    while position + records.RECORD.size <= size:
        opcode, length = records.RECORD.unpack(read(position, records.RECORD.size))
        position += records.RECORD.size + length
        if opcode == Opcode.FOOTER:
            position += len(records.MAGIC)
            if position < size:
                raise Damage('the file goes on behind its end, as if another one had been '
                             'appended to it', position)
            return
        if opcode not in _SUMMARY and opcode < _PRIVATE:
            return      # damage, which reading the summary reports


def _chunk(file: int, offset: int, content: bytes, record: int) -> ChunkHead:
    """
    Return the head of a chunk from the first bytes of its content; Damage: it is wrong.

    :param record: the length of its content.
    """
    stream = Content(content)
    begin = offset + records.RECORD.size
    try:
        start, end, size, crc = _CHUNK.unpack(stream.read(_CHUNK.size))
        compression, length = stream.text(), stream.number(8)
    except ValueError as error:
        raise Damage(str(error), offset) from None
    if stream.at + length > record or size > MAX_CHUNK:
        raise Damage('the lengths in the head of a chunk are wrong', offset)
    return ChunkHead(start, end, size, crc, compression, file, begin + stream.at, length)


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
        import lz4.frame
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
    found = _summary_records(stream.fileno(), start, footer_start)
    if crc and crc != _crc(stream, start, footer_start, footer[:records.RECORD.size + 16]):
        raise ValueError('the CRC of the summary is wrong')
    statistics = found.get(Opcode.STATISTICS)
    if statistics is None:
        return None
    messages, n_channels, chunks = counts_of(Content(statistics[-1]))
    channels = found.get(Opcode.CHANNEL, [])
    topics = frozenset(Channel.read(Content(each[_NUMBER:])).topic for each in channels)
    return Summary(
        messages, chunks, topics if len({each[:_NUMBER] for each in channels}) >= n_channels
        else None, tuple(found.get(Opcode.SCHEMA, [])), tuple(channels))


def _summary_records(file: int, position: int, end: int) -> dict[int, list[bytes]]:
    """
    Return the contents of the used records of a summary by opcode.

    :raises ValueError: if these records do not fill the space from a position to an end.
    """
    found: dict[int, list[bytes]] = {}
    size, read = 0, _Ahead(file).read
    while position < end:
        head = read(position, records.RECORD.size)
        if len(head) < records.RECORD.size:
            raise ValueError(_SHORTER)
        opcode, length = records.RECORD.unpack(head)
        start, position = position + len(head), position + len(head) + length
        if position > end or (opcode not in _SUMMARY and opcode < _PRIVATE):
            raise ValueError('there is no summary where it should be')
        if opcode in _USED:
            size += length
            if size > MAX_CHUNK:
                raise ValueError('the summary is too large')
            found.setdefault(opcode, []).append(read(start, length))
    return found


def _crc(stream: BinaryIO, start: int, end: int, rest: bytes) -> int:
    """Return the CRC of a part of a file and the rest."""
    crc = 0
    stream.seek(start)
    while start < end:
        piece = stream.read(min(end - start, _CRC_PIECE))
        if not piece:
            raise ValueError(_SHORTER)
        crc, start = crc32(piece, crc), start + len(piece)
    return crc32(rest, crc)

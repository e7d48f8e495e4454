# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Where the data of an MCAP file lies, and whether it is sound.

Theory of operation: a file is a row of records. `scan` walks along their headers and gives out
blocks: each a chunk, or a run of plain messages and definitions of a file without chunks. `load`
brings in one block's records and proves them against its sizes and its CRC. The first thing that
is not sound ends both with `Damage`; nothing after it is used, because nothing after it can be
trusted to be what it seems.

1. No length is believed before it is compared with what is there; no memory is taken for a length.
2. The lengths inside a chunk or a message index must add up to the length of its record, or the
   record's length might lead past the next chunk.
3. Message indexes follow their chunk. Where one follows anything else, the record before it was a
   chunk whose opcode has changed.
4. Messages stand in chunks or outside them, not both in one file: a plain message after a chunk is
   a record whose opcode has changed.
5. The CRC of a chunk may be 0, which says that there is none (MCAP specification); plain messages
   never have one.
6. A chunk that is the same as one before it is left out and noted. Only the first chunk may have a
   copy right behind it (`trace_file`, rule 5), which stands in for it where it is not sound.
7. The footer says where the summary begins. Where it begins elsewhere, right behind the data,
   something was cut out or put in: then the summary's list of chunks says where.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
import struct
from typing import BinaryIO
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Statistics
from mddag_executor.trace import records
from mddag_executor.trace.errors import TraceError
import zstandard

MAX_CHUNK = 256 * 1024 * 1024       # before compression; larger ones are taken for damage
_NEVER = 2**64 - 1                  # start time of a block without messages
_PLAIN_BLOCK = 256 * 1024
_CHUNK_OVERHEAD = 1024              # more than a chunk's head and its framing can take
_FOOTER_SIZE = records.RECORD.size + records.FOOTER_CONTENT.size + len(records.MAGIC)
_WRONG_SIZE = 'a chunk does not have the size that its head says'
_REMEDY = 'give a trace written by this program or another MCAP recording'


class Damage(Exception):
    """What is wrong with a file's data, and at which byte; inside this package only."""

    def __init__(self, what: str, offset: int) -> None:
        """Keep both."""
        super().__init__(what)
        self.what = what
        self.offset = offset


class Content(ReadDataStream):
    """
    The content of a record, for mcap's readers.

    Whatever is asked for beyond the end raises ValueError, so no length in a file is trusted.
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


@dataclass(frozen=True)
class Block:
    """Some of a file's records, not yet read."""

    offset: int         # of its first byte in the file
    end: int            # of the first byte after it
    start_time: int     # least log_time of its messages, as far as the file says
    chunk: bool         # whether it is a chunk; else plain records
    compression: str
    data_offset: int    # of its (compressed) records in the file
    data_length: int
    size: int           # of its records, uncompressed
    crc: int            # of these; 0 where there is none
    copy: Block | None = None   # that stands in for it

    @property
    def copies(self) -> int:
        """Return how often its messages are in the file, as its summary counts them."""
        return 1 if self.copy is None else 2


@dataclass(frozen=True)
class Summary:
    """What a file's summary section says that there is."""

    messages: int
    chunks: int
    topics: frozenset[str]
    index: tuple[tuple[int, int], ...] | None
    """Start time and length of each chunk; None where nothing was cut out or put in."""


def open_data(stream: BinaryIO, path: str) -> tuple[int, str]:
    """Check a file's beginning and return where its data section starts, and what wrote it."""
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
        # A wrong length might lead past the first chunk.
        if opcode == Opcode.HEADER and content.count == length:
            return len(magic) + len(head) + int(length), library
    raise TraceError(path, 'ends or is damaged before its first event', _REMEDY)


def usable(
    stream: BinaryIO, start: int, size: int, summary: Summary | None, twice: list[int]
) -> Iterator[Block]:
    """
    Yield the blocks of the data section that count, in the order of the file (rules 6 and 7).

    :param twice: gets the offsets of chunks that are left out
    :raises Damage: as ``scan`` does, and where chunks are missing
    """
    index = list(summary.index) if summary and summary.index is not None else None
    if index and index[0] in index[1:2]:
        del index[1]                # the first one's copy
    seen: set[int] = set()
    first: Block | None = None      # held back until it is known whether it has a copy
    place = 0                       # in the index
    damage: Damage | None = None
    position = start
    try:
        for number, block in enumerate(scan(stream, start, size)):
            position = block.end
            same = hash((block.start_time, block.size, block.crc, block.data_length))
            again = block.chunk and block.crc != 0 and same in seen
            if index is not None and block.chunk:
                about = block.start_time, block.end - block.offset
                if about in index[place:place + 1]:
                    place += 1
                elif not again:
                    raise _missing(index[place:], about, block.offset)
            if again and number == 1 and first is not None:
                first = replace(first, copy=block)
            elif again:
                twice.append(block.offset)
            elif number == 0:
                first = block
            else:
                if first is not None:
                    yield first
                    first = None
                yield block
            seen.add(same)
        if index is not None and place < len(index):
            raise _missing(index[place:], None, position)
    except Damage as error:
        damage = error
    if first is not None:
        yield first
    if damage is not None:
        raise damage


def has_copy(stream: BinaryIO, start: int, size: int) -> bool:
    """Return whether the first chunk, which holds one message then, has a copy (rule 6)."""
    try:
        first = next(usable(stream, start, size, None, []), None)
    except Damage:
        return False
    return first is not None and first.copy is not None


def _missing(index: list[tuple[int, int]], found: tuple[int, int] | None, offset: int) -> Damage:
    """Return that chunks of the index are missing before the one that was found."""
    count = index.index(found) if found in index else len(index)
    return Damage(
        f'{count} chunk{" is" if count == 1 else "s are"} missing' if count else
        'a chunk was put in', offset)


def what_was_used(path: str, damage: Damage, found: str, size: int) -> str:
    """Return the line that says what damage left of a file; ``found`` is what was used."""
    if damage.offset >= size:
        return f'{path}: {damage.what}: used all of it, {found}'
    return (f'{path}: {damage.what} (at byte {damage.offset}): used {found} before it, not the '
            f'{size - damage.offset} bytes from there on')


def used_once(path: str, twice: list[int]) -> str:
    """Return the line about chunks that were left out as they are in a file twice."""
    return (f'{path}: chunks that are there twice were used once: {len(twice)}, the first at byte '
            f'{twice[0]}')


def scan(stream: BinaryIO, start: int, size: int) -> Iterator[Block]:
    """
    Yield the blocks of the data section, in the order of the file.

    :raises Damage: where a record is not sound or the data section does not end as it should
    """
    position = start
    previous = 0            # opcode of the record before, 0 for any that does not matter
    chunks_seen = False
    while True:
        stream.seek(position)
        head = stream.read(records.RECORD.size)
        if len(head) < records.RECORD.size:
            raise Damage('the file ends without a finish record', position)
        opcode, length = records.RECORD.unpack(head)
        end = position + len(head) + length
        if end > size:
            raise Damage('a record is cut off, or its length is wrong', position)

        if opcode == Opcode.CHUNK:
            yield _chunk(stream, position, end)
            chunks_seen = True
        elif opcode == Opcode.MESSAGE_INDEX:
            if previous not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
                raise Damage('a message index belongs to no chunk', position)
            content = stream.read(min(length, 6))
            if len(content) < 6 or length != 6 + records.UINT32.unpack_from(content, 2)[0]:
                raise Damage('the lengths in a message index are wrong', position)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            if chunks_seen and opcode == Opcode.MESSAGE:
                raise Damage('a message stands outside of the chunks', position)
            block = _plain(stream, position, size, messages=not chunks_seen)
            yield block
            end = block.end
        elif opcode == Opcode.DATA_END:
            if length != 4:
                raise Damage('the finish record is damaged', position)
            return
        elif opcode in (0, Opcode.HEADER, Opcode.FOOTER):    # 0: a tail of zeros, no opcode
            raise Damage('a record is where it cannot be', position)
        previous = opcode
        position = end


def _chunk(stream: BinaryIO, position: int, end: int) -> Block:
    """Return the chunk whose record starts at a position, from its head alone."""
    head = stream.read(min(end - stream.tell(), _CHUNK_OVERHEAD))
    content = Content(head)
    try:
        start_time, _, size, crc = records.CHUNK_HEAD.unpack(content.read(records.CHUNK_HEAD.size))
        compression, length = content.read_prefixed_string(), content.read8()
    except ValueError:
        raise Damage('the head of a chunk is damaged', position) from None
    data_offset = position + records.RECORD.size + content.count
    if data_offset + length != end or size > MAX_CHUNK or length > MAX_CHUNK + _CHUNK_OVERHEAD:
        raise Damage('the lengths in the head of a chunk are wrong', position)
    return Block(position, end, start_time, True, compression, data_offset, length, size, crc)


def _plain(stream: BinaryIO, position: int, size: int, messages: bool) -> Block:
    """Return the run of plain records from a position on, at least one."""
    allowed = [Opcode.SCHEMA, Opcode.CHANNEL] + [Opcode.MESSAGE] * messages
    times = []
    end = position
    while True:
        stream.seek(end)
        head = stream.read(records.RECORD.size + records.MESSAGE_HEAD.size)
        if len(head) < records.RECORD.size:
            break       # what is wrong here is for the scan to say
        opcode, length = records.RECORD.unpack_from(head)
        after = end + records.RECORD.size + length
        if opcode not in allowed or after > size:
            break
        if end > position and after - position > _PLAIN_BLOCK:
            break
        if after - position > MAX_CHUNK:
            raise Damage('a record is too large', position)
        if opcode == Opcode.MESSAGE and length >= records.MESSAGE_HEAD.size:
            times.append(records.MESSAGE_HEAD.unpack_from(head, records.RECORD.size)[2])
        end = after
    length = end - position
    return Block(position, end, min(times, default=_NEVER), False, '', position, length, length, 0)


def load(stream: BinaryIO, block: Block) -> bytes:
    """
    Return the records of a block.

    :raises Damage: where they are not what the block's head says
    """
    stream.seek(block.data_offset)
    data = stream.read(block.data_length)
    if len(data) < block.data_length:
        raise Damage('the file has become shorter', block.offset)
    try:
        data = _decompress(data, block.compression, block.size)
    except (zstandard.ZstdError, RuntimeError, MemoryError):
        raise Damage('a chunk cannot be decompressed', block.offset) from None
    except ValueError as error:
        raise Damage(str(error), block.offset) from None
    if len(data) != block.size:
        raise Damage(_WRONG_SIZE, block.offset)
    if block.crc and zlib.crc32(data) != block.crc:
        raise Damage('the CRC of a chunk is wrong', block.offset)
    return data


def _decompress(data: bytes, compression: str, size: int) -> bytes:
    """Return at most a little more than `size` bytes, whatever the data claims to hold."""
    if compression == '' or (size == 0 and not data):
        return data
    if compression == 'zstd':
        claimed = zstandard.frame_content_size(data)
        if claimed not in (size, -1):
            raise ValueError(_WRONG_SIZE)       # before memory is taken for it
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))
    if compression == 'lz4':
        result: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        return result
    raise ValueError(f'the compression of a chunk, {compression[:20]!r}, is unknown')


def read_summary(stream: BinaryIO, size: int, data: int) -> tuple[bool, Summary | None]:
    """
    Return whether the file ends as a finished one, and its summary if it has one.

    A summary whose CRC is wrong makes the file one that does not end as it should.

    :param data: where the data section starts
    """
    if size < _FOOTER_SIZE:
        return False, None
    footer_start = size - _FOOTER_SIZE
    stream.seek(footer_start)
    footer = stream.read(_FOOTER_SIZE)
    content = footer[records.RECORD.size:-len(records.MAGIC)]
    expected = records.RECORD.pack(Opcode.FOOTER, records.FOOTER_CONTENT.size)
    if not (footer.endswith(records.MAGIC) and footer.startswith(expected)):
        return False, None
    start, _, crc = records.FOOTER_CONTENT.unpack(content)
    if start == 0:
        return True, None
    end = size - len(records.MAGIC) - 4
    moved = False
    if crc and (start > footer_start or crc != _crc(stream, start, end)):
        start, moved = _data_end(stream, data, size), True      # rule 7
    if start > footer_start or (crc and moved and crc != _crc(stream, start, end)):
        return False, None
    try:
        return True, _parse_summary(stream, start, footer_start, moved)
    except (ValueError, struct.error):
        return False, None


def _data_end(stream: BinaryIO, start: int, size: int) -> int:
    """Return where the data section ends; the file's size where that is not sound."""
    end = start
    try:
        for block in scan(stream, start, size):
            end = block.end
        while end < size:
            stream.seek(end)
            opcode, length = records.RECORD.unpack(stream.read(records.RECORD.size))
            end += records.RECORD.size + length
            if opcode == Opcode.DATA_END:
                return int(end)
    except (Damage, struct.error):
        pass
    return size


def _crc(stream: BinaryIO, start: int, end: int) -> int:
    crc = 0
    stream.seek(start)
    while start < end:
        data = stream.read(min(end - start, 1 << 20))
        if not data:
            break
        crc = zlib.crc32(data, crc)
        start += len(data)
    return crc


def _parse_summary(stream: BinaryIO, start: int, end: int, moved: bool) -> Summary | None:
    messages = chunks = None
    topics = set()
    index: list[tuple[int, int, int]] = []
    while start < end:
        stream.seek(start)
        opcode, length = records.RECORD.unpack(stream.read(records.RECORD.size))
        content = Content(stream.read(min(length, 1 << 20)))
        if opcode == Opcode.CHUNK_INDEX and moved:
            chunk = ChunkIndex.read(content)
            index.append((chunk.chunk_start_offset, chunk.message_start_time, chunk.chunk_length))
        elif opcode == Opcode.STATISTICS:
            found = Statistics.read(content)
            messages, chunks = found.message_count, found.chunk_count
        elif opcode == Opcode.CHANNEL:
            topics.add(Channel.read(content).topic)
        start += records.RECORD.size + length
    if start != end:
        raise ValueError('the summary does not end at the footer')
    if messages is None or chunks is None:
        return None
    return Summary(messages, chunks, frozenset(topics),
                   tuple(each[1:] for each in sorted(index)) if moved else None)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Building blocks of an MCAP file, beside those of the package mcap.

mcap writes all records but messages and their indexes, which are many. What is read may be
damaged: its readers here believe no length.

Source: the MCAP format specification (https://mcap.dev/spec). A file is the magic, a header
record, the data section (ended by a data-end record), the summary section, a footer and the magic
again. A record is its opcode (1 byte), the length of its content (8 bytes) and the content. All
numbers are little endian, a string is its length in bytes (4 bytes) and UTF-8.
"""

from __future__ import annotations

import struct

MAGIC = b'\x89MCAP0\r\n'
LIBRARY = 'mddag_executor'
"""Stands in the header of files that this program wrote."""

RECORD = struct.Struct('<BQ')               # opcode, length of the content
MESSAGE_HEAD = struct.Struct('<HIQQ')       # channel, sequence, log_time, publish_time
CHUNK_HEAD = struct.Struct('<QQQI')         # start, end, size, CRC; compression and records follow
CHUNK_INDEX_HEAD = struct.Struct('<QQQQ')   # start, end, offset, length; more follows
FOOTER_CONTENT = struct.Struct('<QQI')      # summary start, summary offset start, summary CRC
# messages, schemas, channels, attachments, metadata, chunks, start, end; per channel counts follow
STATISTICS_HEAD = struct.Struct('<QHIIIIQQ')

UINT32 = struct.Struct('<I')


def record(opcode: int, content: bytes) -> bytes:
    """Return a whole record."""
    return RECORD.pack(opcode, len(content)) + content


class Cursor:
    """
    Reads the parts of a record's content one after the other.

    Whatever is asked for beyond the end raises ValueError, so no length in a file is trusted.
    """

    def __init__(self, data: bytes) -> None:
        """Start at the first byte."""
        self._data = data
        self._position = 0

    def take(self, count: int) -> bytes:
        """Return the next bytes."""
        end = self._position + count
        if end > len(self._data):
            raise ValueError('a record is shorter than what it should hold')
        part = self._data[self._position:end]
        self._position = end
        return part

    def uint16(self) -> int:
        """Return the next two bytes as a number."""
        return int.from_bytes(self.take(2), 'little')

    def uint32(self) -> int:
        """Return the next four bytes as a number."""
        return int.from_bytes(self.take(4), 'little')

    def uint64(self) -> int:
        """Return the next eight bytes as a number."""
        return int.from_bytes(self.take(8), 'little')

    def block(self) -> bytes:
        """Return the next bytes, whose length stands in front of them."""
        return self.take(self.uint32())

    def string(self) -> str:
        """Return the next string; raise ValueError (UnicodeDecodeError) where it is no UTF-8."""
        return self.block().decode()

    @property
    def position(self) -> int:
        """Return how many bytes have been read."""
        return self._position

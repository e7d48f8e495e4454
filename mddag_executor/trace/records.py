# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Parts of the MCAP format in addition to the package mcap.

The package mcap writes all records except messages and their indexes, which are many. Records are
read here: loading mcap's classes takes as long as reading a short trace. Read data may be damaged:
every length is checked (``Content``).

Source: the MCAP format specification (https://mcap.dev/spec). A file is the magic, a header
record, the data section (ended by a data-end record), the summary section, a footer and the magic
again. A record is its opcode (1 byte), the length of its content (8 bytes) and the content. All
numbers are little endian, a string is its length in bytes (4 bytes) and UTF-8.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

MAGIC = b'\x89MCAP0\r\n'
LIBRARY = 'mddag_executor'
"""Library in the header of files that this program wrote."""

RECORD = struct.Struct('<BQ')               # opcode, length of the content
MESSAGE_HEAD = struct.Struct('<HIQQ')       # channel, sequence, log_time, publish_time
FOOTER_CONTENT = struct.Struct('<QQI')      # summary start, summary offset start, summary CRC
UINT32 = struct.Struct('<I')
_STATISTICS = struct.Struct('<QHIIII')      # messages, schemas, channels, …, chunks at the end


def record(opcode: int, content: bytes) -> bytes:
    """Return a whole record."""
    return RECORD.pack(opcode, len(content)) + content


class Content:
    """
    The content of a record, which is read from its begin to its end.

    Reading past the end raises ValueError, so wrong lengths are harmless.

    :ivar at: how many bytes were read.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self.at = data, 0

    def read(self, length: int) -> bytes:
        """Return the next bytes."""
        begin, self.at = self.at, self.at + length
        if self.at > len(self._data):
            raise ValueError('a record is shorter than what it should hold')
        return self._data[begin:self.at]

    def number(self, size: int) -> int:
        """Return the next number, which has some bytes."""
        return int.from_bytes(self.read(size), 'little')

    def text(self) -> str:
        """Return the next text."""
        return self.read(self.number(4)).decode()


class Schema(NamedTuple):
    """A schema: type of message, and its definition."""

    name: str
    encoding: str
    data: bytes

    @classmethod
    def read(cls, content: Content) -> Schema:
        """Read a schema behind its number, or raise ValueError."""
        name, encoding = content.text(), content.text()
        return cls(name, encoding, content.read(content.number(4)))


class Channel(NamedTuple):
    """A channel; its metadata (such as QoS) is left out: no message is read differently by it."""

    schema: int
    topic: str
    encoding: str

    @classmethod
    def read(cls, content: Content) -> Channel:
        """Read a channel behind its number, or raise ValueError."""
        found = cls(content.number(2), content.text(), content.text())
        end = content.number(4)
        end += content.at
        while content.at < end:
            content.text(), content.text()
        return found


def library_of(content: Content) -> str:
    """Return the library in a header record, or raise ValueError."""
    content.text()      # the profile
    return content.text()


def counts_of(content: Content) -> tuple[int, int, int]:
    """Return the messages, channels and chunks in a statistics record, or raise ValueError."""
    messages, _, channels, *_, chunks = _STATISTICS.unpack(content.read(_STATISTICS.size))
    return messages, channels, chunks

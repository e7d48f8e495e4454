# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Parts of the MCAP format in addition to the package mcap.

mcap reads and writes all records except messages and their indexes, which are many. Read data may
be damaged: every length is checked (``blocks.Content``).

Source: the MCAP format specification (https://mcap.dev/spec). A file is the magic, a header
record, the data section (ended by a data-end record), the summary section, a footer and the magic
again. A record is its opcode (1 byte), the length of its content (8 bytes) and the content. All
numbers are little endian, a string is its length in bytes (4 bytes) and UTF-8.
"""

from __future__ import annotations

import struct

MAGIC = b'\x89MCAP0\r\n'
LIBRARY = 'mddag_executor'
"""Library in the header of files that this program wrote."""

RECORD = struct.Struct('<BQ')               # opcode, length of the content
MESSAGE_HEAD = struct.Struct('<HIQQ')       # channel, sequence, log_time, publish_time
FOOTER_CONTENT = struct.Struct('<QQI')      # summary start, summary offset start, summary CRC
UINT32 = struct.Struct('<I')


def record(opcode: int, content: bytes) -> bytes:
    """Return a whole record."""
    return RECORD.pack(opcode, len(content)) + content

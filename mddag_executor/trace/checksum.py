# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The CRC-32 of MCAP files.

ISA-L's uses the processor's carry-less multiplication, and is four times as fast as zlib's, which
takes a tenth of the time for reading a recording.  It is not available for all processors.
"""

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ['crc32']

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Protobuf's encoding of many messages of one kind at a time.

A function returns ``Bytes``, a row for each message. A field that all messages have alike has one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mddag_executor.recording.columns import Ints, Mask
import numpy as np
import numpy.typing as npt


class Bytes(NamedTuple):
    """Rows of bytes: those of ``data`` (rows by columns) for which ``used`` is set."""

    data: npt.NDArray[np.uint8]
    used: Mask

    def packed(self) -> bytes:
        """Return the bytes of all rows, one row after the other."""
        return self.data[self.used].tobytes()


def joined(parts: Sequence[Bytes]) -> Bytes:
    """Return rows that consist of the given parts."""
    rows = max((len(part.data) for part in parts), default=1)
    data, used = (
        np.concatenate([np.broadcast_to(each, (rows, each.shape[1])) for each in side], axis=1)
        if side else np.empty((1, 0), dtype=kind)
        for side, kind in zip(zip(*parts) if parts else ((), ()), (np.uint8, np.bool_)))
    return Bytes(data, used)


def where(condition: Mask, *parts: Bytes) -> Bytes:
    """Return the parts in the rows that meet a condition, and nothing in the others."""
    data, used = joined(parts)
    used = used & condition[:, np.newaxis]
    return Bytes(np.broadcast_to(data, used.shape), used)


def varint(values: Any) -> Bytes:
    """Return integers; negative ones have ten bytes."""
    numbers = np.atleast_1d(np.asarray(values, dtype=np.int64)).view(np.uint64)
    width = max(1, -(-int(numbers.max(initial=0)).bit_length() // 7))
    groups = numbers[:, np.newaxis] >> np.arange(0, 7 * width, 7, dtype=np.uint64)
    used = groups > 0
    used[:, 0] = True
    data = (groups & np.uint64(0x7F)).astype(np.uint8)
    data[:, :-1] |= used[:, 1:].view(np.uint8) << 7     # more follow
    return Bytes(data, used)


def number(field: int, values: Any) -> Bytes:
    """Return a field with integers."""
    return joined([varint(field << 3), varint(values)])


def fixed(field: int, values: Ints) -> Bytes:
    """Return a field with integers of eight bytes."""
    data = values.astype('<i8').view(np.uint8).reshape(len(values), 8)
    return joined([varint(field << 3 | 1), Bytes(data, np.ones(data.shape, dtype=np.bool_))])


def texts(field: int, different: Sequence[str], which: Any = 0) -> Bytes:
    """Return a field with texts: by row the index of its text."""
    encoded = [each.encode('utf-8', 'backslashreplace') for each in different]
    width = max(map(len, encoded))
    table = np.frombuffer(b''.join(each.ljust(width) for each in encoded), dtype=np.uint8)
    which = np.atleast_1d(which)
    data = table.reshape(len(encoded), width)[which]
    lengths = np.array(list(map(len, encoded)))[which]
    return message(field, Bytes(data, np.arange(width) < lengths[:, np.newaxis]))


def message(field: int, *parts: Bytes) -> Bytes:
    """Return a field with a message that consists of the given parts."""
    content = joined(parts)
    return joined([varint(field << 3 | 2), varint(content.used.sum(axis=1)), content])

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Memory that compiled code works on: what it is lent, and what it leaves (see ``vectors``).

A structure has three words for each field, those of a vector (address, length, capacity), or an
integer in the first of them.
"""

from __future__ import annotations

from copy import copy
import ctypes
from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class LentTuple:
    """A named tuple of integers and lists, as a structure in numpy's memory."""

    def __init__(self, row: NamedTuple, *more: int) -> None:
        self._columns: list[npt.NDArray[np.int64]] = []  # keeps the memory
        words = []
        for value in (*row, *more):
            if isinstance(value, int):
                words += [value, 0, 0]
                continue
            column = np.ascontiguousarray(value, dtype=np.int64)
            self._columns.append(column)
            words += [column.ctypes.data, len(column), len(column)]
        self._words = np.array(words, dtype=np.int64)

    @property
    def address(self) -> int:
        """Return where the structure is, as long as this object lives."""
        return int(self._words.ctypes.data)

    def copy(self) -> LentTuple:
        """Return a structure of its own over the same columns."""
        copied = copy(self)
        copied._words = self._words.copy()
        return copied


class EmptyMemory:
    """Memory for a structure or a vector that is all empty."""

    def __init__(self, fields: int = 1) -> None:
        self._words = np.zeros(3 * fields, dtype=np.int64)

    @property
    def address(self) -> int:
        """Return where it is, as long as this object lives."""
        return int(self._words.ctypes.data)

    def rows(self, field: int, width: int) -> list[tuple[int, ...]]:
        """Return a copy of a field, which is a vector of tuples."""
        address, length = self._words[3 * field:3 * field + 2].tolist()
        if length == 0:
            return []
        data = (ctypes.c_int64 * (length * width)).from_address(address)
        return list(zip(*np.ctypeslib.as_array(data).reshape(length, width).T.tolist()))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Memory that compiled code works on: what it is lent, and what it leaves (see ``vectors``).

A structure has three words for each field, those of a vector (address, length, capacity), or an
integer in the first of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
import ctypes
from typing import Any, NamedTuple

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

    def words(self, field: int, width: int) -> npt.NDArray[np.int64]:
        """Return a copy of a field, which is a vector of elements with so many words."""
        address, length = self._words[3 * field:3 * field + 2].tolist()
        if length == 0:
            return np.empty((0, width), dtype=np.int64)
        data = (ctypes.c_int64 * (length * width)).from_address(address)
        return np.ctypeslib.as_array(data).reshape(length, width).copy()

    def rows(self, field: int, width: int) -> Rows:
        """Return the same as tuples."""
        return Rows(self.words(field, width))


class Rows(Sequence[tuple[int, ...]]):
    """Tuples of integers that are made when they are asked for: as numbers they take a sixth."""

    _SOME = 8192

    def __init__(self, words: npt.NDArray[np.int64]) -> None:
        self._words = words

    def __len__(self) -> int:
        return len(self._words)

    def __getitem__(self, place: Any) -> Any:
        found = self._words[place].tolist()
        return list(map(tuple, found)) if isinstance(place, slice) else tuple(found)

    def __iter__(self) -> Iterator[tuple[int, ...]]:
        for first in range(0, len(self), self._SOME):
            yield from self[first:first + self._SOME]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Hash tables of numbers for compiled code.

A table is an array of rows: four numbers that are the key, whether the row is used, values.  Its
length is a power of two, and never more than about half of it is used: whoever adds rows looks at
``insert``'s answer and lets ``grown`` make a larger one.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.replay.fast_types import columns_of

HASH_USED = 4
HASH_VALUES = 5
HASH_MIX = 0x9E3779B97F4A7C1


def hash_place(table: Any, a: int, b: int, c: int, d: int) -> int:
    """Return the row at which to begin to look for a key."""
    mixed = a * 31 + b
    mixed = mixed * HASH_MIX + c
    mixed ^= mixed >> 29
    mixed = mixed * HASH_MIX + d
    mixed ^= mixed >> 32
    mixed *= HASH_MIX
    mixed ^= mixed >> 29
    return mixed & (len(table) - 1)


def find(table: Any, a: int, b: int, c: int, d: int) -> int:
    """Return the row of a key, or -1."""
    i = hash_place(table, a, b, c, d)
    while table[i, HASH_USED] != 0:
        if table[i, 0] == a and table[i, 1] == b and table[i, 2] == c and table[i, 3] == d:
            return i
        i = (i + 1) & (len(table) - 1)
    return -1


def insert(table: Any, a: int, b: int, c: int, d: int) -> int:
    """Return the row of a key that is not in the table; its values are 0."""
    i = hash_place(table, a, b, c, d)
    while table[i, HASH_USED] != 0:
        i = (i + 1) & (len(table) - 1)
    for column in range(columns_of(table)):
        table[i, column] = 0
    table[i, 0] = a
    table[i, 1] = b
    table[i, 2] = c
    table[i, 3] = d
    table[i, HASH_USED] = 1
    return i


def remove(table: Any, i: int) -> None:
    """Take a row out; others may move."""
    mask = len(table) - 1
    j = i
    while True:
        j = (j + 1) & mask
        if table[j, HASH_USED] == 0:
            break
        home = hash_place(table, table[j, 0], table[j, 1], table[j, 2], table[j, 3])
        stays = i < home <= j if i <= j else i < home or home <= j
        if not stays:
            for column in range(columns_of(table)):
                table[i, column] = table[j, column]
            i = j
    table[i, HASH_USED] = 0


def rehash(table: Any, larger: Any) -> None:
    """Copy all rows to a larger table, which is empty."""
    for row in range(len(table)):
        if table[row, HASH_USED] != 0:
            i = insert(larger, table[row, 0], table[row, 1], table[row, 2], table[row, 3])
            for column in range(HASH_VALUES, columns_of(table)):
                larger[i, column] = table[row, column]

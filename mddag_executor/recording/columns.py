# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Tables: named columns of one length.

A table has one array for each column, not one record for each row.  An analysis mostly needs few
columns of many rows: masks, sums, sorting and gathering are then 5 to 30 times as fast.

``table['name']`` is a column, ``table[['a', 'b']]`` a table of some columns, ``table[rows]`` one
of the chosen rows (a mask, indices or a slice), and ``table[5]`` a row, with its values by name.
Assigning to a column changes its values, not its type.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, overload

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Places = npt.NDArray[np.int32]

_PART = 1 << 16
"""Rows of a part of a table."""
_MOST_GROWTH = 128
"""How much longer a growing table becomes at most: a file may begin with most of its rows."""


class Table:
    """
    Named columns of one length.

    :param columns: the columns by name; they are not copied.
    """

    __slots__ = ('_columns',)
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        self._columns = dict(columns)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self._columns)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Return the names and types of the columns."""
        return np.dtype([(name, column.dtype) for name, column in self._columns.items()])

    def __len__(self) -> int:
        for column in self._columns.values():
            return len(column)
        return 0

    @overload
    def __getitem__(self, which: str) -> npt.NDArray[Any]: ...

    @overload
    def __getitem__(self, which: int | np.integer[Any]) -> np.void: ...

    @overload
    def __getitem__(self, which: slice | list[str] | npt.NDArray[Any]) -> Table: ...

    def __getitem__(self, which: Any) -> Any:
        """Return a column, a row, or a table of some columns or rows."""
        if isinstance(which, str):
            return self._columns[which]
        if isinstance(which, slice):
            return Table({name: column[which] for name, column in self._columns.items()})
        if isinstance(which, list) and which and isinstance(which[0], str):
            return Table({name: self._columns[name] for name in which})
        rows = np.asarray(which)
        if rows.ndim == 0:
            at = int(rows) + (len(self) if rows < 0 else 0)
            return self[at:at + 1].records()[0]
        if rows.dtype == np.bool_:
            if len(rows) != len(self):
                raise IndexError(f'a mask of {len(rows)} rows for a table of {len(self)}')
            rows = np.flatnonzero(rows)
        elif not len(rows):
            rows = rows.astype(np.int64)
        return Table({name: column.take(rows) for name, column in self._columns.items()})

    def __setitem__(self, name: str, values: Any) -> None:
        """Change the values of a column."""
        self._columns[name][...] = values

    def __iter__(self) -> Iterator[np.void]:
        """Iterate over the rows."""
        return iter(self.records())

    def __eq__(self, other: object) -> Any:
        """Return by row whether all its values are equal to those of another table."""
        if not isinstance(other, Table) or self.names != other.names or len(self) != len(other):
            return NotImplemented
        equal = np.ones(len(self), dtype=np.bool_)
        for name, column in self._columns.items():
            equal &= column == other[name]
        return equal

    def __repr__(self) -> str:
        return f'<Table of {len(self)} rows: {", ".join(self._columns)}>'

    def columns(self, *names: str) -> Iterator[npt.NDArray[Any]]:
        """Yield some columns."""
        for name in names:
            yield self._columns[name]

    def tolist(self) -> list[tuple[Any, ...]]:
        """Return the rows as tuples of Python values."""
        return list(zip(*(column.tolist() for column in self._columns.values())))

    def records(self) -> npt.NDArray[Any]:
        """Return the rows as a numpy structured array, a copy."""
        found = np.empty(len(self), dtype=self.dtype)
        for name, column in self._columns.items():
            found[name] = column
        return found

    def replace(self, name: str, column: npt.NDArray[Any]) -> None:
        """Replace a column by an equal one that takes less memory."""
        self._columns[name] = column

    def freeze(self) -> None:
        """Let no column be written any more."""
        for column in self._columns.values():
            column.flags.writeable = False

    def copy(self) -> Table:
        """Return a table with copies of the columns."""
        return Table({name: column.copy() for name, column in self._columns.items()})


def rows(kind: np.dtype[Any], length: int = 0, /, **columns: Any) -> Table:
    """Return a table of a type: copies of the given columns, 0 in the others."""
    if unknown := columns.keys() - set(kind.names or ()):
        raise ValueError(f'the table has no column {min(unknown)!r}')
    found = {}
    for name in kind.names or ():
        if name in columns:
            found[name] = np.empty(length, dtype=kind[name])
            found[name][...] = columns[name]
        else:
            found[name] = np.zeros(length, dtype=kind[name])
    return Table(found)


def concatenate(tables: Sequence[Table]) -> Table:
    """Return the rows of tables with the same columns, one table after the other."""
    first = tables[0]
    return Table({name: np.concatenate([table[name] for table in tables])
                  for name in first.names})


def in_parts(column: Any) -> Iterator[Any]:
    """Yield a table or column in parts, as views: temporary arrays of parts stay in the caches."""
    for begin in range(0, len(column), _PART):
        yield column[begin:begin + _PART]


class Growing:
    """
    A table that grows by many rows at a time.

    :param values: values of new rows, 0 in the other columns.
    """

    def __init__(self, kind: np.dtype[Any], **values: int) -> None:
        self._columns = {name: np.empty(0, dtype=kind[name]) for name in kind.names or ()}
        self._values = values
        self._count = self._capacity = 0
        self._share = 1.0

    def __len__(self) -> int:
        return self._count

    def more(self, n: int, **columns: Any) -> Table:
        """Add rows; return them as a view, which is valid until more are added."""
        before, self._count = self._count, self._count + n
        if self._count > self._capacity:
            self._grow(before)
        for name, values in {**self._values, **columns}.items():
            self._columns[name][before:self._count] = values
        return self.rows()[before:]

    def rows(self) -> Table:
        """Return all rows as a view, which is valid until more are added."""
        return Table(self._columns)[:self._count]

    def add(self, table: Table) -> None:
        """Add rows."""
        self.more(len(table), **{name: table[name] for name in table.names})

    def table(self) -> Table:
        """Return the table; no rows can be added afterwards."""
        return self.rows()

    def expect(self, share: float) -> None:
        """
        Expect more rows, so that rows are seldom copied.

        :param share: the share of all rows that are there after the next rows are added.
        """
        self._share = max(share, 1 / _MOST_GROWTH)

    def _grow(self, filled: int) -> None:
        """Make room, which takes no memory before something is written to it."""
        capacity = max(1024, 2 * self._count, int(1.1 * self._count / self._share))
        for name, column in self._columns.items():
            larger = np.zeros(capacity, dtype=column.dtype)
            column = column[:filled]
            if column.any():
                larger[:filled] = column
            self._columns[name] = larger
        self._capacity = capacity

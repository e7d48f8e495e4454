# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Batches of events of a trace, as columns of numbers or as tuples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Event = tuple[Any, ...]
Ints = npt.NDArray[np.int64]
FIELDS = 35
"""Bytes of a message's record before the fields of its content."""


class Fixed(NamedTuple):
    """
    How numpy decodes the messages of a channel with a fixed layout.

    :ivar head: the begin of an event's tuple.
    :ivar kind: the type of a row, from ``timestamp`` on.
    :ivar missing: fields that the file lacks, with their values.
    """

    head: Event
    kind: Any
    missing: dict[str, int]


class Column(NamedTuple):
    """
    The events of one channel in a batch.

    :ivar at: positions of their records in the data, ascending.
    :ivar size: bytes of each record; 0: they differ.
    """

    fixed: Fixed
    at: Ints
    size: int


class Table(NamedTuple):
    """
    The events of one kind.

    :ivar rows: a structured array with the event's fields, from ``timestamp`` on.
    :ivar places: positions of the rows in the order of the file over all batches, ascending.
    """

    head: Event
    rows: Any
    places: Ints


class Batch:
    """
    The events of some chunks; valid until the next batch is read.

    :param data: the records of the chunks.
    :param base: position of the first byte of the data in the order of the file.
    :param others: events that numpy cannot decode, with their positions in the data.
    """

    def __init__(
        self, data: bytearray, base: int, columns: Sequence[Column],
        others: Sequence[tuple[int, Event]],
    ) -> None:
        self.data, self.base = data, base
        self.columns, self._others = columns, others

    def __len__(self) -> int:
        return sum(len(column.at) for column in self.columns) + len(self._others)

    def table(self, column: Column) -> Table:
        """Return the events of one channel."""
        rows = rows_at(self.data, column.fixed.kind, column.at + FIELDS)
        return Table(column.fixed.head, with_fields(rows, column.fixed.missing),
                     column.at + self.base)

    def others(self) -> list[tuple[int, Event]]:
        """Return the other events with their positions."""
        return [(self.base + place, event) for place, event in self._others]

    def __iter__(self) -> Iterator[Event]:
        """Yield all events as tuples, in the order of the file."""
        found: list[Event] = []
        places = [np.array([place for place, _ in self._others], dtype=np.int64)]
        found += [event for _, event in self._others]
        for column in self.columns:
            head, rows, _ = self.table(column)
            found += [head + row for row in rows.tolist()]
            places.append(column.at)
        for number in np.argsort(np.concatenate(places), kind='stable').tolist():
            yield found[number]


def with_fields(rows: Any, missing: dict[str, int]) -> Any:
    """Return a structured array with additional fields, each with the same value in all rows."""
    if not missing:
        return rows
    kinds = [(name, rows.dtype[name]) for name in rows.dtype.names]
    wider = np.empty(len(rows), [*kinds, *((name, np.int64) for name in missing)])
    for name, _ in kinds:
        wider[name] = rows[name]
    for name, value in missing.items():
        wider[name] = value
    return wider


def rows_at(data: bytearray | memoryview, kind: Any, positions: Ints) -> Any:
    """Return the structures at positions in data; raise IndexError beyond its end."""
    room = len(data) - kind.itemsize + 1
    # as plain bytes: numpy copies structures field by field
    found = np.ndarray(max(room, 0), f'V{kind.itemsize}', data, strides=(1,))[positions]
    return found.view(kind)

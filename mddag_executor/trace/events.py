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


class Fixed(NamedTuple):
    """
    How numpy decodes the messages of a channel with a fixed layout.

    :ivar head: the begin of an event's tuple.
    :ivar kind: the type of a message, with the encapsulation before the fields.
    :ivar missing: fields that the file lacks, with their values.
    """

    head: Event
    kind: Any
    missing: dict[str, int]


class Table(NamedTuple):
    """
    The events of one channel.

    :ivar rows: a structured array with the event's fields, from ``timestamp`` on.
    :ivar places: positions of the rows in the order of the file over all batches, ascending.
    """

    head: Event
    rows: Any
    places: Ints


class Batch(NamedTuple):
    """
    The events of some chunks.

    :ivar tables: those that numpy can decode.
    :ivar others: the others, with their positions in the order of the file.
    :ivar share: the part of the file up to the end of the batch, 0 to 1.
    """

    tables: Sequence[Table]
    others: Sequence[tuple[int, Event]]
    share: float

    @property
    def n_events(self) -> int:
        """Return the number of events."""
        return sum(len(each.rows) for each in self.tables) + len(self.others)

    def tuples(self) -> Iterator[Event]:
        """Yield all events as tuples, in the order of the file."""
        found = [event for _, event in self.others]
        places = [np.array([place for place, _ in self.others], dtype=np.int64)]
        for head, rows, at in self.tables:
            found += [head + row for row in rows.tolist()]
            places.append(at)
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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Some of a trace's events at once, as columns of numbers, and as tuples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Event = tuple[Any, ...]
Ints = npt.NDArray[np.int64]
Fixed = tuple[Event, Any, dict[str, int]]
OTHER = 0xFFFF
"""Stands for the channel of events that no fixed layout decodes."""


class Table(NamedTuple):
    """
    The events of one kind.

    :ivar rows: a structured array with the event's fields, from ``timestamp`` on.
    :ivar places: of each row, its place among all events of the batch.
    """

    head: Event
    rows: Any
    places: Ints


class Events:
    """
    A batch of events in order.

    Messages of a fixed layout are decoded by numpy, all of a kind at once.

    :param data: in which messages begin at ``positions``.
    :param channels: of each event its channel, ``OTHER``: it is in ``others``, at its position.
    :param decoders: by channel the beginning of its tuples, the type of its rows, and what the
        fields are that these do not have.
    """

    def __init__(
        self, data: bytes, channels: npt.NDArray[np.uint16], positions: Ints,
        others: Sequence[Event], decoders: dict[int, Fixed],
    ) -> None:
        self._data = data
        self._channels = channels
        self._positions = positions
        self._others = others
        self._decoders = decoders

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._channels)

    def tables(self) -> Iterator[Table]:
        """Yield the events of fixed layouts, channel by channel."""
        order = np.argsort(self._channels, kind='stable')
        channels = self._channels[order]
        begins = np.r_[True, channels[1:] != channels[:-1]][:len(order)]
        starts = np.flatnonzero(begins).tolist()
        for start, end in zip(starts, [*starts[1:], len(order)]):
            number = int(channels[start])
            if number != OTHER:
                head, kind, missing = self._decoders[number]
                places = order[start:end]
                rows = rows_at(self._data, kind, self._positions[places])
                yield Table(head, _with_fields(rows, missing) if missing else rows, places)

    def others(self) -> list[tuple[int, Event]]:
        """Return the other events with their places."""
        places = np.flatnonzero(self._channels == OTHER)
        return [(place, self._others[number])
                for place, number in zip(places.tolist(), self._positions[places].tolist())]

    def __iter__(self) -> Iterator[Event]:
        """Yield them as tuples."""
        found: list[Any] = [None] * len(self)
        for head, rows, places in self.tables():
            for place, row in zip(places.tolist(), rows.tolist()):
                found[place] = head + row
        for place, event in self.others():
            found[place] = event
        return iter(found)


def _with_fields(rows: Any, missing: dict[str, int]) -> Any:
    """Return a structured array with more fields, the same in each row."""
    kinds = [(name, rows.dtype[name]) for name in rows.dtype.names]
    wider = np.empty(len(rows), [*kinds, *((name, np.int64) for name in missing)])
    for name, _ in kinds:
        wider[name] = rows[name]
    for name, value in missing.items():
        wider[name] = value
    return wider


def rows_at(data: bytes, kind: Any, positions: Ints) -> Any:
    """Return the structures of a type that stand in data at positions, which are checked."""
    room = len(data) - kind.itemsize + 1
    # as plain bytes: numpy copies structures field by field
    found = np.ndarray(max(room, 0), f'V{kind.itemsize}', data, strides=(1,))[positions]
    return found.view(kind)

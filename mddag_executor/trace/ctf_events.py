# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Events of CTF traces as columns, and what is missing in the traces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

from mddag_executor.text import counted
from mddag_executor.trace.ctf_layout import Field, fields_of
from mddag_executor.trace.ctf_types import Clock, NS, Struct
import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Array = npt.NDArray[Any]

NEVER = 2 ** 63 - 1


class Kind(NamedTuple):
    """A kind of event: its name and what it consists of."""

    name: str
    fields: tuple[Field, ...]


@lru_cache(65536)
def kind_of(name: str, payload: Struct | None) -> Kind:
    """Return a kind of event, which is the same object for all traces."""
    return Kind(name, fields_of(payload))


@dataclass
class Rows:
    """Events of a kind: columns by field, or a tuple for each event."""

    kind: Kind
    count: int
    columns: list[Array] | None
    tuples: list[tuple[Any, ...]]

    def picked(self, rows: Ints) -> Rows:
        """Return some of the events."""
        if self.columns is not None:
            return Rows(self.kind, len(rows), [column[rows] for column in self.columns], [])
        return Rows(self.kind, len(rows), None, [self.tuples[row] for row in rows.tolist()])


@dataclass
class Events:
    """
    Events of several kinds, as columns.

    :ivar place: in the order of their stream.
    :ivar rows: event by event its place in a table of ``tables``, whose number is ``table``.
    :ivar known: whether process and thread are recorded.
    :ivar raw: the bytes of each event's fields, if they are wanted.
    """

    time: Ints
    place: Ints
    vpid: Ints
    vtid: Ints
    procname: Array
    known: npt.NDArray[np.bool_]
    trace: Ints
    table: Ints
    row: Ints
    raw: Array
    tables: list[Rows] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.time)

    def picked(self, which: Array) -> Events:
        """Return some of the events, in the order given; tables have no others."""
        found = Events(**{name: getattr(self, name)[which] for name in _COLUMNS})
        row = found.row.copy()
        order = np.argsort(found.table, kind='stable')
        bounds = np.searchsorted(found.table[order], np.arange(len(self.tables) + 1))
        for number, rows in enumerate(self.tables):
            mine = order[bounds[number]:bounds[number + 1]]
            found.tables.append(rows.picked(found.row[mine]))
            row[mine] = np.arange(len(mine))
        found.row = row
        return found


_COLUMNS = ('time', 'place', 'vpid', 'vtid', 'procname', 'known', 'trace', 'table', 'row', 'raw')


def joined(parts: Sequence[Events]) -> Events:
    """Return the events of several parts; each kind has one table."""
    tables: dict[tuple[int, bool], list[Rows]] = {}
    numbers: dict[tuple[int, bool], int] = {}
    sizes: dict[tuple[int, bool], int] = {}
    table, row = [], []
    for part in parts:
        shifts, places = [], []
        for rows in part.tables:
            key = id(rows.kind), rows.columns is None
            places.append(numbers.setdefault(key, len(numbers)))
            shifts.append(sizes.get(key, 0))
            sizes[key] = shifts[-1] + rows.count
            tables.setdefault(key, []).append(rows)
        table.append(np.array(places, dtype=np.int64)[part.table])
        row.append(part.row + np.array(shifts, dtype=np.int64)[part.table])
    columns = {name: np.concatenate([getattr(part, name) for part in parts])
               for name in _COLUMNS if name not in ('table', 'row')}
    return Events(table=np.concatenate(table), row=np.concatenate(row),
                  tables=[_one_table(each) for each in tables.values()], **columns)


def _one_table(parts: Sequence[Rows]) -> Rows:
    first = parts[0]
    if len(parts) == 1:
        return first
    columns = None if first.columns is None else [
        np.concatenate(each) for each in zip(*(part.columns or () for part in parts))]
    return Rows(first.kind, sum(part.count for part in parts), columns,
                [values for part in parts for values in part.tuples])


def no_events() -> Events:
    """Return none."""
    none = np.zeros(0, dtype=np.int64)
    return Events(none, none, none, none, none.astype('S1'), none.astype('?'), none, none, none,
                  none.astype(object))


class Lost(NamedTuple):
    """
    Events that are missing.

    :ivar time: at the end of the gap; ``begin``: at its begin, 0: unknown.
    :ivar cause: why: ``schema.DISCARDED``, ``MISSING`` or ``DAMAGED``.
    :ivar number: of events, packets, or places of files.
    """

    time: int
    begin: int
    cause: int
    number: int = 1


class Damage(NamedTuple):
    """What is wrong in a file, where, and how many bytes are not used because of it."""

    file: str
    offset: int
    what: str
    lost: int


def described(damages: Sequence[Damage]) -> list[str]:
    """Return a line for each file that is damaged."""
    by_file: dict[str, list[Damage]] = {}
    for damage in damages:
        by_file.setdefault(damage.file, []).append(damage)
    lines = []
    for file, found in by_file.items():
        first, lost = min(found), sum(damage.lost for damage in found)
        more = f', and it is damaged at {counted(len(found) - 1, "more place")}' * (len(found) > 1)
        missing = f'{counted(lost, "byte")} are not used' if lost else 'what followed is missing'
        lines.append(f'{file}: {first.what} (at byte {first.offset}){more}: {missing}')
    return lines


def time_of(clock: Clock, ticks: int) -> int:
    """Return a time of a clock as ns of the epoch, in the range of times."""
    return min(max(ticks * NS // clock.frequency + clock.offset, 0), NEVER - 1)


def times_of(clock: Clock, ticks: npt.NDArray[np.uint64]) -> Ints:
    """Return times of a clock as ns of the epoch; -1: impossible."""
    low, high = (max(0, -(-(bound - clock.offset) * clock.frequency // NS))
                 for bound in (0, NEVER - NS))
    if high > 2 ** 64 - 1:
        high = 2 ** 64 - 1
    possible = (ticks >= np.uint64(min(low, 2 ** 64 - 1))) & (ticks <= np.uint64(high))
    frequency = np.uint64(clock.frequency)
    found = ticks.copy()
    if clock.frequency != NS:
        found = (ticks // frequency * np.uint64(NS)
                 + ticks % frequency * np.uint64(NS) // frequency)
    found += np.uint64(clock.offset % 2 ** 64)
    return np.where(possible, found.view(np.int64), -1)

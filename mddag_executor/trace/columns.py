# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes columns of events into a trace file.

The file is the same as if `TraceFile.extend` had written event by event, but messages of a known
size are encoded a kind at a time, and then put into the order of the events.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mddag_executor.trace import cdr, records
from mddag_executor.trace.trace_file import Channel, TraceFile
import numpy as np
import numpy.typing as npt

_Ints = npt.NDArray[np.int64]


class Columns(NamedTuple):
    """
    Events of one kind.

    :ivar event: its name for `TraceFile.extend`.
    :ivar order: the place of each event among those of all kinds.
    :ivar vpid: process, and ``vtid`` thread of each event.
    :ivar fields: a column for each field, or a tuple of values for each event.
    """

    event: str
    order: _Ints
    timestamp: _Ints
    vpid: _Ints
    vtid: _Ints
    fields: Sequence[npt.NDArray[Any]] | Sequence[tuple[Any, ...]]


class ColumnWriter:
    """Writes events of many kinds into a file."""

    def __init__(self, file: TraceFile) -> None:
        self._file = file
        self._types: dict[str, np.dtype[Any] | None] = {}

    def has_columns(self, event: str) -> bool:
        """Return whether the messages of a kind have a known size, so that columns are wanted."""
        if event not in self._types:
            places = cdr.fixed_places(self._file.channel(event).event.types)
            self._types[event] = None if places is None else np.dtype({
                'names': [*_HEAD, *(str(number) for number in range(len(places[0])))],
                'formats': [*_HEAD.values(), *(kind for kind, _ in places[0])],
                'offsets': [*_OFFSETS, *(_BODY + offset for _, offset in places[0])],
                'itemsize': _BODY + places[1]})
        return self._types[event] is not None

    def write(self, tables: Sequence[Columns]) -> None:
        """
        Write events in their order.

        :param tables: those of a kind are in one of them; the numbers of all events in the order
            are 0, 1, 2 and so on.
        :raises TraceError: if writing fails
        """
        count = sum(len(table.order) for table in tables)
        sizes = np.zeros(count, dtype=np.int64)
        times = np.zeros(count, dtype=np.int64)
        which = np.zeros(count, dtype=np.int64)
        encoded = [self._encoded(table) for table in tables]
        for number, (table, messages) in enumerate(zip(tables, encoded)):
            times[table.order], which[table.order] = table.timestamp, number
            sizes[table.order] = messages.dtype.itemsize if isinstance(
                messages, np.ndarray) else [len(message) for message in messages]
        ends = np.cumsum(sizes)
        data = np.zeros(int(ends[-1]) if count else 0, dtype=np.uint8)
        text = memoryview(data)
        for table, messages in zip(tables, encoded):
            begins = ends[table.order] - sizes[table.order]
            if isinstance(messages, np.ndarray):
                if len(messages):
                    size = messages.dtype.itemsize
                    windows = np.lib.stride_tricks.sliding_window_view(
                        data, size, writeable=True)
                    windows[begins] = messages.view(np.uint8).reshape(-1, size)
            else:
                for begin, message in zip(begins.tolist(), messages):
                    text[begin:begin + len(message)] = message
        channels = [self._file.channel(table.event) for table in tables]
        self._chunks(channels, which, times, ends, sizes, data)

    def _chunks(self, channels: Sequence[Channel], which: _Ints, times: _Ints, ends: _Ints,
                sizes: _Ints, data: npt.NDArray[np.uint8]) -> None:
        """Write messages in pieces that fit into chunks."""
        first = 0
        while first < len(ends):
            begin = int(ends[first] - sizes[first])
            room = self._file.room(channels, int(sizes[first]))
            last = max(first + 1, int(np.searchsorted(ends, begin + room, side='right')))
            part, messages = which[first:last], {}
            marks = np.column_stack((times[first:last], ends[first:last] - sizes[first:last]
                                     - begin))
            for number in np.unique(part).tolist():
                messages[channels[number]] = marks[part == number].reshape(-1).tolist()
            self._file.append(data[begin:int(ends[last - 1])].tobytes(), messages)
            first = last

    def _encoded(self, table: Columns) -> npt.NDArray[Any] | list[bytes]:
        """Return the messages of a kind, with their heads."""
        channel = self._file.channel(table.event)
        kind = self._types[table.event] if self.has_columns(table.event) else None
        count = len(table.order)
        sequence = (channel.count + np.arange(count)) & 0xFFFFFFFF
        if kind is None:
            fields: Sequence[Any] = table.fields
            return [channel.encode(
                number, time, time, cdr.ENCAPSULATION, time, vpid, vtid, *values)
                for number, time, vpid, vtid, values in zip(
                    sequence.tolist(), table.timestamp.tolist(), table.vpid.tolist(),
                    table.vtid.tolist(), fields)]
        found = np.zeros(count, kind)
        found['opcode'], found['length'] = Opcode.MESSAGE, kind.itemsize - records.RECORD.size
        found['channel'], found['sequence'] = channel.number, sequence
        found['log_time'] = found['publish_time'] = table.timestamp
        found['encapsulation'] = np.frombuffer(cdr.ENCAPSULATION, dtype='<u4')[0]
        for number, values in enumerate((table.timestamp, table.vpid, table.vtid, *table.fields)):
            found[str(number)] = values
        return found


_HEAD = {'opcode': 'u1', 'length': '<u8', 'channel': '<u2', 'sequence': '<u4',
         'log_time': '<u8', 'publish_time': '<u8', 'encapsulation': '<u4'}
_OFFSETS = (0, 1, 9, 11, 15, 23, 31)
_BODY = 35
"""The record of a message: its head, and where the message's fields begin."""

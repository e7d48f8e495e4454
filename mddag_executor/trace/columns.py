# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Events as rows of numbers, for compiled code: a chunk at a time, in the order of time.

Theory of operation:

1. What a pass over a file does, with its order and what it does on damage, is in ``reading``; here
   a chunk's events are rows of an array instead of tuples in a list.
2. A row has the numbers of an event whose kind is asked for and whose channel has one fixed
   layout of integers.  Every other event that is wanted (text among its fields, other fields than
   the table's) has a row that only tells its time and its place in a list, where it stands as the
   tuple that ``TraceReader.events`` gives.
3. Walking over the records is compiled (``columns_kernel``); the definitions between them, which
   are few, are not.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
import struct
from typing import Any, BinaryIO, NamedTuple

from mddag_executor.trace import column_layout as cl
from mddag_executor.trace import records
from mddag_executor.trace.blocks import Block, Damage
from mddag_executor.trace.channels import Channels, Event
from mddag_executor.trace.reading import Reading
from mddag_executor.trace.times import plain
import numpy as np
import numpy.typing as npt

Rows = npt.NDArray[np.int64]
Scan = Callable[..., None]

_SIGNED = {'q': 1, 'i': 1, 'h': 1, 'b': 1, 'Q': 0, 'I': 0, 'H': 0, 'B': 0, '?': 2}
_SOME = 1 << 15         # rows at a time
_SLACK = 64             # bytes that can be read after a chunk's records


class Columns(NamedTuple):
    """Events: their rows, and those that are no numbers, by the place that their row tells."""

    rows: Rows
    others: list[Event]


class ColumnReading(Reading):
    """
    A pass over a file that yields rows.

    :param kinds: by full name, the kinds of events that are to be rows of numbers.
    :param scan: ``columns_kernel.scan_records``, compiled.
    """

    def __init__(
        self, path: str, channels: Channels, kinds: Mapping[str, int], scan: Scan
    ) -> None:
        super().__init__(path, channels)
        self._kinds = kinds
        self._scan_records = scan
        self._classes = np.zeros(1 << 16, dtype=np.int64)
        self._layouts = np.zeros((0, cl.LAYOUT), dtype=np.int64)

    def columns(self, stream: BinaryIO, blocks: Iterator[Block]) -> Iterator[Columns]:
        """
        Yield the events in the order of time, some at a time.

        :raises TraceError: where too many chunks overlap in time
        """
        return self._by_time(stream, blocks)

    def _in_order(self, stream: BinaryIO, block: Block, pending: int) -> _Loaded:
        rows, others = self._rows(self._load(stream, block), block)
        if len(rows) > self._room(pending):
            raise self._too_unordered()
        times = rows[:, cl.TIME]
        if len(rows) and not plain(int(times.min()), int(times.max())):
            rows = np.delete(rows, self._times.impossible(times.tolist()), axis=0)
            times = rows[:, cl.TIME]
        if len(rows) > 1 and bool((times[1:] < times[:-1]).any()):
            rows = rows[np.argsort(times, kind='stable')]
        if len(rows) and rows[0, cl.TIME] < block.start_time:
            raise Damage('a chunk holds an event from before the time in its head', block.offset)
        return _Loaded(rows, others)

    def _rows(self, data: bytes, block: Block) -> tuple[Rows, list[Event]]:
        """Return the events of a block's records; raise Damage where malformed."""
        end = len(data)
        data += bytes(_SLACK)
        address = np.frombuffer(data, dtype=np.uint8).ctypes.data
        rows = np.empty((_SOME, cl.ROW), dtype=np.int64)
        places = np.empty((_SOME, 2), dtype=np.int64)
        result = np.zeros(cl.N_RESULTS, dtype=np.int64)
        parts: list[Rows] = []
        others: list[Event] = []
        self._classify()    # definitions come with other passes, too, which share the channels
        while True:
            result[cl.ROWS] = result[cl.OTHERS] = 0
            self._scan_records(
                address, end, self._classes, self._layouts, rows, places, result)
            # now: a definition that follows may make them known
            parts.append(self._decoded(data, rows[:result[cl.ROWS]], places, others))
            position = int(result[cl.POSITION])
            if result[cl.STATUS] == cl.CUT:
                raise Damage('the records of a chunk do not fit into it', block.offset)
            if result[cl.STATUS] == cl.DONE:
                break
            if result[cl.STATUS] == cl.DEFINITION:
                opcode, length = records.RECORD.unpack_from(data, position)
                after = position + records.RECORD.size + length
                self._define(opcode, data[position + records.RECORD.size:after], block)
                self._classify()
                result[cl.POSITION] = after
        self.messages += int(result[cl.MESSAGES]) * block.copies
        self.chunks += block.chunk * block.copies
        return parts[0] if len(parts) == 1 else np.concatenate(parts), others

    def _decoded(self, data: bytes, rows: Rows, places: Rows, others: list[Event]) -> Rows:
        """Return a copy of rows; what is no row of numbers is decoded, or left out."""
        found = rows.copy()
        rest = np.flatnonzero(found[:, cl.KIND] == cl.OTHER)
        if not len(rest):
            return found
        known = np.ones(len(found), dtype=np.bool_)
        for row in rest.tolist():
            start, after = places[found[row, cl.THREAD]].tolist()
            channel = records.UINT16.unpack_from(data, start + records.RECORD.size)[0]
            before = len(others)
            self._add_any(others, channel, data[start:after])
            if len(others) > before:
                found[row, cl.TIME] = others[-1][1]
                found[row, cl.THREAD] = before
            else:
                known[row] = False
        return found[known]

    def _classify(self) -> None:
        """Take in what the channels hold that have been defined."""
        channels = self._channels
        layouts: list[list[int]] = []
        for number in channels.passed_over:
            self._classes[number] = cl.PASSED_OVER
        for number, (head, size, unpack) in channels.fast.items():
            layout = self._layout(self._kinds.get(head[0], cl.OTHER), size, unpack)
            if layout is not None:
                self._classes[number] = cl.FIRST_LAYOUT + len(layouts)
                layouts.append(layout)
        self._layouts = np.array(layouts, dtype=np.int64).reshape(-1, cl.LAYOUT)

    def _layout(self, kind: int, size: int, unpack: Any) -> list[int] | None:
        """Return the layout of a channel, None where it is none for rows."""
        fields: list[int] = []
        offset = 0
        for code in unpack.__self__.format[1:]:
            if code == 'x':
                offset += 1
                continue
            if code not in _SIGNED:
                return None
            length = struct.calcsize('<' + code)
            fields += (offset, length, _SIGNED[code])
            offset += length
        count = len(fields) // 3
        if kind == cl.OTHER or count >= cl.ROW:
            return None
        return [kind, size, count, *fields, *[0] * (cl.LAYOUT - cl.L_FIRST - len(fields))]

    def _take(self, loaded: dict[int, Any], before: int | None) -> Columns:
        """Take out the events before a time (None: all), in the order of time."""
        parts: list[Rows] = []
        others: list[Event] = []
        for number in sorted(loaded):
            part = loaded[number]
            rows = part.take(before)
            if len(rows):
                if part.others:
                    other = rows[:, cl.KIND] == cl.OTHER
                    rows[other, cl.THREAD] += len(others)
                    others += part.others
                parts.append(rows)
            if not len(part):
                del loaded[number]
        if not parts:
            return Columns(np.empty((0, cl.ROW), dtype=np.int64), [])
        if len(parts) == 1:
            return Columns(parts[0], others)
        rows = np.concatenate(parts)
        return Columns(rows[np.argsort(rows[:, cl.TIME], kind='stable')], others)


class _Loaded:
    """What is left of a block's events."""

    def __init__(self, rows: Rows, others: list[Event]) -> None:
        self._rows = rows
        self.others = others

    def __len__(self) -> int:
        return len(self._rows)

    def take(self, before: int | None) -> Rows:
        rows = self._rows
        count = len(rows) if before is None or not len(rows) or rows[-1, cl.TIME] < before else \
            bisect_left(rows[:, cl.TIME], before)
        self._rows = rows[count:]
        return rows[:count]

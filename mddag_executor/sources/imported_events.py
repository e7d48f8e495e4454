# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the events of an imported recording into one table, in the order of time.

Each event of ``KINDS`` is a row with the same columns; names of fields differ between versions of
the tracers.  Other events are tuples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from mddag_executor.recording.columns import Ints, rows, Table
from mddag_executor.recording.joins import different, sort_by
from mddag_executor.sources.progress import Progress
from mddag_executor.text import counted
from mddag_executor.trace import TraceReader
from mddag_executor.trace.errors import TraceError
from mddag_executor.trace.events import Event
from mddag_executor.trace.schema import (
    BEFORE_HUMBLE,
    BEFORE_HUMBLE_PROBLEM,
    BEFORE_HUMBLE_REMEDY,
    PROCESS,
)
from mddag_executor.trace.times import NEVER
import numpy as np

ADDRESSES = 2 ** 64

(START, END, INTRA, RCLCPP, RCL, DDS_WRITE, BECAME, BIND, RMW_PUBLISH, DISPATCH, TAKE, WITHIN,
 COPY, ENQUEUE, DEQUEUE, LOST, SHUTDOWN) = range(17)
LAST_KIND = SHUTDOWN

KINDS: dict[str, tuple[Any, ...]] = {
    'ros2_caret:dds_write': (DDS_WRITE, 'message', 'timestamp_'),
    'ros2_caret:dds_bind_addr_to_addr': (BECAME, 'addr_from', 'addr_to'),
    'ros2_caret:dds_bind_addr_to_stamp': (BIND, 'addr', 'source_stamp'),
    'ros2:callback_start': (START, 'callback'),
    'ros2:callback_end': (END, 'callback'),
    'ros2:rclcpp_intra_publish': (INTRA, 'publisher_handle', 'message'),
    'ros2:rclcpp_publish': (RCLCPP, 'publisher_handle', 'message', 'message_timestamp'),
    'ros2:rcl_publish': (RCL, 'publisher_handle', 'message'),
    'ros2:rmw_publish': (RMW_PUBLISH, 'message', 'timestamp_ source_timestamp'),
    'ros2:dispatch_subscription_callback': (
        DISPATCH, 'callback', 'source_stamp', 'message_timestamp'),
    'ros2:rmw_take': (TAKE, 'rmw_subscription_handle', 'source_timestamp', 'taken'),
    'ros2:dispatch_intra_process_subscription_callback': (WITHIN, 'callback', 'message'),
    'ros2:message_construct': (COPY, 'original_message', 'constructed_message'),
    'ros2:rclcpp_ring_buffer_enqueue': (ENQUEUE, 'buffer', 'index', 'overwritten'),
    'ros2:rclcpp_ring_buffer_dequeue': (DEQUEUE, 'buffer', 'index'),
    'mddag:lost': (LOST, 'count', 'begin', 'cause'),
}
"""By full name of an event its kind, and the fields of its columns ``a``, ``b``, …"""
OWN_KINDS: dict[str, tuple[Any, ...]] = {
    'mddag:dispatch': (START, 'callback', 'ready', 'due'),
    'ros2:callback_end': KINDS['ros2:callback_end'],
    'ros2:rclcpp_publish': KINDS['ros2:rclcpp_publish'],
    'ros2:rmw_take': (
        TAKE, 'rmw_subscription_handle', 'source_timestamp', 'taken', 'sequence_number'),
    'mddag:lost': KINDS['mddag:lost'], 'mddag:shutdown': (SHUTDOWN, 'end')}
"""
The same for a trace of this executor without declaration.

`callback_start` and `rcl_publish` are not in it: they say the same as `dispatch` and
`rclcpp_publish`, with which they are recorded.  Column ``d`` of a `dispatch` is what ``computed``
takes apart.
"""

_TIMES = ('init_timestamp', 'ready', 'start')
"""The fields of other events that are times: of a timer's initialisation, of `unfinished`."""
_COLUMNS_OF_TIMES = {START: ('b', 'c'), SHUTDOWN: ('a',)}
"""By kind of event its columns that are times, 0: unknown; LTTng's starts have none."""
_EVENT = np.dtype([('time', 'i8'), ('place', 'i8'), ('thread', 'i4'), ('kind', 'i1'),
                   ('a', 'i8'), ('b', 'i8'), ('c', 'i8'), ('d', 'i8')])
_OfKind = tuple[Any, Ints, tuple[Any, ...]]
"""Events of one kind: a structured array, their positions in the file, and the kind."""


class Events(NamedTuple):
    """
    The events of a recording.

    :ivar table: events of ``KINDS`` in the order of time; ``thread`` is an index of ``threads``.
    :ivar threads: process and thread id.
    :ivar others: the other events, as tuples with a ``Layout``, in the order of time.
    :ivar warning: events at impossible times, which were left out; empty: none.
    :ivar names: the last name of a thread, by process and thread id.
    :ivar own: the processes that this executor ran.
    :ivar shift: by process what was added to the recorded times, ns.
    """

    table: Table
    threads: list[tuple[int, int]]
    others: list[Event]
    warning: str
    names: Mapping[tuple[int, int], str] = {}
    own: frozenset[int] = frozenset()
    shift: Mapping[int, int] = {}

    def of_threads(self, by_process: Mapping[int, int]) -> Ints:
        """Return the values of the processes of all threads; 0: none."""
        return np.array([by_process.get(pid, 0) for pid, _ in self.threads], dtype=np.int64)


def computed(packed: Ints) -> tuple[Ints, Ints]:
    """Return CPU times, -1: unknown, and whether the GIL was held, from columns ``d``."""
    return packed // 2 - 1, packed % 2


def moved(events: Events, shift: Mapping[int, int]) -> Events:
    """
    Return events with the times of some processes moved.

    :param shift: by process id what is added, ns.  Source timestamps in events do not change.
    """
    table = events.table.copy()
    more = events.of_threads(shift)[table['thread']]
    table['time'] += more
    for kind, columns in _COLUMNS_OF_TIMES.items() if events.own else ():
        for column in columns:
            mine = np.flatnonzero((table['kind'] == kind) & (table[column] > 0))
            table[column][mine] += more[mine]
    # it is not known which clock a gap has: it is in its place by each of them
    lost, later = table['kind'] == LOST, max(0, *shift.values())
    table['b'][lost & (table['b'] == 0)] = events.table['time'][lost & (table['b'] == 0)]
    table['b'][lost] = np.maximum(1, table['b'][lost] + min(0, *shift.values()))
    table['time'][lost] += later
    table['time'] = np.clip(table['time'], 0, NEVER - 1)
    others = []
    for layout, time, pid, *rest in events.others:
        later = shift.get(pid, 0)
        for field in _TIMES:
            at = 1 + layout.fields.index(field) if field in layout.fields else 0
            if at and isinstance(rest[at], int):
                rest[at] += later
        others.append((layout, min(max(0, time + later), NEVER - 1), pid, *rest))
    return events._replace(
        table=table[sort_by(table['time'], table['place'])],
        others=sorted(others, key=lambda event: event[1]), shift={
            pid: shift.get(pid, 0) + events.shift.get(pid, 0) for pid in {*shift, *events.shift}})


class Listener(Protocol):
    """Receives the events of some kinds."""

    @property
    def names(self) -> Sequence[str]:
        """Return the full names of the kinds."""

    def take(self, name: str, events: Any, places: Ints) -> None:
        """Receive events of a kind, and their places in the file."""


def read_events(
    reader: TraceReader, kinds: Mapping[str, tuple[Any, ...]], others: Sequence[str],
    progress: Progress | None = None, listener: Listener | None = None,
) -> Events:
    """
    Return the events of a trace: those of ``kinds`` as a table, and ``others`` as tuples.

    :param listener: also receives those events of its names that have columns.
    """
    heard = () if listener is None else listener.names
    parts: list[Table] = [rows(_EVENT)]
    thread_numbers: dict[int, int] = {}     # by process and thread id
    tuples: list[tuple[int, Event]] = []
    names_of: dict[tuple[int, int], str] = {}
    count = 0
    for batch in reader.batches(
            {*kinds, *others, *heard, *BEFORE_HUMBLE, PROCESS}, as_table=False):
        some: list[_OfKind] = []
        for head, table, places in batch.tables:
            if head[0].name in BEFORE_HUMBLE:
                raise TraceError(reader.path, BEFORE_HUMBLE_PROBLEM, BEFORE_HUMBLE_REMEDY)
            if listener is not None and head[0].name in heard:
                listener.take(head[0].name, table, places)
            if head[0].name in kinds:
                some.append((table, places, kinds[head[0].name]))
            elif head[0].name in heard:
                continue
            if head[0].name not in kinds or head[0].name in others:
                tuples += zip(places.tolist(), (head + row for row in table.tolist()))
        for place, event in batch.others:
            layout = event[0]
            if layout.name in heard and layout.name not in kinds:
                continue
            if layout.name == PROCESS:
                names_of[event[2], event[3]] = str(event[4])
                continue
            if layout.name in kinds:
                names = ('timestamp', 'vpid', 'vtid', *layout.fields)
                numbers = {name: value for name, value in zip(names, event[1:])
                           if isinstance(value, int)}
                row = np.zeros(1, [(name, 'i8') for name in numbers])
                for name, value in numbers.items():
                    row[name] = (value + ADDRESSES // 2) % ADDRESSES - ADDRESSES // 2
                some.append((row, np.array([place]), kinds[layout.name]))
            if layout.name not in kinds or layout.name in others:
                tuples.append((place, event))
        if some:
            parts.append(_in_order(some, thread_numbers))
        count += batch.n_events
        if progress is not None:
            progress(count)
    table = _joined(parts)
    tuples.sort(key=lambda each: (each[1][1], each[0]))
    possible = (table['time'] >= 0) & (table['time'] < NEVER)
    kept = [event for _, event in tuples if 0 <= event[1] < NEVER]
    impossible = table['time'][~possible].tolist() + [
        event[1] for _, event in tuples if not 0 <= event[1] < NEVER]
    threads = np.array([*thread_numbers], dtype=np.int64)
    in_order = sort_by(threads)
    table.replace('thread', np.argsort(in_order).astype(np.int32)[table['thread']])
    warning = '' if not impossible else (
        f'left out: {counted(len(impossible), "event")} at an impossible time, the first at '
        f'{impossible[0]} ns')
    if not possible.all():
        table = table[possible]
    return Events(
        table, [(each >> 32, (each & 0xFFFFFFFF) - (each & 0x80000000) * 2)
                for each in threads[in_order].tolist()], kept, warning, names_of)


def _in_order(some: list[_OfKind], threads: dict[int, int]) -> Table:
    """
    Return the events of a batch as rows of the table, in the order of time and file.

    :param threads: receives the threads: process and thread id as one number.
    """
    place = np.concatenate([places for _, places, _ in some])
    found, begin = rows(_EVENT, len(place), place=place), 0
    for events, places, kind in some:
        _fill(found[begin:begin + len(places)], events, kind, threads)
        begin += len(places)
    return found[sort_by(found['time'], place)]


def _joined(parts: list[Table]) -> Table:
    """Return the rows of batches in the order of time and file; empties the list."""
    columns = {name: [each[name] for each in parts] for name in parts[0].names}
    parts.clear()
    found = {'time': np.concatenate(columns.pop('time'))}
    order = sort_by(found['time'])
    places = np.flatnonzero(order != np.arange(len(order)))     # few: batches hardly overlap
    order = order[places]
    found['time'][places] = found['time'][order]
    for name in _EVENT.names or ():
        if name in columns:
            found[name] = np.concatenate(columns.pop(name))
            found[name][places] = found[name][order]
    return Table(found)


def _fill(
    found: Table, events: Any, kind: tuple[Any, ...], threads: dict[int, int]
) -> None:
    """Fill rows with events of one kind; missing fields are 0."""
    names = events.dtype.names or ()
    found['time'], found['kind'] = events['timestamp'], kind[0]
    numbers, which = different(
        (events['vpid'].astype(np.int64) << 32) | (events['vtid'].astype(np.int64) & 0xFFFFFFFF))
    found['thread'] = np.array([
        threads.setdefault(each, len(threads)) for each in numbers.tolist()])[which]
    for name, fields in zip('abcd', kind[1:]):
        for field in reversed(fields.split()):
            if field in names:
                value = events[field]
                np.copyto(found[name], value, casting='unsafe', where=value != 0)
    if kind[0] == START and {'cpu_time', 'held_interpreter'} <= {*names}:
        found['d'] = 2 * (events['cpu_time'] + 1) + (events['held_interpreter'] != 0)

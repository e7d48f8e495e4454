# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the packets of CTF traces, and merges their events in the order of time.

Theory of operation:

1. A stream (of a processor, in a trace) is packets, one after another; of a session that was
   rotated it continues in the next file.  A packet says its size and that of its content, its
   first and last time, its number, and how many events were discarded so far.
2. Packets are taken in the order of their first times, about `_WINDOW` bytes at once.  All events
   before the first time of any later packet are known then: they are sorted, and yielded as
   columns.  The rest, at most that of a packet of each stream, waits.  So the memory is bounded.
3. The events in packets are read by `ctf_decoder`.
4. *Damage.*  What comes from the file is checked before it is used.  Of a packet in which an event
   cannot be read, the events before it are used; of a file in which the head of a packet cannot be
   read, the packets before it.  Both are noted (`Damage`).
5. *Gaps.*  The tracer counts the events that it discards, and the packets that it writes.  Packets
   without the ones before them are gaps as well: a flight recorder overwrites packets, and files
   of a session that was rotated may be gone.
"""

from __future__ import annotations

from collections.abc import Iterator
import heapq
import os
import stat
import struct
from typing import Any, NamedTuple

from mddag_executor.trace.ctf_decoder import Decoder, Packet
from mddag_executor.trace.ctf_events import Damage, Events, joined, Lost, NEVER, no_events, time_of
from mddag_executor.trace.ctf_layout import Cursor, Damaged, reader_of
from mddag_executor.trace.ctf_types import Metadata
from mddag_executor.trace.schema import DAMAGED, DISCARDED, MISSING
import numpy as np

_WINDOW = 4 * 1024 * 1024
_HEAD = 4096            # the head of a packet is in these bytes
_MAGIC = 0xC1FC1FC1


class Trace:
    """
    A trace: what its metadata says, and the streams in its folders.

    :ivar number: which trace of a host it is.
    """

    def __init__(self, metadata: Metadata, number: int, raw: bool) -> None:
        self.metadata, self.number = metadata, number
        self.files: list[str] = []
        environment = metadata.environment
        version = tuple(int(environment.get(f'tracer_{part}', '0')[:6]) if environment.get(
            f'tracer_{part}', '0').isdecimal() else 0 for part in ('major', 'minor'))
        # earlier tracers noted the end of a packet before its last events
        slack = 0 if version == (0, 0) or version >= (2, 13) else metadata.clock.frequency
        self.decoders = {
            each: Decoder(metadata.clock, number, slack, stream, raw)
            for each, stream in metadata.streams.items()}

    def ns(self, ticks: int) -> int:
        """Return a time of its clock as ns of the epoch, in the range of times."""
        return time_of(self.metadata.clock, ticks)


class _HeadOfPacket(NamedTuple):
    packet: Packet
    size: int               # bytes, of the packet
    instance: int           # of the stream
    number: int             # of the packet; -1: unknown
    discarded: int          # events so far; -1: unknown
    is_cut: bool


def read_head(trace: Trace, file: str, offset: int, size: int) -> _HeadOfPacket:
    """
    Return what the head of a packet says.

    :param size: of the file.
    :raises Damaged: if it says what cannot be
    """
    metadata = trace.metadata
    with open(file, 'rb', buffering=0) as stream:
        data = os.pread(stream.fileno(), _HEAD, offset)
    cursor = Cursor(data, 0, len(data) * 8)
    header: dict[str, Any] = {}
    context: dict[str, Any] = {}
    try:
        if metadata.packet_header is not None:
            header = cursor.read('packet-header', reader_of(metadata.packet_header))
        if header.get('magic', _MAGIC) != _MAGIC:
            raise Damaged('a packet does not begin as packets do')
        uuid = header.get('uuid')
        if metadata.uuid and isinstance(uuid, list) and (
                bytes(uuid).hex() != metadata.uuid.replace('-', '').lower()):
            raise Damaged('a packet is of another trace')
        number = header.get('stream_id', next(iter(metadata.streams), 0))
        if number not in trace.decoders:
            raise Damaged(f'a packet is of an unknown stream ({number})')
        of_stream = metadata.streams[number].packet_context
        if of_stream is not None:
            context = cursor.read('packet-context', reader_of(of_stream))
        values = {name: context.get(name, default) for name, default in (
            ('packet_size', (size - offset) * 8), ('timestamp_begin', 0), ('timestamp_end', 0),
            ('events_discarded', -1), ('packet_seq_num', -1))}
        values['content_size'] = context.get('content_size', values['packet_size'])
        values['instance'] = header.get('stream_instance_id', -1)
        if not all(isinstance(value, int) for value in values.values()):
            raise Damaged('the head of a packet is not understood')
    except (struct.error, KeyError, TypeError, ValueError) as error:
        raise Damaged(
            str(error).replace('an event', 'the head of a packet') if isinstance(error, Damaged)
            else 'the head of a packet is not understood') from None
    whole, content = values['packet_size'], values['content_size']
    begin, end = values['timestamp_begin'], values['timestamp_end']
    if whole % 8 or not cursor.at <= content <= whole or not whole or (
            not 0 <= begin < 2 ** 64 or not 0 <= end < 2 ** 64 or 0 < end < begin):
        raise Damaged('sizes or times of a packet are wrong')
    left = size - offset
    packet = Packet(file, offset, begin, end, -(-cursor.at // 8), min(-(-content // 8), left),
                    trace.decoders[number], 0)
    return _HeadOfPacket(packet, whole // 8, values['instance'], values['packet_seq_num'],
                         values['events_discarded'], whole // 8 > left)


class _Stream:
    """The packets of a stream, which may be in several files."""

    def __init__(self, trace: Trace, number: int) -> None:
        self._trace, self._number = trace, number
        #: First time and path of each file.
        self.files: list[tuple[int, str]] = []

    def packets(self, reading: Reading) -> Iterator[Packet]:
        """Yield the packets, in the order of time."""
        number, discarded, begin, end = -1, 0, 0, 0
        is_damaged = False
        for _, file in sorted(self.files):
            size, offset = os.stat(file).st_size, 0
            while offset < size:
                try:
                    head = read_head(self._trace, file, offset, size)
                except Damaged as error:
                    reading.damaged(file, str(error), offset, size, self._trace.ns(end))
                    is_damaged = True
                    break
                packet = head.packet
                packet.stream = self._number
                offset += head.size
                # what was discarded was not in the packet before
                since = self._trace.ns(min(end, packet.begin) if number >= 0 else packet.begin)
                if number >= 0 and 0 <= head.number <= number and packet.begin <= begin:
                    continue        # a snapshot has packets of the one before
                if number < head.number - 1 and not is_damaged:
                    reading.lost.append(Lost(
                        self._trace.ns(packet.begin), since if number >= 0 else 0, MISSING,
                        head.number - 1 - number))
                is_damaged = False
                # an empty packet, written when a buffer is flushed, may say 0
                if head.discarded > discarded:
                    reading.lost.append(Lost(
                        self._trace.ns(packet.end), since, DISCARDED, head.discarded - discarded))
                    discarded = head.discarded
                number, begin, end = head.number, packet.begin, max(packet.begin, packet.end)
                yield packet
                if head.is_cut:
                    reading.damaged(file, 'the file ends within a packet', size, size,
                                    self._trace.ns(begin))


class Reading:
    """
    The events of the traces of a host.

    :param folders: the metadata of each of their folders, by folder.
    :param raw: whether the bytes of each event are wanted.
    :ivar damages: what is wrong, after the events were read.
    :ivar offsets: by number of a trace from the 0 of its clock to that of its times, ns, if
        credible.
    """

    def __init__(self, folders: dict[str, Metadata], raw: bool) -> None:
        self.damages: list[Damage] = []
        self.lost: list[Lost] = []
        self._missing_from: int | None = None       # up to the end; None: nothing is missing
        self._count = 0
        self._streams: dict[Any, _Stream] = {}
        traces: dict[str, Trace] = {}
        for folder, metadata in folders.items():
            # each process of a user has a trace; the chunks of a session are one
            key = metadata.uuid or folder
            if key not in traces or traces[key].metadata != metadata:
                number = traces[key].number if key in traces else len(traces)
                traces[key] = Trace(metadata, number, raw)
            self._add(traces[key], folder)
        self.offsets = {
            each.number: offset for each in traces.values()
            if 0 < (offset := each.metadata.clock.offset) < NEVER}

    def _add(self, trace: Trace, folder: str) -> None:
        """Take the files of a trace in a folder."""
        for entry in sorted(os.scandir(folder), key=lambda each: each.name):
            if entry.name == 'metadata' or entry.name.startswith('.'):
                continue
            status = entry.stat()
            if not stat.S_ISREG(status.st_mode) or not status.st_size:
                continue
            try:
                head = read_head(trace, entry.path, 0, status.st_size)
            except Damaged as error:
                self.damaged(entry.path, str(error), 0, status.st_size, 0)
                continue
            key = (trace.number, entry.path) if head.instance < 0 else (
                trace.number, id(head.packet.decoder), head.instance)
            stream = self._streams.setdefault(key, _Stream(trace, len(self._streams)))
            stream.files.append((head.packet.begin, entry.path))

    def damaged(self, file: str, what: str, offset: int, size: int, since: int) -> None:
        """
        Note damage after which nothing of a file is used.

        :param since: the time up to which it was used, ns.
        """
        self.damages.append(Damage(file, offset, what, size - offset))
        self._missing_from = since if self._missing_from is None else min(
            since, self._missing_from)

    def batches(self) -> Iterator[tuple[Events, list[Lost]]]:
        """Yield events in the order of time, and what is missing up to the last of them."""
        heap: list[tuple[int, int, Packet, Iterator[Packet]]] = []

        def advance(packets: Iterator[Packet]) -> None:
            packet = next(packets, None)
            if packet is not None:
                heapq.heappush(heap, (
                    packet.decoder.ns(packet.begin), packet.stream, packet, packets))

        for stream in self._streams.values():
            advance(stream.packets(self))
        window: dict[int, list[Packet]] = {}
        waiting: Events | None = None
        size, last = 0, 0
        while heap:
            _, _, packet, packets = heapq.heappop(heap)
            window.setdefault(id(packet.decoder), []).append(packet)
            size += packet.content
            advance(packets)
            if heap and size < _WINDOW:
                continue
            parts = [] if waiting is None else [waiting]
            for of_decoder in window.values():
                found = of_decoder[0].decoder.events(
                    of_decoder, self._count, self.damages, self.lost)
                if found is not None:
                    self._count += len(found)
                    parts.append(found)
            window, size, waiting = {}, 0, None
            until = heap[0][0] if heap else NEVER
            if not parts:
                continue
            events = joined(parts)
            order = np.lexsort((events.place, events.time))
            ready = int(np.searchsorted(events.time[order], until))
            waiting = events.picked(order[ready:]) if ready < len(order) else None
            events = events.picked(order[:ready])
            last = int(events.time[-1]) if len(events) else last
            yield events, self._take_lost(until)
        if self._missing_from is not None:
            self.lost.append(Lost(last, self._missing_from, DAMAGED))
        if self.lost:
            yield no_events(), self._take_lost(NEVER)

    def _take_lost(self, until: int) -> list[Lost]:
        found = sorted(lost for lost in self.lost if lost.time < until)
        self.lost = [lost for lost in self.lost if lost.time >= until]
        return found

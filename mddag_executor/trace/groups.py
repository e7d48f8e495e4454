# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Events that are always recorded together, as one entry.

Theory of operation
-------------------
A live run mostly records the same few events for each callback.  Recording and encoding them one
by one would be the largest part of the cost of recording.  So the executor records *one entry* for
an execution and one for a publication, and the writer packs the messages of all its events at
once. The file is the same: each event is a message of its own channel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter
import struct
from typing import Any

from mcap.opcode import Opcode
from mddag_executor.trace import cdr, records

EXECUTION, PUBLICATION = 'execution', 'publication'
"""A declared callback has run; a message is published: the names of entries."""

_VALUES = {
    EXECUTION: 'start vtid callback dag vertex job worker ready deadline end completed whole leg '
               'cpu_time held',
    PUBLICATION: 'time vtid publisher message header_stamp'}
"""What follows the name of an entry; ``completed`` is the core's time of the completion."""

GROUPS = {
    EXECUTION: {
        'mddag:dispatch':
            'start callback dag vertex job worker ready deadline none unknown none',
        'ros2:callback_start': 'start callback none',
        'ros2:callback_end': 'end callback',
        'mddag:complete':
            'completed callback dag vertex job whole end leg cpu_time held'},
    PUBLICATION: {
        'ros2:rclcpp_publish': 'time publisher message header_stamp',
        'ros2:rcl_publish': 'time publisher message'}}
"""The events of an entry, in the order in which they are written: time and fields of each."""


def events_of(entry: Sequence[Any]) -> int:
    """Return the number of events of an entry; 1 for other entries."""
    return next((len(events) for name, events in GROUPS.items() if entry[:1] == (name,)), 1)


class Group:
    """
    The channels of an entry's events, and their encoder.

    :ivar parts: the channels (see ``trace_file``).
    :ivar sizes: size of each message record, bytes.
    :ivar defined: whether all of the channels are in the file.
    """

    def __init__(self, name: str, channels: Mapping[str, Any]) -> None:
        self.parts = [channels[key] for key in GROUPS[name]]
        layouts = [f'11sIQQ4s{cdr.fixed_layout(part.event.types)}' for part in self.parts]
        self.sizes = [struct.calcsize(f'<{layout}') for layout in layouts]
        self.defined = False
        self._pack = struct.Struct('<' + ''.join(layouts)).pack
        heads = [
            struct.pack('<BQH', Opcode.MESSAGE, size - records.RECORD.size, part.number)
            for size, part in zip(self.sizes, self.parts)]
        self._constants = (*heads, cdr.ENCAPSULATION, 0, -1)
        # the names of what ``encode`` puts together, and of that what each message consists of
        n = range(len(self.parts))
        values = ['name', *_VALUES[name].split()]
        names = [*values, 'vpid', *(f'head {i}' for i in n), 'cdr', 'none', 'unknown',
                 *(f'sequence {i}' for i in n)]
        self._length = len(values)
        picked, times = list[str](), list[str]()
        for i, fields in enumerate(GROUPS[name].values()):
            time, *rest = fields.split()
            times.append(time)
            picked += (f'head {i}', f'sequence {i}', time, time, 'cdr', time, 'vpid', 'vtid')
            picked += rest
        self._pick = itemgetter(*map(names.index, picked))
        self._times = itemgetter(*map(names.index, times))

    def encode(self, entry: Sequence[Any], vpid: int) -> tuple[bytes, tuple[int, ...]]:
        """Return the records of an entry as one block, and the time of each."""
        if len(entry) != self._length:
            raise ValueError(f'{len(entry)} values instead of {self._length}')
        values = (*entry, vpid, *self._constants,
                  *[part.count & 0xFFFFFFFF for part in self.parts])
        return self._pack(*self._pick(values)), self._times(values)

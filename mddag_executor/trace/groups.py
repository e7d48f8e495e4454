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

from collections.abc import Callable, Sequence
import struct
from typing import Any, Protocol

from mcap.opcode import Opcode
from mddag_executor.trace import cdr, records

EXECUTION = 'execution'
"""
A declared callback has run: ``dispatch``, ``callback_start``, ``callback_end``, ``complete``.

After the name: start, vtid, callback, dag, vertex, job, worker, ready, deadline, end, completed
(the core's time of its completion), whole, leg, CPU time, whether it held the GIL.
"""

PUBLICATION = 'publication'
"""
A message is published: ``rclcpp_publish``, ``rcl_publish``.

After the name: time, vtid, publisher, message.
"""

GROUPS = {
    EXECUTION: (
        'mddag:dispatch', 'ros2:callback_start', 'ros2:callback_end', 'mddag:complete'),
    PUBLICATION: ('ros2:rclcpp_publish', 'ros2:rcl_publish'),
}
"""The events of an entry, in the order in which they are written."""


def events_of(entry: Sequence[Any]) -> int:
    """Return the number of events of an entry; 1 for what is none."""
    return next((len(events) for name, events in GROUPS.items() if entry[:1] == (name,)), 1)


_SEQUENCE = 0xFFFFFFFF
_M = Opcode.MESSAGE
_E = cdr.ENCAPSULATION


class Channel(Protocol):
    """A channel (see ``trace_file``), as used here."""

    event: Any
    number: int
    count: int


class Group:
    """
    The channels of an entry's events, and their encoder.

    :ivar parts: the channels.
    :ivar sizes: size of each message record, bytes.
    :ivar encode: returns the records of an entry as one block, and the time of each.
    :ivar defined: whether all of the channels are in the file.
    """

    __slots__ = ('parts', 'sizes', 'encode', 'defined')

    def __init__(self, name: str, channels: dict[str, Any]) -> None:
        self.parts: list[Any] = [channels[key] for key in GROUPS[name]]
        layouts = [f'BQHIQQ4s{cdr.fixed_layout(part.event.types)}' for part in self.parts]
        self.sizes = [struct.calcsize('<' + layout) for layout in layouts]
        lengths = [size - records.RECORD.size for size in self.sizes]
        pack = struct.Struct('<' + ''.join(layouts)).pack
        self.encode = _ENCODERS[name](self.parts, lengths, pack)
        self.defined = False


Encode = Callable[[Sequence[Any], int], 'tuple[bytes, tuple[int, ...]]']


def _execution(
    parts: Sequence[Channel], lengths: Sequence[int], pack: Callable[..., bytes]
) -> Encode:
    dispatch, begun, ended, complete = parts
    n0, n1, n2, n3 = (part.number for part in parts)
    l0, l1, l2, l3 = lengths

    def encode(entry: Sequence[Any], vpid: int) -> tuple[bytes, tuple[int, ...]]:
        (_, start, vtid, callback, dag, vertex, job, worker, ready, deadline, end, completed,
         whole, leg, cpu_time, held) = entry
        data = pack(
            _M, l0, n0, dispatch.count & _SEQUENCE, start, start, _E, start, vpid, vtid,
            callback, dag, vertex, job, worker, ready, deadline,
            _M, l1, n1, begun.count & _SEQUENCE, start, start, _E, start, vpid, vtid,
            callback, False,
            _M, l2, n2, ended.count & _SEQUENCE, end, end, _E, end, vpid, vtid,
            callback,
            _M, l3, n3, complete.count & _SEQUENCE, completed, completed, _E, completed, vpid,
            vtid, callback, dag, vertex, job, whole, end, leg, cpu_time, held)
        return data, (start, start, end, completed)

    return encode


def _publication(
    parts: Sequence[Channel], lengths: Sequence[int], pack: Callable[..., bytes]
) -> Encode:
    outer, inner = parts
    n0, n1 = outer.number, inner.number
    l0, l1 = lengths

    def encode(entry: Sequence[Any], vpid: int) -> tuple[bytes, tuple[int, ...]]:
        _, time, vtid, publisher, message = entry
        data = pack(
            _M, l0, n0, outer.count & _SEQUENCE, time, time, _E, time, vpid, vtid,
            publisher, message, 0,
            _M, l1, n1, inner.count & _SEQUENCE, time, time, _E, time, vpid, vtid,
            publisher, message)
        return data, (time, time)

    return encode


_ENCODERS = {EXECUTION: _execution, PUBLICATION: _publication}

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Events, files and child processes that the trace tests share."""

import struct
from typing import Any

from hypothesis import strategies as st
from mddag_executor.trace import EVENTS, TraceFile, TraceReader
from mddag_executor.trace.cdr import FieldType

VPID = 4321
START = 1_732_166_766_000_000_000

_RANGES = {
    'uint8': (0, 2**8 - 1), 'uint16': (0, 2**16 - 1), 'uint32': (0, 2**32 - 1),
    'uint64': (0, 2**64 - 1), 'int8': (-2**7, 2**7 - 1), 'int16': (-2**15, 2**15 - 1),
    'int32': (-2**31, 2**31 - 1), 'int64': (-2**63, 2**63 - 1),
    # rosbags takes a byte for signed, ROS 2 does not
    'byte': (0, 127), 'char': (0, 255),
}


def values(kind):
    """Return a strategy for values of a type, ends of the ranges included."""
    one: st.SearchStrategy[Any]
    if kind.base == 'string':
        one = st.text(st.characters(exclude_categories=['Cs']), max_size=20)
    elif kind.base == 'bool':
        one = st.booleans()
    elif kind.base in _RANGES:
        low, high = _RANGES[kind.base]
        one = st.integers(low, high) | st.sampled_from([low, high])
    else:
        one = st.floats(width=32 if kind.base == 'float32' else 64, allow_nan=False)
    if kind.count is None:
        return one
    size = kind.count if kind.count >= 0 else 5
    return st.lists(one, min_size=max(kind.count, 0), max_size=size).map(tuple)


def entries(event):
    """Return a strategy for recordings of an event: name, timestamp, thread id, fields."""
    return st.tuples(st.just(event.key), st.integers(0, 2**63 - 1),
                     st.integers(-2**31, 2**31 - 1),
                     *(values(FieldType.parse(kind)) for _, kind in event.fields))


def sample(event, number):
    """Return one recording of an event, different for each number."""
    def value(kind, place):
        if kind == 'string':
            return f'/höhe/{number}-{place}'
        if kind == 'bool':
            return number % 2 == 0
        return number * 16 + place
    return (event.key, START + number * 1000, 100 + number % 7,
            *(value(kind, place) for place, (_, kind) in enumerate(event.fields)))


def mixture(count, first=0):
    """Return recordings of all events of the table, one by one, in the order of time."""
    events = list(EVENTS.values())
    return [sample(events[number % len(events)], number)
            for number in range(first, first + count)]


def read_back(recorded, vpid=VPID):
    """Return recordings as the reader gives them."""
    return [(name, timestamp, vpid, *rest) for name, timestamp, *rest in recorded]


def write_chunks(path, chunks, finish=True):
    """Write a file with the given recordings in each chunk."""
    file = TraceFile(path, overwrite=True)
    for chunk in chunks:
        file.extend(chunk, VPID)
        file.flush()
    assert file.rejected == 0, file.rejection
    if finish:
        file.finish()
    else:
        file.abandon()


def read(path, in_time_order=False):
    """Return the events of a file and the warnings."""
    reader = TraceReader(path)
    events = list(reader.events(sorted=in_time_order))
    return events, reader.warnings


def records_of(data):
    """Return opcode, offset and end of the records of a sound file."""
    found = []
    position = 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from('<BQ', data, position)
        found.append((opcode, position, position + 9 + length))
        position += 9 + length
    return found

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings whose values are changed at random."""

from mddag_executor.trace import EventType, TraceFile, TraceReader

TEXTS = ('', '/', '/camera', 'x' * 5000, '\x1b[2J\n', '/camera\n')
NUMBERS = (0, 1, 2, -1, 11, 12, 100, 30_012, 2 ** 62, 2 ** 63 - 1, -2 ** 63)


def lie(value, rng):
    if isinstance(value, str):
        return rng.choice(TEXTS)
    if isinstance(value, bool):
        return not value
    if rng.random() < 0.5:
        value ^= 1 << rng.randrange(63)
        return min(value, 2 ** 63 - 1)
    return rng.choice(NUMBERS)


def tell_lies(events, target, rng):
    """Write events, some left out, doubled, in other places, or with other values; how many."""
    events, lies = [*events], rng.choice((1, 1, 2, 8, 40))
    for _ in range(lies):
        at, what = rng.randrange(len(events)), rng.randrange(8)
        layout, time, pid, tid, *values = events[at]
        fields = [(field, {str: 'string', bool: 'bool'}.get(type(value), 'int64'))
                  for field, value in zip(layout[1], values)]
        place = rng.randrange(len(fields)) if fields else 0
        if what == 0:
            del events[at]
            continue
        if what == 1:
            events.insert(rng.randrange(len(events)), events[at])
            continue
        if what == 2:
            time = max(0, lie(time, rng))
        elif what == 3:
            layout = layout[0], layout[1][:place] + layout[1][place + 1:]
            del values[place:place + 1]
        elif fields:
            values[place] = lie(values[place], rng)
        events[at] = layout, time, pid, tid, *values
    write_events(events, target)
    return lies


def events_of(path):
    """Return the events of a trace, as ``write_events`` receives them."""
    return [((layout.name, layout.fields), *event)
            for layout, *event in TraceReader(path).layout_events(None)]


def write_events(events, target, chunk=None):
    """Write events, a number of them into each chunk; all numbers have 64 bits."""
    with TraceFile(target, overwrite=True) as file:
        for place, ((name, names), time, pid, tid, *values) in enumerate(events, 1):
            provider, _, short = name.partition(':')
            key = file.define(EventType(provider, short, tuple(
                (field, {str: 'string', bool: 'bool'}.get(type(value), 'int64'))
                for field, value in zip(names, values))))
            file.extend(((key, time, tid, *values),), pid)
            if chunk is not None and place % chunk == 0:
                file.flush()

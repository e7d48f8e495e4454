# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The clocks of the machines of one run.

Theory of operation
-------------------
1. *Machines.*  A trace names the boot of its machine (``mddag:host``).  Older traces belong to one
   machine if their clocks differ by less than ``SAME_CLOCK``.
2. *Messages* show how clocks differ: the publisher's clock has the time of sending (the source
   timestamp), the receiver's clock the time of taking.  The minimum difference from A to B is the
   minimum transport plus the offset of B's clock; from B to A it is the minimum transport minus
   the offset.  So the offset is half their difference, and half their sum is its possible error.
3. A message counts if only one machine publishes its topic, and has recorded a publication at that
   time, within ``SAME_PUBLICATION``.  Otherwise it may be from elsewhere, or the clock was set.
4. Machines without messages in both directions are compared through other machines.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from mddag_executor.recording.columns import Ints
from mddag_executor.recording.joins import as_of, different, rows_by
from mddag_executor.trace import TraceReader
import numpy as np

SAME_CLOCK = 500_000_000
SAME_PUBLICATION = 10_000_000

_NODES = ('ros2:rcl_publisher_init', 'ros2:rcl_subscription_init')
_PUBLISH, _TAKE = 'ros2:rclcpp_publish', 'ros2:rmw_take'
_COLUMNS = {
    _PUBLISH: ('publisher_handle', 'timestamp'),
    _TAKE: ('rmw_subscription_handle', 'source_timestamp')}
"""The fields of events: the handle, and a time."""

Ways = dict[tuple[int, int], int]
"""By two machines the minimum time of a message from one to the other, by their clocks."""


class Offset(NamedTuple):
    """How far a clock is ahead of the first machine's, and the possible error, ns."""

    ahead: int
    uncertainty: int


def machines(clocks: Sequence[tuple[str, int]]) -> list[int]:
    """
    Return for each trace the first one that was recorded on the same machine (rule 1).

    :param clocks: by trace the boot of its machine, '': unknown, and the offset from its steady
        clock to its times.
    """
    found: list[int] = []
    for boot, offset in clocks:
        found.append(next(
            (i for i in found if (clocks[i][0] == boot if clocks[i][0] and boot
                                  else abs(clocks[i][1] - offset) < SAME_CLOCK)), len(found)))
    return found


class Messages:
    """
    The messages of a trace, by topic.

    :ivar sent: when they were published; ``taken``: source timestamps, and when they were taken.
    """

    def __init__(self, reader: TraceReader) -> None:
        made: dict[int, list[tuple[int, str]]] = defaultdict(list)
        found: dict[str, list[Ints]] = {_PUBLISH: [], _TAKE: []}
        for batch in reader.batches({*_NODES, _PUBLISH, _TAKE}):
            others = [event for _, event in batch.others if None not in event]
            for (name, *_), table, _ in batch.tables:
                if name in found:
                    found[name].append(_columns(*(
                        table[field] for field in ('timestamp', *_COLUMNS[name]))))
                else:
                    others += [(name, *row) for row in table.tolist()]
            for event in others:
                if event[0] in _NODES:
                    made[event[4]].append((event[1], event[7]))
                else:
                    stamp = event[6] if event[0] == _TAKE else event[1]
                    found[event[0]].append(_columns(
                        *([value] for value in (event[1], event[4], stamp))))
        self.sent = {topic: np.sort(rows[0]) for topic, rows in _by_topic(
            found[_PUBLISH], made)}
        self.taken = {topic: rows[[2, 0]].T for topic, rows in _by_topic(found[_TAKE], made)}


def _columns(time: Any, handle: Any, stamp: Any) -> Ints:
    """Return events as three rows of numbers."""
    return np.array([np.asarray(each).astype(np.int64) for each in (time, handle, stamp)])


def _by_topic(
    parts: Sequence[Ints], made: Mapping[int, list[tuple[int, str]]]
) -> Iterator[tuple[str, Ints]]:
    """
    Yield the topics of events, and the events of each.

    :param made: by handle when it was initialised, and its topic.
    """
    events = np.concatenate([np.empty((3, 0), dtype=np.int64), *parts], axis=1)
    handles, which = different(events[1])
    found: dict[str, list[Ints]] = defaultdict(list)
    for handle, mine in zip(handles.tolist(), rows_by(which, len(handles))):
        inits = sorted(made.get(handle, ()))
        newest = as_of([time for time, _ in inits], events[0, mine])
        for number, (_, topic) in enumerate(inits):
            found[topic].append(events[:, mine[newest == number]])
    for topic, each in found.items():
        rows = np.concatenate(each, axis=1)
        if rows.shape[1]:
            yield topic, rows


def ways(traces: Sequence[Messages], machine: Sequence[int], shifts: Sequence[int]) -> Ways:
    """
    Return the minimum times of messages from machine to machine (rules 2 and 3).

    :param machine: of each trace; ``shifts``: offset from each trace to its machine's clock.
    """
    publishers: dict[str, set[int]] = defaultdict(set)
    for trace, of in zip(traces, machine):
        for topic in trace.sent:
            publishers[topic].add(of)
    found: Ways = {}
    for i, one in enumerate(traces):
        for topic in (topic for topic in one.sent if len(publishers[topic]) == 1):
            for j, other in enumerate(traces):
                if machine[i] == machine[j] or topic not in other.taken:
                    continue
                stamps, times = other.taken[topic].T
                times = (times - stamps)[_near(one.sent[topic], stamps)]
                if len(times):
                    way, least = (machine[i], machine[j]), int(times.min()) + shifts[j] - shifts[i]
                    found[way] = min(found.get(way, least), least)
    return found


def _near(sent: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """Return which stamps are near a publication."""
    after = np.searchsorted(sent, stamps)
    away = np.minimum(
        np.abs(stamps - sent[np.minimum(after, len(sent) - 1)]),
        np.abs(stamps - sent[np.maximum(after - 1, 0)]))
    near: np.ndarray = away <= SAME_PUBLICATION
    return near


def offsets(
    of: Iterable[int], found: Ways, given: Mapping[int, int]
) -> dict[int, Offset]:
    """
    Return the offsets of machines from machine 0, given or measured (rules 2 and 4).

    :param given: known offsets, by machine.
    :return: without unknown offsets.
    """
    known = {0: Offset(0, 0), **{machine: Offset(ahead, 0) for machine, ahead in given.items()}}
    for _ in set(of):
        for (a, b), there in found.items():
            if a in known and (b, a) in found and b not in given and b != 0:
                back = found[b, a]
                now = Offset(known[a].ahead + (there - back) // 2,
                             known[a].uncertainty + (abs(there + back) + 1) // 2)
                if b not in known or now.uncertainty < known[b].uncertainty:
                    known[b] = now
    return known


def said(offset: Offset | None, there: int | None, name: str) -> str:
    """
    Return the warning about the clock of another machine.

    :param there: the minimum time of a message to it, None without messages.
    """
    if offset is None:
        early = '' if there is None or there >= 0 else (
            f', though messages come there {-there / 1e6:.3f} ms before they are sent')
        return (f'no messages went both ways, so its clock is assumed to be synchronised{early}: '
                f'give --offset {name}=TIME if it was not')
    ahead = 'behind' if offset.ahead < 0 else 'ahead'
    return (f'its clock is taken to be {abs(offset.ahead) / 1e6:.3f} ms {ahead}, within '
            f'{offset.uncertainty / 1e6:.3f} ms, by the messages both ways')

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The clocks of the machines that the traces of one run come from.

Theory of operation
-------------------
1. *Machines.*  A trace says in which boot of which machine it was recorded (``mddag:host``).  Of
   older traces those are of one machine whose clocks differ by less than ``SAME_CLOCK``.
2. *Messages* show how clocks differ: the publisher's says when one was sent (the source
   timestamp), the receiver's when it was taken.  The least of these times from A to B is the
   least transport plus the offset of B's clock, and that from B to A the least transport minus
   it.  So half their difference is the offset, and half their sum how far that may be wrong.
3. A message counts where one machine only publishes its topic, and has recorded a publication
   at that time, to ``SAME_PUBLICATION``: else it may be a stranger's, or the clock was set
   meanwhile.
4. Machines between which messages do not go both ways are compared by way of others.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from mddag_executor.trace import TraceReader
import numpy as np

SAME_CLOCK = 500_000_000
SAME_PUBLICATION = 10_000_000

HOST = 'mddag:host'
_NODES = ('ros2:rcl_publisher_init', 'ros2:rcl_subscription_init')
_PUBLISH, _TAKE = 'ros2:rclcpp_publish', 'ros2:rmw_take'

Ways = dict[tuple[int, int], int]
"""By two machines the least time of a message from one to the other, by their clocks."""


class Offset(NamedTuple):
    """How far a clock is ahead of the first machine's, and how far that may be wrong, ns."""

    ahead: int
    uncertainty: int


def machines(clocks: Sequence[tuple[str, int]]) -> list[int]:
    """
    Return for each trace the first one that was recorded on the same machine (rule 1).

    :param clocks: of each the boot of its machine, '' where that is not known, and what turns its
        steady clock to its times.
    """
    found: list[int] = []
    for boot, offset in clocks:
        found.append(next(
            (i for i in found if (clocks[i][0] == boot if clocks[i][0] and boot
                                  else abs(clocks[i][1] - offset) < SAME_CLOCK)), len(found)))
    return found


class Messages:
    """
    What a trace says of messages, by topic.

    :ivar sent: when they were published; ``taken``: source timestamps, and when they were taken.
    """

    def __init__(self, reader: TraceReader) -> None:
        topics: dict[int, str] = {}
        sent: dict[str, list[int]] = defaultdict(list)
        taken: dict[str, list[tuple[int, int]]] = defaultdict(list)
        for event in reader.events({*_NODES, _PUBLISH, _TAKE}, sorted=True):
            if None in event:
                continue
            if event[0] in _NODES:
                topics[event[4]] = event[7]
            elif event[4] in topics and event[0] == _PUBLISH:
                sent[topics[event[4]]].append(event[1])
            elif event[4] in topics:
                taken[topics[event[4]]].append((event[6], event[1]))
        self.sent = {topic: np.array(times) for topic, times in sent.items()}
        self.taken = {topic: np.array(pairs) for topic, pairs in taken.items()}


def ways(traces: Sequence[Messages], machine: Sequence[int], shifts: Sequence[int]) -> Ways:
    """
    Return the least times of messages from machine to machine (rules 2 and 3).

    :param machine: of each trace; ``shifts``: what puts each on its machine's clock.
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
    """Return which stamps are near one of the times at which something was sent."""
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
    Return the offsets of machines from machine 0: as given, or as messages show (rules 2 and 4).

    :param given: those that are known, by machine.
    :return: without those that are not known.
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
    Return what there is to say of the clock of another machine.

    :param there: the least time of a message to it, None where there was none.
    """
    if offset is None:
        early = '' if there is None or there >= 0 else (
            f', though messages come there {-there / 1e6:.3f} ms before they are sent')
        return (f'no messages went both ways, so its clock is taken as synchronised{early}: give '
                f'--offset {name}=TIME if it was not')
    ahead = 'behind' if offset.ahead < 0 else 'ahead'
    return (f'its clock is taken to be {abs(offset.ahead) / 1e6:.3f} ms {ahead}, within '
            f'{offset.uncertainty / 1e6:.3f} ms, by the messages both ways')

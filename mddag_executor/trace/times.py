# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds impossible times in recordings; the only rule for traces and ordinary bags.

Theory of operation
-------------------
One flipped bit can move a time by years; a program that uses it waits for years.

1. A time before 1970 or at or after `NEVER` (2116) is impossible.

The other rules are for bags, whose messages are in the order of recording.  A trace records an
execution at its end, so its start may be any time before neighbouring events; but chunks of a
trace have checksums.

2. The remaining times, in the order of the file, are grouped: times at most `GAP_NS` from the next
   belong to one group.  Most recordings have one group; pauses and rare messages cause several,
   one after the other.
3. A group is stray if it is much smaller (`FEW`) than the largest, and either is between others in
   the file but not in time, or is `FAR_NS` or more from the largest.  Its times are impossible.
4. Groups that are not stray but out of order in the file are jumps of the clock: they are used and
   reported.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

from mddag_executor.text import counted
from msg_graph import format_duration
import numpy as np

NEVER = 2 ** 62
GAP_NS = 60 * 1_000_000_000
FAR_NS = 366 * 24 * 3600 * 1_000_000_000
FEW = 8         # times smaller


class Times:
    """
    Checks times, and counts odd ones.

    :ivar left_out: number of impossible times.
    :ivar jumps: number of backward jumps of the clock; `furthest`: the largest one, ns.
    """

    def __init__(self) -> None:
        self.left_out = 0
        self.jumps = 0
        self.furthest = 0
        self._example = 0

    def _leave_out(self, times: Any) -> None:
        if len(times) and not self.left_out:
            self._example = int(times[0])
        self.left_out += len(times)

    def impossible(self, times: Sequence[int]) -> list[int]:
        """Return the positions of impossible times of one bag, ascending."""
        if not len(times) or _plain(min(times), max(times)):
            return []
        array = np.array([min(max(int(time), -1), NEVER) for time in times], dtype=np.int64)
        wrong = (array < 0) | (array >= NEVER)
        for group in self._stray(array, np.flatnonzero(~wrong)):
            wrong[group] = True
        found: list[int] = np.flatnonzero(wrong).tolist()
        self._leave_out([times[place] for place in found])
        back = -np.diff(array[~wrong])
        back = back[back > GAP_NS]
        self.jumps += len(back)
        self.furthest = max(self.furthest, *back.tolist(), 0)
        return found

    def _stray(self, times: Any, places: Any) -> list[Any]:
        """Return the stray groups, as positions."""
        groups = grouped(times, places)
        sizes = [len(group) for group in groups]
        if len(groups) < 2:
            return []
        largest = groups[max(range(len(groups)), key=sizes.__getitem__)]
        before, after = int(times[largest[0]]) - FAR_NS, int(times[largest[-1]]) + FAR_NS
        stray = []
        # groups in the order of the file so far: number, first and last position
        kept: list[tuple[int, int, int]] = []
        for number in sorted(range(len(groups)), key=lambda n: -sizes[n]):
            group = groups[number]
            first, last = int(group.min()), int(group.max())
            at = bisect_left(kept, (number,))
            fits = (at == 0 or kept[at - 1][2] < first) and (
                at == len(kept) or last < kept[at][1])
            near = before < int(times[group[0]]) and int(times[group[-1]]) < after
            if sizes[number] * FEW <= len(largest) and not (fits and near):
                stray.append(group)
            elif fits:
                kept.insert(at, (number, first, last))
        return stray

    def lines(self, noun: str) -> list[str]:
        """Return warnings about odd times."""
        found = []
        if self.left_out:
            found.append(f'left out: {counted(self.left_out, noun)} at an impossible time, the '
                         f'first at {self._example} ns')
        if self.jumps:
            found.append(f'the clock jumps back {counted(self.jumps, "time")} in it, by '
                         f'{format_duration(self.furthest)} at most')
        return found


def credible(stamp: int, arrival: int) -> bool:
    """Return whether a stamp fits a time of arrival: not years before it."""
    return 0 < stamp and arrival - stamp < FAR_NS


def _plain(least: int, greatest: int) -> bool:
    """Return whether all times in a range are possible, and of one group."""
    return 0 <= least and greatest < NEVER and greatest - least <= GAP_NS


def grouped(times: Any, places: Any) -> list[Any]:
    """Return the positions of times as groups without a gap, in the order of time (rule 2)."""
    order = places[np.argsort(times[places], kind='stable')]
    return list(np.split(order, np.flatnonzero(np.diff(times[order]) > GAP_NS) + 1))


def joined(several: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return ranges in the order of time, with adjacent ones joined."""
    found: list[tuple[int, int]] = []
    for start, end in sorted(several):
        if found and start - found[-1][1] <= GAP_NS:
            start, end = found[-1][0], max(end, found.pop()[1])
        found.append((start, end))
    return found


def stretches(times: Sequence[int]) -> list[tuple[int, int]]:
    """Return the ranges of times without a gap, in the order of time."""
    array = np.array(times, dtype=np.int64)
    if not len(array):
        return []
    return [(int(array[group[0]]), int(array[group[-1]]))
            for group in grouped(array, np.arange(len(array)))]

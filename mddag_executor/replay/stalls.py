# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Stalls: times in which no thread of the process ran though something was ready or running.

Theory of operation
-------------------
The executor itself notices stops of the machine while it spins, and records them (``stop``).  It
does so up to a slice late, so such a stall begins with the last event before.

The rest of a trace is searched.  Where nothing at all was recorded for ``LEAST_NS`` or longer, it
was a stall, unless the executor would have noticed that and did not,

* if nothing ran, but a callback was ready all the while, or a timer was due and nobody noticed;
* if something ran, a timer was due and nobody noticed, and all that ran took longer than usual by
  most of that time;
* if several callbacks ran, and each took longer than usual by just about that time.

A single callback that runs long while nothing else was to be done looks the same as a stop in the
middle of it, and counts as running long.
"""

from __future__ import annotations

from mddag_executor.core.stops import LEAST_NS
from mddag_executor.replay.happenings import Ints
import numpy as np

_UNNOTICED_NS = 10_000_000
_MOST, _ABOUT = 0.75, 1.25


class Spans:
    """
    Spans from starts to ends, ns.

    Sums of times may exceed 64 bits.  They wrap around, as numpy's integers do; the difference of
    two of them, a length of time, is exact all the same.
    """

    def __init__(self, starts: Ints, ends: Ints) -> None:
        self._starts, self._ends = np.sort(starts), np.sort(ends)
        self._sums = [np.r_[0, np.cumsum(each)] for each in (self._starts, self._ends)]

    def within(self, begins: Ints, ends: Ints) -> Ints:
        """Return how long they lasted within each span of time, added up, ns."""
        found: Ints = np.maximum(0, self._before(ends) - self._before(begins))
        return found

    def _before(self, times: Ints) -> Ints:
        total = np.zeros(len(times), dtype=np.int64)
        for sign, each, sums in zip((1, -1), (self._starts, self._ends), self._sums):
            number = np.searchsorted(each, times, 'right')
            total += sign * (times * number - sums[number])
        return total


def crowded(starts: Ints, ends: Ints, least: int) -> tuple[Ints, Ints]:
    """Return the starts and ends of the times at which at least so many spans last."""
    times = np.concatenate([starts, ends])
    step = np.repeat([1, -1], len(starts))
    order = np.lexsort((step, times))       # at one instant what ends goes first
    times, count = times[order], np.cumsum(step[order])
    full = count >= least
    before = np.r_[False, full[:-1]]
    return times[full & ~before], times[~full & before]


class Stretch:
    """
    What is known of a stretch of a run.

    :ivar times: of all events.
    :ivar timers: releases of timers, and when they were noticed.
    :ivar started: executions: ready and start.
    :ivar ran: pieces: start, end, and how much longer than usual they took.
    :ivar stops: as recorded: begin and end.
    :ivar noticed: from then on stops are recorded.
    """

    def __init__(
        self, times: Ints, timers: Ints, started: Ints, ran: Ints, stops: Ints,
        noticed: int,
    ) -> None:
        self.times = np.sort(times)
        self.timers = timers[timers[:, 1] - timers[:, 0] >= _UNNOTICED_NS]
        self.started = started[started[:, 1] - started[:, 0] >= LEAST_NS]
        self.ran, self.stops, self.noticed = ran, stops, noticed

    def suspicious(self) -> Spans:
        """Return the times within which there may be stalls that are not recorded."""
        long = self.ran[self.ran[:, 2] >= _MOST * LEAST_NS]
        starts, ends = np.concatenate(
            [self.timers, self.started, long[:, :2]]).reshape(-1, 2).T
        return Spans(starts, ends)


def find(stretch: Stretch, since: int, until: int) -> list[tuple[int, int]]:
    """Return begin and end of the stalls that ended within a time, in order."""
    stops, times = stretch.stops[stretch.stops[:, 0] < stretch.stops[:, 1]], stretch.times
    found = [_widened(times, begin, end) for begin, end in stops.tolist()
             if since < end <= until and end - begin >= LEAST_NS]
    gaps = np.flatnonzero(np.diff(times) >= LEAST_NS)
    gaps = gaps[(times[gaps + 1] > since) & (times[gaps + 1] <= until)]
    if len(gaps):
        gaps = gaps[stretch.suspicious().within(times[gaps], times[gaps + 1]) > 0]
    for gap in gaps.tolist():
        begin, end = int(times[gap]), int(times[gap + 1])
        if any(first < end and begin < last for first, last in found):
            continue
        if stretch.noticed <= begin and not ((stops[:, 0] < end) & (stops[:, 1] > begin)).any():
            continue
        stalled = _begin(stretch, begin, end)
        if stalled is not None and end - stalled >= LEAST_NS:
            found.append((stalled, end))
    return sorted(found)


def _widened(times: Ints, begin: int, end: int) -> tuple[int, int]:
    """Return a recorded stop from the event before it, if that is near."""
    before = int(np.searchsorted(times, begin, 'right')) - 1
    last = int(times[before]) if before >= 0 else begin
    return (last if begin - last <= LEAST_NS else begin), end


def _begin(stretch: Stretch, begin: int, end: int) -> int | None:
    """Return when the stall began that a time without any event was, None if it was none."""
    release, noticed = stretch.timers.T
    due = release[(release > begin) & (release <= end - _UNNOTICED_NS) & (noticed >= end)]
    start, ended, more = stretch.ran.T
    ran = (start <= begin) & (ended >= end)
    length = end - begin
    if ran.any():
        long = more[ran] >= _MOST * length
        if not long.all():
            return None
        several = ran.sum() > 1 and bool((more[ran] <= _ABOUT * length).all())
        return begin if len(due) or several else None
    ready, begun = stretch.started.T
    if ((ready <= begin) & (begun >= end)).any():
        return begin
    return int(due.min()) if len(due) else None

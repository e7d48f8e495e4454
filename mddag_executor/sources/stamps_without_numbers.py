# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds the publications of messages by their source timestamps, in traces without numbers.

Traces of version 2 have no numbers of messages.  A publication that was being sent at a timestamp
and has no message yet gets it, in the order in which the messages were taken; if there are
several, the publication is unknown.
"""

from __future__ import annotations

from bisect import bisect_right

from mddag_executor.recording.columns import Ints
import numpy as np

ROUNDING_NS = 1_000
"""Rounding of the two clocks that timestamp and publication are read from."""
UNSENT = 256
"""Number of publications of a topic without a timestamp that are compared."""


class BeingSent:
    """
    The publications of a topic in the order of time.

    :ivar stamps: their source timestamps; 0: unknown.
    """

    def __init__(self, times: list[int], ends: list[int]) -> None:
        self.stamps = [0] * len(times)
        self._times, self._ends = times, ends
        #: By publication the last one before it that was being sent longer, or -1.
        self._longer: list[int] = []
        for place, end in enumerate(ends):
            before = place - 1
            while before >= 0 and ends[before] <= end:
                before = self._longer[before]
            self._longer.append(before)

    def being_sent(self, stamp: int) -> list[int]:
        """Return the publications without timestamp that were being sent at a time."""
        last = bisect_right(self._times, stamp + ROUNDING_NS)
        least, begun = last - UNSENT, stamp - ROUNDING_NS
        fits, place = [], last - 1
        while place >= max(0, least):
            if self._ends[place] < begun:
                place = self._longer[place]     # all between them had ended before
                continue
            if not self.stamps[place]:
                fits.append(place)
            place -= 1
        return fits


def find_in_order(begins: Ints, ends: Ints, stamps: Ints) -> tuple[Ints, list[int]]:
    """Return the same as ``stamps.find_stamps``."""
    published = BeingSent(begins.tolist(), ends.tolist())
    several = []
    for stamp in stamps.tolist():
        fits = published.being_sent(stamp)
        if len(fits) == 1:
            published.stamps[fits[0]] = stamp
        elif fits:
            several.append(stamp)
    return np.array(published.stamps, dtype=np.int64), several

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds the publications of messages by their source timestamps and numbers.

Theory of operation
-------------------
1. A publication is being sent from when it begins until its thread publishes again or ends its
   callback.  The source timestamp of its message is in this time.  It has one message: of several
   the first that was taken.
2. If only one publication of the topic was being sent at a timestamp, the message is its.
3. Otherwise the message is of a publication that has no message by rule 2.  If there are several,
   the number of the message decides.  The middleware numbers the messages of each publisher one
   after the other.  Publications outside callbacks are numbered, but not recorded, so the
   difference between the number of a message and the position of its publication grows from one
   message to the next, or stays.  The messages of rule 2 before and after it are its bounds.
4. If not exactly one publication is possible, the publication of the message is unknown.

Traces of version 2 have no numbers: ``stamps_without_numbers``.
"""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.recording.columns import Ints, Mask
from mddag_executor.recording.joins import different, rows_by
from mddag_executor.sources.stamps_without_numbers import find_in_order, ROUNDING_NS, UNSENT
import numpy as np

_AT_ONCE = 4096
"""Messages whose publications are compared at once, which bounds the memory."""


class Sent(NamedTuple):
    """The publications of a topic in the order of time, each with its publisher."""

    begins: Ints
    ends: Ints
    publisher: Ints


def find_stamps(sent: Sent, stamps: Ints, numbers: Ints) -> tuple[Ints, list[int]]:
    """
    Return by publication the source timestamp of its message (0: unknown), and doubtful ones.

    :param stamps: different timestamps, in the order in which their messages were taken.
    :param numbers: the numbers of the messages; 0: unknown.
    :return: the second list has the timestamps for which several publications are possible.
    """
    begun = np.searchsorted(sent.begins, stamps + ROUNDING_NS, 'right')
    by_end = np.argsort(sent.ends, kind='stable')
    ended = np.searchsorted(sent.ends[by_end], stamps - ROUNDING_NS, 'left')
    several = begun - ended > 1
    if (several & (numbers <= 0)).any():
        return find_in_order(sent.begins, sent.ends, stamps)
    # of all that had begun, all but one had ended: it is the difference of sums of positions
    sums = (np.append(0, np.cumsum(each)) for each in (np.arange(len(by_end)), by_end))
    first, last = (each[at] for each, at in zip(sums, (begun, ended)))
    which = np.where(begun - ended == 1, first - last, -1)
    mine = np.flatnonzero(which >= 0)[::-1]
    found = np.zeros(len(sent.begins), dtype=np.int64)
    found[which[mine]] = stamps[mine]       # the first one is written last
    if not several.any():
        return found, []
    # before this one all had ended
    first = np.searchsorted(np.maximum.accumulate(sent.ends), stamps - ROUNDING_NS, 'left')
    first = np.maximum(first, begun - UNSENT)
    may_have = _Numbers(sent.publisher, which, numbers)
    unknown = list[int]()
    doubtful = np.flatnonzero(several)
    for at in range(0, len(doubtful), _AT_ONCE):
        asked = doubtful[at:at + _AT_ONCE]
        counts = begun[asked] - first[asked]
        of = np.repeat(np.arange(len(asked)), counts)
        place = np.arange(len(of)) + np.repeat(first[asked] + counts - np.cumsum(counts), counts)
        fits = (found[place] == 0) & (sent.ends[place] >= stamps[asked][of] - ROUNDING_NS)
        of, place = of[fits], place[fits]
        possible = may_have(place, numbers[asked][of])
        pairs = list(zip(place.tolist(), possible.tolist()))
        ends = np.searchsorted(of, np.arange(len(asked)), 'right').tolist()
        given = dict[int, int]()
        for stamp, begin, end in zip(stamps[asked].tolist(), [0, *ends], ends):
            left = [pair for pair in pairs[begin:end] if pair[0] not in given]
            if len(left) > 1:
                left = [pair for pair in left if pair[1]]
            if len(left) == 1:
                given[left[0][0]] = stamp
            else:
                unknown.append(stamp)
        found[list(given)] = list(given.values())
    return found, unknown


class _Numbers:
    """
    The numbers of messages whose publications are known, by publisher (rule 3).

    :param which: by message its publication, -1: unknown.
    """

    def __init__(self, publisher: Ints, which: Ints, numbers: Ints) -> None:
        publishers, self._publisher = different(publisher)
        self._place = np.zeros(len(publisher), dtype=np.int64)
        self._known: list[tuple[Ints, Ints]] = []
        messages, n = np.flatnonzero(which >= 0), len(publishers)
        for mine, some in zip(rows_by(self._publisher, n), rows_by(
                self._publisher[which[messages]], n)):
            self._place[mine], some = np.arange(len(mine)), messages[some]
            some = some[np.argsort(numbers[some], kind='stable')]
            self._known.append((numbers[some], numbers[some] - self._place[which[some]]))

    def __call__(self, places: Ints, numbers: Ints) -> Mask:
        """Return whether the messages of publications may have numbers."""
        found = np.zeros(len(places), dtype=np.bool_)
        by_publisher = rows_by(self._publisher[places], len(self._known))
        for (known, away), mine in zip(self._known, by_publisher):
            at, here = np.searchsorted(known, numbers[mine]), numbers[mine] - self._place[
                places[mine]]
            least, most = np.append(here.min(initial=0), away), np.append(
                away, here.max(initial=0))
            found[mine] = (here >= least[at]) & (here <= most[at])
        return found

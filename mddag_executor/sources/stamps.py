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

from mddag_executor.recording.columns import Ints
from mddag_executor.recording.joins import distinct
from mddag_executor.sources.stamps_without_numbers import (
    BeingSent,
    find_in_order,
    ROUNDING_NS,
)
import numpy as np


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
    may_have = _Numbers(sent.publisher, which, numbers)
    sending = BeingSent(sent.begins.tolist(), sent.ends.tolist())
    sending.stamps = found.tolist()
    unknown = []
    for stamp, number in zip(stamps[several].tolist(), numbers[several].tolist()):
        fits = sending.being_sent(stamp)
        if len(fits) > 1:
            fits = [place for place in fits if may_have(place, number)]
        if len(fits) == 1:
            sending.stamps[fits[0]] = stamp
        else:
            unknown.append(stamp)
    return np.array(sending.stamps, dtype=np.int64), unknown


class _Numbers:
    """
    The numbers of messages whose publications are known, by publisher (rule 3).

    :param which: by message its publication, -1: unknown.
    """

    def __init__(self, publisher: Ints, which: Ints, numbers: Ints) -> None:
        self._publisher = publisher.tolist()
        self._place = np.zeros(len(publisher), dtype=np.int64)
        self._known: dict[int, tuple[Ints, Ints]] = {}
        messages = np.flatnonzero(which >= 0)
        of = publisher[which[messages]]
        for each in distinct(publisher).tolist():
            mine, some = np.flatnonzero(publisher == each), messages[of == each]
            self._place[mine] = np.arange(len(mine))
            some = some[np.argsort(numbers[some], kind='stable')]
            self._known[each] = numbers[some], numbers[some] - self._place[which[some]]

    def __call__(self, place: int, number: int) -> bool:
        """Return whether the message of a publication may have a number."""
        numbers, away = self._known[self._publisher[place]]
        at, mine = int(np.searchsorted(numbers, number)), number - self._place[place]
        return bool((at == 0 or mine >= away[at - 1]) and (at == len(away) or mine <= away[at]))

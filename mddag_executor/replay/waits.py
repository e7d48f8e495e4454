# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How long callbacks waited for their mutually exclusive group."""

from __future__ import annotations

from collections import deque
from itertools import islice

from mddag_executor.replay.happenings import Batch, Ints, Observer, RAN
from mddag_executor.trace.census import Census
import numpy as np

_KEEP = 256


class GroupWaits(Observer):
    """
    Finds out how much of each wait was for the callback group: while another of it ran.

    Told before those who ask it.

    :ivar found: of the last batch: by piece, how long its group was busy, ns.
    """

    def __init__(self, who: Census) -> None:
        self._who = who
        # by group what ran in it last: start and end
        self._busy: dict[int, deque[tuple[int, int]]] = {}
        self.found: Ints = np.empty(0, dtype=np.int64)

    def take(self, batch: Batch) -> None:
        """Look how long pieces of executions waited."""
        pieces = batch.columns(RAN)
        self.found = np.zeros(len(pieces), dtype=np.int64)
        number = self._who.groups()
        if not len(pieces) or not number:
            return
        callbacks, which = np.unique(pieces[:, 0], return_inverse=True)
        group = np.array([number.get(callback, -1) for callback in callbacks.tolist()])[which]
        rows = np.flatnonzero(group >= 0)
        rows = rows[np.argsort(group[rows], kind='stable')]
        begins = np.flatnonzero(np.r_[True, group[rows][1:] != group[rows][:-1]])
        for mine in np.split(rows, begins[1:]) if len(rows) else ():
            self._take_group(int(group[mine[0]]), mine, pieces[mine])

    def _take_group(self, group: int, rows: Ints, pieces: Ints) -> None:
        """Look at the pieces of a group, in order."""
        before = self._busy.setdefault(group, deque(maxlen=_KEEP))
        n = len(before)
        busy = [*before, *zip(pieces[:, 6].tolist(), pieces[:, 7].tolist())]
        ready = pieces[:, 5]
        ended = np.r_[before[-1][1] if before else -1, pieces[:-1, 7]]
        # only where the one before ended after this one was ready
        for i in np.flatnonzero((ended > ready) & (pieces[:, 8] != 0)).tolist():
            since, start, waited = int(ready[i]), busy[n + i][0], 0
            for begun, end in islice(reversed(busy[max(0, n + i - _KEEP):n + i]), _KEEP):
                if end <= since:
                    break
                waited += max(0, min(end, start) - max(begun, since))
            self.found[rows[i]] = waited
        before.extend(busy[max(n, len(busy) - _KEEP):])

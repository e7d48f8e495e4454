# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How long callbacks waited for their mutually exclusive group."""

from __future__ import annotations

from collections import deque

from mddag_executor.replay.follower import Observer, Piece
from mddag_executor.replay.groups import RecordedGroups

_KEEP = 256


class GroupWaits(Observer):
    """
    Finds out how much of each wait was for the callback group: while another of it ran.

    Told before those who ask it for ``last``.
    """

    def __init__(self, groups: RecordedGroups) -> None:
        self._groups = groups
        self._busy: dict[int, deque[tuple[int, int]]] = {}
        #: Of the piece that was told last: how long its group was busy while it waited, ns.
        self.last = 0

    def ran(self, piece: Piece) -> None:
        """Take in a piece of an execution."""
        self.last = 0
        group = self._groups.by_callback().get(piece.callback, -1)
        if group < 0:
            return
        busy = self._busy.setdefault(group, deque(maxlen=_KEEP))
        if piece.first:
            for start, end in reversed(busy):
                if end <= piece.ready:
                    break
                self.last += max(0, min(end, piece.start) - max(start, piece.ready))
        busy.append((piece.start, piece.end))

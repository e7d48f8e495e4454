# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Everything that has to be done at a time: timers, deadlines, checks and calls.

All times are ns of the monotonic clock. ``NEVER`` is later than all of them: nothing is due.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heapify, heappop, heappush
from typing import Any, Protocol

from mddag_executor.core import NEVER

CLEAN_EVERY = 16
"""Each time that this many appointments (a power of two) were set, cancelled ones are removed."""


class Appointment(Protocol):
    """
    Something that is done at a time, and may be set for another time before that.

    :ivar entry: belongs to the agenda; None at first.
    """

    entry: list[Any] | None

    def come_due(self) -> None:
        """Do it."""


class Agenda:
    """
    A heap of appointments by the time at which each is due, and the same by its latest time.

    While a thread waits for events, it wakes up for each appointment when it is due.  While a
    callback computes, no thread waits, and it is enough to notice each until its latest time.  All
    methods need one lock.

    :ivar next: when the next appointment is due.
    :ivar latest: until when one must be noticed.
    """

    def __init__(self) -> None:
        # An appointment that is cancelled empties its entry, which both heaps refer to.  The first
        # entry of neither heap is empty, except in ``handle``.
        self._heap: list[tuple[int, int, list[Any]]] = []
        self._latest: list[tuple[int, int, list[Any]]] = []
        self._entries = 0
        self._appointments = 0
        self.next = self.latest = NEVER

    def __len__(self) -> int:
        """Return how many entries the larger heap has, with cancelled ones."""
        return max(len(self._heap), len(self._latest))

    def set(self, appointment: Appointment, at: int, latest: int) -> None:
        """Set an appointment, which may be set already, for a time."""
        if appointment.entry:
            self.cancel(appointment)
        self._appointments += 1
        number = self._entries = self._entries + 1
        entry = appointment.entry = [appointment]
        heappush(self._heap, (at, number, entry))
        heappush(self._latest, (latest, number, entry))
        if at < self.next:
            self.next = at
        if latest < self.latest:
            self.latest = latest
        if not number & CLEAN_EVERY - 1:
            self._clean()

    def _clean(self) -> None:
        """Remove cancelled entries if there are many."""
        most = 2 * self._appointments + 8
        if len(self._heap) > most:
            self._heap = _without_cancelled(self._heap)
        if len(self._latest) > most:
            self._latest = _without_cancelled(self._latest)

    def cancel(self, appointment: Appointment) -> None:
        """Cancel an appointment, if it is set."""
        if appointment.entry:
            appointment.entry.clear()
            self._appointments -= 1
            self._note_first()

    def _note_first(self) -> None:
        """Remove cancelled entries from the front, and note the first times."""
        heap = self._heap
        while heap and not heap[0][2]:
            heappop(heap)
        self.next = heap[0][0] if heap else NEVER
        heap = self._latest
        while heap and not heap[0][2]:
            heappop(heap)
        self.latest = heap[0][0] if heap else NEVER

    def handle(self, clock: Callable[[], int]) -> None:
        """
        Let each appointment come due that is due, in order, except what is set meanwhile.

        :param clock: returns the time.
        """
        last = self._entries
        try:
            while self._heap:  # another list after many changes
                at, number, entry = self._heap[0]
                if entry:
                    if number > last or at > clock():
                        break
                    appointment: Appointment = entry.pop()
                    self._appointments -= 1
                    heappop(self._heap)
                    appointment.come_due()
                else:
                    heappop(self._heap)
        finally:
            self._note_first()


def _without_cancelled(heap: list[tuple[int, int, list[Any]]]) -> list[tuple[int, int, list[Any]]]:
    rest = [each for each in heap if each[2]]
    heapify(rest)
    return rest

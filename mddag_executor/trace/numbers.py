# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Unique process and thread ids for several computers or containers in one recording.

Linux assigns ids per computer and container, so two of them may have the same id.
"""

from __future__ import annotations

from collections.abc import Hashable

_LINUX_IDS = 1 << 22    # Linux numbers processes and threads below this


class Numbers:
    """Ids of processes, or of threads: each belongs to one place."""

    def __init__(self) -> None:
        self._given: dict[tuple[Hashable, int], int] = {}
        self._used: set[int] = set()

    def of(self, place: Hashable, number: int) -> int:
        """Return the unique id for an id of a place: the same if no other place has it."""
        found = self._given.get((place, number))
        if found is None:
            found = number
            while found in self._used:
                found += _LINUX_IDS
            self._given[place, number] = found
            self._used.add(found)
        return found

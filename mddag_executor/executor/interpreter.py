# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Who holds the interpreter (the GIL), and when what waits may overtake it (``core.rules``, rule 10).

Executions that hold it form a chain: each one overtook the one before, and only the latest
computes.  If an overtaken one is urged (``core.rules``, rule 4), it may overtake the later ones.
All times are ns on the trace's clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mddag_executor.core import Tables
from mddag_executor.core.queues import (
    first_of,
    first_waiting,
    has_place,
    overtaking_pays,
    overtaking_pays_from,
)
from mddag_executor.core.state import N_IDLE, State
from mddag_executor.executor.bounds import (
    LEAST_PATIENCE_NS,
    MOST,
    PATIENCE_NS,
    PATIENCE_PART,
)

if TYPE_CHECKING:
    from mddag_executor.executor.work import Work


class Interpreter:
    """
    The executions that hold the interpreter, and what waits for it; changed by the engine only.

    :ivar holders: those that hold it, the most urgent one last.
    :ivar pauses: whether a callback pauses while a more urgent one overtakes it.
    """

    def __init__(self, tables: Tables, state: State) -> None:
        self._tables = tables
        self._state = state
        self.holders: list[Work] = []
        self.pauses = False
        # by vertex: see ``patience``
        self._patience = [
            min(PATIENCE_NS, max(LEAST_PATIENCE_NS, offset // PATIENCE_PART))
            for offset in tables.rad_offset]

    @property
    def holder(self) -> Work | None:
        """Return the most urgent execution that holds it."""
        return self.holders[-1] if self.holders else None

    @property
    def overtaken(self) -> list[Work]:
        """Return the executions that hold it but were overtaken."""
        return self.holders[:-1]

    def reorder(self) -> None:
        """Put those that hold it into the order of their urgency, which may have changed."""
        keys = self._state.x_key
        self.holders.sort(key=lambda work: -keys[work.x][0])

    def is_wanted(self) -> bool:
        """Return whether anything waits while an execution holds it."""
        return bool(self.holders) and has_waiting(self._state)

    def patience(self) -> int:
        """Return how long what is ready may wait for a callback that was expected to end, ns."""
        state = self._state
        x = first_waiting(state)
        # that of the vertex whose deadline it has or inherits; -1: the default one, which is last
        return self._patience[-1 if x < 0 else state.x_like[x]]

    def may_be_overtaken(self, now: int) -> bool:
        """Return whether the first waiting execution may overtake the latest holder."""
        work = self.holders[-1]
        return overtaking_pays(
            self._tables, self._state, first_waiting(self._state),
            now - self._held_from(work), work.entity.habit.mean_ns, self.pauses)

    def overtaking_at(self) -> int:
        """Return when the first waiting execution may overtake the latest holder."""
        work = self.holders[-1]
        return self._held_from(work) + overtaking_pays_from(
            self._tables, self._state, first_waiting(self._state), work.entity.habit.mean_ns,
            self.pauses)

    def usual_end(self, work: Work) -> int:
        """Return until when a running execution computes if it takes twice as long as usual."""
        return self._held_from(work) + 2 * work.entity.habit.mean_ns

    def _held_from(self, work: Work) -> int:
        """Return when an execution would have started to hold it without pauses."""
        return self._state.x_started[work.x] + work.paused_ns

    def may_start_more(self, now: int) -> bool:
        """Return whether an idle worker may be able to start an execution; True if in doubt."""
        state = self._state
        if not state.scalars[N_IDLE] or not has_waiting(state):
            return False
        ready, deferred = state.ready, state.deferred
        is_held = bool(self.holders)
        if len(ready) > MOST or deferred and not is_held:
            return True
        x_holds, x_group, owners = state.x_holds, state.x_group, state.group_owner
        has_outer = bool(state.outer_limit)
        first = deferred[0] if deferred else None
        for entry in ready:
            x = first_of(state, entry)
            group = x_group[x]
            if group >= 0 and owners[group] >= 0 and owners[group] != x:
                continue
            if has_outer and not has_place(state, x):
                continue
            if not is_held or not x_holds[x]:
                return True
            if first is None or entry < first:
                first = entry
        return (first is not None and first[0] < state.x_key[self.holders[-1].x][0]
                and bool(self.may_be_overtaken(now)))


def has_waiting(state: State) -> bool:
    """Return whether any execution waits in the core, except for its callback group."""
    return bool(state.ready or state.deferred)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Keeping up with nodes: whose entities there are now, and who has to know.

Nodes say that something has changed (``Executor.wake``), not what.  So registry, intakes and trace
are brought up to date with all nodes at once, by the thread that spins, and where entities are
made in a row not anew for each of them.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from typing import Any

from mddag_executor.live.intake.entities import EMPTY, snapshot
from mddag_executor.live.intake.events import EventsIntake
from mddag_executor.live.intake.waitset import WaitSetIntake
from mddag_executor.live.pool import Pool
from mddag_executor.live.recorder import Recorder
from mddag_executor.live.registry import Registry

REFRESH_REST = 3
"""After looking at all entities, rest for so many times what it took."""
HAND_OVER_S = 2.0
"""For so long an intake is given to take no more of something; it takes a few milliseconds."""

Intake = EventsIntake | WaitSetIntake


class Upkeep:
    """
    Keeps registry, intakes and trace up to date.

    :param nodes: returns the nodes with what the executor is to run of them.
    :ivar changed: whether there may be something new (see ``change``).
    :ivar entities: what there was when it was looked at last.
    """

    def __init__(
        self, nodes: Callable[[], list[Any]], registry: Registry, pool: Pool,
        recorder: Recorder | None,
    ) -> None:
        self.changed = True
        self.entities = EMPTY
        self._nodes = nodes
        self._registry = registry
        self._pool = pool
        self._recorder = recorder
        self._intakes: list[Intake] = []
        self._lock = threading.Lock()
        self._refresh_at = 0.0

    def change(self) -> None:
        """Take note that entities may have come or gone."""
        self.changed = True
        self._pool.is_settled = False

    def add_intake(self, intake: Intake) -> None:
        """Keep an intake up to date, too; it learns what there is with the next ``refresh``."""
        self._intakes.append(intake)
        self.changed = True

    def remove_intake(self, intake: Intake) -> None:
        """Leave an intake, which has been stopped, with nothing: its threads refer to it."""
        self._intakes.remove(intake)
        intake.update(EMPTY)

    def rest_s(self) -> float | None:
        """Return after how many seconds to ``refresh``; None: nothing has changed."""
        return max(0.0, self._refresh_at - time.monotonic()) if self.changed else None

    def refresh(self) -> None:
        """Bring all up to date if anything may have changed."""
        with self._lock:
            if not self.changed:
                return
            start = time.monotonic()
            self.changed = False
            self._look()
            self._register()
            self._pool.is_settled = True
            if self.changed:  # meanwhile
                self._pool.is_settled = False
            self._inform_intakes()
            end = time.monotonic()
            self._refresh_at = end + REFRESH_REST * (end - start)

    def hand_over(self) -> None:
        """Take nothing more of what another executor gets, and only then forget it."""
        with self._lock:
            self._look()
            self._register(keep=True)
            self._inform_intakes()
            end = time.monotonic() + HAND_OVER_S
            while not all(each.settled() for each in list(self._intakes)):
                if time.monotonic() > end:
                    break
                time.sleep(0.001)
            self._register()

    def _look(self) -> None:
        # Once for all: an intake must not take from what the registry does not know yet.
        self.entities = snapshot(self._nodes(), self.entities)

    def _register(self, keep: bool = False) -> None:
        added, gone = self._registry.refresh(self.entities, keep)
        engine, pool = self._pool.engine, self._pool
        if engine.other_processes is not None and (added or gone):
            with pool.lock:
                engine.other_processes.host(
                    self._registry.hosted(), self._registry.subscriptions(), engine.record,
                    pool.tick())
        since = pool.clock.now()
        for entity in added:
            entity.since = since
        for entity in gone:
            pool.report(engine.remove, entity)
        if self._recorder is not None:
            self._recorder.entities(self.entities.nodes, added)

    def _inform_intakes(self) -> None:
        for intake in self._intakes:
            intake.update(self.entities)

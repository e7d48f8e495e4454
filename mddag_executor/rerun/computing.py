# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When executions end that share CPUs and the interpreter.

The machine is the simulator's (``simulate.machine``): it tells who stands still.  What an
execution has sent before its end leaves when it is as far as it was then in the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.live.engine import Engine
from mddag_executor.live.work import Work
from mddag_executor.simulate import Load
from mddag_executor.simulate.machine import Machine

_NO_LOAD = Load([], [], [], [], [], [])


class Computing:
    """
    What runs on workers, and how far it is.

    :param cpus: how many there are; None: as many as are needed.
    :param python: whether all need the interpreter at their end: see ``Machine``.
    :param start: when the run begins.
    :param ended: called with what was given to ``begin`` when it ends, and the time.
    """

    def __init__(
        self, engine: Engine, cpus: int | None, python: bool, start: int,
        ended: Callable[[Any, int], None],
    ) -> None:
        self._engine = engine
        self._machine = Machine(
            engine.tables, engine.scheduler.state, _NO_LOAD, cpus, python=python, deliveries=self)
        self._machine.settle(start)
        self._ended = ended
        self._finish_at = [NEVER] * engine.n_workers
        self._running: list[Any] = [None] * engine.n_workers
        # by execution: how far it is when something leaves, and that; the next one last
        self._places: dict[int, list[tuple[int, Callable[[], None]]]] = {}

    def waits(self, work: Work) -> None:
        """Take in that an execution has a worker and, for now, needs nothing."""
        self._machine.begins(work.x, 0, -1)

    def begin(
        self, what: Any, work: Work, takes: int,
        leaving: list[tuple[int, Callable[[], None]]],
    ) -> None:
        """
        Have an execution run on its worker.

        :param takes: how long, if nothing keeps it; of that it computes ``work.cpu_ns``.
        :param leaving: what is to be done before its end, and how far it is then.
        """
        self._engine.takes(work, takes)
        self._machine.begins(work.x, takes, work.cpu_ns)
        self._running[work.worker] = what
        if leaving:
            self._places[work.x] = sorted(leaving, key=lambda each: each[0], reverse=True)

    def next_place(self, x: int) -> int:
        """Return how far a running execution is when something of it leaves next."""
        places = self._places.get(x)
        return places[-1][0] if places else NEVER

    def next_time(self) -> int:
        """Return when somebody ends, or needs something else."""
        return min(self._machine.next_time, *self._finish_at)

    def settle(self, now: int) -> None:
        """Take in that time has passed."""
        self._machine.settle(now)

    def share(self, now: int) -> None:
        """Find out who goes on."""
        self._machine.share(now, self._finish_at)
        for worker, what in enumerate(self._running):
            if what is None:
                self._finish_at[worker] = NEVER

    def go_on(self, now: int) -> bool:
        """Do what is due; False: there is nothing."""
        for x, places in self._places.items():
            if places and self._engine.progress(x, now) >= places[-1][0]:
                places.pop()[1]()
                return True
        for worker, time in enumerate(self._finish_at):
            if time <= now:
                self._finish_at[worker] = NEVER
                what, self._running[worker] = self._running[worker], None
                self._places.pop(what.work.x, None)
                self._ended(what, now)
                return True
        return False

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
When executions end that share CPUs and the interpreter.

The machine is the simulator's (``simulate.machine``): it decides which execution pauses.
"""

from __future__ import annotations

from typing import Any

from mddag_executor.core import NEVER
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.work import Work
from mddag_executor.simulate.machine import begins, new_machine, NEXT_TIME, settle, share


class SharedCpus:
    """
    What runs on workers, and how far it is.

    :param cpus: how many there are; None: as many as are needed.
    :param python: whether all need the interpreter at their end: see ``Machine``.
    """

    def __init__(self, engine: Engine, cpus: int | None, python: bool) -> None:
        self._engine = engine
        self._state = engine.scheduler.state
        self._machine = new_machine(engine.tables, self._state, cpus, python)
        self._finish_at = [NEVER] * engine.n_workers
        self._running: list[Any] = [None] * engine.n_workers

    def waits(self, work: Work) -> None:
        """Note that an execution has a worker and, for now, needs nothing."""
        begins(self._state, self._machine, work.x, 0, -1)

    def begin(self, execution: Any, takes: int) -> None:
        """
        Have an execution run on its worker.

        :param takes: how long, if nothing keeps it; of that it computes ``work.cpu_ns``.
        """
        state, work, x = self._state, execution.work, execution.work.x
        state.x_left[x] += takes - state.x_cost[x]  # else the core cannot say how far it is
        state.x_cost[x] = takes
        begins(state, self._machine, x, takes, work.cpu_ns)
        self._running[work.worker] = execution

    def next_time(self) -> int:
        """Return when the next execution ends, or needs another resource."""
        return min(self._machine.scalars[NEXT_TIME], *self._finish_at)

    def settle(self, now: int) -> None:
        """Note that time has passed."""
        settle(self._state, self._machine, now)

    def share(self, now: int) -> None:
        """Decide which executions go on."""
        share(self._engine.tables, self._state, self._machine, now, self._finish_at)
        for worker, execution in enumerate(self._running):
            if execution is None:
                self._finish_at[worker] = NEVER

    def take_finished(self, now: int) -> Any:
        """Return an execution that has finished, of the first such worker; None: none has."""
        for worker, time in enumerate(self._finish_at):
            if time <= now:
                self._finish_at[worker] = NEVER
                execution, self._running[worker] = self._running[worker], None
                return execution
        return None

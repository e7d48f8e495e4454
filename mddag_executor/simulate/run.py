# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""One simulated run: a task set, its workload and a policy give a verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mddag_executor.core import NEVER, Tables, Tally
from mddag_executor.core.state import Decision
from mddag_executor.errors import UsageError
from mddag_executor.simulate.pool import LogEntry
from mddag_executor.simulate.schedule import schedule, Settings
from mddag_executor.simulate.workload import Workload
from msg_graph import TaskSet
from msg_graph.model import MOST_WORKERS

if TYPE_CHECKING:
    from mddag_executor.results.simulations import SimulatedRunRare, SimulatedRunResult

JUDGES = ('horizon', 'completions')


@dataclass
class SimulatedRun:
    """
    The result of a run: the tally, its end (ns) and, if requested, the log of every worker.

    ``log`` and ``decisions`` (those of the core) are in order of time.
    """

    settings: Settings
    tally: Tally
    ended_ns: int
    utilisation: float | None
    log: Sequence[LogEntry] = ()
    decisions: Sequence[Decision] = ()

    def result(self) -> SimulatedRunResult:
        """Return the result format of ``simulate --json``."""
        more: SimulatedRunRare = {}
        if self.settings.cpus is not None:
            more['cpus'] = self.settings.cpus
        return {
            'policy': self.settings.policy, 'on_late': self.settings.on_late,
            'workers': self.settings.workers,
            'preemptive': self.settings.preempts, 'duration_ns': self.settings.duration_ns,
            'utilisation': self.utilisation, **self.tally.result(), **more}


def simulate(
    task_set: TaskSet,
    load: Workload,
    settings: Settings,
    *,
    utilisation: float | None = None,
    max_active_jobs: int | None = None,
    log: bool = False,
    progress: Callable[[int], None] | None = None,
) -> SimulatedRun:
    """
    Run the core over a load.

    :param utilisation: of the load, for the result.
    :param max_active_jobs: maximum number of open jobs of a DAG that does not declare it.
    :param log: keep the log of every worker.
    :param progress: receives the virtual time (ns) regularly.
    :raises UsageError: for invalid settings.
    :raises mddag_executor.core.PolicyError: if there is no such policy.
    """
    check(settings)
    tables = Tables.build(
        task_set, on_late=settings.on_late,
        max_active_jobs=NEVER if max_active_jobs is None else max_active_jobs)
    result = schedule(tables, load, settings, log=log, progress=progress)
    tally = Tally(task_set, tables)
    result.count_into(tally, load, settings)
    return SimulatedRun(
        settings, tally, result.ended, utilisation, result.log, result.decisions)


def check(settings: Settings) -> None:
    """Check settings."""
    for workers in settings.pools:
        if not 1 <= workers <= MOST_WORKERS:
            raise UsageError(f'workers: {workers} is out of range: give 1 to {MOST_WORKERS}')
    if settings.duration_ns < 1:
        raise UsageError(f'duration: {settings.duration_ns} ns is too short: give at least 1')
    if settings.cpus is not None and settings.cpus < 1:
        raise UsageError(f'cpus: {settings.cpus} is too few: give at least 1')
    if settings.judge not in JUDGES:
        raise UsageError(
            f"judge '{settings.judge}': there is no such way: choose one of {', '.join(JUDGES)}")
    if settings.dispatch_overhead_ns < 0 or settings.switch_overhead_ns < 0:
        raise UsageError('overhead: it is negative: give 0 or more')

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Schedules a load in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from mddag_executor import defaults
from mddag_executor.core import NEVER, Tables, Tally
from mddag_executor.core.state import (
    as_object,
    Decision,
    empty,
    JOB_END,
    NOT_JUDGED,
    SINK_DEMOTED,
    State,
)
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import EngineOptions, run
from mddag_executor.simulate.machine import Machine
from mddag_executor.simulate.policies import is_of_user, preempts, ROS2
from mddag_executor.simulate.policies import policy as find_policy
from mddag_executor.simulate.pool import LogEntry, Pool
from mddag_executor.simulate.workload import as_list, as_lists, Workload

# Approximate time of plain Python per execution, without and with a machine, to choose the faster.
PLAIN_S, _STOPS_S = 10e-6, 50e-6
SOON_S = 1.0
"""For less time, loading compiled code does not pay."""
_PART = 1 << 16
"""The number of decisions that are counted together."""


@dataclass(frozen=True)
class Settings:
    """
    How a load is scheduled.

    :ivar pools: by process its number of workers; each process has its own interpreter.
    :ivar duration_ns: when the run ends, on the load's clock.
    :ivar preemptive: None: the policy's own mode of the paper's experiment.
    :ivar judge: ``horizon`` judges open jobs at the end, ``completions`` (as in the paper) only
        completions.
    :ivar dispatch_overhead_ns: added to an execution at each dispatch; ``switch_overhead_ns``: at
        each preemption.
    :ivar cpus: shared by the executions that compute; None: enough for all.
    :ivar judge_from: jobs released before are not judged; ``judge_until``: nor those released
        then or later.
    :ivar on_late: handling of late jobs of a DAG that does not declare it.
    """

    policy: str = 'rad'
    pools: tuple[int, ...] = (defaults.WORKERS,)
    duration_ns: int = defaults.DURATION_NS
    preemptive: bool | None = False
    judge: str = 'horizon'
    stop_at_first_miss: bool = False
    dispatch_overhead_ns: int = 0
    switch_overhead_ns: int = 0
    cpus: int | None = None
    judge_from: int = -NEVER
    judge_until: int = NEVER
    on_late: str = 'continue'

    @property
    def workers(self) -> int:
        """Return the number of workers of all processes."""
        return sum(self.pools)

    @property
    def preempts(self) -> bool:
        """Return whether a more urgent execution preempts a running one."""
        return preempts(self.policy, self.preemptive, len(self.pools))

    @property
    def engine_options(self) -> EngineOptions:
        """Return the settings as integers for the engine; raise like ``preempts``."""
        return EngineOptions(
            list(self.pools), int(self.preempts),
            int(self.policy == ROS2), find_policy(self.policy).urgency,
            self.dispatch_overhead_ns,
            self.switch_overhead_ns, self.judge_from, self.judge_until, self.cpus or NEVER,
            self.duration_ns,
            int(self.stop_at_first_miss), int(self.judge == 'horizon'), 1)


class Scheduled(NamedTuple):
    """
    The result of a load: when the run ended, and, in order of time, log and decisions.

    :ivar busy: by worker its busy time, ns.
    """

    ended: int
    log: Sequence[LogEntry]
    decisions: Sequence[Decision]
    busy: list[int]

    def count_into(self, tally: Tally, load: Workload, settings: Settings) -> None:
        """
        Count the judged jobs that were released, and the decisions, in an empty tally.

        Those of plain Python, which may exceed 64 bits, are counted without numpy: importing it
        takes as long as a short run.
        """
        releases = load.releases if len(load.releases) else load.times
        if not isinstance(self.decisions, list):
            self._count_columns(tally, load, releases, settings)
            return
        for time, dag, release in zip(*map(as_list, (load.times, load.dags, releases))):
            if (time <= self.ended and time < settings.duration_ns
                    and settings.judge_from <= release < settings.judge_until):
                tally.released(dag)
        tally.add(self.decisions)

    def _count_columns(
        self, tally: Tally, load: Workload, releases: Sequence[int], settings: Settings
    ) -> None:
        """Count the jobs and decisions of a compiled run."""
        import numpy as np
        every = tuple(map(np.asarray, (load.times, load.dags, releases)))
        jobs = np.zeros(len(tally.jobs) + 1, dtype=np.int64)
        for first in range(0, len(every[0]), _PART):
            times, dags, released = (column[first:first + _PART] for column in every)
            judged = (times <= self.ended) & (times < settings.duration_ns) & (
                released >= settings.judge_from) & (released < settings.judge_until)
            jobs += np.bincount(dags[judged].astype(np.int64), minlength=len(jobs))
        tally.jobs = jobs[:-1].tolist()     # without those of undeclared callbacks
        decisions = np.asarray(self.decisions, dtype=np.int64).reshape(-1, 6)
        tally.add_results(_results(decisions))
        tally.add(decisions[decisions[:, 0] == SINK_DEMOTED].tolist())
        for first in range(0, len(decisions), _PART):
            kind, dag, place, _, how, _ = decisions[first:first + _PART].T
            ends = (kind == JOB_END) & (place != NOT_JUDGED)
            numbers = np.bincount(dag[ends] << 8 | how[ends])
            for pair in np.flatnonzero(numbers).tolist():
                tally.ends[pair >> 8][pair & 255] += int(numbers[pair])


def _results(decisions: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the results among decisions, in parts: copies of all of them would be large."""
    for first in range(0, len(decisions), _PART):
        kind, _, vertex, job, deadline, time = decisions[first:first + _PART].T
        results = kind < JOB_END
        yield tuple(column[results] for column in (kind, vertex, job, deadline, time))


def schedule(
    tables: Tables, load: Workload, settings: Settings, *, log: bool = False,
    progress: Callable[[int], None] | None = None, compiled: bool | None = None,
) -> Scheduled:
    """
    Run the core over a load.

    :param log: keep the log of every worker.
    :param progress: receives the virtual time (ns) regularly, from plain Python only.
    :param compiled: whether to use the compiled core; None: if that is faster.
    """
    options = settings.engine_options._replace(keep_log=int(log))
    if compiled is None:
        compiled = prepare(tables, load, settings)
    if compiled:
        from mddag_executor.simulate.compiled import run_each
        return Scheduled(*run_each(tables, load, settings.policy, options)[0])
    state = as_object(empty(State))
    pool = empty(Pool)
    ended = run(
        as_object(tables), state, pool, empty(Deliveries), empty(Machine),
        find_policy(settings.policy).key, as_lists(load), options, progress)
    return Scheduled(ended, pool.log, state.decisions, pool.busy)


def prepare(tables: Tables, load: Workload, settings: Settings, runs: int = 1) -> bool:
    """Return whether ``runs`` runs are faster compiled; if so, compile, or load the code."""
    if is_of_user(settings.policy):
        return False
    executions = runs * len(load.times) * max(1, tables.n_vertices // max(1, tables.n_dags))
    stops = len(load.holds) > 0 or settings.cpus is not None
    if not compiling_pays(executions * (_STOPS_S if stops else PLAIN_S)):
        return False
    from mddag_executor.simulate import compiled
    compiled.prepare()
    return True


def compiling_pays(plain_s: float) -> bool:
    """Return whether compiled code is faster for work that takes plain Python this long."""
    if plain_s < SOON_S:
        return False
    from mddag_executor.simulate import compiled
    return compiled.pays(plain_s)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Runs in the compiled core: what ``kernel`` does, over lent memory (see ``compiling``)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from mddag_executor.core.policies import POLICIES
from mddag_executor.core.policies import policy as find_policy
from mddag_executor.core.state import Decision, State
from mddag_executor.core.tables import Tables
from mddag_executor.simulate.compiling import (
    cached_entries,
    compile_elsewhere,
    entries_of,
    keeps_entries,
)
from mddag_executor.simulate.draws import Times
from mddag_executor.simulate.engine import LogEntry
from mddag_executor.simulate.lending import EmptyMemory, LentTuple
from mddag_executor.simulate.load import Load
from mddag_executor.simulate.run import Settings
from mddag_executor.simulate.workload import periodic_load
from msg_graph import TaskSet
import numpy as np
import numpy.typing as npt

_ENTRIES = ('accept_runs', 'run_once', 'free_run')
_WORD = 8


def cached() -> bool:
    """Tell whether what ``evaluate`` needs has been compiled before (for any processor)."""
    return cached_entries('accept_runs')


@cache
def _entries() -> dict[str, Callable[..., Any]]:
    from mddag_executor.simulate import kernel
    return entries_of(kernel, _ENTRIES)


def compile_here() -> None:
    """Compile what ``evaluate`` needs, by evaluating no run of nothing."""
    nothing = EmptyMemory(max(len(Tables._fields) + 1, len(State._fields)))
    _entries()['accept_runs'](
        nothing.address, nothing.address, nothing.address, 0, 0, 1, 0, 0, 0, 0, 1, False,
        np.zeros(0, dtype=np.bool_))


class CompiledJudge:
    """
    Simulates runs in compiled code (see ``experiment.Judge``); several threads may call it.

    :param duration_ns: of each run.
    """

    def __init__(self, task_set: TaskSet, duration_ns: int) -> None:
        built = Tables.build(task_set)
        load = periodic_load(
            task_set, [[0] * len(dag.vertices) for dag in task_set.dags], duration_ns)
        self._columns = built.n_vertices
        self._duration_ns = duration_ns
        self._tables = [LentTuple(built, number) for number in range(len(POLICIES))]
        self._load = LentTuple(load._replace(
            cost_base=[built.first_vertex[dag.index] for dag in task_set.dags]))

    def warm_up(self, waiting: Callable[[], None] = lambda: None) -> None:
        """Compile, and call ``waiting`` now and then, or load what was compiled before."""
        if keeps_entries() and not cached():
            compile_elsewhere(__name__, waiting)
        none = np.ones((0, self._columns), dtype=np.int64)
        self(Settings(preemptive=False, judge='completions'), none)

    def __call__(self, settings: Settings, times: Times) -> npt.NDArray[np.bool_]:
        """Tell which of the runs met every deadline."""
        row = find_policy(settings.policy)
        load = self._load.copy()  # whose costs become each run's
        working = EmptyMemory(len(State._fields))
        times = np.ascontiguousarray(times, dtype=np.int64)
        accepted = np.zeros(len(times), dtype=np.bool_)
        _entries()['accept_runs'](
            self._tables[list(POLICIES).index(settings.policy)].address, load.address,
            working.address, times.ctypes.data, self._columns * _WORD, settings.workers,
            int(settings.preempts), int(row.polling), settings.dispatch_overhead_ns,
            settings.switch_overhead_ns, self._duration_ns, settings.judge == 'horizon', accepted)
        return accepted


def run_compiled(
    built: Tables, load: Load, settings: Settings
) -> tuple[int, list[LogEntry], list[Decision]]:
    """
    Run the compiled core over a load, as ``engine.run`` does with the plain one.

    It is there to be compared with that one, start by start (see ``test_compiled``).

    :return: when the run ended (ns), the log of every worker, and the core's decisions.
    """
    row = find_policy(settings.policy)
    lent = LentTuple(built, list(POLICIES).index(settings.policy))
    lent_load = LentTuple(load)
    working = EmptyMemory(len(State._fields))
    log = EmptyMemory()
    entries = _entries()
    ended = entries['run_once'](
        lent.address, lent_load.address, working.address, settings.workers,
        int(settings.preempts), int(row.polling), settings.dispatch_overhead_ns,
        settings.switch_overhead_ns, settings.duration_ns, settings.stop_at_first_miss,
        settings.judge == 'horizon', log.address)
    try:
        place = State._fields.index('decisions')
        return int(ended), log.rows(0, 6), working.rows(place, 6)  # type: ignore[return-value]
    finally:
        entries['free_run'](working.address, log.address)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A load in virtual time: how it is scheduled, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mddag_executor.core import NEVER, Tables
from mddag_executor.core import policy as find_policy
from mddag_executor.core.jobs import finish
from mddag_executor.core.state import Decision, divide, JUDGE_FROM, new_state, State
from mddag_executor.simulate.deliveries import new_deliveries
from mddag_executor.simulate.engine import LogEntry, run
from mddag_executor.simulate.load import Load
from mddag_executor.simulate.machine import new_machine


class How(NamedTuple):
    """
    How a load is scheduled.

    :ivar workers: of each process.
    :ivar dispatch_overhead: added to an execution at each dispatch, ns; ``switch_overhead``: at
        each preemption.
    :ivar judge_from: jobs released before are not judged.
    :ivar cpus: that those who compute share; None: enough for all.
    :ivar processes: how many there are, each with an interpreter of its own.
    """

    policy: str
    workers: int
    preemptive: bool = False
    dispatch_overhead: int = 0
    switch_overhead: int = 0
    judge_from: int = -NEVER
    cpus: int | None = None
    processes: int = 1

    def start(self, tables: Tables, propagate: int = 1) -> State:
        """
        Return the core's state for such a run.

        :raises mddag_executor.core.PolicyError: there is no such policy, or it cannot do that.
        """
        policy = find_policy(self.policy)
        state = new_state(
            tables, self.workers * self.processes, propagate=propagate,
            preemptive=policy.mode(self.preemptive, self.processes),
            dispatch_overhead=self.dispatch_overhead, switch_overhead=self.switch_overhead,
            polling=policy.polling)
        if self.processes > 1:
            divide(state, [self.workers] * self.processes)
        state.scalars[JUDGE_FROM] = self.judge_from
        return state


class Scheduled(NamedTuple):
    """What came of a load: when the run ended, and, in order of time, logs and decisions."""

    ended: int
    log: list[LogEntry]
    decisions: list[Decision]


def schedule(
    tables: Tables, load: Load, how: How, horizon: int, *, stop_at_first_miss: bool = False,
    log: bool = False, judge_open: bool = True, progress: Callable[[int], None] | None = None,
) -> Scheduled:
    """
    Run the core over a load up to the horizon, or its first miss.

    :param log: keep the log of every worker.
    :param judge_open: judge what is open at the horizon.
    :param progress: told the virtual time (ns) now and then.
    :raises mddag_executor.core.PolicyError: as ``How.start``.
    """
    sends = len(load.delay_base) > 0
    state = how.start(tables, 2 if sends else 1)
    entries: list[LogEntry] = []
    stops = len(load.holds) > 0 or how.cpus is not None
    machine = new_machine(tables, state, how.cpus, needs_python(load)) if stops else None
    ended = run(
        tables, state, find_policy(how.policy).key, load, horizon, stop_at_first_miss,
        entries if log else None, progress, new_deliveries() if sends else None, machine)
    if judge_open and ended == horizon:
        finish(tables, state, ended)
    return Scheduled(ended, entries, state.decisions)


def needs_python(load: Load) -> bool:
    """Tell whether it is known what needs the interpreter, so that all else does at its end."""
    return len(load.computed) > 0 and len(load.holds) > 0

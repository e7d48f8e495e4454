# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A load in virtual time: how it is scheduled, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mddag_executor.core import NEVER, Tables
from mddag_executor.core import policy as find_policy
from mddag_executor.core.state import as_object, Decision, empty, State
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import LogEntry, Orders, run_load
from mddag_executor.simulate.load import as_lists, Load
from mddag_executor.simulate.machine import Machine

# Roughly, to choose what is sooner done: plain Python's time for each execution, and for each
# where those that run may stand still.
_PLAIN_S, _STOPS_S = 10e-6, 50e-6
SOON_S = 1.0
"""What plain Python has done so soon is not worth loading what is compiled."""


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

    def orders(self, horizon: int, stop_at_first_miss: bool, judge_open: bool) -> Orders:
        """
        Return how to run a load, as integers.

        :raises mddag_executor.core.PolicyError: there is no such policy, or it cannot do that.
        """
        policy = find_policy(self.policy)
        return Orders(
            self.workers, self.processes, int(policy.mode(self.preemptive, self.processes)),
            int(policy.polling), self.dispatch_overhead, self.switch_overhead, self.judge_from,
            self.cpus or NEVER, horizon, int(stop_at_first_miss), int(judge_open))


class Scheduled(NamedTuple):
    """What came of a load: when the run ended, and, in order of time, logs and decisions."""

    ended: int
    log: list[LogEntry]
    decisions: list[Decision]


def schedule(
    tables: Tables, load: Load, how: How, horizon: int, *, stop_at_first_miss: bool = False,
    log: bool = False, judge_open: bool = True,
    progress: Callable[[int], None] | None = None, compiled: bool | None = None,
) -> Scheduled:
    """
    Run the core over a load up to the horizon, or its first miss.

    :param log: keep the log of every worker.
    :param judge_open: judge what is open at the horizon.
    :param progress: told the virtual time (ns) now and then, by plain Python.
    :param compiled: whether compiled, which gives the same; None: what is sooner done.
    :raises mddag_executor.core.PolicyError: as ``How.orders``.
    """
    orders = how.orders(horizon, stop_at_first_miss, judge_open)
    if compiled is None:
        compiled = prepare(tables, load, how)
    if compiled:
        from mddag_executor.simulate.compiled import run_once
        return Scheduled(*run_once(tables, load, how.policy, orders, log))
    state = as_object(empty(State))
    entries: list[LogEntry] = []
    ended = run_load(
        as_object(tables), state, empty(Deliveries), empty(Machine), find_policy(how.policy).key,
        as_lists(load), orders, entries if log else None, progress)
    return Scheduled(ended, entries, state.decisions)


def prepare(
    tables: Tables, load: Load, how: How, runs: int = 1,
    waiting: Callable[[], None] = lambda: None,
) -> bool:
    """
    Tell whether so many runs are sooner done compiled; if so, compile, or load what was.

    :param waiting: called now and then meanwhile.
    """
    executions = runs * len(load.times) * tables.n_vertices // max(1, tables.n_dags)
    stops = len(load.holds) > 0 or how.cpus is not None
    plain_s = executions * (_STOPS_S if stops else _PLAIN_S)
    if plain_s < SOON_S:
        return False
    from mddag_executor.simulate import compiled
    if not compiled.pays(compiled.RUN_ONCE, plain_s):
        return False
    compiled.prepare(compiled.RUN_ONCE, waiting)
    return True

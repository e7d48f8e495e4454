# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The machine in virtual time: CPUs, and the interpreter that one thread at a time computes with.

Theory of operation
-------------------
Alone, an execution takes its cost.  What it needs meanwhile depends on how far it is; in turn

1.  it computes with Python's lock: half of its CPU time if it is one that does so, all of it if
    it hardly waits besides; if it only waits, the little that Python takes to begin;
2.  it computes without the lock: CPU time of one that computes and does not hold the interpreter;
3.  it waits, and needs nothing;
4.  it computes with the lock again: the rest of its CPU time, in which it publishes.

Where what it needs is not free, it stands still.  The rules of the core (rule 11) decide which of
those that hold the interpreter are started; this module, how those that run share it:

* **The lock.**  Who has it keeps it until it needs it no more, or until another has waited for a
  *switch interval*; then they take turns, in the order in which they asked, as in CPython.
* **CPUs.**  Those that compute, of those with the lock only the one that has it, share the CPUs.
  Where there are more, they take turns by *slices*; what begins to compute goes first.

A stop makes what is left of an execution longer (``State.x_left``), so the core, which puts
preempted executions back, knows of none.  All is in whole nanoseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from mddag_executor.core import NEVER, Tables
from mddag_executor.core.queues import first_waiting, overtaking_pays
from mddag_executor.core.rules import progress
from mddag_executor.core.state import N_HOLDING, PREEMPTIVE, State
from mddag_executor.simulate.engine import Load

SWITCH_NS = 1_000_000
"""Python's switch interval while an executor spins."""
SLICE_NS = 3_000_000
"""How long the operating system lets a thread compute while others wait for a CPU."""
BRIEF_NS = 100_000
"""What one that computes without the lock takes in Python at its end, at most."""
HARDLY = 8
"""One that holds the interpreter and waits for less than this part of it keeps it meanwhile."""

_LOCK, _CPU, _NOTHING = range(3)


class Places(Protocol):
    """Knows how far executions are when something of them has to be told."""

    def next_place(self, x: int) -> int:
        """Return how far a running execution is then."""


class _Lock:
    """The lock of an interpreter: those that want it, first who has it."""

    def __init__(self) -> None:
        self._queue: list[int] = []
        self.switch_at = NEVER

    def take_turns(self, now: int, wanted: list[int]) -> list[int]:
        """Return who has it now, if anybody."""
        before = self._queue
        queue = [x for x in before if x in wanted]
        queue += [x for x in wanted if x not in queue]
        if len(queue) < 2:
            self.switch_at = NEVER
        elif len(before) < 2 or queue[0] != before[0]:
            self.switch_at = now + SWITCH_NS
        elif now >= self.switch_at:
            queue.append(queue.pop(0))
            self.switch_at = now + SWITCH_NS
        self._queue = queue
        return queue[:1]


class Machine:
    """
    Who computes, among those that run.

    :param state: of the core.
    :param load: of the run; its ``holds`` tell which executions hold the interpreter.
    :param cpus: how many there are; None: as many as are needed.
    :param computed: CPU time of the executions, as ``load.costs``; -1: it waits, as far as is
        known.  Empty: all of them compute all the time.
    :param python: whether executions that do not hold the interpreter need it at their end.
    :param locks: whether they compute with Python's lock, as ``computed``; empty: those do that
        hold the interpreter.
    :ivar next_time: when somebody needs something else, or must wait.
    """

    def __init__(
        self, tables: Tables, state: State, load: Load, cpus: int | None = None,
        computed: Sequence[int] = (), python: bool = False, deliveries: Places | None = None,
        locks: Sequence[bool] = (),
    ) -> None:
        self._t = tables
        self._s = state
        self._load = load
        self._cpus = cpus or NEVER
        self._computed = computed
        self._locks_of = locks
        self._python = python
        self._deliveries = deliveries
        state.overtaking.extend([1] * (max(tables.process) + 1 - len(state.overtaking)))
        # by execution that was started: up to where it needs what
        self._parts: dict[int, tuple[int, int, int]] = {}
        self._still: list[int] = []
        self._settled = 0
        self._locks = [_Lock() for _ in state.overtaking[1:]]
        # those that compute, first who have a CPU
        self._cpu: list[int] = []
        self._slice_at = NEVER
        self.next_time = NEVER

    def settle(self, now: int) -> None:
        """Take in that time has passed."""
        for x in self._still:
            self._s.x_left[x] += now - self._settled
        self._settled = now

    def decide(self, now: int) -> None:
        """Decide by process whether what waits first may overtake who began last to hold it."""
        s = self._s
        if s.scalars[N_HOLDING] == 0 or not (s.ready or s.held_back):
            return
        for process in range(1, len(s.overtaking)):
            holders = [x for x in s.worker_x if x >= 0 and s.x_holds[x] == process]
            first = first_waiting(self._t, s, process) if holders else -1
            s.overtaking[process] = 1
            if first >= 0 and s.x_holds[first] == process:
                last = max(holders, key=lambda x: (s.x_started[x], s.x_worker[x]))
                s.overtaking[process] = int(overtaking_pays(
                    self._t, s, process, now - s.x_started[last], s.x_cost[last],
                    s.scalars[PREEMPTIVE] != 0))

    def started(self, x: int) -> None:
        """Take in that an execution has been dispatched."""
        s, load = self._s, self._load
        slot = s.x_slot[x]
        dag = s.job_dag[slot]
        place = (load.cost_base[dag] + s.job_index[slot] * load.cost_stride[dag]
                 + x - s.job_base[slot])
        cost = s.x_cost[x]
        self.begins(x, cost, self._computed[place] if self._computed else cost,
                    bool(self._locks_of and self._locks_of[place]))

    def begins(self, x: int, cost: int, cpu: int, locks: bool = False) -> None:
        """Take in what an execution that has been dispatched takes, and what it computes of it."""
        self._parts[x] = self._ends(cost, min(cpu, cost), locks or self._s.x_holds[x] != 0)

    def _ends(self, cost: int, cpu: int, locks: bool) -> tuple[int, int, int]:
        """Return where the first three parts of an execution end."""
        if locks:
            if (cost - cpu) * HARDLY <= cpu:
                return cost, cost, cost
            half = cpu // 2
            return half, half, cost - cpu + half
        if cpu < 0:
            return -NEVER, -NEVER, cost
        if not self._python:
            return -NEVER, cpu, cost
        if 2 * cpu >= cost:
            brief = min(cpu, BRIEF_NS)
            return -NEVER, cpu - brief, cost - brief
        first = cpu // 4
        return first, first, cost - cpu + first

    def share(self, now: int, finish_at: list[int]) -> None:
        """Find out who goes on, and set when they finish."""
        s = self._s
        free, steps = [], {}
        waiting: list[list[int]] = [[] for _ in self._locks]
        for x in s.worker_x:
            if x >= 0:
                at = progress(s, x, now)
                need, until = self._need(x, at)
                if need == _LOCK:
                    waiting[self._interpreter(x) - 1].append(x)
                elif need == _CPU:
                    free.append(x)
                steps[x] = at, until, need
        for lock, wanted in zip(self._locks, waiting):
            free += lock.take_turns(now, wanted)
        self._take_turns_with_cpus(now, free)
        computes = set(self._cpu[:self._cpus])
        self._still = []
        self.next_time = min(self._slice_at, *(lock.switch_at for lock in self._locks))
        for worker, x in enumerate(s.worker_x):
            if x < 0:
                continue
            at, until, need = steps[x]
            if need == _NOTHING or x in computes:
                finish_at[worker] = s.x_started[x] + s.x_left[x]
                if self._deliveries is not None:
                    until = min(until, self._deliveries.next_place(x))
                if until < s.x_cost[x]:
                    self.next_time = min(self.next_time, now + until - at)
            else:
                finish_at[worker] = NEVER
                self._still.append(x)

    def _need(self, x: int, at: int) -> tuple[int, int]:
        """Return what an execution needs that is so far, and how far it needs that."""
        first, second, third = self._parts[x]
        if at < first:
            return _LOCK, first
        if at < second:
            return _CPU, second
        if at < third:
            return _NOTHING, third
        cost = self._s.x_cost[x]
        return (_LOCK if third < cost else _NOTHING), cost

    def _interpreter(self, x: int) -> int:
        """Return which interpreter an execution computes with."""
        s = self._s
        return s.x_holds[x] or self._t.process[s.x_vertex[x]]

    def _take_turns_with_cpus(self, now: int, wanted: list[int]) -> None:
        queue = [x for x in self._cpu if x in wanted]
        queue = [x for x in wanted if x not in queue] + queue
        if len(queue) <= self._cpus:
            self._slice_at = NEVER
        elif self._slice_at == NEVER:
            self._slice_at = now + SLICE_NS
        elif now >= self._slice_at:
            had = self._cpu[:self._cpus]
            queue = [x for x in queue if x not in had] + [x for x in queue if x in had]
            self._slice_at = now + SLICE_NS
        self._cpu = queue

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The machine in virtual time: CPUs, and the GIL, with which one thread at a time computes.

Theory of operation
-------------------
In isolation, an execution takes its cost.  It passes through these parts, in this order:

1. it computes with the GIL: half of its CPU time if it computes with the GIL, all of it if it
   hardly waits; a short time to begin if it only waits;
2. it computes without the GIL: CPU time of an execution that does not hold the interpreter;
3. it waits, and needs nothing;
4. it computes with the GIL again: the rest of its CPU time, in which it publishes.

An execution that does not get the GIL or CPU that it needs is stopped.  The rules of the core
(rule 10) decide which executions that hold the interpreter are started.  This module decides how
running executions share it:

* **The GIL.**  An execution keeps it until it no longer needs it, or until another one has waited
  for a *switch interval*.  Then they alternate, in the order of their requests, as in CPython. An
  execution that starts when another one of its process ends continues in its thread, with the GIL.
* **CPUs.**  Executions that compute share the CPUs; of those that need the GIL only its holder
  does.  If there are too many, they alternate by *slices*; an execution that begins to compute
  goes first.

A stop makes the rest of an execution longer (``State.x_left``), so the core, which can continue
preempted executions, does not know of stops.  All times are integers, ns.
"""

from __future__ import annotations

from typing import NamedTuple

from mddag_executor.core.queues import overtaking_pays, overtaking_pays_from
from mddag_executor.core.state import add_heap, N_HOLDING, State
from mddag_executor.core.tables import NEVER, Tables
from mddag_executor.simulate.pool import first_to_run, Pool, PREEMPTIVE
from mddag_executor.simulate.workload import place_of, Workload

SWITCH_NS = 1_000_000
"""Python's switch interval while an executor spins."""
SLICE_NS = 3_000_000
"""Time slice of the operating system if threads wait for a CPU."""
TAIL_NS = 100_000
"""Maximum CPU time with the GIL at the end of an execution that computes without it."""
HARDLY = 8
"""An execution that waits for at most 1 / HARDLY of its CPU time keeps the GIL meanwhile."""

# What an execution needs.
_LOCK, _CPU, _NOTHING = range(3)

# Columns of ``Machine.scalars``: number of CPUs; whether executions that do not hold the
# interpreter need the GIL at their end; the time up to which the machine is up to date; when the
# slices end, if nothing happens before; when an execution needs something else; how often the CPUs
# were assigned; when overtaking pays that does not pay now.
CPUS, PYTHON, COUNTED_UNTIL, SLICE_AT, NEXT_TIME, SHARES, OVERTAKE_AT = range(7)


class Machine(NamedTuple):
    """Which running executions compute; filled by ``fill_machine``, or empty if all do."""

    scalars: list[int]
    # by started execution: the progress up to which it computes with the GIL, computes without it,
    # and waits; at which it publishes next before its end (``deliveries``; NEVER: never)
    locked_until: list[int]
    computes_until: list[int]
    waits_until: list[int]
    publishes_at: list[int]
    # its progress, its need and up to which progress; the assignment in which it last had a CPU
    at: list[int]
    need: list[int]
    until: list[int]
    assigned_in: list[int]
    # stopped executions; computing executions, first those with a CPU; those that begin to compute
    stalled: list[int]
    computing: list[int]
    joining: list[int]
    # by interpreter, from 1: executions that need its GIL, the holder first; the previous holder
    # while others waited, or -1; when the next one gets it
    lock_queue: list[list[int]]
    previous_holder: list[int]
    switch_at: list[int]


def fill_machine(s: State, m: Machine, cpus: int, python: int) -> None:
    """
    Fill the columns of an empty machine, on which nothing runs yet.

    :param cpus: number of CPUs; NEVER: as many as are needed.
    :param python: 1 if executions that do not hold the interpreter need the GIL at their end.
    """
    for value in (cpus, python, 0, NEVER, NEVER, 1, NEVER):
        m.scalars.append(value)
    for _ in range(len(s.overtaking)):
        add_heap(m.lock_queue)
        m.previous_holder.append(-1)
        m.switch_at.append(NEVER)


def is_used(m: Machine) -> bool:
    """Return whether executions may be stopped."""
    return len(m.scalars) > 0


def progress(s: State, x: int, now: int) -> int:
    """Return the execution time of a running execution so far, ns."""
    return s.x_cost[x] - s.x_left[x] + now - s.x_started[x]


def advance_machine(s: State, m: Machine, now: int) -> None:
    """Advance the machine to the present time."""
    passed = now - m.scalars[COUNTED_UNTIL]
    for i in range(len(m.stalled)):
        s.x_left[m.stalled[i]] += passed
    m.scalars[COUNTED_UNTIL] = now


def decide_overtaking(t: Tables, s: State, p: Pool, m: Machine, now: int) -> None:
    """Decide by process whether the first waiting execution may overtake the last holder."""
    m.scalars[OVERTAKE_AT] = NEVER
    if s.scalars[N_HOLDING] == 0 or first_to_run(s, p, 0) < 0:
        return
    for process in range(1, len(s.overtaking)):
        s.overtaking[process] = 1
        last = -1
        for worker in range(len(s.worker_x)):
            x = s.worker_x[worker]
            if (x >= 0 and s.x_holds[x] == process
                    and (last < 0 or s.x_started[x] >= s.x_started[last])):
                last = x
        first = first_to_run(s, p, process) if last >= 0 else -1
        if first >= 0 and s.x_holds[first] == process:
            preempts = p.scalars[PREEMPTIVE] != 0
            s.overtaking[process] = int(overtaking_pays(
                t, s, first, now - s.x_started[last], s.x_cost[last], preempts))
            if s.overtaking[process] == 0:
                pays_at = s.x_started[last] + overtaking_pays_from(
                    t, s, first, s.x_cost[last], preempts)
                if now < pays_at < m.scalars[OVERTAKE_AT]:
                    m.scalars[OVERTAKE_AT] = pays_at


def on_dispatch(s: State, load: Workload, m: Machine, x: int, now: int) -> None:
    """Note that an execution has been dispatched."""
    cost = s.x_cost[x]
    cpu = load.computed[place_of(s, load, x)] if len(load.computed) > 0 else cost
    set_phases(s, m, x, cost, cpu)


def set_phases(s: State, m: Machine, x: int, cost: int, cpu: int) -> None:
    """Note the cost of a dispatched execution, and its computing parts."""
    while len(m.at) <= x:
        for column in (m.locked_until, m.computes_until, m.waits_until, m.publishes_at, m.at,
                       m.need, m.until, m.assigned_in):
            column.append(0)
    m.publishes_at[x] = NEVER
    cpu = min(cpu, cost)
    if s.x_holds[x] != 0:
        if (cost - cpu) * HARDLY <= cpu:
            _set_parts(m, x, cost, cost, cost)
        else:
            _set_parts(m, x, cpu // 2, cpu // 2, cost - cpu + cpu // 2)
    elif cpu < 0:
        _set_parts(m, x, -NEVER, -NEVER, cost)
    elif m.scalars[PYTHON] == 0:
        _set_parts(m, x, -NEVER, cpu, cost)
    elif 2 * cpu >= cost:
        tail = min(cpu, TAIL_NS)
        _set_parts(m, x, -NEVER, cpu - tail, cost - tail)
    else:
        _set_parts(m, x, cpu // 4, cpu // 4, cost - cpu + cpu // 4)


def _set_parts(m: Machine, x: int, first: int, second: int, third: int) -> None:
    m.locked_until[x] = first
    m.computes_until[x] = second
    m.waits_until[x] = third


def assign_cpus(s: State, m: Machine, now: int, finish_at: list[int]) -> None:
    """Assign the GIL and CPUs, and compute when executions finish."""
    number = m.scalars[SHARES] = m.scalars[SHARES] + 1
    m.joining.clear()
    on = s.worker_x
    for worker in range(len(on)):
        x = on[worker]
        if x >= 0:
            _find_need(s, m, x, progress(s, x, now))
    for process in range(1, len(m.lock_queue)):
        if len(m.lock_queue[process]) > 0:
            _pass_lock(s, m, process, now)
    _pass_cpus(s, m, now)
    next_time = min(m.scalars[SLICE_AT], m.scalars[OVERTAKE_AT])
    for process in range(1, len(m.switch_at)):
        next_time = min(next_time, m.switch_at[process])
    m.stalled.clear()
    for worker in range(len(on)):
        x = on[worker]
        if x < 0:
            continue
        if m.need[x] == _NOTHING or m.assigned_in[x] == number:
            finish_at[worker] = s.x_started[x] + s.x_left[x]
            until = m.until[x]
            if m.publishes_at[x] < until:
                until = m.publishes_at[x]
            if until < s.x_cost[x] and now + until - m.at[x] < next_time:
                next_time = now + until - m.at[x]
        else:
            finish_at[worker] = NEVER
            m.stalled.append(x)
    m.scalars[NEXT_TIME] = next_time


def _find_need(s: State, m: Machine, x: int, at: int) -> None:
    """Find what an execution needs at its progress; queue it for a new need."""
    need, until = _NOTHING, s.x_cost[x]
    if at < m.locked_until[x]:
        need, until = _LOCK, m.locked_until[x]
    elif at < m.computes_until[x]:
        need, until = _CPU, m.computes_until[x]
    elif at < m.waits_until[x]:
        until = m.waits_until[x]
    elif m.waits_until[x] < until:
        need = _LOCK
    m.at[x], m.need[x], m.until[x] = at, need, until
    if need == _LOCK:
        interpreter = s.x_holds[x]
        if interpreter == 0:
            interpreter = s.process[s.x_vertex[x]]
        if x not in m.lock_queue[interpreter]:
            _ask(s, m, x, interpreter)
    elif need == _CPU and x not in m.computing:
        m.joining.append(x)


def _ask(s: State, m: Machine, x: int, interpreter: int) -> None:
    """Queue for the GIL; an execution that follows an ended holder gets its place."""
    queue = m.lock_queue[interpreter]
    if len(queue) > 0 and m.at[x] == 0:
        first = queue[0]
        if (s.x_worker[first] < 0 and m.need[first] == _CPU
                and s.process[s.x_vertex[first]] == s.process[s.x_vertex[x]]):
            queue[0] = x
            if m.previous_holder[interpreter] == first:
                m.previous_holder[interpreter] = x
            return
    queue.append(x)


def _pass_lock(s: State, m: Machine, process: int, now: int) -> None:
    """Find which execution has the GIL of an interpreter now: it needs a CPU."""
    queue = m.lock_queue[process]
    kept = 0
    for i in range(len(queue)):
        x = queue[i]
        if s.x_worker[x] >= 0 and m.need[x] == _LOCK:
            queue[kept] = x
            kept += 1
    del queue[kept:]
    had = m.previous_holder[process]
    m.previous_holder[process] = -1
    if kept < 2:
        m.switch_at[process] = NEVER
    else:
        if queue[0] != had:
            m.switch_at[process] = now + SWITCH_NS
        elif now >= m.switch_at[process]:
            for i in range(1, kept):
                queue[i - 1] = queue[i]
            queue[kept - 1] = had
            m.switch_at[process] = now + SWITCH_NS
        m.previous_holder[process] = queue[0]
    if kept > 0:
        first = queue[0]
        m.need[first] = _CPU
        if first not in m.computing:
            m.joining.append(first)


def _pass_cpus(s: State, m: Machine, now: int) -> None:
    """Find which executions have a CPU now."""
    number, cpus = m.scalars[SHARES], m.scalars[CPUS]
    for i in range(len(m.computing)):
        x = m.computing[i]
        if s.x_worker[x] >= 0 and m.need[x] == _CPU:
            m.joining.append(x)
    wanted = len(m.joining)
    turns = False
    if wanted <= cpus:
        m.scalars[SLICE_AT] = NEVER
    else:
        turns = m.scalars[SLICE_AT] <= now
        if turns or m.scalars[SLICE_AT] == NEVER:
            m.scalars[SLICE_AT] = now + SLICE_NS
    m.computing.clear()
    for i in range(wanted):
        x = m.joining[i]
        if not turns or m.assigned_in[x] != number - 1:
            m.computing.append(x)
    if turns:
        for i in range(wanted):
            x = m.joining[i]
            if m.assigned_in[x] == number - 1:
                m.computing.append(x)
    for i in range(min(cpus, wanted)):
        m.assigned_in[m.computing[i]] = number

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The event loop of simulation and rescheduling: virtual time around the core's rules.

Theory of operation
-------------------
Time jumps from event to event; an event is the release of a job or the end of an execution.  At
one instant first the completions are given to the core, workers in ascending order, then the
releases in DAG order, then the core dispatches until nothing is left to do (design section 9). A
completion at the horizon counts; nothing is released or dispatched from then on.

If transport takes time or executions fail, ``deliveries`` ends the executions, and the messages of
an instant arrive between its completions and its releases.  If CPUs are limited or executions hold
the GIL, ``machine`` computes after each instant when the running executions finish.

A job's deadlines count from its release.  This is the time at which its source becomes ready,
unless ``releases`` has an earlier time (a sensor's message that arrived later).

Like the rules this is integer arithmetic on lists, so that it can be compiled unchanged; arguments
that are None then cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mddag_executor.core import jobs, overload, rules
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.state import add_slot, divide, fill_state, JUDGE_FROM, State
from mddag_executor.core.tables import NEVER, Tables
from mddag_executor.simulate.deliveries import (
    arrive_due,
    Deliveries,
    ends_sending,
    next_arrival,
    sends_at_start,
)
from mddag_executor.simulate.load import Load, needs_python, SKIPPED
from mddag_executor.simulate.machine import (
    decide,
    fill_machine,
    Machine,
    NEXT_TIME,
    settle,
    share,
    starts,
)

# Kinds of log entries.
START, END, PREEMPT = range(3)

LogEntry = tuple[int, int, int, int, int, int]
"""(time, kind, worker, DAG, global vertex, job): one change of a worker."""


class Orders(NamedTuple):
    """How to run a load, as integers: see ``schedule.Settings``."""

    workers: int
    processes: int
    intakes: int
    preemptive: int
    polling: int
    urgency: int
    dispatch_overhead: int
    switch_overhead: int
    judge_from: int
    cpus: int
    horizon: int
    stop_at_first_miss: int
    judge_open: int
    keep_log: int


def run_load(
    t: Tables, s: State, d: Deliveries, m: Machine, key: KeyFunction, load: Load, o: Orders,
    busy: list[int], log: list[LogEntry], progress: Callable[[int], None] | None,
) -> int:
    """
    Run the core over a load (see ``run``) with an empty state, deliveries and machine.

    :param busy: receives by worker its busy time, ns; ``log``: the log of the workers, if wanted.
    """
    sends = len(load.delay_base) > 0
    stops = len(load.holds) > 0 or o.cpus < NEVER
    workers = [o.workers] * o.processes + [1] * (o.processes * o.intakes)
    fill_state(
        t, s, sum(workers), o.preemptive, 2 if sends else 1, o.dispatch_overhead,
        o.switch_overhead, o.polling, o.urgency)
    if len(workers) > 1:
        divide(s, workers)
    s.scalars[JUDGE_FROM] = o.judge_from
    stop, keep = o.stop_at_first_miss != 0, o.keep_log != 0
    for _ in range(sum(workers)):
        busy.append(0)
    if stops:
        fill_machine(
            t, s, m, o.cpus, int(needs_python(load)), o.processes if o.intakes != 0 else NEVER)
    if sends:
        d.sent.append(0)
        if stops:
            ended = run(t, s, key, load, o.horizon, stop, log, progress, d, m, busy, keep)
        else:
            ended = run(t, s, key, load, o.horizon, stop, log, progress, d, None, busy, keep)
    elif stops:
        ended = run(t, s, key, load, o.horizon, stop, log, progress, None, m, busy, keep)
    else:
        ended = run(t, s, key, load, o.horizon, stop, log, progress, None, None, busy, keep)
    if o.judge_open != 0 and ended == o.horizon:
        jobs.finish(t, s, ended)
    if not keep:
        log.clear()
    return ended


def run(
    t: Tables,
    s: State,
    key: KeyFunction,
    load: Load,
    horizon: int,
    stop_at_first_miss: bool,
    log: list[LogEntry] | None = None,
    progress: Callable[[int], None] | None = None,
    deliveries: Deliveries | None = None,
    machine: Machine | None = None,
    busy: list[int] | None = None,
    keep_log: bool = True,
) -> int:
    """
    Run the core over a load and return the time at which the run ended, ns.

    Decisions are in ``s.decisions``.  With ``stop_at_first_miss`` the run ends with the instant at
    which the first miss is known: a late completion, an expiry or an abort.  ``progress`` receives
    the virtual time at each event.  The busy time of each worker is added to ``busy``.
    """
    if len(load.holds) > 0:
        for v in range(t.n_vertices):
            place = load.cost_base[t.dag_of[v]] + t.region_offset[v]  # of its first job, if any
            if place < len(load.holds):
                s.holder[v] = load.holds[place]
    overload.admit(t, s)
    n_workers = len(s.worker_x)
    finish_at = [NEVER] * n_workers
    running = [-1] * n_workers
    since = [-1] * n_workers
    next_release = 0
    n_releases = len(load.times)
    now = 0
    while True:
        if log is not None:
            if not keep_log:
                log.clear()
        instant = NEVER
        if next_release < n_releases and load.times[next_release] < horizon:
            instant = load.times[next_release]
        for w in range(n_workers):
            if finish_at[w] < instant:
                instant = finish_at[w]
        if deliveries is not None:
            instant = min(instant, next_arrival(deliveries))
        if machine is not None:
            instant = min(instant, machine.scalars[NEXT_TIME])
        if instant > horizon:
            _end_busy(busy, since, horizon)
            return horizon
        now = instant
        if progress is not None:
            progress(now)
        seen = len(s.decisions)
        if machine is not None:
            settle(s, machine, now)
        for w in range(n_workers):
            if finish_at[w] == now:
                finish_at[w] = NEVER
                x = s.worker_x[w]
                if busy is not None:
                    busy[w] += now - since[w]
                    since[w] = -1
                if log is not None:
                    running[w] = -1
                    _note(t, s, log, now, END, w, x)
                if deliveries is not None:
                    ends_sending(t, s, key, load, deliveries, machine, x, now)
                else:
                    rules.complete(t, s, key, x, now)
        if now == horizon:
            _end_busy(busy, since, horizon)
            return horizon
        if deliveries is not None:
            arrive_due(t, s, key, load, deliveries, machine, now)
        while next_release < n_releases and load.times[next_release] == now:
            release_load(t, s, key, load, next_release, now)
            next_release += 1
        _dispatch(t, s, key, load, now, finish_at, running, since, busy, log, deliveries,
                  machine)
        if machine is not None:
            share(t, s, machine, now, finish_at)
        if stop_at_first_miss and any_missed(s, seen):
            _end_busy(busy, since, now)
            return now


def _end_busy(busy: list[int] | None, since: list[int], now: int) -> None:
    """Count the executions that still run at the end."""
    if busy is not None:
        for w in range(len(since)):
            if since[w] >= 0:
                busy[w] += now - since[w]


def release_load(
    t: Tables, s: State, key: KeyFunction, load: Load, i: int, now: int
) -> None:
    """Release the i-th job of a load, with its execution times."""
    dag = load.dags[i]
    job = load.jobs[i]
    cost = load.cost_base[dag] + job * load.cost_stride[dag]
    if dag == t.n_dags:
        x = rules.ready_undeclared(
            t, s, key, job, -1, load.holds[cost] if len(load.holds) > 0 else 0, now)
        s.job_index[s.x_slot[x]] = job
        s.x_cost[x] = s.x_left[x] = load.costs[cost]
        return
    release = load.releases[i] if len(load.releases) > 0 else now
    slot = jobs.release_job(t, s, dag, job, release, now)
    if slot < 0:
        add_slot(t, s, dag)
        slot = jobs.release_job(t, s, dag, job, release, now)
    base = s.job_base[slot]
    source = t.region_offset[t.source[dag]]
    if len(load.fates) > 0:
        if load.fates[cost + source] == SKIPPED:
            jobs.expire_job(t, s, slot, now)
            return
    for place in range(t.n_region[dag]):
        s.x_cost[base + place] = load.costs[cost + place]
    if len(load.holds) > 0:
        for place in range(t.n_region[dag]):
            s.x_holds[base + place] = load.holds[cost + place]
    rules.make_ready(t, s, key, base + source, now)


def _dispatch(
    t: Tables, s: State, key: KeyFunction, load: Load, now: int, finish_at: list[int],
    running: list[int], since: list[int], busy: list[int] | None, log: list[LogEntry] | None,
    deliveries: Deliveries | None, machine: Machine | None,
) -> None:
    """Dispatch executions; ``running`` has the preempted executions for the log."""
    if machine is not None:
        decide(t, s, machine, now)
    x = rules.schedule(t, s, key, now)
    while x >= 0:
        worker = s.x_worker[x]
        finish_at[worker] = now + s.x_left[x]
        if busy is not None:
            if since[worker] >= 0:
                busy[worker] += now - since[worker]
            since[worker] = now
        if log is not None:
            if running[worker] >= 0:
                _note(t, s, log, now, PREEMPT, worker, running[worker])
            running[worker] = x
            _note(t, s, log, now, START, worker, x)
        if machine is not None:
            starts(s, load, machine, x, now)
        if deliveries is not None:
            sends_at_start(t, s, load, deliveries, machine, x, now)
        if machine is not None:
            decide(t, s, machine, now)
        x = rules.schedule(t, s, key, now)


def _note(
    t: Tables, s: State, log: list[LogEntry], now: int, kind: int, worker: int, x: int
) -> None:
    vertex = s.x_vertex[x]
    log.append((now, kind, worker, t.dag_of[vertex], vertex, s.job_index[s.x_slot[x]]))


def any_missed(s: State, first: int) -> bool:
    """Return whether a miss is among the decisions from number ``first`` on."""
    for i in range(first, len(s.decisions)):
        if jobs.is_miss(s.decisions[i][0]):
            return True
    return False

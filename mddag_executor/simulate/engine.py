# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The event loop of simulation and rescheduling: virtual time around the core's rules.

Theory of operation
-------------------
Time jumps from event to event; an event is the release of a job or the end of an execution.  At
one instant first the completions are given to the core, workers in ascending order, then the
releases in DAG order, then the core dispatches until nothing is left to do (design section 9). A
completion at the horizon counts; after that nothing is released or dispatched.

If transport takes time or executions fail, ``deliveries`` ends the executions, and the messages of
an instant arrive between its completions and its releases.  If CPUs are limited or executions hold
the GIL, ``machine`` computes after each instant when the running executions finish.

A job's deadlines count from its release.  This is the time at which its source becomes ready,
unless ``releases`` has an earlier time (a sensor's message that arrived later).

Like the rules this is integer arithmetic on lists, so that it can be compiled unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mddag_executor.core.inheritance import inherit
from mddag_executor.core.jobs import finish, give_up, is_miss, release_job
from mddag_executor.core.overload import admit
from mddag_executor.core.policies import KeyFunction
from mddag_executor.core.rules import complete, make_ready, ready_undeclared
from mddag_executor.core.state import (
    add_slot,
    EXPIRED,
    fill_state,
    JOB_END,
    JUDGE_FROM,
    JUDGE_UNTIL,
    OUTDATED,
    State,
)
from mddag_executor.core.tables import NEVER, Tables
from mddag_executor.simulate.deliveries import (
    arrive_due,
    Deliveries,
    ends_sending,
    next_arrival,
    sends_at_start,
)
from mddag_executor.simulate.dispatch import dispatch
from mddag_executor.simulate.machine import (
    advance_machine,
    assign_cpus,
    decide_overtaking,
    fill_machine,
    is_used,
    Machine,
    NEXT_TIME,
    on_dispatch,
)
from mddag_executor.simulate.pool import (
    divide,
    END,
    fill_pool,
    JOB_ENDED,
    Pool,
    PREEMPT,
    RELEASE,
    START,
)
from mddag_executor.simulate.workload import needs_python, SKIPPED, Workload


class EngineOptions(NamedTuple):
    """
    How to run a load, as integers: see ``schedule.Settings``.

    :ivar workers: by process its number of workers.
    """

    workers: list[int]
    preemptive: int
    polling: int
    urgency: int
    dispatch_overhead: int
    switch_overhead: int
    judge_from: int
    judge_until: int
    cpus: int
    horizon: int
    stop_at_first_miss: int
    judge_open: int
    keep_log: int


def run(
    t: Tables, s: State, p: Pool, d: Deliveries, m: Machine, key: KeyFunction, load: Workload,
    o: EngineOptions, progress: Callable[[int], None] | None,
) -> int:
    """
    Run the core over a load, with an empty state, pool, …; return the end, ns.

    Decisions are in ``s.decisions``, busy times and log in the pool.  With
    ``EngineOptions.stop_at_first_miss`` the run ends with the instant at which the first miss is
    known: a late completion, or an early end of a job.

    :param progress: receives the virtual time at each event.
    """
    _fill(t, s, p, d, m, load, o)
    sends, stops = len(load.delay_base) > 0, is_used(m)
    n_workers, n_releases = len(s.worker_x), len(load.times)
    now = next_release = 0
    while now < o.horizon:
        instant = NEVER
        if next_release < n_releases and load.times[next_release] < o.horizon:
            instant = load.times[next_release]
        for w in range(n_workers):
            if p.finish_at[w] < instant:
                instant = p.finish_at[w]
        if sends:
            instant = min(instant, next_arrival(d))
        if stops:
            instant = min(instant, m.scalars[NEXT_TIME])
        now = min(instant, o.horizon)
        if instant > o.horizon:
            break
        if progress is not None:
            progress(now)
        seen = len(s.decisions)
        if stops:
            advance_machine(s, m, now)
        for w in range(n_workers):
            if p.finish_at[w] == now:
                p.finish_at[w] = NEVER
                x = s.worker_x[w]
                p.busy[w] += now - p.since[w]
                p.since[w] = p.running[w] = -1
                if o.keep_log != 0:
                    _note(t, s, p, now, END, w, x)
                if sends:
                    ends_sending(t, s, key, load, d, m, x, now)
                else:
                    complete(t, s, key, x, now)
                if o.keep_log != 0:
                    _note_ends(t, s, p, now)
        if now == o.horizon:
            break
        if sends:
            arrive_due(t, s, key, load, d, m, now)
            if o.keep_log != 0:
                _note_ends(t, s, p, now)
        while next_release < n_releases and load.times[next_release] == now:
            release_load(t, s, p, key, load, o, next_release, now)
            next_release += 1
        _dispatch(t, s, p, d, m, key, load, o, now)
        if stops:
            assign_cpus(s, m, now, p.finish_at)
        if o.stop_at_first_miss != 0 and any_missed(s, seen):
            break
    for w in range(n_workers):
        if p.since[w] >= 0:
            p.busy[w] += now - p.since[w]
    if o.judge_open != 0 and now == o.horizon:
        finish(t, s, now)
    return now


def _fill(
    t: Tables, s: State, p: Pool, d: Deliveries, m: Machine, load: Workload, o: EngineOptions
) -> None:
    """Fill the columns of an empty state, and of deliveries and machine if the load needs them."""
    sends = len(load.delay_base) > 0
    n_workers = 0
    for i in range(len(o.workers)):
        n_workers += o.workers[i]
    fill_state(t, s, n_workers, 2 if sends else 1, o.urgency)
    fill_pool(t, s, p, o.preemptive, o.polling, o.dispatch_overhead, o.switch_overhead)
    if len(o.workers) > 1:
        divide(t, s, p, o.workers)
    s.scalars[JUDGE_FROM], s.scalars[JUDGE_UNTIL] = o.judge_from, o.judge_until
    if sends:
        d.scalars.append(0)
        d.scalars.append(o.preemptive)
    if len(load.holds) > 0 or o.cpus < NEVER:
        fill_machine(s, m, o.cpus, int(needs_python(load)))
    if len(load.holds) > 0:
        for v in range(t.n_vertices):
            place = load.cost_base[t.dag_of[v]] + t.region_offset[v]  # of its first job, if any
            if place < len(load.holds):
                s.holder[v] = load.holds[place]
    admit(t, s)


def release_load(
    t: Tables, s: State, p: Pool, key: KeyFunction, load: Workload, o: EngineOptions, i: int,
    now: int,
) -> None:
    """Release the i-th job of a load, with its execution times."""
    dag = load.dags[i]
    job = load.jobs[i]
    cost = load.cost_base[dag] + job * load.cost_stride[dag]
    if dag == t.n_dags:
        x = ready_undeclared(
            t, s, key, job, -1, load.holds[cost] if len(load.holds) > 0 else 0, -1, now)
        s.job_index[s.x_slot[x]] = job
        s.x_cost[x] = s.x_left[x] = load.costs[cost]
        if len(load.inherited) > 0:
            inherit(t, s, x, load.inherited[job], load.inherits_from[job])
        return
    release = load.releases[i] if len(load.releases) > 0 else now
    slot = release_job(t, s, dag, job, release, now)
    if slot < 0:
        add_slot(t, s, dag)
        slot = release_job(t, s, dag, job, release, now)
    if o.keep_log != 0:
        _note_ends(t, s, p, now)
        p.log.append((now, RELEASE, -1, dag, release, job))
    base = s.job_base[slot]
    source = t.region_offset[t.source[dag]]
    if len(load.fates) > 0 and load.fates[cost + source] == SKIPPED:
        give_up(t, s, slot, EXPIRED, now)
        if o.keep_log != 0:
            _note_ends(t, s, p, now)
        return
    for place in range(t.n_region[dag]):
        s.x_cost[base + place] = s.x_left[base + place] = load.costs[cost + place]
    if len(load.holds) > 0:
        for place in range(t.n_region[dag]):
            s.x_holds[base + place] = load.holds[cost + place]
    make_ready(t, s, key, base + source, now)
    if o.keep_log != 0:
        _note_ends(t, s, p, now)


def _dispatch(
    t: Tables, s: State, p: Pool, d: Deliveries, m: Machine, key: KeyFunction, load: Workload,
    o: EngineOptions, now: int,
) -> None:
    """Dispatch executions; ``Pool.running`` has the preempted ones for the log."""
    sends, stops = len(load.delay_base) > 0, is_used(m)
    if stops:
        decide_overtaking(t, s, p, m, now)
    x = dispatch(t, s, p, key, now)
    while x >= 0:
        worker = s.x_worker[x]
        p.finish_at[worker] = now + s.x_left[x]
        if p.since[worker] >= 0:
            p.busy[worker] += now - p.since[worker]
        p.since[worker] = now
        if o.keep_log != 0:
            if p.running[worker] >= 0:
                _note(t, s, p, now, PREEMPT, worker, p.running[worker])
            _note(t, s, p, now, START, worker, x)
        p.running[worker] = x
        if stops:
            on_dispatch(s, load, m, x, now)
        if sends:
            sends_at_start(t, s, load, d, m, x, now)
        if stops:
            decide_overtaking(t, s, p, m, now)
        x = dispatch(t, s, p, key, now)


def _note(t: Tables, s: State, p: Pool, now: int, kind: int, worker: int, x: int) -> None:
    vertex = s.x_vertex[x]
    p.log.append((now, kind, worker, t.dag_of[vertex], vertex, s.job_index[s.x_slot[x]]))


def _note_ends(t: Tables, s: State, p: Pool, now: int) -> None:
    """Note the jobs that ended early, but did not fail, since the last call."""
    for i in range(p.logged[0], len(s.decisions)):
        kind, dag, _, job, end, _ = s.decisions[i]
        if kind == JOB_END and (end == EXPIRED or end == OUTDATED):
            p.log.append((now, JOB_ENDED, -1, dag, end, job))
    p.logged[0] = len(s.decisions)


def any_missed(s: State, first: int) -> bool:
    """Return whether a miss is among the decisions from number ``first`` on."""
    for i in range(first, len(s.decisions)):
        if is_miss(s.decisions[i][0]):
            return True
    return False

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What must hold of every schedule, read from its log alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import policy, rad_offsets, Tables
from mddag_executor.core.state import (
    ABORTED,
    COMPLETED,
    DROP,
    empty,
    EXPIRED,
    JOB_END,
    LATE,
    ORDER,
    RUNNING,
    SINK_ABORTED,
    SINK_COMPLETED,
    SINK_EXPIRED,
    SINK_LATE,
    State,
    WAITING,
)
from mddag_executor.simulate import END, LogEntry, PREEMPT, Settings
from mddag_executor.simulate.deliveries import Deliveries
from mddag_executor.simulate.engine import run_load
from mddag_executor.simulate.machine import Machine
from msg_graph import Dag

from .dag_paths import laxity, reachable_sinks
from .task_sets import Case, cases, examples, task_sets, TICK

Id = tuple[int, int, int]
"""DAG, vertex in its DAG, job."""


def paths_to_sinks(dag: Dag, index: int) -> Iterator[int]:
    """Yield the sink at the end of each path from a vertex."""
    open_paths = [index]
    while open_paths:
        vertex = dag.vertices[open_paths.pop()]
        if vertex.successors:
            open_paths += vertex.successors
        else:
            yield vertex.index


def rad_offset(dag: Dag, index: int) -> int:
    """Return RAD minus release as the paper defines it, ns."""
    deadlines = [dag.vertices[sink].deadline_ns for sink in paths_to_sinks(dag, index)]
    return min(deadline for deadline in deadlines if deadline is not None)


def depth(dag: Dag, index: int) -> int:
    """Return how many vertices lie before one on the longest path to it."""
    return max((1 + depth(dag, p) for p in dag.vertices[index].predecessors), default=0)


@dataclass
class Moment:
    """All that is ready and runs after what happened at one tick."""

    now: int
    started: list[Id]
    preempted: list[tuple[Id, Id]]
    running: dict[int, Id]
    waiting: list[Id]
    blocked: set[Id]


class Schedule:
    """A log of a run without bounds and aborts, taken apart tick by tick."""

    def __init__(self, case: Case, horizon: int) -> None:
        self.case = case
        self.horizon = horizon
        self.dags = case.task_set.dags
        self.log = case.events(case.run(horizon))
        self.end: dict[Id, int] = {}
        for now, kind, _, dag, vertex, job in self.log:
            if kind == 'end':
                assert (dag, vertex, job) not in self.end, 'ended twice'
                self.end[dag, vertex, job] = now
        self.ready = self._ready_times()

    def _ready_times(self) -> dict[Id, int]:
        """Return when each execution became ready that did so before the horizon."""
        ready = {}
        for dag in self.dags:
            for job in range(-(-self.horizon * TICK // dag.period_ns)):
                for vertex in dag.vertices:
                    ends = [self.end.get((dag.index, before, job), self.horizon)
                            for before in vertex.predecessors]
                    when = max(ends, default=job * dag.period_ns // TICK)
                    if when < self.horizon:
                        ready[dag.index, vertex.index, job] = when
        assert {(d, v, job) for _, _, _, d, v, job in self.log} <= set(ready)
        return ready

    def group(self, each: Id) -> tuple[str, str] | None:
        callback = self.dags[each[0]].vertices[each[1]].callback
        return None if callback.group is None else (callback.node, callback.group)

    def key(self, each: Id) -> tuple[int, ...]:
        """Return the part of the documented key that does not depend on the order of events."""
        d, v, job = each
        dag = self.dags[d]
        release = job * dag.period_ns
        return {
            'rad': (release + rad_offset(dag, v), v, d),
            'gedf': (release + max(dag.vertices[s].deadline_ns or 0 for s in dag.sinks), v, d),
            'llf': (release + min(
                laxity(dag, v, sink) for sink in reachable_sinks(dag, v)), v, d),
            'dm': (rad_offset(dag, v), job),
            'rm': (dag.period_ns, job), 'wc': (job,), 'fifo': (self.ready[each],),
            'ros2': (0,),  # what waits for the next poll is not to be compared: see test_polling
            'picas': self.chain(d, v),
        }[self.case.policy]

    def chain(self, d: int, v: int) -> tuple[int, ...]:
        """Return the least (deadline, period, DAG, -depth, vertex) of a callback's vertices."""
        callback = self.dags[d].vertices[v].callback
        return min(
            (rad_offset(dag, vertex.index), dag.period_ns, dag.index, -depth(dag, vertex.index),
             vertex.index)
            for dag in self.dags for vertex in dag.vertices if vertex.callback is callback)

    def priority(self, each: Id) -> tuple[int, ...]:
        """Return the part of the key that decides about preemption."""
        return self.key(each) if self.case.policy == 'picas' else self.key(each)[:1]

    def moments(self) -> Iterator[Moment]:
        """Yield what is the case after each tick before the horizon at which something was."""
        running: dict[int, Id] = {}
        begun: set[Id] = set()
        i = 0
        while i < len(self.log) and self.log[i][0] < self.horizon:
            now = self.log[i][0]
            started: list[Id] = []
            preempted: list[tuple[Id, Id]] = []
            while i < len(self.log) and self.log[i][0] == now:
                _, kind, worker, *rest = self.log[i]
                each: Id = (rest[0], rest[1], rest[2])
                if kind == 'start':
                    assert worker not in running, 'two at once on a worker'
                    assert each not in running.values(), 'one on two workers'
                    if preempted and preempted[-1][1] == (-1, worker, -1):
                        preempted[-1] = (preempted[-1][0], each)
                    running[worker] = each
                    begun.add(each)
                    started.append(each)
                else:
                    assert running.pop(worker) == each
                    if kind == 'preempt':
                        preempted.append((each, (-1, worker, -1)))
                i += 1
            alive = [e for e, ready in self.ready.items()
                     if ready <= now and self.end.get(e, now + 1) > now]
            waiting = [e for e in alive if e not in running.values()]
            held = {self.group(e): e for e in alive if e in begun and self.group(e) is not None}
            blocked = {e for e in waiting if held.get(self.group(e), e) != e}
            yield Moment(now, started, preempted, dict(running), waiting, blocked)


plain_cases = cases(bounds=False)


@examples(150)
@given(plain_cases, st.integers(5, 50))
def test_every_moment(case: Case, horizon: int) -> None:
    """Order, work conservation, workers, groups and preemption, at every instant of a run."""
    schedule = Schedule(case, horizon)
    for moment in schedule.moments():
        assert len(moment.running) <= case.workers
        able = [e for e in moment.waiting if e not in moment.blocked]
        if len(moment.running) < case.workers:
            assert able == [], 'a worker idles while something may run'
        for started in moment.started:
            assert all(schedule.key(e) >= schedule.key(started) for e in able
                       if e not in [victim for victim, _ in moment.preempted]), (
                'a smaller key waits while a larger one starts')
        for victim, preemptor in moment.preempted:
            assert case.preemptive
            assert schedule.priority(preemptor) < schedule.priority(victim), 'not smaller'
        if case.preemptive and case.policy != 'fifo':  # a preemption makes fifo's keys anew
            assert all(schedule.priority(e) >= schedule.priority(r) for e in able
                       for r in moment.running.values()), 'a preemption was forgotten'
        groups = Counter(schedule.group(e) for e in moment.running.values())
        assert all(count == 1 for group, count in groups.items() if group is not None)


@examples(100)
@given(cases(), st.integers(5, 40))
def test_every_job_ends_in_exactly_one_way(case: Case, last_release: int) -> None:
    horizon = last_release * (1 + sum(map(sum, case.ticks)))
    run = case.run(horizon, last_release=last_release)
    dags = case.task_set.dags
    released = {(dag.index, job) for dag in dags
                for job in range(-(-last_release * TICK // dag.period_ns))}
    ends: dict[tuple[int, int], int] = {}
    sinks: dict[Id, int] = {}
    for kind, dag, vertex, job, deadline, time in run.decisions:
        if kind == JOB_END:
            assert (dag, job) not in ends
            ends[dag, job] = deadline
        elif kind in (*SINK_COMPLETED, SINK_ABORTED, SINK_EXPIRED):
            assert (dag, vertex, job) not in sinks
            assert (kind == SINK_LATE) == (kind in SINK_COMPLETED and time > deadline)
            sinks[dag, vertex, job] = kind
    assert set(ends) == released
    assert len(sinks) == sum(len(dags[dag].sinks) for dag, _ in released)
    for (dag, job), end in ends.items():
        kinds = {kind for each, kind in sinks.items() if (each[0], each[2]) == (dag, job)}
        if kinds.issubset(SINK_COMPLETED):
            assert end == (LATE if SINK_LATE in kinds else COMPLETED)
        else:
            assert end == (ABORTED if SINK_ABORTED in kinds else EXPIRED)
            assert not {SINK_ABORTED, SINK_EXPIRED} <= kinds
    counted: Counter[str] = Counter()
    for dag_result in run.result()['dags'].values():
        counted.update(dag_result['ends'])
    assert sum(counted.values()) == len(released)


@examples(100)
@given(cases(overheads=True), st.integers(5, 50))
def test_whatever_gets_ready_ends_or_is_dropped_or_is_there(case: Case, horizon: int) -> None:
    """Also of jobs that are aborted or expire."""
    tables = Tables.build(case.task_set)
    settings = Settings(
        case.policy, case.workers, horizon * TICK, case.preemptive,
        dispatch_overhead_ns=case.dispatch_overhead * TICK,
        switch_overhead_ns=case.switch_overhead * TICK)
    state = empty(State)
    log: list[LogEntry] = []
    run_load(
        tables, state, empty(Deliveries), empty(Machine), policy(case.policy).key,
        case.load(horizon), replace(settings, judge='completions').orders, [], log,
        None)
    kinds = Counter(kind for _, kind, *_ in log)
    ready = state.scalars[ORDER] - kinds[PREEMPT]
    dropped = sum(kind == DROP for kind, *_ in state.decisions)
    there = Counter(state.x_state)
    assert ready == kinds[END] + dropped + there[WAITING] + there[RUNNING]


@examples(100)
@given(task_sets(max_callbacks=8))
def test_rad_is_the_least_deadline_of_the_sinks_it_leads_to(task_set: Any) -> None:
    tables = Tables.build(task_set)
    for dag in task_set.dags:
        brute = [rad_offset(dag, vertex.index) for vertex in dag.vertices]
        assert rad_offsets(dag) == brute
        first = tables.first_vertex[dag.index]
        assert tables.rad_offset[first:first + len(dag.vertices)] == brute

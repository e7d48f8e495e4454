# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The engine by itself: a list of events, without threads, clocks and rclpy."""

from __future__ import annotations

import subprocess
import sys

from hypothesis import assume, given
from hypothesis import strategies as st
from mddag_executor.core import NEVER, POLICIES
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.habits import Habit
from mddag_executor.executor.jobs import Origin
from mddag_executor.executor.work import Work
from msg_graph import TaskSet
import pytest

from ..core.task_sets import Case, cases, Event, examples, TICK

HORIZON = 60
PLAIN = tuple(name for name, policy in POLICIES.items() if not policy.polling)


def entity_of(engine: Engine, task_set: TaskSet, dag: int, index: int) -> Entity:
    """Return an entity that one vertex is bound to, with one leg for all of its messages."""
    vertex = task_set.dags[dag].vertices[index]
    entity = Entity('waitable', None, vertex.callback.node, vertex.callback, -1, 0, '')
    first = engine.tables.first_vertex[dag]
    if index == task_set.dags[dag].source:
        entity.source = first + index
    entity.targets = {first + before: (first + index, 0) for before in vertex.predecessors}
    return entity


class Driver:
    """Plays a case as the pool would: virtual time, and executions of the case's lengths."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.engine = Engine(
            case.task_set, case.workers, case.policy, default_deadline=1, max_active_jobs=NEVER,
            expire_after=NEVER)
        self.tables = self.engine.tables
        self.entities = {
            self.tables.first_vertex[dag.index] + vertex.index:
            entity_of(self.engine, case.task_set, dag.index, vertex.index)
            for dag in case.task_set.dags for vertex in dag.vertices}
        self.running: dict[int, tuple[int, Work]] = {}
        self.log: list[Event] = []

    def note(self, now: int, kind: str, work: Work) -> None:
        assert work.origin is not None
        _, dag, job, vertex = work.origin
        self.log.append(
            (now // TICK, kind, work.worker, dag, self.tables.index_in_dag[vertex], job))

    def run(self) -> None:
        load = self.case.load(HORIZON)
        releases = list(zip(load.times, load.dags))
        for now in range(0, HORIZON * TICK + 1, TICK):
            for worker in sorted(w for w, (end, _) in self.running.items() if end == now):
                self.complete(self.running.pop(worker)[1], now)
            if now == HORIZON * TICK:
                return
            while releases and releases[0][0] == now:
                source = self.entities[self.tables.source[releases.pop(0)[1]]]
                self.engine.timer_due(Work(None, print, entity=source), now, now)
            while (work := self.engine.dispatch(now)) is not None:
                self.note(now, 'start', work)
                assert work.origin is not None
                _, dag, _, vertex = work.origin
                ticks = self.case.ticks[dag][self.tables.index_in_dag[vertex]]
                self.running[work.worker] = now + ticks * TICK, work

    def complete(self, work: Work, now: int) -> None:
        self.note(now, 'end', work)
        assert work.origin is not None
        slot, dag, job, vertex = work.origin
        self.engine.finished(work, now, now, now, 0, work.worker)
        tables = self.tables
        for i in range(tables.first_successor[vertex], tables.first_successor[vertex + 1]):
            after = self.entities[tables.successors[i]]
            self.engine.arrived(
                Work(None, print, entity=after), Origin(slot, dag, job, vertex), -1, -1, now)


@examples(150)
@given(cases(policies=PLAIN, groups=False, bounds=False))
def test_the_same_events_give_the_same_answers_as_the_simulator(case: Case) -> None:
    # A sync is one execution for each message here, and one in all there.
    assume(all(len(v.predecessors) <= 1 for d in case.task_set.dags for v in d.vertices))
    case = Case(case.task_set, case.ticks, case.workers, case.policy, preemptive=False)
    driver = Driver(case)
    driver.run()
    run = case.run(HORIZON)
    assert driver.log == case.events(run)
    driver.engine.finish(HORIZON * TICK)
    verdicts = driver.engine.verdicts.tally.result()
    assert verdicts['dags'] == run.result()['dags']


@examples(150)
@given(st.lists(st.booleans() | st.integers(0, 2), max_size=120))
def test_nothing_waits_that_may_run_beside_who_computes(steps: list[bool | int]) -> None:
    """What computes or does not becomes ready, or a worker ends, as the pool does it."""
    engine = Engine(
        None, 3, 'rad', default_deadline=10 ** 9, max_active_jobs=NEVER, expire_after=NEVER)
    entities = [Entity('waitable', None, '/n', None, -1, 0, '') for _ in range(2)]
    for holds, entity in enumerate(entities):
        entity.habit = Habit(bool(holds))
    running: dict[int, Work] = {}
    for now, step in enumerate(steps):
        begun: list[Work | None] = []
        if isinstance(step, bool):
            engine.ready(Work(None, print, entity=entities[step]), now)
            begun.append(engine.dispatch(now))
        elif step in running:
            engine.finished(running.pop(step), now, now, now, 0, step)
            begun.append(engine.dispatch(now, step))
        while begun and engine.has_more and (len(begun) == 1 or begun[-1] is not None):
            begun.append(engine.dispatch(now))
        running |= {work.worker: work for work in begun if work is not None}
        if len(running) < engine.n_workers:
            assert not entities[0].waiting
            assert not entities[1].waiting or engine.holders
        assert sum(work.entity.habit.holds for work in running.values()) <= 1


def test_a_full_queue_drops_the_oldest_and_counts_it() -> None:
    engine = Engine(None, 1, 'rad', default_deadline=100, max_active_jobs=64, expire_after=NEVER)
    entity = Entity('waitable', None, '/n', None, -1, 2, '/t')
    works = [Work(None, print, (number,), entity=entity) for number in range(5)]
    for now, work in enumerate(works):
        engine.arrived(work, None, -1, -1, now)
    ran = []
    while (ready := engine.dispatch(10)) is not None:
        ran.append(ready.args[0])
        engine.finished(ready, 10, 11, 11, 0, ready.worker)
    assert (ran, entity.dropped, entity.ran) == ([3, 4], 3, 2)


def test_it_needs_no_rclpy_and_no_thread() -> None:
    program = (
        'import sys; sys.modules["rclpy"] = None\n'
        'import mddag_executor.executor.engine as engine\n'
        'engine.Engine(None, 7, "rad", default_deadline=1, max_active_jobs=1, expire_after=1)\n')
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 0


def entity_without_job(engine: Engine, group: int = -1) -> Entity:
    return Entity('waitable', None, '/n', None, group, 10, '/t')


def test_what_runs_past_the_core_keeps_its_worker_and_its_group() -> None:
    engine = Engine(None, 2, 'rad', default_deadline=100, max_active_jobs=64, expire_after=NEVER)
    entity = entity_without_job(engine, engine.scheduler.new_group())
    other = entity_without_job(engine)
    alone = Work(None, print, entity=entity)
    assert engine.begins_alone(alone)
    works = [Work(None, print, entity=each) for each in (entity, other, other)]
    for now, work in enumerate(works):
        engine.arrived(work, None, -1, -1, now)
    assert engine.dispatch(5) is works[1]   # there is one worker more, and the group is busy
    assert engine.dispatch(5) is None
    engine.finished(alone, 0, 6, 6, 0, alone.worker)
    assert engine.dispatch(6) is works[0]
    assert engine.dispatch(6) is None
    engine.finished(works[1], 5, 7, 7, 0, works[1].worker)
    assert engine.dispatch(7) is works[2]
    assert (entity.ran, entity.ready, other.ready, engine.undeclared) == (1, 2, 2, 4)


def test_nothing_runs_past_the_core_that_this_would_not_dispatch() -> None:
    engine = Engine(None, 1, 'rad', default_deadline=100, max_active_jobs=64, expire_after=NEVER)
    entity = entity_without_job(engine, engine.scheduler.new_group())
    works = [Work(None, print, entity=entity) for _ in range(3)]
    engine.arrived(works[0], None, -1, -1, 0)
    assert not engine.begins_alone(works[1])    # one waits
    assert engine.dispatch(0) is works[0]
    assert not engine.begins_alone(works[1])    # it runs, on the only worker
    engine.suspended(works[0], 0, 1, 0, works[0].worker)
    assert not engine.begins_alone(works[1])    # its group is busy
    engine.resume(works[0])
    assert engine.dispatch(2) is works[0]
    engine.finished(works[0], 2, 3, 3, 0, works[0].worker)
    assert engine.begins_alone(works[1])
    assert not engine.begins_alone(works[2])    # one at a time
    engine.finished(works[1], 3, 4, 4, 0, works[1].worker)
    assert engine.dispatch(4) is None and engine.idle_workers == 1


@pytest.mark.parametrize('policy', POLICIES)
def test_what_runs_past_the_core_is_in_nobodys_place(policy: str) -> None:
    engine = Engine(None, 2, policy, default_deadline=1, max_active_jobs=NEVER, expire_after=NEVER)
    alone, *works = (Work(None, print, entity=entity_without_job(engine)) for _ in range(3))
    if not engine.begins_alone(alone):
        assert policy not in PLAIN
        engine.ready(alone, 0)
        assert engine.dispatch(0) is alone
    for work in works:
        engine.ready(work, 1)
    first = engine.dispatch(2)
    assert first in works and first.worker != alone.worker
    assert engine.dispatch(2) is None
    engine.finished(alone, 0, 3, 3, 0, alone.worker)
    second = engine.dispatch(3)
    assert second in works and second is not first
    for work in (first, second):
        engine.finished(work, 2, 4, 4, 0, work.worker)
    assert engine.idle_workers == 2 and not engine.has_waiting

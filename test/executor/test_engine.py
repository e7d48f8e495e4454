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
from mddag_executor.executor.gil import GilHabit
from mddag_executor.executor.jobs import Origin
from mddag_executor.executor.verdicts import DeadlineMiss
from mddag_executor.executor.work import Work
from msg_graph import loads, TaskSet

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
            case.task_set, case.workers, case.policy, default_deadline=1,
            on_late='continue', max_active_jobs=NEVER, expire_after=NEVER)
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
                self.engine.timer_due(Work(source, print), now, now)
            while (work := self.engine.dispatch(0, now)) is not None:
                self.note(now, 'start', work)
                assert work.origin is not None
                _, dag, _, vertex = work.origin
                ticks = self.case.ticks[dag][self.tables.index_in_dag[vertex]]
                self.running[work.worker] = now + ticks * TICK, work
            self.engine.validate()

    def complete(self, work: Work, now: int) -> None:
        self.note(now, 'end', work)
        assert work.origin is not None
        slot, dag, job, vertex = work.origin
        self.engine.finished(work, now, now, now, 0, work.worker)
        tables = self.tables
        for i in range(tables.first_successor[vertex], tables.first_successor[vertex + 1]):
            after = self.entities[tables.successors[i]]
            self.engine.arrived(
                Work(after, print), Origin(slot, dag, job, vertex), -1, -1, now)


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


def test_what_was_reported_as_overdue_is_late() -> None:
    """Also when the thread in which it completed in time gets the lock only after that."""
    task_set = loads("""
mddag: 1
nodes:
  - node: /n
    callbacks: [{name: tick, timer: 100us, deadline: 100us}]
""")
    reported: list[DeadlineMiss] = []
    recorded: list[tuple[object, ...]] = []
    engine = Engine(
        task_set, 2, 'rad', default_deadline=1, max_active_jobs=NEVER, expire_after=NEVER,
        on_miss=reported.append, record=lambda *event: recorded.append(event))
    entity = entity_of(engine, task_set, 0, 0)
    for release in (0, 100_000):
        engine.timer_due(Work(entity, print), release, release)
    first, second = engine.dispatch(0, 100_000), engine.dispatch(1, 100_000)
    assert first is not None and second is not None
    engine.judge_overdue(150_000)
    engine.finished(first, 0, 90_000, 151_000, 0, 0)
    engine.finished(second, 100_000, 149_000, 152_000, 0, 1)
    engine.finish(200_000)
    assert [(miss.job, miss.kind) for miss in reported] == [(0, 'overdue')]
    sink = engine.verdicts.tally.result()['dags']['/n']['sinks']['/n:tick']
    assert (sink['completed'], sink['late'], sink['overdue']) == (2, 1, 0)
    assert sink['response_ns']['max'] == 100_001
    # what a trace has of it judges the same
    assert [event[5:] for event in recorded if event[0] == 'deadline'] == [(0, 100_000, 100_001)]
    assert entity.busy_ns == 10_001  # it would have ended that much later


@examples(150)
@given(st.lists(st.booleans() | st.integers(0, 2), max_size=120))
def test_nothing_waits_that_may_run_beside_who_computes(steps: list[bool | int]) -> None:
    """What computes or does not becomes ready, or a worker ends, as the pool does it."""
    engine = Engine(
        None, 3, 'rad', default_deadline=10 ** 9, max_active_jobs=NEVER, expire_after=NEVER)
    entities = [Entity('waitable', None, '/n', None, -1, 0, '') for _ in range(2)]
    for holds, entity in enumerate(entities):
        entity.habit = GilHabit(bool(holds))
    running: dict[int, Work] = {}
    for now, step in enumerate(steps):
        begun: list[Work | None] = []
        if isinstance(step, bool):
            engine.ready(Work(entities[step], print), now)
            begun.append(engine.dispatch(0, now))
        elif step in running:
            engine.finished(running.pop(step), now, now, now, 0, step)
            begun.append(engine.dispatch(step, now))
        while begun and engine.may_start_more(now) and (len(begun) == 1 or begun[-1] is not None):
            begun.append(engine.dispatch(0, now))
        running |= {work.worker: work for work in begun if work is not None}
        engine.validate()
        if len(running) < engine.n_workers:
            assert not entities[0].waiting
            assert not entities[1].waiting or engine.holders
        assert sum(work.entity.habit.holds for work in running.values()) <= 1


def test_it_needs_no_rclpy_and_no_thread() -> None:
    program = (
        'import sys; sys.modules["rclpy"] = None\n'
        'import mddag_executor.executor.engine as engine\n'
        'engine.Engine(None, 7, "rad", default_deadline=1, max_active_jobs=1, expire_after=1)\n')
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 0


def without_job(group: int = -1, most_waiting: int = 0) -> Entity:
    entity = Entity('waitable', None, '/n', None, group, 0, '/t')
    entity.most_waiting = most_waiting
    return entity


def new_engine(workers: int = 2, policy: str = 'rad') -> Engine:
    return Engine(None, workers, policy, default_deadline=100, max_active_jobs=64,
                  expire_after=NEVER)


def test_more_is_collected_when_one_that_waits_starts() -> None:
    engine, collected = new_engine(), []
    entity = without_job(most_waiting=1)
    engine.ready(Work(entity, print), 0)
    entity.collect_more = lambda: collected.append(1)
    first = engine.dispatch(0, 0)
    assert first is not None and collected == [1] and entity.collect_more is None


def test_who_holds_the_gil_is_given_back_when_it_ends_waits_or_lends() -> None:
    engine = new_engine(4)
    entities = [without_job() for _ in range(3)]
    for entity in entities:
        entity.habit = GilHabit(True)
    for end in (
        lambda work: engine.finished(work, 0, 1, 1, 0, work.worker),
        lambda work: engine.suspended(work, 0, 1, 0, work.worker),
        engine.lend, engine.stop_holding,
        lambda work: engine.left_open(work, 0, 1, 0, work.worker, True),
    ):
        work = Work(entities[0], print)
        engine.ready(work, 0)
        assert engine.dispatch(0, 0) is work and engine.interpreter_holder() is work
        end(work)
        assert engine.holders == [] and engine.interpreter_holder() is None

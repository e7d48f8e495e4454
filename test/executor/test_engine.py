# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The engine by itself, without threads and clocks; its invariants, each broken once."""

import threading
from time import monotonic_ns
from types import SimpleNamespace
import weakref

from hypothesis import assume, example, given
from hypothesis import strategies as st
from mddag_executor.core import NEVER, POLICIES
from mddag_executor.core.jobs import source_depth
from mddag_executor.core.state import N_HOLDING, N_IDLE, WAITING
from mddag_executor.core.tally import counts
from mddag_executor.errors import UsageError
from mddag_executor.executor import due as due_module
from mddag_executor.executor import workers
from mddag_executor.executor.agenda import Agenda
from mddag_executor.executor.attribution import Origin
from mddag_executor.executor.bounds import NET_NS, PATIENCE_NS, REPORT_NS, SOON_NS
from mddag_executor.executor.debugging import engine_lock, InvariantError
from mddag_executor.executor.engine import Engine
from mddag_executor.executor.entity import Entity
from mddag_executor.executor.gil import GilHabit
from mddag_executor.executor.gil_check import CHECK_PART, GilCheck
from mddag_executor.executor.holder_check import HolderCheck
from mddag_executor.executor.threads import RUNS, WorkerThread
from mddag_executor.executor.work import current, Work
from msg_graph import loads
import pytest

from ..conftest import examples
from ..core.task_sets import Case, cases, TICK
from ..invariants import broken_invariants
from .conftest import Spinning, wait_for
from .declared import graph
from .inside import engine_of, pool_of, replace_method

HORIZON = 60
MS = 1_000_000


def check(engine):
    """Check the invariants that hold between two calls."""
    broken = [*broken_invariants(engine)]
    assert not broken, broken


def new_engine(task_set=None, workers=1, policy='rad', **more):
    return Engine(task_set, workers, policy, max_active_jobs=NEVER, expire_after=NEVER,
                  **{'default_deadline': 10 ** 9, **more})


class TimerLike(Entity):
    """An entity whose arrivals are the releases of its jobs, as those of a timer are."""

    is_due_at_release = keeps_oldest = True


def new_entity(group=-1, depth=0, holds=False, node='/n', callback=None, kind=Entity):
    entity = kind(None, node)
    entity.callback, entity.group, entity.depth = callback, group, depth
    entity.habit = GilHabit(holds)
    return entity


def entity_of(engine, task_set, dag, index, kind=Entity):
    """Return an entity that one vertex is bound to, with one leg for all of its messages."""
    vertex = task_set.dags[dag].vertices[index]
    entity = new_entity(node=vertex.callback.node, callback=vertex.callback, kind=kind)
    first = engine.tables.first_vertex[dag]
    if index == task_set.dags[dag].source:
        entity.source = first + index
    entity.targets = {first + before: (first + index, 0) for before in vertex.predecessors}
    return entity


class Driver:
    """Plays a case as the pool would: virtual time, and executions of the case's lengths."""

    def __init__(self, case):
        self.case = case
        self.engine = new_engine(
            case.task_set, case.workers, case.policy, default_deadline=1, on_late='continue')
        self.tables = self.engine.tables
        self.entities = {
            self.tables.first_vertex[dag.index] + vertex.index:
            entity_of(self.engine, case.task_set, dag.index, vertex.index)
            for dag in case.task_set.dags for vertex in dag.vertices}
        self.running = {}
        self.log = []

    def note(self, now, kind, work):
        _, dag, job, vertex = work.origin
        self.log.append(
            (now // TICK, kind, work.worker, dag, self.tables.index_in_dag[vertex], job))

    def run(self):
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
            while (work := self.engine.step(0, now).work) is not None:
                self.note(now, 'start', work)
                _, dag, _, vertex = work.origin
                ticks = self.case.ticks[dag][self.tables.index_in_dag[vertex]]
                self.running[work.worker] = now + ticks * TICK, work
            check(self.engine)

    def complete(self, work, now):
        self.note(now, 'end', work)
        slot, dag, job, vertex = work.origin
        self.engine.finished(work, now, now, now, 0, work.worker)
        tables = self.tables
        for i in range(tables.first_successor[vertex], tables.first_successor[vertex + 1]):
            after = self.entities[tables.successors[i]]
            self.engine.arrived(
                Work(after, print), Origin(slot, dag, job, vertex), -1, -1, now)


@examples(150)
@given(cases(policies=tuple(POLICIES), groups=False, bounds=False))
def test_the_same_events_give_the_same_answers_as_the_simulator(case):
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


@pytest.mark.parametrize(('keys', 'release', 'dropped'), [
    ('keep: newest', 60, 3), ('on_late: demote', 40, 2), ('on_late: continue', 0, 0)])
def test_which_releases_of_a_timer_give_way_to_newer_ones(keys, release, dropped):
    """All, or late ones: those of 0 and 20 ms, when that of 60 ms is due."""
    task_set = loads(graph(
        motor=f'name: drive, timer: 20ms, deadline: 40ms, execution_time: 1ms, {keys}'))
    engine = new_engine(task_set)
    timer = entity_of(engine, task_set, 0, 0)
    timer.depth = source_depth(engine.tables, engine.scheduler.state, 0)
    for due in range(0, 61 * MS, 20 * MS):
        engine.timer_due(Work(timer, print), due, due)
        check(engine)
    work = engine.step(0, 61 * MS).work
    assert engine.release_of(work) == release * MS
    assert (timer.dropped, timer.skipped) == (dropped, 0 if dropped else 2)


@pytest.mark.parametrize('deadline', ['none', '1s'])
def test_the_job_of_a_waiting_release_does_not_end_before_its_source_runs(deadline):
    """200 releases could be in time, and 64 jobs may be open."""
    task_set = loads(graph(
        imu='name: sample, timer: 5ms, publishes: [/imu], max_active_jobs: 64',
        filter=f'name: store, subscription: /imu, deadline: {deadline}'))
    engine = new_engine(task_set, on_late='demote')
    timer, store = entity_of(engine, task_set, 0, 0), entity_of(engine, task_set, 0, 1)
    timer.depth = source_depth(engine.tables, engine.scheduler.state, 0)
    store.depth = 5
    for due in range(0, 500 * MS, 5 * MS):
        engine.timer_due(Work(timer, print), due, due)
    ran = []
    for now in range(500 * MS, 520 * MS, MS):
        work = engine.step(0, now).work
        ran.append(work.entity)
        assert engine.open_release(work.origin) is not None
        engine.finished(work, now, now, now, 0, 0)
        if work.entity is timer:
            engine.arrived(Work(store, print), work.origin, -1, -1, now)
        check(engine)
    assert set(ran) == {timer, store}
    assert store.unattributed == 0


@pytest.mark.parametrize('reported_at', [41, 45])
def test_a_sink_that_ended_in_time_is_in_time_also_if_it_was_reported_overdue(reported_at):
    """Its thread could report the end only after the deadline."""
    task_set = loads(graph(motor='name: drive, timer: 100ms, deadline: 40ms, tolerate: 1 of 3'))
    events, misses = [], []
    engine = new_engine(
        task_set, record=lambda *event: events.append(event), on_miss=misses.append)
    timer = entity_of(engine, task_set, 0, 0)
    engine.timer_due(Work(timer, print), 0, 0)
    work = engine.step(0, 30 * MS).work
    engine.judge_overdue(40 * MS + 1, [work])   # its thread may report that it has ended
    check(engine)
    assert not misses and engine.deadlines.first() == 40 * MS
    engine.judge_overdue(40 * MS + 1)
    check(engine)
    sink = engine.verdicts.tally.result()['dags']['/motor']['sinks']['/motor:drive']
    assert (sink['late'], sink['overdue'], sink['tolerate']['worst']) == (1, 1, 1)
    engine.finished(work, 30 * MS, 40 * MS, reported_at * MS, 0, 0)
    check(engine)
    result = engine.verdicts.tally.result()
    sink = result['dags']['/motor']['sinks']['/motor:drive']
    assert [miss.kind for miss in misses] == ['overdue']
    assert (sink['completed'], sink['late'], sink['overdue'], sink['tolerate']['worst']) == (
        1, 0, 0, 0)
    assert result['first_miss'] is None and not result['deadline_missed']
    execution, = (event for event in events if event[0] == 'execution')
    assert 40 * MS in execution and 40 * MS + 1 not in execution
    assert not [event for event in events if event[0] == 'deadline']


@pytest.mark.parametrize('inherits', [False, True])
def test_a_request_that_inherits_waits_for_a_short_callback_as_briefly_as_its_client(inherits):
    task_set = loads(graph(motor='name: drive, timer: 20ms, deadline: 20ms'))
    engine = new_engine(task_set, workers=2, default_deadline=100 * MS)
    engine.timer_due(Work(entity_of(engine, task_set, 0, 0), print), 0, 0)
    urgent = engine.patience()
    client = engine.step(0, 0).work
    request = Work(new_entity(), print)
    request.heritage = engine.heritage(client) if inherits else None
    engine.posted(request, 0)
    assert (engine.patience() == urgent) == inherits


class OneUser:
    """An engine for a timer that starts jobs, and one subscription, of deadline 300 ms."""

    def __init__(self, policy='rad', depth=0, **more):
        task_set = loads(graph(
            sensor='name: tick, timer: 500ms, publishes: [/data], dag: data',
            user='name: use, subscription: /data, deadline: 300ms'))
        self.engine = new_engine(task_set, policy=policy, default_deadline=100 * MS, **more)
        self.source, self.user = (entity_of(self.engine, task_set, 0, i) for i in (0, 1))
        self.user.depth = depth

    def publish(self, time):
        """Run the timer; return the origin of what it publishes."""
        self.engine.timer_due(Work(self.source, print), time, time)
        running = self.engine.step(0, time).work
        self.engine.finished(running, time, time, time, 0, 0)
        return running.origin

    def hear(self, origin, time):
        work = Work(self.user, print)
        self.engine.arrived(work, origin, -1, -1, time)
        check(self.engine)
        return work


@pytest.mark.parametrize(('on_late', 'dropped'), [('demote', 4), ('continue', 1)])
def test_late_messages_of_a_full_queue_are_dropped_with_the_oldest(on_late, dropped):
    """Otherwise all that follow wait for as many periods as it is long, and are late as well."""
    one = OneUser(depth=4, on_late=on_late)
    times = range(0, 2500 * MS, 500 * MS)
    origins = [one.publish(time) for time in times]
    last = [one.hear(origin, times[-1]) for origin in origins][-1]
    assert one.user.dropped == dropped and len(one.user.waiting) == 5 - dropped
    assert (one.engine.step(0, times[-1]).work is last) == (on_late == 'demote')


class Robot:
    """
    An engine that runs an important controller, a camera, and a detector that is slow at first.

    The load is 15 % of the interpreter, but the first detections take 100 ms each.
    """

    def __init__(self, slow, depth, keep, others=0):
        task_set = loads(graph(
            controller='name: control, timer: 20ms, deadline: 20ms, importance: high',
            camera='name: grab, timer: 60ms, publishes: [/image]',
            detector=f'name: detect, subscription: /image, deadline: 100ms, keep: {keep}'))
        self.engine = new_engine(task_set, 4, on_late='demote')
        self.controller, self.camera = (entity_of(self.engine, task_set, i, 0) for i in (0, 1))
        self.detector = entity_of(self.engine, task_set, 1, 1)
        self.detector.depth = depth
        for timer in (self.controller, self.camera):
            timer.depth = source_depth(
                self.engine.tables, self.engine.scheduler.state, self.engine.tables.dag_of[
                    timer.source])
        self.costs = {self.controller: (1 + others) * MS, self.camera: MS, self.detector: 5 * MS}
        self.slow = slow
        self.detections = []
        for entity in self.costs:
            entity.habit = GilHabit(True)

    def run(self, end):
        """Run callbacks one after the other, as they hold the interpreter."""
        engine, now, due = self.engine, 0, {self.controller: 0, self.camera: 0}
        while now < end:
            self.fire(due, now)
            work = engine.step(0, now).work
            if work is None:
                now = min(due.values())
                continue
            cost = self.costs[work.entity]
            if work.entity is self.detector:
                self.detections.append(now)
                if len(self.detections) <= self.slow:
                    cost = 100 * MS
            start, now, origin = now, now + cost, work.origin
            self.fire(due, now)
            work.entity.habit.took(cost, cost)
            engine.finished(work, start, now, now, 0, 0)
            if work.entity is self.camera:
                engine.arrived(Work(self.detector, print), origin, -1, -1, now)
            check(engine)
        return self.detections

    def fire(self, due, now):
        for timer, period in ((self.controller, 20 * MS), (self.camera, 60 * MS)):
            while due[timer] <= now:
                self.engine.timer_due(Work(timer, print), due[timer], now)
                due[timer] += period


@pytest.mark.parametrize('slow', [1, 3, 10])
@pytest.mark.parametrize(('depth', 'keep'), [(5, 'all'), (1, 'all'), (5, 'newest')])
def test_a_callback_that_was_slow_at_first_runs_as_often_as_it_can(slow, depth, keep):
    """It is less important than the controller, which was late because of it."""
    robot = Robot(slow, depth, keep)
    times = robot.run(6000 * MS)
    assert len(times) >= 100 - 2 * slow
    assert robot.controller.ran >= 300 - 5 * slow
    assert robot.engine.scheduler.state.mean[2] <= 6 * MS  # the detector's


@pytest.mark.parametrize(('depth', 'keep'), [(5, 'all'), (1, 'all'), (5, 'newest')])
def test_no_queue_starves_a_callback_in_an_overload(depth, keep):
    """The controller takes all the time; a message that is dropped passes its age on."""
    times = Robot(0, depth, keep, others=21).run(20_000 * MS)
    assert max(after - before for before, after in zip(times, times[1:])) <= 1300 * MS


def flooded(depths, tick_ms=2):
    """
    Run a declared timer of 100 ms, deadline 50 ms, next to a flood of undeclared messages.

    Each message takes 20 ms; every 10 ms one comes, for the callbacks in rotation.  Return the
    timer's results, and by callback the number and time of the messages that ran.
    """
    engine = new_engine(
        loads(graph(n='name: tick, timer: 100ms, deadline: 50ms')), default_deadline=100 * MS)
    timer = new_entity(holds=True)
    timer.source, timer.depth = 0, 2
    entities = [new_entity(depth=depth, holds=True) for depth in depths]
    ran, now, ticks, messages = [[] for _ in depths], 0, 0, 0
    while now < 10_000 * MS:
        while min(ticks * 10, messages) * 10 * MS <= now:
            if ticks * 10 <= messages:
                engine.timer_due(Work(timer, print), ticks * 100 * MS, now)
                ticks += 1
            else:
                entity = entities[messages % len(entities)]
                engine.ready(Work(entity, print, (messages,)), now)
                messages += 1
        work = engine.step(0, now).work
        if work is None:
            now = min(ticks * 10, messages) * 10 * MS
            continue
        start, is_tick = now, work.entity is timer
        now += (tick_ms if is_tick else 20) * MS
        if not is_tick:
            ran[entities.index(work.entity)].append((work.args[0], start))
        engine.finished(work, start, now, now, 0, 0)
        check(engine)
    return engine.verdicts.tally.result()['dags']['/n']['sinks']['/n:tick'], ran


@pytest.mark.parametrize('depths', [(1,), (10,), (1000,), (10, 10, 1)])
def test_an_undeclared_overload_takes_no_declared_deadline_down(depths):
    tick, ran = flooded(depths)
    assert counts(tick).in_time >= 98  # of 100; at first, all messages can be in time as well
    assert 480 <= sum(map(len, ran)) <= 500  # all the time that the timer leaves
    for each in ran:
        assert [number for number, _ in each] == sorted(number for number, _ in each)


@pytest.mark.parametrize('depth', [1, 10, 1000])
def test_a_declared_overload_does_not_starve_undeclared_callbacks(depth):
    """They get a turn about once in ten of their deadlines, 100 ms."""
    _, (ran,) = flooded((depth,), tick_ms=120)
    times = [0, *(time for _, time in ran), 10_000 * MS]
    assert max(after - before for before, after in zip(times, times[1:])) <= 1500 * MS


def test_the_first_executions_of_a_callback_do_not_count():
    habit, found = GilHabit(True), []
    for ms in (100, 80, 90, 5, 7):
        habit.took(ms * MS, ms * MS)
        found.append(habit.needs_ns)
    assert found == [-1, -1, -1, 5 * MS, 6 * MS]


def test_one_in_eight_long_executions_is_measured_of_a_callback_that_waits():
    """Each one again as soon as it computes, and of a callback that does."""
    habit = GilHabit()

    def run(own, wall):
        is_measured = habit.rests < 1
        if is_measured:
            habit.took(own * MS, wall * MS)
            habit.learn(wall * MS, own * MS, 0)
        else:
            habit.rests -= 1
            habit.waited(wall * MS)
        habit.rest_less()
        return is_measured

    for _ in range(20):
        run(1, 10)
    assert sum(run(1, 10) for _ in range(80)) == 10 and habit.needs_ns == 10 * MS
    assert habit.holds == 0
    run(1, 6)
    assert habit.needs_ns == 6 * MS   # measured or not, the least duration is known
    while not run(9, 10):
        pass
    assert all(run(9, 10) for _ in range(80)) and habit.computes == 1
    assert habit.needs_ns == habit.mean_ns


def test_a_message_of_a_job_comes_to_a_queue_that_is_full_of_short_ones_without_a_job():
    one = OneUser(depth=2)
    works = [one.hear(origin, 0) for origin in (None, None, one.publish(0))]
    assert [one.engine.step(0, 0).work, one.user.dropped] == [works[1], 1]


@pytest.mark.parametrize('policy', ['rad', 'gedf', 'fifo'])
def test_a_second_message_of_a_publication_comes_after_the_first(policy):
    """It belongs to no job, and would have the earlier deadline."""
    one = OneUser(policy)
    origin = one.publish(0)
    messages = [one.hear(origin, time) for time in range(3)]
    for time, message in enumerate(messages, 3):
        assert one.engine.step(0, time).work is message
        one.engine.finished(message, 0, time, time, 0, 0)


@pytest.mark.parametrize('policy', ['rad', 'gedf', 'llf'])
def test_messages_without_a_job_keep_their_order_behind_a_late_one(policy):
    """Though one that can be in time has come between them."""
    one, other = OneUser(policy, on_late='demote'), Work(new_entity(), print)
    origins = [one.publish(0), one.publish(500 * MS)]
    now = 600 * MS
    late = one.hear(origins[0], now)
    one.engine.ready(other, now)
    ran = [one.engine.step(0, now).work]
    messages = [late, *(one.hear(origin, now) for origin in (None, origins[1], None))]
    for _ in messages:
        one.engine.finished(ran[-1], now, now, now, 0, 0)
        ran.append(one.engine.step(0, now).work)
    assert [([other] + messages).index(work) for work in ran] == [0, 1, 3, 2, 4]


def test_messages_keep_their_order_when_their_callback_is_found_to_compute_no_more():
    """The first one has to wait, because another callback has the GIL."""
    engine, user = new_engine(workers=2), new_entity(holds=True)
    other = Work(new_entity(holds=True), print)
    engine.ready(other, 0)
    assert engine.step(0, 0).work is other
    messages = [Work(user, print) for _ in range(2)]
    for message in messages:
        engine.ready(message, 1)
        assert engine.step(1, 1).work is None
        user.habit.holds = 0
        check(engine)
    engine.finished(other, 1, 1, 1, 0, 0)
    assert [engine.step(worker, 1).work for worker in (0, 1)] == messages


def test_a_step_says_what_other_threads_are_to_do():
    engine = new_engine(workers=3)
    first, second = new_entity(), new_entity()
    for entity in (first, second):
        engine.ready(Work(entity, print), 0)
    step = engine.step(0, 0)
    assert step.work.entity is first and step.n_idle == 2 and engine.may_start_more(0)
    step = engine.step(1, 0)
    assert step.work.entity is second and step.n_idle == 1 and not engine.may_start_more(0)
    first.wall_ns = second.wall_ns = 1000
    for entity in (first, second):
        engine.ready(Work(entity, print), 0)
    step = engine.step(2, 0)
    assert step.is_short and step.n_idle == 0
    assert step.patience_ns == 4 * MS
    assert not engine.may_start_more(0)


def test_a_step_says_what_is_overtaken_and_when_the_next_deadline_is():
    task_set = loads(graph(n='name: tick, timer: 10ms, deadline: 10ms'))
    engine = new_engine(task_set, 3)
    engine.interpreter.pauses = True
    urgent, long = entity_of(engine, task_set, 0, 0), new_entity()
    for entity in (urgent, long):
        entity.habit = GilHabit(True)
    long.habit.mean_ns = 10 ** 9
    engine.ready(Work(long, print), 0)
    step = engine.step(0, 0)
    held = step.work
    assert not step.overtaken and engine.deadlines.first() == NEVER
    engine.timer_due(Work(urgent, print), MS, MS)
    step = engine.step(1, MS)
    work = step.work
    assert work.entity is urgent and step.overtaken == [held]
    assert engine.deadlines.first() == 11 * MS and engine.interpreter.overtaken == [held]
    engine.finished(work, MS, 2 * MS, 2 * MS, 0, 1)
    step = engine.step(1, 2 * MS)
    assert step.work is None and engine.interpreter.holders == [held]
    assert engine.deadlines.first() == NEVER


@pytest.mark.parametrize('is_late', [False, True])
def test_what_waits_for_a_callback_group_urges_its_owner(is_late):
    """Else an overtaken callback pauses for all that are less urgent than what it holds up."""
    task_set = loads(graph(
        n='name: fast, timer: 20ms, deadline: 20ms\nname: slow, timer: 500ms, deadline: 500ms',
        m='name: between, timer: 100ms, deadline: 100ms'))
    engine = new_engine(task_set, 3)
    engine.interpreter.pauses = True
    group = engine.scheduler.new_group()
    fast, slow, between = (entity_of(engine, task_set, dag, 0) for dag in range(3))
    fast.group = slow.group = group
    works = []
    for entity, now in ((slow, 0), (between, MS), (fast, 2 * MS)):
        entity.habit = GilHabit(True)
        entity.habit.mean_ns = 10 ** 9
        release = now - 30 * MS if is_late and entity is fast else now
        entity.since = release
        works.append(Work(entity, print))
        engine.timer_due(works[-1], release, now)
        step = engine.step(len(works) - 1, now)
        check(engine)
    assert step.work is None
    chain = works[:2] if is_late else works[1::-1]
    assert engine.interpreter.holders == chain and step.overtaken == chain[:1]
    engine.finished(works[0], 0, 3 * MS, 3 * MS, 0, 0)
    assert engine.step(0, 3 * MS).work is (None if is_late else works[2])
    check(engine)


def test_the_owner_of_a_callback_group_is_urged_after_it_has_awaited_something_as_well():
    """Else it waits for a worker behind all that is less urgent than what it holds up."""
    task_set = loads(graph(
        n='name: fast, timer: 20ms, deadline: 20ms',
        m='name: between, timer: 100ms, deadline: 50ms'))
    engine = new_engine(task_set, 1, default_deadline=100 * MS)
    fast, between = (entity_of(engine, task_set, dag, 0) for dag in range(2))
    slow = new_entity()
    slow.group = fast.group = engine.scheduler.new_group()
    owner = Work(slow, print)
    engine.ready(owner, 0)
    assert engine.step(0, 0).work is owner
    engine.suspended(owner, 0, MS, 0, 0)
    works = [Work(each, print) for each in (fast, between)]
    for work in works:
        engine.timer_due(work, MS, MS)
    assert engine.step(0, MS).work is works[1]
    check(engine)
    engine.timer_due(Work(between, print), 2 * MS, 2 * MS)
    engine.resume(owner, 3 * MS)
    engine.finished(works[1], MS, 4 * MS, 4 * MS, 0, 0)
    assert engine.step(0, 4 * MS).work is owner
    engine.finished(owner, 4 * MS, 5 * MS, 5 * MS, 0, 0)
    assert engine.step(0, 5 * MS).work is works[0]
    check(engine)


@examples(150)
@given(st.lists(st.booleans() | st.integers(0, 2), max_size=120))
def test_nothing_waits_that_may_run_during_a_computing_callback(steps):
    """What computes or does not becomes ready, or a worker ends, as the pool does it."""
    engine = new_engine(workers=3)
    entities = [new_entity(holds=holds) for holds in (False, True)]
    running = {}
    for now, step in enumerate(steps):
        begun = []
        if isinstance(step, bool):
            engine.ready(Work(entities[step], print), now)
            begun.append(engine.step(0, now).work)
        elif step in running:
            engine.finished(running.pop(step), now, now, now, 0, step)
            begun.append(engine.step(step, now).work)
        while begun and engine.may_start_more(now) and (len(begun) == 1 or begun[-1] is not None):
            begun.append(engine.step(0, now).work)
        running |= {work.worker: work for work in begun if work is not None}
        check(engine)
        if len(running) < engine.n_workers:
            assert not entities[0].waiting
            assert not entities[1].waiting or engine.interpreter.holders
        assert sum(work.entity.habit.holds for work in running.values()) <= 1


GRAPH = graph(n='name: tick, timer: 10ms, deadline: 10ms')


@examples(100)
@given(st.integers(0, 20), st.integers(1, 60), st.booleans())
def test_a_holder_that_takes_longer_than_usual_is_overtaken_when_the_engine_says(
    usual, arrival, has_ended
):
    """Also if another one has overtaken it before: its own time counts."""
    task_set = loads(GRAPH)
    engine = new_engine(task_set, 3)
    urgent, long = entity_of(engine, task_set, 0, 0), new_entity()
    for entity, mean in ((urgent, 0), (long, usual * MS)):
        entity.habit = GilHabit(True)
        entity.habit.mean_ns = mean
    engine.ready(Work(long, print), 0)
    assert engine.step(0, 0).work is not None
    now = arrival * MS
    if has_ended:
        engine.timer_due(Work(urgent, print), now, now)
        engine.interpreter.holders[-1].entity.habit.mean_ns = 10 ** 9
        other = engine.step(1, now).work
        long.habit.mean_ns = usual * MS
        engine.finished(other, now, now, now, 0, 1)
    engine.timer_due(Work(urgent, print), now, now)
    at = engine.interpreter.overtaking_at()
    assert at == usual * MS + 5 * MS  # half of the deadline
    if arrival <= usual - 5:  # it takes long enough even if it takes as long as usual
        assert engine.step(1, now).work is not None
        return
    if now < at:
        assert engine.step(1, at - 1).work is None
    assert engine.step(1, max(at, now)).work is not None


@pytest.mark.parametrize('deadline, most', [('33ms', 1), ('5ms', 0.6), ('1s', 4)])
def test_what_is_urgent_waits_less_for_a_callback_that_was_expected_to_end(deadline, most):
    """And it is checked as much sooner whether one that it may not overtake computes."""
    task_set = loads(graph(n=f'name: a, subscription: /a, period: 1s, deadline: {deadline}'))
    engine = new_engine(task_set, workers=2)
    entity = entity_of(engine, task_set, 0, 0)
    assert engine.interpreter.patience() == 4 * MS
    engine.arrived(Work(entity, print), None, 0, -1, 0)
    assert engine.interpreter.patience() == most * MS
    check = GilCheck()
    check.begin(engine, 0, 2 * MS, engine.interpreter.patience() // 2)
    assert check.at == 2 * MS
    check.waits(threading.get_ident(), threading.get_native_id(), 2 * MS)
    assert check.at == 2 * MS + engine.interpreter.patience() // 2


def test_a_timer_that_fires_once_and_is_due_again_starts_no_other_job():
    """As long as its callback, which cancels it, has not run: it runs as an undeclared one."""
    task_set = loads(graph(n='name: a, timer: 10ms, once: true, deadline: 10ms'))
    engine = new_engine(task_set)
    entity = entity_of(engine, task_set, 0, 0)
    for now in (0, 10 * MS):
        engine.timer_due(Work(entity, print), now, now)
    engine.timer_missed(entity, 10 * MS, 10 * MS, 3, 40 * MS)
    jobs = []
    while (work := engine.step(0, 40 * MS).work) is not None:
        jobs.append(work.origin is not None)
        engine.finished(work, 40 * MS, 40 * MS, 40 * MS, 0, 0)
    assert jobs == [True, False]
    assert engine.verdicts.tally.result()['dags']['/n']['jobs'] == 1


def test_what_is_urgent_waits_no_longer_because_it_needs_the_interpreter():
    """It is not overtaken by a callback that is expected to end soon; that one may wait."""
    task_set = loads(graph(n="""
        name: a, subscription: /a, period: 1s, deadline: 33ms, holds_interpreter: true
        name: b, subscription: /b, period: 1s, deadline: 1s, holds_interpreter: true"""))
    engine = new_engine(task_set, workers=2)
    urgent, holder = (entity_of(engine, task_set, dag, 0) for dag in range(2))
    for entity in (urgent, holder):
        entity.habit = GilHabit(True)
        entity.habit.mean_ns = MS // 2
    engine.arrived(Work(holder, print), None, 0, -1, 0)
    assert engine.step(0, 0).work is not None
    engine.arrived(Work(urgent, print), None, 0, -1, 0)
    before = engine.interpreter.patience()
    assert engine.step(1, 0).work is None
    assert engine.interpreter.patience() == before == MS


def test_the_successor_of_a_callback_that_waits_starts_within_a_millisecond():
    """A thread looks, and checks once more whether that callback computes."""
    task_set = loads(graph(n='name: a, subscription: /a, period: 1s, deadline: 20ms'))
    engine = new_engine(task_set, workers=2)
    engine.arrived(Work(entity_of(engine, task_set, 0, 0), print), None, 0, -1, 0)
    patience = engine.interpreter.patience()
    assert patience // 2 + patience // CHECK_PART < MS // 2


def test_what_is_taken_while_its_node_is_removed_counts_as_dropped():
    """A waitable's data are taken without the engine's lock."""
    engine, recorded = new_engine(), []
    engine.verdicts.record = lambda *event: recorded.append((event[0], event[-1]))
    entity = new_entity()
    engine.remove(entity, 0)
    engine.ready(Work(entity, print), 1)
    assert (entity.ready, entity.dropped, entity.is_through()) == (1, 1, True)
    assert recorded == [('drop', 'destroyed')] and not engine.has_waiting
    engine.finish(2)
    engine.ready(Work(entity, print), 3)  # its recording is closed
    assert entity.dropped == len(recorded) == 1


def test_what_the_end_of_a_context_has_kept_from_running_is_dropped():
    """What has begun has run; neither keeps a worker."""
    engine, entity = new_engine(workers=2), new_entity()
    for has_run in (True, False):
        work = Work(entity, print)
        engine.ready(work, 0)
        assert engine.step(0, 0).work is work
        engine.left_open(work, 0, 5, 0, 0, has_run)
        check(engine)
    assert (entity.ready, entity.ran, entity.dropped, entity.busy_ns) == (2, 1, 1, 5)
    assert entity.is_through() and engine.idle_workers == 2


def test_a_message_that_its_group_has_refused_answers_the_job_that_is_the_newest_later():
    task_set = loads(graph(
        lidar='name: scan, timer: 50ms, publishes: [/points], dag: scan',
        camera='name: grab, timer: 20ms, publishes: [/boxes], deadline: 20ms',
        fusion='name: fuse, sync: {topics: [/boxes, /points], driven_by: /points}, '
        'publishes: [/obstacles], deadline: 1s'))
    engine = new_engine(task_set, 2)
    scan = entity_of(engine, task_set, 0, 0)
    points, boxes = (entity_of(engine, task_set, 0, 1) for _ in range(2))
    for entity, topic in ((points, '/points'), (boxes, '/boxes')):
        entity.topic, entity.awaiting = topic, engine.answers.awaiting['/fusion:fuse']
    boxes.may_answer, boxes.targets = True, {}
    fused = Work(boxes, print)
    engine.ready(fused, 0)
    assert engine.step(0, 0).work is fused and engine.origin_of(fused) is None
    engine.refused(fused, MS)
    check(engine)
    engine.timer_due(Work(scan, print), MS, MS)
    scanned = engine.step(0, MS).work
    driving = Work(points, print)
    engine.arrived(driving, scanned.origin, -1, -1, 2 * MS)
    assert engine.step(1, 2 * MS).work is driving
    engine.finished(scanned, MS, 2 * MS, 2 * MS, 0, 0)
    assert engine.step(0, 2 * MS).work is fused
    engine.answers.note_published(fused, '/obstacles', None)
    for work in (driving, fused):
        engine.finished(work, 2 * MS, 3 * MS, 3 * MS, 0, work.worker)
        check(engine)
    dag = engine.verdicts.tally.result()['dags']['scan']
    assert counts(dag['sinks']['/fusion:fuse']).in_time == 1


def test_jobs_are_judged_that_were_released_before_their_process_is_ready():
    """The one of several processes that is ready last says since when."""
    task_set = loads(GRAPH)
    engine = new_engine(task_set, 2)
    timer = entity_of(engine, task_set, 0, 0)
    engine.set_judging(False, None, 0)
    for since, release, now in ((0, MS, 2 * MS), (3 * MS, 4 * MS, 6 * MS)):
        if since:
            engine.set_judging(True, since, 5 * MS)
        engine.timer_due(Work(timer, print), release, now)
        work = engine.step(0, now).work
        engine.finished(work, now, now, now, 0, 0)
    dag = engine.verdicts.tally.result()['dags']['/n']
    assert counts(dag['sinks']['/n:tick']).in_time == 1


def test_how_long_something_has_waited_for_its_program_counts_from_the_first_time():
    """Not from the last time that something more urgent of the program went before it."""
    task_set = loads(GRAPH)
    engine = new_engine(task_set, 2)
    outer = engine.outer.new()
    engine.outer.open(outer, 1, 0)
    first, patient, urgent = new_entity(), new_entity(), entity_of(engine, task_set, 0, 0)
    for each in (first, patient, urgent):
        each.outer = outer
    works = [Work(first, print), Work(patient, print)]
    for work in works:
        engine.ready(work, 0)
    assert engine.step(0, 0).work is works[0] and engine.step(1, MS).work is None
    engine.finished(works[0], 0, 5 * MS, 5 * MS, 0, 0)
    engine.timer_due(Work(urgent, print), 5 * MS, 5 * MS)
    work = engine.step(0, 5 * MS).work
    assert work.entity is urgent and engine.step(1, 6 * MS).work is None
    engine.finished(work, 5 * MS, 9 * MS, 9 * MS, 0, 0)
    assert engine.step(0, 9 * MS).work is works[1]
    assert engine.outer.read_wait(outer) == 8 * MS
    check(engine)


def test_the_time_of_pauses_does_not_count_as_held():
    """Else an overtaken callback would soon seem to take longer than usual."""
    engine = new_engine(workers=2)
    entity = new_entity(holds=True)
    entity.habit.mean_ns = 5 * MS
    engine.ready(Work(entity, print), 0)
    work = engine.step(0, MS).work
    assert engine.interpreter.usual_end(work) == 11 * MS
    pays_at = engine.interpreter.overtaking_at()
    work.paused_ns = 3 * MS
    assert engine.interpreter.usual_end(work) == 14 * MS
    assert engine.interpreter.overtaking_at() == pays_at + 3 * MS


@pytest.mark.parametrize('kind, deadline, part', [
    ('declared', '40ms', 2.5), ('declared', '8ms', 2), ('undeclared', '40ms', 25),
    ('waits', '40ms', 0)])
def test_how_long_a_timer_may_stay_unnoticed(make_executor, kind, deadline, part):
    """For a part of deadline or period; one whose callback waits not at all."""
    task_set = loads(graph(n=f'name: tick, timer: 10ms, deadline: {deadline}'))
    executor = make_executor(task_set)
    entity = entity_of(engine_of(executor), task_set, 0, 0, TimerLike)
    if kind == 'undeclared':
        entity.callback, entity.source = None, -1
    entity.habit = GilHabit(kind != 'waits')
    assert pool_of(executor).due.allowance(entity, 10 * MS) == part * MS


def test_half_a_deadline_is_left_when_a_message_of_a_job_arrives(make_executor):
    """All of it if the job is released then, or if the message is of no job."""
    task_set = loads(graph(
        n='name: tick, timer: 80ms, publishes: [/a], dag: a',
        m='name: use, subscription: /a, deadline: 80ms',
        o='name: hear, subscription: /b, period: 80ms, deadline: 80ms',
        p='name: hear, subscription: /b, period: 80ms, deadline: 80ms, '
        'release_from: source_timestamp'))
    engine = engine_of(make_executor(task_set, default_deadline='80ms'))
    entities = [entity_of(engine, task_set, *place) for place in ((0, 1), (1, 0), (2, 0))]
    found = [engine.relative_deadline(entity) for entity in (*entities, new_entity())]
    assert found == [40 * MS, 80 * MS, 40 * MS, 80 * MS]


class Appointment:
    """Something that is done at a time."""

    entry = None
    is_done = False

    def come_due(self):
        self.is_done = True


def test_a_thread_that_rests_puts_off_the_next_look(make_executor):
    """No parked thread is to wake up in vain while it waits; after a quiet time, none at all."""
    pool = pool_of(make_executor())
    due, watch = pool.due, pool.parking.watch
    begin, found = monotonic_ns(), []
    with pool.lock:
        pool.running, pool.polling = True, 1
        for ms, look in ((100, 104), (101, 103), (102, 120), (110, 112)):
            watch.arm(begin + look * MS)
            due.arm_idle(begin + ms * MS)
            found.append(watch.at if watch.at == NEVER else (watch.at - begin) // MS)
        pool.agenda.set(Appointment(), begin + 150 * MS, begin + 150 * MS)
        for ms, look in ((120, 125), (130, 170), (130, 140)):
            watch.arm(begin + look * MS)
            due.arm_idle(begin + ms * MS)
            found.append((watch.at - begin) // MS)
        pool.running, pool.polling = False, 0
    assert found == [NEVER, 121, 120, NEVER, 170, 170, 150]


def test_a_look_is_put_off_to_when_the_next_callback_would_need_it(make_executor):
    """So that this one need not set it, as long as it is not to end before."""
    pool = pool_of(make_executor())
    due, watch, now = pool.due, pool.parking.watch, monotonic_ns()
    found = []
    with pool.lock:
        pool.running, pool.polling = True, 1
        for latest in (11, 17, 60):  # of a timer that is due in 10 ms
            timer = Appointment()
            pool.agenda.set(timer, now + 10 * MS, now + latest * MS)
            watch.arm(now + 2 * MS)
            due.arm_idle(now)
            found.append((watch.at - now) // MS)
            pool.agenda.cancel(timer)
        pool.running, pool.polling = False, 0
    assert found == [30, 17, 30]


def test_a_callback_is_not_looked_for_because_of_the_check_of_one_that_has_ended(make_executor):
    pool = pool_of(make_executor(num_workers=2))
    due, engine = pool.due, pool.engine
    with pool.lock:
        pool.running = True
        now = pool.tick()
        holder = new_entity(holds=True)
        engine.ready(Work(holder, print), now)
        work = engine.step(0, now).work
        engine.ready(Work(new_entity(holds=True), print), now)
        due.check.begin_if_wanted(now - pool.offset)
        assert pool.agenda.latest < NEVER
        now += 1_000 * MS
        engine.finished(work, now, now, now, 0, 0)
        assert engine.step(0, now).work
        due.arm_late_look(now - pool.offset, 20 * MS)
        assert pool.parking.watch.at == now - pool.offset + 20 * MS
        pool.running = False


@pytest.mark.parametrize('latest, is_done', [(0, True), (20 * MS, False)])
def test_a_thread_does_itself_what_another_one_would_have_to_soon(
        make_executor, latest, is_done):
    """When its callback ends; the other one would be woken for it."""
    pool = pool_of(make_executor())
    me, entity, appointment = WorkerThread(pool, threading.current_thread()), new_entity(), None
    entity.wall_ns = 0
    with pool.lock:
        pool.running = True
        pool.engine.ready(Work(entity, print), pool.tick())
        assert pool._choose(me, pool.now)
        me.outcome, me.end = None, pool.now
        now = pool.tick() - pool.offset
        appointment = Appointment()
        pool.agenda.set(appointment, now, now + latest)
        pool._polled_at = pool.now + 1_000 * MS
        pool._go_on(me, is_last=True)
        pool.running = False
        pool.agenda.cancel(appointment)
        pool._n_parked += 1
    assert appointment.is_done == is_done


def test_what_nothing_waits_for_any_more_is_not_checked_and_not_kept():
    """Its message may be large."""
    engine, agenda = new_engine(workers=2), Agenda()
    pool = SimpleNamespace(
        engine=engine, agenda=agenda, pauses=SimpleNamespace(is_watched=False))
    check = HolderCheck(pool, 0, lambda at: None)
    holder, other = Work(new_entity(holds=True), print), new_entity(holds=True)
    engine.ready(holder, 0)
    assert engine.step(0, 0).work is holder
    engine.ready(Work(other, print), 0)
    engine.step(1, 0)
    check.begin_if_wanted(0)
    assert agenda.next < NEVER
    engine.remove(other, 1)
    check.note(1)
    assert agenda.next == NEVER
    engine.finished(holder, 0, 1, 1, 0, 0)
    kept = weakref.ref(holder)
    del holder
    assert kept() is None


class Holding:
    """A pool with an execution that holds the interpreter, and one that waits for it."""

    def __init__(self):
        self.engine, self.agenda, self.now, self.calls = new_engine(workers=2), Agenda(), 0, []
        self.pauses = SimpleNamespace(is_watched=False, end=lambda: self.calls.append('goes on'))
        thread = SimpleNamespace(ident=threading.get_ident(), vtid=threading.get_native_id())
        self.thread_of = lambda work: thread
        self.check = HolderCheck(self, 0, lambda at: None)
        self.works = [Work(new_entity(holds=True), print) for _ in range(3)]
        for number, work in enumerate(self.works):
            self.engine.ready(work, 0)
            assert (self.engine.step(number % 2, 0).work is None) == bool(number)


def test_what_a_paused_thread_checks_no_other_one_does():
    pool = Holding()
    pool.pauses.is_watched = True
    pool.check.begin_if_wanted(0)
    overtakes_at = pool.engine.interpreter.overtaking_at()
    assert pool.agenda.next == overtakes_at
    pool.pauses.is_watched = False
    pool.check.begin_if_wanted(0)
    assert pool.agenda.next < overtakes_at


def test_what_runs_longer_than_usual_is_checked_at_once_and_once_more():
    pool = Holding()
    pool.check.begin_late(MS)
    assert pool.check._check.has_begun(pool.works[0])


def test_the_next_one_that_computes_is_checked_from_scratch():
    pool = Holding()
    pool.check.begin_if_wanted(0)
    pool.engine.finished(pool.works[0], 0, 1, 1, 0, 0)
    assert pool.engine.step(0, 1).work is pool.works[1]
    pool.now = 100 * MS
    pool.check.come_due()
    assert pool.check._check.subject is pool.works[1]
    assert not pool.check._check.has_begun(pool.works[1])


def test_the_one_that_was_overtaken_goes_on_when_the_urgent_one_waits():
    pool = Holding()
    pool.check._check = SimpleNamespace(
        subject=pool.works[0], at=0, waits=lambda *_: True, end=lambda: None)
    pool.check.come_due()
    assert pool.calls == ['goes on'] and not pool.engine.interpreter.holders
    assert pool.engine.step(1, 1).work is pool.works[1]


@pytest.mark.parametrize('wall_ms', [0, 100])
def test_what_takes_the_interpreter_is_checked_if_something_waits_for_it(make_executor, wall_ms):
    """Though another thread waits for events already: it may sleep for long."""
    pool = pool_of(make_executor(num_workers=3))
    me, entities = WorkerThread(pool, None), [new_entity(holds=True) for _ in range(2)]
    with pool.lock:
        pool.running, pool.polling = True, 1
        for entity in entities:
            entity.wall_ns = wall_ms * MS
            pool.engine.ready(Work(entity, print), pool.tick())
        assert pool._choose(me, pool.now) and me.work.entity is entities[0]
        assert pool.loop.timer.at <= pool.agenda.next < NEVER
        pool.running, pool.polling = False, 0


def test_what_computes_is_checked_when_something_comes_that_waits_for_it(make_executor):
    """Else nothing would wake the thread that waits for events."""
    pool = pool_of(make_executor(num_workers=3))
    me, entities = WorkerThread(pool, None), [new_entity(holds=True) for _ in range(2)]
    with pool.lock:
        pool.running, pool.polling = True, 1
        pool.engine.ready(Work(entities[0], print), pool.tick())
        assert pool._choose(me, pool.now) and pool.agenda.next == NEVER
        pool.engine.ready(Work(entities[1], print), pool.tick())
        pool.wake_for(pool.now)
        assert pool.loop.timer.at <= pool.agenda.next < NEVER
        pool.running, pool.polling = False, 0


def test_what_a_thread_finds_waiting_when_it_looks_is_checked_for(make_executor):
    """What has the interpreter runs longer than usual: it may wait."""
    pool = pool_of(make_executor(num_workers=3))
    me, entities = WorkerThread(pool, None), [new_entity(holds=True) for _ in range(2)]
    me.begin()
    pool._visitors.append(me)
    with pool.lock:
        pool.running = True
        pool.engine.ready(Work(entities[0], print), pool.tick())
        assert pool._choose(me, pool.now)
        pool.engine.ready(Work(entities[1], print), pool.tick())
        assert pool.agenda.next == NEVER
        pool._look()
        assert pool.agenda.next < NEVER
        pool.running = False
    pool._visitors.remove(me)


def test_the_deadline_of_what_may_hang_is_watched(make_executor):
    """Else its miss would be known when it ends."""
    task_set = loads(GRAPH)
    pool = pool_of(make_executor(task_set, num_workers=2))
    timer = entity_of(pool.engine, task_set, 0, 0, TimerLike)
    with pool.lock:
        pool.running = True
        now = pool.tick()
        pool.engine.timer_due(Work(timer, print), now, now)
        assert pool._choose(WorkerThread(pool, None), pool.now)
        assert pool.agenda.next == now - pool.offset + 10 * MS + 1
        pool.running = False


def test_a_step_can_be_woken_again_after_a_worker_has_looked(make_executor):
    """The look of a callback that has outlasted a spin takes the event that was to wake it."""
    pool = pool_of(make_executor())
    with pool.lock:
        pool.running = pool.is_spin_once = True
        pool.call()
        pool._look()
        assert not pool.loop.wait(0)
        pool.call()
        assert pool.loop.wait(0)
        pool.running = pool.is_spin_once = False


def test_a_parked_thread_looks_soon_for_what_comes_during_a_short_callback(
        make_executor, monkeypatch):
    """In case that the callback takes longer this time."""
    pool = pool_of(make_executor(num_workers=2))
    me, entities = WorkerThread(pool, None), [new_entity(), new_entity()]
    monkeypatch.setattr(current, 'running', me)
    with pool.lock:
        pool.running = True
        entities[0].wall_ns = 0
        pool.engine.ready(Work(entities[0], print), pool.tick())
        assert pool._choose(me, pool.now)
        assert pool.parking.watch.at <= pool.now - pool.offset + NET_NS
        pool.engine.ready(Work(entities[1], print), pool.tick())
        pool.wake_for_more()
        assert pool.parking.watch.at <= pool.now - pool.offset + PATIENCE_NS
        pool.running = False


@pytest.mark.parametrize('leaving', [0, 1])
def test_what_becomes_due_while_nothing_spins_wakes_a_thread_in_the_next_spin(
        make_executor, monkeypatch, leaving):
    """One that is just leaving may have been woken for it in vain."""
    monkeypatch.setattr(workers, 'END_S', 0.0)
    pool = pool_of(make_executor())
    with pool.lock:
        pool.running, pool.polling = True, 1
        now = pool.tick() - pool.offset
        pool.agenda.set(Appointment(), now, now)
        pool.due.arm(now)
        assert pool.loop.wait(10.0)
        pool.polling = leaving
    pool.pause()
    assert not pool.loop.wait(0)
    with pool.lock:
        pool.running, pool.polling = True, 1
        pool.due.arm(now)
        pool.running, pool.polling = False, 0
    assert pool.loop.wait(10.0)


class Eager(Entity):
    """An entity for which a thread has to wait, also while a callback computes."""

    def may_come_from_outside(self):
        return True

    def is_eager(self):
        return True


def test_no_thread_waits_for_events_of_a_callback_that_has_gone(make_executor):
    """While another one computes."""
    pool = pool_of(make_executor(num_workers=2))
    me, other = WorkerThread(pool, None), WorkerThread(pool, threading.current_thread())
    eager = new_entity(kind=Eager)
    with pool.lock:
        pool.running = True
        pool.engine.ready(Work(new_entity(holds=True), print), pool.tick())
        assert pool._choose(me, pool.now)
        for change, state in ((pool.note_eager, 'waiting'), (pool.forget_eager, 'parked')):
            change(eager)
            pool._rest(other, pool.now)
            assert other.state.value == state
        pool.running = False


def test_a_thread_is_called_to_wait_for_events_while_a_callback_computes(
        make_executor, monkeypatch):
    """If a callback is known to wait, which may get messages at any time."""
    pool, calls = pool_of(make_executor(num_workers=2)), []
    monkeypatch.setattr(pool.parking, 'call', lambda: calls.append(1))
    eager = new_entity(kind=Eager)
    pool.note_eager(eager)
    with pool.lock:
        pool.running, pool._n_parked = True, 1
        for expected in (1, 0):
            me, computes = WorkerThread(pool, None), new_entity(holds=True)
            computes.wall_ns = 100 * MS
            pool.engine.ready(Work(computes, print), pool.tick())
            assert pool._choose(me, pool.now) and len(calls) == expected
            pool.engine.finished(me.work, pool.now, pool.now, pool.now, 0, 0)
            pool.forget_eager(eager)
            calls.clear()
        pool.running, pool._n_parked = False, 0


@pytest.mark.parametrize('wall_ns', [0, MS], ids=['past the core', 'core'])
def test_a_message_is_freed_when_its_callback_has_ended(make_executor, wall_ns):
    """It is kept by nothing until the next one comes."""
    pool = pool_of(make_executor())
    me, entity = WorkerThread(pool, None), new_entity()
    entity.wall_ns = wall_ns
    work = Work(entity, print)
    with pool.lock:
        pool.running = True
        pool.engine.ready(work, pool.tick())
        assert pool._choose(me, pool.now) and me.work is work
        me.work = None
        pool.engine.finished(work, pool.now, pool.now, pool.now, 0, 0)
        pool.running = False
    kept = weakref.ref(work)
    del work
    assert kept() is None


def test_a_thread_that_may_be_needed_soon_waits_for_events_next_to_another_one(make_executor):
    """Its last callback has waited; but no more threads wait than workers are idle."""
    pool = pool_of(make_executor(num_workers=3))
    threads = [WorkerThread(pool, threading.current_thread()) for _ in range(4)]
    with pool.lock:
        pool.running = True
        for thread in threads:
            thread.is_spare = True
            pool._rest(thread, pool.tick())
        assert [thread.state.value for thread in threads] == 3 * ['waiting'] + ['parked']
        pool.running = False


def test_messages_lost_on_the_way_to_the_executor_itself_are_none_of_a_callback():
    engine, entity = new_engine(), new_entity()
    for is_own in (True, False):
        entity.is_own = is_own
        engine.messages_lost(entity, 3, 0)
    assert entity.lost == 3


def test_the_job_of_a_callback_that_is_destroyed_before_it_runs_expires():
    task_set = loads(GRAPH)
    engine = new_engine(task_set, 2)
    engine.timer_due(Work(entity_of(engine, task_set, 0, 0), print), 0, 0)
    work = engine.step(0, 0).work
    engine.destroyed(work, MS)
    check(engine)
    sink = engine.verdicts.tally.result()['dags']['/n']['sinks']['/n:tick']
    assert (sink['completed'], sink['expired']) == (0, 1)
    assert work.entity.dropped == 1 and engine.idle_workers == 2


def test_what_comes_to_a_destroyed_callback_inherits_nothing():
    """Nor does any other execution instead of it."""
    engine, gone, other = new_engine(), new_entity(), Work(new_entity(), print)
    engine.ready(other, 0)
    engine.remove(gone, 0)
    request = Work(gone, print)
    request.heritage = 1, 0
    engine.posted(request, 0)
    check(engine)
    assert engine.step(0, 0).work is other and engine.heritage(other) is None


def test_a_callback_that_is_just_reported_is_asked_again_soon_whether_it_is_overdue(
        make_executor):
    """If it is not about to end but to begin, it may hang."""
    task_set = loads(GRAPH)
    pool = pool_of(make_executor(task_set, num_workers=2))
    timer, me = entity_of(pool.engine, task_set, 0, 0, TimerLike), WorkerThread(pool, None)
    with pool.lock:
        pool.running = True
        pool._visitors.append(me)
        release = pool.tick() - 20 * MS
        pool.engine.timer_due(Work(timer, print), release, release)
        assert pool._choose(me, pool.now)
        pool.due.overdue.come_due()
        assert pool.agenda.next == pool.now - pool.offset + REPORT_NS
        me.outcome = RUNS
        pool.due.overdue.come_due()
        sink = pool.engine.verdicts.tally.result()['dags']['/n']['sinks']['/n:tick']
        assert sink['overdue'] == 1
        pool.running = False
        pool._visitors.remove(me)


def test_a_parked_thread_looks_when_something_is_due_but_not_all_the_time(make_executor):
    """Though a callback that may get messages is known to wait."""
    pool = pool_of(make_executor(num_workers=2))
    due, watch = pool.due, pool.parking.watch
    with pool.lock:
        pool.running = True
        now = pool.tick() - pool.offset
        due.arm_late_look(now, NET_NS)
        assert watch.at == now + NET_NS
        pool.agenda.set(Appointment(), now + MS, now + 2 * MS)
        due.arm_late_look(now, NET_NS)
        assert watch.at == now + 2 * MS
        due.expect(new_entity(kind=Eager))
        due.arm_look(now)
        assert watch.at == now + SOON_NS
        pool.running = False


def test_a_job_that_has_waited_in_vain_until_the_end_has_expired():
    """It is not only overdue, though no other job was released after it."""
    task_set = loads(graph(
        n='name: tick, timer: 10ms, publishes: [/a], dag: a',
        m='name: use, subscription: /a, deadline: 1s'))
    engine = Engine(task_set, 1, 'rad', max_active_jobs=NEVER, expire_after=5 * MS,
                    default_deadline=10 ** 9)
    engine.timer_due(Work(entity_of(engine, task_set, 0, 0), print), 0, 0)
    work = engine.step(0, 0).work
    engine.finished(work, 0, 0, 0, 0, 0)
    engine.finish(1200 * MS)
    sink = engine.verdicts.tally.result()['dags']['a']['sinks']['/m:use']
    assert (sink['expired'], sink['overdue']) == (1, 0)


def test_another_thread_starts_what_has_waited_for_the_interpreter_when_it_is_free():
    """Next to something that came first, and does not need it."""
    engine = new_engine(workers=2)
    group = engine.scheduler.new_group()
    first, second, third = (Work(new_entity(*each), print) for each in (
        (group, 0, True), (group, 0, False), (-1, 0, True)))
    engine.ready(first, 0)
    assert engine.step(0, 0).work is first
    engine.ready(second, 1)
    engine.ready(third, 2)
    assert engine.step(1, 3).work is None and not engine.may_start_more(3)
    engine.finished(first, 0, 4, 4, 0, 0)
    assert engine.step(0, 4).work is second and engine.may_start_more(4)
    assert engine.step(1, 4).work is third and not engine.may_start_more(4)
    check(engine)


def test_a_thread_is_woken_for_what_is_urgent_though_something_else_waits_longer():
    """For the interpreter, which it may not have."""
    task_set = loads(GRAPH)
    engine = new_engine(task_set, 3)
    engine.interpreter.pauses = True
    urgent = entity_of(engine, task_set, 0, 0)
    urgent.habit = GilHabit(True)
    for now in range(2):
        entity = new_entity(holds=True)
        entity.habit.mean_ns = 10 ** 9
        engine.ready(Work(entity, print), now)
        assert (engine.step(now, now).work is None) == bool(now)
    assert not engine.may_start_more(MS)
    engine.timer_due(Work(urgent, print), MS, MS)
    assert engine.may_start_more(MS)
    assert engine.step(1, MS).work.entity is urgent


def test_what_runs_at_once_counts_as_undeclared():
    engine, entity = new_engine(), new_entity()
    engine.ran_at_once(entity)
    engine.ready(Work(entity, print), 0)
    assert engine.undeclared == 2 and (entity.ready, entity.ran) == (2, 1)


def test_what_waits_for_a_callback_that_seems_to_compute_waits_half_as_long():
    """Then it is found out whether it does."""
    found = []
    for holds in (False, True):
        engine = new_engine(workers=2)
        engine.ready(Work(new_entity(holds=holds), print), 0)
        assert engine.step(0, 0).work
        engine.ready(Work(new_entity(holds=True), print), 0)
        found.append(engine.patience())
    assert found == [PATIENCE_NS, PATIENCE_NS // 2]


def test_one_thread_is_called_until_it_has_looked(make_executor, monkeypatch):
    """Each further one would find nothing more to start."""
    pool, calls = pool_of(make_executor()), []
    monkeypatch.setattr(pool.parking, 'call', lambda: calls.append(1))
    monkeypatch.setattr(pool.loop, 'poll', lambda: [])
    me = WorkerThread(pool, None)
    pool._n_parked = 2
    with pool.lock:
        pool.call()
        pool.call()
    assert len(calls) == 1
    pool._receive(me, None)
    with pool.lock:
        pool.call()
    assert len(calls) == 2
    pool._n_parked = 0


def test_no_thread_is_woken_for_a_busy_group_but_for_its_owner():
    engine = new_engine(workers=2)
    group = engine.scheduler.new_group()
    owner, other = new_entity(group), new_entity(group)
    engine.ready(Work(owner, print), 0)
    work = engine.step(0, 0).work
    engine.ready(Work(other, print), 1)
    assert not engine.may_start_more(1)
    engine.suspended(work, 0, 2, 0, work.worker)
    assert not engine.may_start_more(2)
    engine.resume(work, 3)
    assert engine.may_start_more(3)


@pytest.mark.parametrize('waits_since, computed, stops', [(0, 0, 1), (100, 0, 0), (0, 90, 0)])
def test_a_late_wake_up_is_no_stop_if_all_threads_ran_callbacks(
        make_executor, monkeypatch, waits_since, computed, stops):
    """No thread waited for the timer then; nor if the process computed meanwhile."""
    pool, used, found = pool_of(make_executor()), [0], []
    monkeypatch.setattr(due_module, 'process_time_ns', lambda: used[0])
    replace_method(
        monkeypatch, pool.engine, 'machine_stopped', lambda *times: found.append(times))
    now = pool.clock.now()
    begin = now - 100 * MS - pool.offset
    with pool.lock:
        pool.due.begin(begin)
        pool.loop.timer.arm(begin + 10 * MS)
        used[0] = computed * MS
        pool.due.handle(now, now - (100 - waits_since) * MS)
    assert found == stops * [(now - 90 * MS, now)]


class Steps:
    """An engine with entities of several kinds, each work of which has a number."""

    def __init__(self, policy, workers=2):
        self.engine = new_engine(loads(GRAPH), workers, policy)
        group = self.engine.scheduler.new_group()
        self.entities = [new_entity(), new_entity(group, 2, True), new_entity(group, 1),
                         new_entity(holds=True), new_entity(depth=1)]
        for entity in self.entities:
            entity.wall_ns = 0
        self.entities[0].wall_ns = MS
        self.entities[4].source = 0
        self.running = []
        self.suspended = []
        self.lent = []
        self.returning = []
        self.count = 0

    def do(self, step, which, now):
        """Carry out one step; return what has started."""
        engine, entity, started = self.engine, self.entities[which], None
        if step == 'ready':
            self.count += 1
            work = Work(entity, print, (self.count,))
            if entity.source < 0:
                engine.ready(work, now)
            else:
                engine.timer_due(work, now, now)
        elif step == 'dispatch':
            started = engine.step(which % 2, now).work
            self.returning = [each for each in self.returning if each is not started]
            self.running += [started] * (started is not None)
        elif step == 'remove':
            engine.remove(entity, now)
            entity.removed = False
        elif step == 'resume' and self.suspended:
            engine.resume(self.suspended.pop(which % len(self.suspended)), now)
        elif step == 'rejoin' and self.lent:
            work = self.lent.pop(which % len(self.lent))
            self.running.remove(work)
            self.returning.append(work)
            engine.rejoin(work, now)
        elif step == 'go_on' and self.returning:
            work = self.returning.pop(which % len(self.returning))
            engine.go_on_without(work)
            self.running.append(work)
            self.lent.append(work)
        elif step in ('finish', 'fail', 'suspend', 'lend') and self.running:
            work = self.running[which % len(self.running)]
            if step == 'lend':
                engine.lend(work)
                self.lent += [work] * (work not in self.lent)
            else:
                self.running.remove(work)
                self.lent = [each for each in self.lent if each is not work]
            if step == 'suspend':
                engine.suspended(work, now, now, 0, work.worker)
                self.suspended.append(work)
            elif step != 'lend':
                engine.finished(work, now, now, now, 0, work.worker, step == 'fail')
        check(engine)
        return started

    def seen(self, started, now):
        """Return what can be seen after a step."""
        engine = self.engine
        return (
            started and (started.args, started.worker), engine.queue_length, engine.has_waiting,
            engine.idle_workers, engine.may_start_more(now),
            [(len(each.waiting), each.ran, each.dropped, each.skipped, each.failed)
             for each in self.entities])


STEPS = st.lists(st.tuples(st.sampled_from([
    'ready', 'ready', 'ready', 'dispatch', 'dispatch', 'finish', 'finish', 'suspend', 'resume',
    'lend', 'rejoin', 'go_on', 'fail', 'remove']), st.integers(0, 4)), min_size=1, max_size=80)


# a full queue; it bypasses the core, or a declared timer ends the bypass
NEXT = [('dispatch', 0), ('finish', 0)]
FULL = [('ready', 2), ('ready', 3), ('ready', 2), *NEXT, ('ready', 2), ('ready', 2), ('ready', 3),
        ('ready', 2)]


@examples(300)
@given(st.sampled_from(sorted(POLICIES)), STEPS)
@example('rad', [*FULL, *3 * NEXT])
@example('rad', [*FULL, ('ready', 4), *4 * NEXT])
@example('fifo', [*FULL, ('ready', 4), *4 * NEXT])
def test_what_bypasses_the_core_runs_as_the_core_would_run_it(policy, steps):
    twins = Steps(policy), Steps(policy)
    twins[1].engine.allow_bypass()
    for now, step in enumerate(steps):
        seen = [twin.seen(twin.do(*step, now), now) for twin in twins]
        assert seen[0] == seen[1], step


def test_a_full_queue_drops_its_oldest_messages_without_the_core():
    """Which would cost three times as much for each message until nothing waits."""
    engine = new_engine(workers=2)
    engine.allow_bypass()
    full, other = new_entity(depth=2), new_entity()
    full.wall_ns = other.wall_ns = 0
    for now, entity in enumerate((full, other, full, full, other, full), 1):
        engine.ready(Work(entity, print, (now,)), now)
    started = []
    while (work := engine.step(0, 7).work) is not None:
        assert engine.scheduler.queue_length == 0
        started.append(work.args[0])
        engine.finished(work, 7, 7, 7, 0, 0)
    # the oldest that is left has the place of the first one
    assert started == [4, 2, 5, 6]
    assert (full.ready, full.ran, full.dropped, engine.undeclared) == (4, 2, 2, 6)


@pytest.mark.parametrize(('depth', 'expected'), [(0, [1, 2]), (1, [2])])
def test_no_message_bypasses_a_program_whose_callbacks_all_wait_for_responses(depth, expected):
    """They have lent their workers, but count for how many of the program may run at a time."""
    engine = new_engine(workers=3)
    engine.allow_bypass()
    outer = engine.outer.new()
    engine.outer.open(outer, 2, 0)
    calling, entity, other = new_entity(), new_entity(depth=depth), new_entity()
    calling.outer = entity.outer = outer
    calling.wall_ns = entity.wall_ns = other.wall_ns = 0
    lent = []
    for now in range(2):
        engine.ready(Work(calling, print), now)
        lent.append(engine.step(0, now).work)
        engine.lend(lent[-1])
    for number in (1, 2):
        engine.ready(Work(entity, print, (number,)), 3)
        assert engine.step(0, 3).work is None
    check(engine)
    engine.finished(lent[0], 3, 4, 4, 0, -1)
    engine.ready(Work(other, print, (3,)), 5)
    started = []
    while (work := engine.step(0, 6).work) is not None:
        started.append(work.args[0])
        engine.finished(work, 6, 6, 6, 0, 0)
    assert started == [*expected, 3]
    check(engine)


@examples(300)
@given(st.sampled_from(sorted(POLICIES)), st.booleans(), STEPS)
def test_work_of_an_entity_starts_in_its_order_and_is_never_lost(policy, slow, steps):
    each = Steps(policy)
    engine, started = each.engine, {}
    for now, step in enumerate(steps):
        now *= 20 * MS if slow else 1  # so that deadlines pass
        work = each.do(*step, now)
        if work is not None:
            started.setdefault(id(work), work)
        for entity in each.entities:
            numbers = [work.args[0] for work in started.values() if work.entity is entity]
            assert numbers == sorted(numbers)
            assert not entity.depth or len(entity.waiting) <= entity.depth
    while engine.idle_workers and (work := engine.step(0, now).work) is not None:
        engine.finished(work, now, now, now, 0, work.worker)
    if engine.idle_workers == engine.n_workers and max(engine._state.group_owner) < 0:
        assert not any(entity.waiting for entity in each.entities)


def busy_engine():
    """
    Return an engine in which something of each kind is under way.

    One of group 0 runs and one waits for it; one holds the GIL and one waits for it; one is
    suspended; and a job of a DAG is ready.
    """
    twin = Steps('rad', 4)
    for step, *several in [
            ('ready', 0), ('dispatch', 0), ('suspend', 0), ('ready', 2, 1, 3, 3),
            ('dispatch', 0, 0, 0), ('ready', 0, 0, 4)]:
        for which in several:
            twin.do(step, which, 0)
    return twin.engine


def count(engine, column):
    engine._state.scalars[column] += 1


def set_running(engine, column, value):
    """Change what is known of the execution of the group that runs."""
    getattr(engine._state, column)[engine._state.group_owner[0]] = value


def set_queue(engine, column, value):
    """Change what is known of a queue in which two wait."""
    state = engine._state
    queue = next(queue for queue, first in enumerate(state.queue_first)
                 if state.queue_last[queue] != first)
    getattr(state, column)[queue] = value(state, queue)


def set_key(engine, queue):
    """Let a queue at the end of the ready heap come last."""
    state = engine._state
    state.ready[-1] = state.queue_key[queue] = (10 ** 12, 0, 0, 0, queue)


BREAKS = {
    'lost entry': ('those in a heap', lambda e: e._state.deferred.pop()),
    'two entries': ('a second entry', lambda e: e._state.ready.append(e._state.ready[0])),
    'wrong place': ('which says', lambda e: set_queue(e, 'queue_place', lambda s, q: 7)),
    'wrong key': ('which says', lambda e: set_queue(e, 'queue_key', lambda s, q: (0,) * 5)),
    'lost first': ('backwards', lambda e: set_queue(
        e, 'queue_first', lambda s, q: s.x_next[s.queue_first[q]])),
    'lost last': ('backwards', lambda e: set_queue(
        e, 'queue_last', lambda s, q: s.queue_first[q])),
    'order in a queue': ('is before', lambda e: set_queue(
        e, 'queue_first', lambda s, q: s.x_key.__setitem__(
            s.queue_first[q], (10 ** 12,) * 5) or s.queue_first[q])),
    'after its first': ('is not late', lambda e: set_key(e, e._state.ready[-1][4])),
    'late and empty': ('is empty', lambda e: e._state.queue_demoted.append(7)
                       or e._state.queue_first.append(-1) or e._state.queue_last.append(-1)
                       or e._state.queue_place.append(-1)),
    'wrong group': ('waits for group', lambda e: e._state.x_group.__setitem__(
        e._state.queue_first[e._state.group_heap[0][0][4]], -1)),
    'idle workers': ('are idle', lambda e: count(e, N_IDLE)),
    'holders counted': ('hold the interpreter', lambda e: count(e, N_HOLDING)),
    'worker': ('runs execution', lambda e: set_running(e, 'x_state', WAITING)),
    'owner': ('nothing brings', lambda e: e._state.group_owner.__setitem__(0, -1)),
    'active': ('counted are', lambda e: e._state.job_active.__setitem__(
        e._state.job_dag.index(0), 9)),
    'open jobs': ('jobs of DAG 0 are open', lambda e: e._state.n_open.__setitem__(0, 0)),
    'bypass': ('bypass the core', lambda e: setattr(e._bypass, 'is_open', True)),
    'deadline': ('no timer is set', lambda e: (
        e.deadlines.first(), e.deadlines._entry.clear())),
}


@pytest.mark.parametrize('broken', BREAKS)
def test_each_broken_invariant_is_found(broken):
    engine = busy_engine()
    text, break_it = BREAKS[broken]
    break_it(engine)
    with pytest.raises(AssertionError, match=text):
        check(engine)


def test_a_broken_invariant_ends_the_spin(make_executor, make_node):
    node, ticks = make_node(), []
    node.create_timer(0.01, lambda: ticks.append(None))
    executor = make_executor(nodes=[node])
    with Spinning(executor, raises=InvariantError) as spinning:
        assert wait_for(lambda: ticks)
        count(engine_of(executor), N_HOLDING)
        spinning.join()
        engine_of(executor)._state.scalars[N_HOLDING] -= 1
    assert 'mddag-worker-' in str(spinning.error)  # what threads did before


def test_checks_that_are_in_no_file_are_refused(monkeypatch, tmp_path):
    engine, empty = new_engine(), tmp_path / 'empty.py'
    empty.touch()
    for value in ('engine', str(empty)):
        monkeypatch.setenv('MDDAG_DEBUG', value)
        with pytest.raises(UsageError, match=f'MDDAG_DEBUG={value}: '):
            engine_lock(engine, list)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Jobs from release to end: legs, groups, bounds, aborts, deadlines, polls, the interpreter."""

from dataclasses import dataclass, field
import random

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import rules, Scheduler, Tables
from mddag_executor.core.deadlines import Deadlines
from mddag_executor.core.queues import SWEEP_AT
from mddag_executor.core.state import (
    DROP,
    EXPIRED,
    FAILED,
    FREE,
    JOB_END,
    OPEN,
    RUNNING,
    SINK_FAILED,
    SINK_OVERDUE,
    SUSPENDED,
    WAITING,
)
from mddag_executor.core.tables import NEVER

from ..conftest import examples
from .live_helpers import J, live, run_one, start_job, undeclared, US, X
from .task_sets import declaration, single


def test_a_job_fails_with_what_fails_of_it():
    """What has a message already runs, and is not judged; nothing is missed twice."""
    scheduler = live()
    slot = start_job(scheduler)
    x, leg = scheduler.execution(slot, X), scheduler.execution(slot, J, 0)
    scheduler.ready(x, 1)
    scheduler.ready(leg, 1)
    first = scheduler.take(0, 1)
    assert first in (x, leg)
    rules.fail(scheduler.tables, scheduler.state, scheduler.policy.key, first, 2)
    assert scheduler.decisions() == [
        (SINK_FAILED, 0, J, 0, 50 * US, -1), (JOB_END, 0, -1, 0, FAILED, 2)]
    second = scheduler.take(0, 3)
    assert {first, second} == {x, leg}
    rules.fail(scheduler.tables, scheduler.state, scheduler.policy.key, second, 4)
    assert scheduler.decisions() == []
    assert scheduler.state.job_state[slot] == FREE


def aborting():
    return declaration([
        {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd',
         'on_late': 'abort'},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '5us'},
        {'node': '/n', 'name': 'y', 'subscription': '/s', 'deadline': '50us'},
        {'node': '/n', 'name': 'z', 'subscription': '/s', 'deadline': '60us'}])


def test_a_blocked_callback_does_not_abort_its_job():
    """Only what would go next shows that a job is late; what waits for its group does not."""
    scheduler = live(aborting(), workers=2)
    group = scheduler.new_group()
    busy = undeclared(scheduler, 0, group, 0)
    scheduler.take(0, 0)
    slot = start_job(scheduler)
    y = scheduler.execution(slot, 2)
    scheduler.state.x_group[y] = group
    scheduler.ready(y, 1)
    assert scheduler.take(1, 10 * US) == -1
    assert scheduler.state.job_state[slot] == OPEN
    scheduler.complete(busy, 11 * US)
    assert scheduler.take(1, 11 * US) == -1
    assert scheduler.decisions()[-1][0] == DROP


# --- workers -------------------------------------------------------------------------------------


def test_a_groups_number_is_used_again_once_nothing_of_it_runs_or_waits():
    scheduler = live(workers=1)
    first, second = scheduler.new_group(), scheduler.new_group()
    running = undeclared(scheduler, 0, second, 0)
    scheduler.take(0, 0)
    waiting = undeclared(scheduler, 1, second, 1)
    assert scheduler.take(0, 1) == -1
    scheduler.free_group(second)
    assert scheduler.new_group() not in (first, second), 'its owner runs'
    scheduler.complete(running, 2)
    assert scheduler.take(0, 2) == waiting
    scheduler.complete(waiting, 3)
    assert scheduler.new_group() == second
    n_groups = len(scheduler.state.group_owner)
    for _ in range(50):
        scheduler.free_group(first)
        assert scheduler.new_group() == first
    assert len(scheduler.state.group_owner) == len(scheduler.state.group_heap) == n_groups


# --- drop ----------------------------------------------------------------------------------------


SINKS = declaration([
    {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd'},
    {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '30us'},
    {'node': '/n', 'name': 'y', 'subscription': '/s', 'deadline': '70us'},
    {'node': '/n', 'name': 'z', 'subscription': '/s', 'deadline': '70us'},
    {'node': '/n', 'name': 'o', 'timer': '100us', 'deadline': '10us', 'dag': 'other'},
])
steps = st.lists(st.one_of(
    st.tuples(st.just('release'), st.integers(0, 1), st.integers(0, 40)),
    st.tuples(st.just('complete'), st.integers(0, 30), st.integers(1, 3)),
    st.tuples(st.just('expire'), st.integers(0, 30), st.just(0)),
    st.tuples(st.just('judge'), st.just(0), st.just(0)),
), max_size=60)


@given(steps, st.lists(st.integers(0, 25), min_size=60, max_size=60))
def test_each_overdue_sink_is_found_once_and_in_time(steps, gaps):
    scheduler = live(SINKS)
    tables, state = scheduler.tables, scheduler.state
    deadlines = Deadlines(tables, state)
    jobs = []
    open_sinks = {}  # DAG, job, vertex -> deadline
    overdue = []
    now = 0
    for (what, which, more), gap in zip(steps, gaps):
        now += gap * US
        if what == 'release':
            # some releases are known late, and out of order
            index, release = len(jobs), now - more * US
            slot = scheduler.release(which, index, release, now)
            deadlines.watch(slot)
            jobs.append((which, index, slot))
            first, last = tables.first_sink[which:which + 2]
            for vertex in tables.sinks[first:last]:
                open_sinks[which, index, vertex] = release + tables.sink_deadline[vertex]
        elif what in ('complete', 'expire') and jobs:
            dag, index, slot = jobs[which % len(jobs)]
            vertex = tables.first_vertex[dag] + (more if dag == 0 else 0)
            if state.job_state[slot] != OPEN or state.job_index[slot] != index:
                continue
            if what == 'expire':
                scheduler.give_up(slot, EXPIRED, now)
                open_sinks = {key: d for key, d in open_sinks.items() if key[:2] != (dag, index)}
            elif (dag, index, vertex) in open_sinks:
                run_one(scheduler, scheduler.execution(slot, vertex), now)
                del open_sinks[dag, index, vertex]
        else:
            expected = sorted(key for key, d in open_sinks.items()
                              if d < now and key not in overdue)
            assert (deadlines.next < now) >= bool(expected)
            scheduler.decisions()
            deadlines.judge(now)
            found = scheduler.decisions()
            assert {decision[0] for decision in found} <= {SINK_OVERDUE}
            assert sorted((dag, job, vertex) for _, dag, vertex, job, _, _ in found) == expected
            overdue += expected
            later = [d for d in open_sinks.values() if d >= now]
            assert now <= deadlines.next <= min(later, default=NEVER)


# --- the core by itself --------------------------------------------------------------------------


def scheduler(workers=1):
    tables = Tables.build(declaration([
        {'node': '/n', 'name': 'one', 'subscription': '/x', 'period': '10us', 'dag': 'x',
         'publishes': ['/a', '/b']},
        {'node': '/n', 'name': 'join', 'sync': ['/a', '/b'], 'deadline': '10us'},
        {'node': '/n', 'name': 'tick', 'timer': '10us', 'deadline': '10us', 'dag': 't'}]),
        legs=True)
    return Scheduler(tables, workers, 'ros2')


def test_dropped_ones_leave_the_queues():
    """Memory is bounded, the length is right, and the entity is polled once for each round."""
    core = scheduler()
    slot = core.release(1, 0, 0, 0)
    kept = core.source(slot)
    for i in range(3 * SWEEP_AT):
        core.drop(undeclared(core, i, -1, 0), 0)
    core.ready(kept, 1)
    assert core.queue_length == 1
    assert sum(map(len, core.state.entity_queue)) <= SWEEP_AT + 2
    assert len(core.state.unpolled) == len(set(core.state.unpolled)) <= 2
    assert core.take(0, 2) == kept
    core.complete(kept, 3)
    assert core.take(0, 4) == -1
    assert core.queue_length == 0


URGENT = 0
DEADLINES = (10, 20, 30)


def computing(workers, policy='rad'):
    """Return one with a DAG of one callback for each urgency."""
    dags = [single(f'd{deadline}', 1000, deadline) for deadline in DEADLINES]
    return Scheduler(Tables.build(declaration(dags), groups=False), workers, policy)


def start_next(core, now):
    """Start one execution on an idle worker and return it; -1: there is none."""
    workers = core.state.worker_x
    return core.take(workers.index(-1), now) if -1 in workers else -1


@dataclass
class Driver:
    """Drives the core as an executor does: whatever may start is started at once."""

    core: Scheduler
    now: int = 0
    jobs: int = 0
    started: list[int] = field(default_factory=list)
    urgency: dict[int, int] = field(default_factory=dict)

    def ready(self, urgency, *, holds, group=-1):
        self.now += 1
        x = self.core.source(self.core.release(urgency, self.jobs, 0, self.now))
        self.jobs += 1
        self.urgency[x] = urgency
        self.core.state.x_holds[x] = int(holds)
        self.core.state.x_group[x] = group
        self.core.ready(x, self.now)
        return x

    def go(self):
        """Return what starts now."""
        started = []
        while (x := start_next(self.core, self.now)) >= 0:
            started.append(x)
        return started

    def complete(self, x):
        self.now += 1
        self.core.complete(x, self.now)


def test_one_that_turns_out_to_wait_gives_the_interpreter_back():
    drive = Driver(computing(7))
    holder, held_back = drive.ready(URGENT, holds=True), drive.ready(URGENT, holds=True)
    assert drive.go() == [holder]
    drive.core.stop_holding(holder)
    assert drive.go() == [held_back]
    drive.complete(holder)
    drive.complete(held_back)
    assert drive.core.state.worker_x.count(-1) == 7


def may_start(core, x):
    """Tell by the words of the rules whether a waiting execution may start."""
    state = core.state
    if state.x_group[x] >= 0 and state.group_owner[state.x_group[x]] not in (-1, x):
        return False
    return not state.x_holds[x] or all(
        state.x_key[other][0] > state.x_key[x][0]
        for other in state.worker_x if other >= 0 and state.x_holds[other])


@examples(150)
@given(seed=st.integers(0, 2 ** 32), workers=st.integers(1, 4), groups=st.booleans())
def test_whatever_happens_the_most_urgent_that_may_start_starts(seed, workers, groups):
    draw = random.Random(seed)
    drive = Driver(computing(workers))
    core, state = drive.core, drive.core.state
    group_numbers = [core.new_group() for _ in range(2)] if groups else []
    alive = set()
    count = dict.fromkeys(('ready', 'ended'), 0)
    for step in range(120):
        here = sorted(alive)
        running = [x for x in here if state.x_state[x] == RUNNING]
        waiting = [x for x in here if state.x_state[x] == WAITING]
        suspended = [x for x in here if state.x_state[x] == SUSPENDED]
        what = draw.random() if step < 80 else 0.5
        if what < 0.45:
            group = draw.choice([-1, *group_numbers])
            alive.add(drive.ready(draw.randrange(3), holds=draw.random() < 0.6, group=group))
            count['ready'] += 1
        elif what < 0.8 and running:
            x = draw.choice(running)
            drive.complete(x)
            alive.remove(x)
            count['ended'] += 1
        elif what < 0.85 and waiting:
            x = draw.choice(waiting)
            if state.x_started[x] < 0:
                core.drop(x, drive.now)
                alive.remove(x)
                count['ended'] += 1
        elif what < 0.9 and running:
            core.stop_holding(draw.choice(running))
        elif what < 0.95 and running:
            core.suspend(draw.choice(running))
        elif suspended:
            core.resume(draw.choice(suspended))
        while True:
            could = [x for x in alive if state.x_state[x] == WAITING and may_start(core, x)]
            idle = core.state.worker_x.count(-1)
            x = start_next(core, drive.now)
            if x < 0:
                assert not could or not idle
                break
            assert idle and x == min(could, key=lambda each: state.x_key[each])
    assert count['ready'] == count['ended'] + len(alive)

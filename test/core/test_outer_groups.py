# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Outer groups (rule 4) limit the executions of a program; none runs while one is closed."""

import random

from mddag_executor.core import Scheduler, Tables
from mddag_executor.core.queues import has_place
from mddag_executor.core.state import NO_PLACE, PLACED, RUNNING
import pytest

from ..invariants import broken_in_core

GROUPS, LIMITS = 4, (0, 1, 1, 3, 1 << 30)


class Run:
    """A driver that does at random what live ones do."""

    def __init__(self, seed, policy='rad'):
        self.random = random.Random(seed)
        tables = Tables.build(
            None, legs=True, default_deadline=100, max_active_jobs=4, expire_after=1000)
        self.core = Scheduler(tables, 3, policy)
        self.state = self.core.state
        self.groups = [self.core.new_group() for _ in range(GROUPS)]
        self.outer = [self.core.new_outer_group() for _ in range(3)]
        # callbacks: the queue, group and outer group of each; -1: it has none
        self.callbacks = [(-1, -1, -1), *(
            (self.core.new_queue(), self.random.choice((-1, *self.groups)),
             self.random.choice((-1, *self.outer))) for _ in range(8))]
        self.limit = dict.fromkeys(self.outer, 0)
        self.once = set()
        self.now = self.job = 0
        self.waiting, self.running, self.lent, self.suspended = [], [], [], []
        self.began = set()

    def step(self):
        self.now += 1
        getattr(self, self.random.choice((
            'add', 'add', 'take', 'take', 'complete', 'lend', 'rejoin', 'suspend', 'resume',
            'open', 'drop', 'move', 'go_on')))()
        assert [*broken_in_core(self.core.tables, self.state)] == []

    def add(self):
        if len(self.waiting) < 30:
            queue, group, outer = self.random.choice(self.callbacks)
            if queue < 0:
                outer = self.random.choice((-1, *self.outer))
            self.job += 1
            x = self.core.ready_undeclared(
                self.job, group, self.random.random() < 0.2, queue, self.now)
            self.state.x_outer[x] = outer
            self.waiting.append(x)
            self.began.discard(x)

    def take(self):
        worker = next((w for w, x in enumerate(self.state.worker_x) if x < 0), None)
        places = [*self.state.x_place]
        x = -1 if worker is None else self.core.take(worker, self.now)
        if x < 0:
            return
        self.waiting.remove(x)
        self.running.append(x)
        outer = self.state.x_outer[x]
        if outer >= 0 and places[x] != PLACED:     # else it has kept its place
            others = [y for y in self.state_running() if self.state.x_outer[y] == outer and y != x]
            most = max(self.limit[outer], int(x in self.began))
            assert len(others) < most, (outer, others, x)
            if outer in self.once and x not in self.began:
                self.once.remove(outer)
                self.limit[outer] = 0
        self.began.add(x)

    def state_running(self):
        return [y for y in (*self.running, *self.lent)
                if self.state.x_place[y] == PLACED and self.state.x_state[y] == RUNNING]

    def pick(self, some):
        return some.pop(self.random.randrange(len(some))) if some else None

    def complete(self):
        x = self.pick(self.running)
        if x is not None:
            self.core.complete(x, self.now)

    def lend(self):
        x = self.pick(self.running)
        if x is not None:
            self.core.lend(x)
            self.lent.append(x)

    def rejoin(self):
        x = self.pick(self.lent)
        if x is not None:
            self.core.rejoin(x, self.job, 0, self.now)
            self.waiting.append(x)

    def go_on(self):
        some = [x for x in self.waiting
                if self.state.x_place[x] != NO_PLACE and has_place(self.state, x)]
        if some and self.random.random() < 0.2:
            self.waiting.remove(some[0])
            self.core.go_on_without(some[0])
            self.running.append(some[0])

    def suspend(self):
        x = self.pick(self.running)
        if x is not None:
            self.core.suspend(x)
            self.suspended.append(x)

    def resume(self):
        x = self.pick(self.suspended)
        if x is not None:
            self.core.resume(x, self.job, 0, self.now)
            self.waiting.append(x)

    def open(self, limit=None):
        for outer in self.outer if limit else [self.random.choice(self.outer)]:
            once = limit is None and self.random.random() < 0.3
            self.limit[outer] = limit or (1 if once else self.random.choice(LIMITS))
            (self.once.add if once else self.once.discard)(outer)
            self.core.open_outer(outer, self.limit[outer], once)

    def drop(self):
        fresh = [x for x in self.waiting if x not in self.began]
        if fresh and self.random.random() < 0.3:
            self.waiting.remove(fresh[0])
            self.core.drop(fresh[0], self.now)
            self.core.decisions()

    def move(self):
        place = self.random.randrange(len(self.callbacks))
        queue, group, _ = self.callbacks[place]
        outer = self.random.choice((-1, *self.outer))
        self.callbacks[place] = queue, group, outer
        for x in self.waiting:
            if self.state.x_queue[x] == queue and self.state.x_place[x] == NO_PLACE:
                self.core.set_outer(x, outer)


@pytest.mark.parametrize('seed', range(30))
def test_no_more_run_than_may_and_none_is_forgotten(seed):
    run = Run(seed)
    for _ in range(600):
        run.step()
    run.open(1)
    for _ in range(5000):
        if not (run.waiting or run.running or run.lent or run.suspended):
            break
        for action in (run.rejoin, run.resume, run.take, run.complete):
            action()
        assert [*broken_in_core(run.core.tables, run.state)] == []
    assert not (run.waiting or run.running)
    assert [*run.state.outer_running] == [0, 0, 0]


def test_one_that_goes_on_may_leave_its_outer_group():
    core = Scheduler(Tables.build(
        None, legs=True, default_deadline=100, max_active_jobs=4, expire_after=1000), 2, 'rad')
    first, other = core.new_outer_group(), core.new_outer_group()
    core.open_outer(first, 1)
    core.open_outer(other, 1)
    x = core.ready_undeclared(0, -1, 0, core.new_queue(), 0)
    core.state.x_outer[x] = first
    assert core.take(0, 1) == x
    core.lend(x)
    core.rejoin(x, 0, 0, 2)
    core.set_outer(x, -1)
    assert [*broken_in_core(core.tables, core.state)] == []
    core.go_on_without(x)
    assert [*core.state.outer_running] == [0, 0]
    y = core.ready_undeclared(0, -1, 0, core.new_queue(), 3)
    core.state.x_outer[y] = other
    assert core.take(0, 4) == y


def test_several_that_go_on_in_a_closed_group_do_so_one_after_the_other():
    """Though a fresh execution, which may not start there, waits before them."""
    core = Scheduler(Tables.build(
        None, legs=True, default_deadline=100, max_active_jobs=4, expire_after=1000), 2, 'rad')
    outer = core.new_outer_group()
    several = [core.ready_undeclared(0, -1, 0, core.new_queue(), now) for now in range(3)]
    for x in several:
        core.state.x_outer[x] = outer
    first, second, fresh = several
    core.open_outer(outer, 1)
    for x in (first, second):
        assert core.take(0, 3) == x
        core.lend(x)
    core.open_outer(outer, 0)
    core.rejoin(first, 0, 0, 4)
    core.rejoin(second, 0, 0, 5)
    assert core.take(0, 6) == first
    assert core.take(1, 6) == -1
    core.complete(first, 7)
    assert [*broken_in_core(core.tables, core.state)] == []
    assert core.take(0, 7) == second
    core.complete(second, 8)
    assert core.take(0, 8) == -1
    core.open_outer(outer, 1)
    assert core.take(0, 9) == fresh


@pytest.mark.parametrize('seed', range(20))
def test_those_that_wait_keep_their_order_when_one_goes_on_in_a_closed_group(seed):
    """Each is set aside when it comes, whatever it inherits."""
    draw = random.Random(seed)
    core = Scheduler(Tables.build(
        None, legs=True, default_deadline=1000, max_active_jobs=4, expire_after=1000), 2, 'rad')
    outer = core.new_outer_group()

    def ready(now):
        x = core.ready_undeclared(0, -1, 0, core.new_queue(), now)
        core.state.x_outer[x] = outer
        return x

    core.open_outer(outer, 1)
    several = [ready(0), ready(0)]
    for x in several:
        assert core.take(0, 0) == x
        core.lend(x)
    core.open_outer(outer, 0)
    core.rejoin(several[0], 0, 0, 1)
    assert core.take(0, 1) == several[0]
    waiting = {}
    others = draw.sample(range(100, 900), 12)
    place = draw.randrange(len(others))
    for number, priority in enumerate(others):
        if number == place:
            core.rejoin(several[1], 0, 0, 2)
            assert core.take(1, 2) == -1
        x = ready(2)
        core.inherit(x, priority, 0)
        assert core.take(1, 2) == -1
        waiting[priority] = x
    core.complete(several[0], 3)
    assert core.take(0, 3) == several[1]
    core.complete(several[1], 4)
    core.open_outer(outer, 1)
    started = []
    while (x := core.take(0, 5)) >= 0:
        started.append(x)
        core.complete(x, 5)
    assert started == [waiting[priority] for priority in sorted(waiting)]


def test_the_number_of_a_freed_outer_group_is_used_again_when_none_of_it_is_left():
    core = Scheduler(Tables.build(
        None, legs=True, default_deadline=100, max_active_jobs=4, expire_after=1000), 2, 'rad')
    first = core.new_outer_group()
    x = core.ready_undeclared(0, -1, 0, core.new_queue(), 0)
    core.state.x_outer[x] = first
    core.open_outer(first, 1)
    core.free_outer_group(first)
    assert core.take(0, 1) == x
    other = core.new_outer_group()
    assert other != first
    core.complete(x, 2)
    assert core.new_outer_group() == first
    assert core.new_outer_group() not in (first, other)
    assert core.state.outer_limit[first] == 0


def test_one_that_is_dropped_leaves_the_place_to_the_next():
    core = Run(0).core
    outer = core.new_outer_group()
    core.open_outer(outer, 1)
    several = []
    for now in range(3):
        several.append(core.ready_undeclared(0, -1, 0, core.new_queue(), now))
        core.state.x_outer[several[-1]] = outer
    assert core.take(0, 3) == several[0] and core.take(1, 3) == -1
    core.complete(several[0], 4)
    core.drop(several[1], 4)    # it would have been next
    assert core.take(0, 4) == several[2]

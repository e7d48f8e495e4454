# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Rule 11: who holds the interpreter, who is held back for it, and who overtakes."""

from __future__ import annotations

from dataclasses import dataclass, field
import random

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import Scheduler, Tables
from mddag_executor.core.state import RUNNING, SUSPENDED, WAITING

from .task_sets import declaration, examples
from .test_by_hand import single

URGENT, MIDDLE, RELAXED = range(3)
DEADLINES = (10, 20, 30)


def scheduler(workers: int, policy: str = 'rad') -> Scheduler:
    """Return one with a DAG of one callback for each urgency."""
    dags = [single(f'd{deadline}', 1000, deadline) for deadline in DEADLINES]
    return Scheduler(Tables.build(declaration(dags), groups=False), workers, policy,
                     propagate=False)


@dataclass
class Driver:
    """Drives the core as an executor does: whatever may start is started at once."""

    core: Scheduler
    now: int = 0
    jobs: int = 0
    started: list[int] = field(default_factory=list)
    urgency: dict[int, int] = field(default_factory=dict)

    def ready(self, urgency: int, *, holds: bool, group: int = -1) -> int:
        self.now += 1
        x = self.core.source(self.core.release(urgency, self.jobs, 0, self.now))
        self.jobs += 1
        self.urgency[x] = urgency
        self.core.state.x_holds[x] = int(holds)
        self.core.state.x_group[x] = group
        self.core.ready(x, self.now)
        return x

    def go(self) -> list[int]:
        """Return what starts now."""
        started = []
        while (x := self.core.schedule(self.now)) >= 0:
            started.append(x)
        return started

    def complete(self, x: int) -> None:
        self.now += 1
        self.core.complete(x, self.now)


def test_one_that_turns_out_to_wait_gives_the_interpreter_back() -> None:
    drive = Driver(scheduler(7))
    holder, held_back = drive.ready(URGENT, holds=True), drive.ready(URGENT, holds=True)
    assert drive.go() == [holder]
    drive.core.stop_holding(holder)
    assert drive.go() == [held_back]
    drive.complete(holder)
    drive.complete(held_back)
    assert drive.core.idle_workers == 7


def test_lending_and_suspending_give_it_back() -> None:
    drive = Driver(scheduler(7))
    first, second, third = (drive.ready(MIDDLE, holds=True) for _ in range(3))
    assert drive.go() == [first]
    drive.core.lend(first)
    assert drive.go() == [second]
    drive.core.suspend(second)
    assert drive.go() == [third]
    drive.core.resume(second)
    assert drive.go() == []  # it holds the interpreter again when it goes on
    drive.complete(third)
    assert drive.go() == [second]


def test_it_holds_under_polling_too() -> None:
    drive = Driver(scheduler(7, 'ros2'))
    first, second = drive.ready(URGENT, holds=True), drive.ready(MIDDLE, holds=True)
    assert drive.go() == [first]
    drive.complete(first)
    assert drive.go() == [second]


def may_start(core: Scheduler, x: int) -> bool:
    """Tell by the words of the rules whether a waiting execution may start."""
    state = core.state
    if state.x_group[x] >= 0 and state.group_owner[state.x_group[x]] not in (-1, x):
        return False
    return not state.x_holds[x] or all(
        state.x_key[other][0] > state.x_key[x][0]
        for other in state.worker_x if other >= 0 and state.x_holds[other])


@examples(150)
@given(seed=st.integers(0, 2 ** 32), workers=st.integers(1, 4), groups=st.booleans())
def test_whatever_happens_the_most_urgent_that_may_start_starts(
    seed: int, workers: int, groups: bool
) -> None:
    draw = random.Random(seed)
    drive = Driver(scheduler(workers))
    core, state = drive.core, drive.core.state
    group_numbers = [core.new_group() for _ in range(2)] if groups else []
    alive: set[int] = set()
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
            idle = core.idle_workers
            x = core.schedule(drive.now)
            if x < 0:
                assert not could or not idle
                break
            assert idle and x == min(could, key=lambda each: state.x_key[each])
    assert count['ready'] == count['ended'] + len(alive)

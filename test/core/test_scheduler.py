# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The rules as the live executor uses them: messages make the edges, threads take the work."""

from __future__ import annotations

from mddag_executor.core import NEVER, PolicyError, Scheduler, Tables
from mddag_executor.core.queues import SWEEP_AT
from mddag_executor.core.state import (
    COMPLETED,
    FREE,
    JOB_END,
    SINK_IN_TIME,
)
import pytest

from .live_helpers import J, JOIN, live, run_one, start_job, undeclared, US, X, Y


def test_an_unknown_policy_is_refused_with_the_list() -> None:
    with pytest.raises(PolicyError, match=r"policy 'edf': .*: choose one of rad, rm, wc, fifo"):
        live(policy_name='edf')


# --- legs of a sync ------------------------------------------------------------------------------


@pytest.mark.parametrize('order', [(0, 1), (1, 0)])
def test_a_sync_completes_with_the_leg_that_makes_it_whole(order: tuple[int, int]) -> None:
    scheduler = live()
    slot = start_job(scheduler)
    for vertex in (X, Y):
        assert run_one(scheduler, scheduler.execution(slot, vertex), 10)
    first, last = (scheduler.execution(slot, J, leg) for leg in order)
    assert first != last
    assert run_one(scheduler, first, 20) is False
    assert scheduler.decisions() == []
    assert run_one(scheduler, last, 30) is True
    assert scheduler.decisions() == [
        (SINK_IN_TIME, 0, J, 0, 50 * US, 30), (JOB_END, 0, -1, 0, COMPLETED, 30)]
    assert scheduler.state.job_state[slot] == FREE


# --- workers -------------------------------------------------------------------------------------


def test_undeclared_callbacks_have_the_default_deadline() -> None:
    tables = Tables.build(JOIN, legs=True, groups=False, default_deadline=40 * US)
    scheduler = Scheduler(tables, 1, propagate=False)
    slot = scheduler.release(0, 0, 0, 0)        # RAD 50 us
    scheduler.ready(scheduler.source(slot), 0)
    early = undeclared(scheduler, 0, -1, 0)      # 40 us
    later = undeclared(scheduler, 1, -1, 11 * US)  # 51 us
    assert [scheduler.take(0, 11 * US), scheduler.complete(early, 12 * US),
            scheduler.take(0, 12 * US), scheduler.complete(scheduler.source(slot), 12 * US),
            scheduler.take(0, 12 * US)] == [early, True, scheduler.source(slot), True, later]
    assert scheduler.decisions() == [], 'nobody judges what nobody declared'


def test_without_declaration_everything_is_undeclared() -> None:
    scheduler = live(None)
    x = undeclared(scheduler, 0, -1, 5)
    assert scheduler.take(0, 5) == x
    assert scheduler.complete(x, 6)
    scheduler.expire_idle(NEVER)
    scheduler.finish(NEVER)
    assert scheduler.decisions() == []


def test_a_groups_number_is_used_again_once_nothing_of_it_runs_or_waits() -> None:
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


@pytest.mark.parametrize('grouped', [False, True])
def test_queues_stay_bounded_when_what_waits_longest_is_dropped_for_ever(grouped: bool) -> None:
    """As with a topic of QoS depth 5 behind a callback that never ends."""
    scheduler = live(workers=1, policy_name='rm')
    group = scheduler.new_group() if grouped else -1
    busy = undeclared(scheduler, 0, group, 0)
    assert scheduler.take(0, 0) == busy
    scheduler.lend(busy)
    waiting: list[int] = []
    for i in range(3_000):
        if len(waiting) == 5:
            scheduler.drop(waiting.pop(0), i)
        waiting.append(undeclared(scheduler, i, group, i))
        if grouped:
            assert scheduler.take(0, i) == -1
        assert scheduler.queue_length == len(waiting)
        entries = len(scheduler.state.ready) + sum(map(len, scheduler.state.group_heap))
        assert entries <= 2 * (SWEEP_AT + 5)
    assert len(scheduler.state.job_dag) <= 10, 'slots are used again'
    scheduler.complete(busy, 4_000)
    order = []
    for _ in waiting:
        order.append(scheduler.take(0, 4_000))
        scheduler.complete(order[-1], 4_000)
    assert order == waiting
    assert scheduler.take(0, 4_000) == -1

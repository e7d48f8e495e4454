# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The rules as the live executor uses them: messages make the edges, threads take the work."""

from __future__ import annotations

from mddag_executor.core import NEVER, PolicyError, Scheduler, Tables
from mddag_executor.core.queues import SWEEP_AT
from mddag_executor.core.state import (
    COMPLETED,
    DROP,
    EXPIRED,
    FREE,
    JOB_END,
    LATE,
    OPEN,
    SINK_EXPIRED,
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


def test_legs_of_one_sync_may_run_at_once_and_count_at_their_ends() -> None:
    scheduler = live()
    slot = start_job(scheduler)
    legs = [scheduler.execution(slot, J, leg) for leg in (0, 1)]
    for leg in legs:
        scheduler.ready(leg, 10)
    assert [scheduler.take(worker, 10) for worker in (0, 1)] == legs
    assert scheduler.complete(legs[1], 20) is False
    assert scheduler.complete(legs[0], 60 * US) is True
    assert scheduler.decisions()[-1] == (JOB_END, 0, -1, 0, LATE, 60 * US)


def test_completions_make_no_edge_true() -> None:
    scheduler = live()
    slot = start_job(scheduler)
    assert scheduler.queue_length == 0
    assert scheduler.take(0, 1) == -1
    assert scheduler.state.job_state[slot] == OPEN


# --- workers -------------------------------------------------------------------------------------

def test_the_worker_that_asks_gets_the_work() -> None:
    scheduler = live(workers=3)
    x = undeclared(scheduler, 0, -1, 0)
    assert scheduler.take(2, 0) == x
    assert scheduler.state.worker_x == [-1, -1, x]
    assert scheduler.idle_workers == 2
    y = undeclared(scheduler, 1, -1, 0)
    assert scheduler.schedule(0) == y
    assert scheduler.state.worker_x == [y, -1, x]
    assert scheduler.schedule(0) == -1
    undeclared(scheduler, 2, -1, 0)
    undeclared(scheduler, 3, -1, 0)
    assert scheduler.schedule(0) >= 0
    assert scheduler.schedule(0) == -1, 'no worker is idle, and nobody preempts'
    assert scheduler.queue_length == 1


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


def test_lending_frees_the_worker_but_not_the_group() -> None:
    scheduler = live(workers=1)
    group = scheduler.new_group()
    x = undeclared(scheduler, 0, group, 0)
    assert scheduler.take(0, 0) == x
    blocked = undeclared(scheduler, 1, group, 0)
    other = undeclared(scheduler, 2, -1, 0)
    assert scheduler.idle_workers == 0
    scheduler.lend(x)
    assert scheduler.idle_workers == 1
    assert scheduler.take(0, 1) == other
    scheduler.complete(x, 2)     # ends on a thread without a place
    assert scheduler.idle_workers == 0
    scheduler.complete(other, 3)
    assert scheduler.take(0, 3) == blocked


def test_a_suspended_callback_keeps_its_group_and_its_key() -> None:
    scheduler = live(workers=1)
    group = scheduler.new_group()
    x = undeclared(scheduler, 0, group, 0)
    scheduler.take(0, 0)
    scheduler.suspend(x)
    assert scheduler.idle_workers == 1
    blocked = undeclared(scheduler, 1, group, 1)
    assert scheduler.take(0, 2) == -1
    later = undeclared(scheduler, 2, -1, 3)
    scheduler.resume(x)
    assert scheduler.queue_length == 3
    assert scheduler.take(0, 4) == x, 'its deadline is still the first'
    scheduler.suspend(x)
    assert scheduler.take(0, 5) == later
    scheduler.complete(later, 6)
    scheduler.resume(x)
    assert scheduler.take(0, 7) == x
    assert scheduler.complete(x, 8)
    assert scheduler.take(0, 8) == blocked


def test_what_is_refused_keeps_its_place_and_what_may_run_lets_the_next_be_asked() -> None:
    scheduler = live(workers=2)
    group = scheduler.new_group()
    first, second, other = (
        undeclared(scheduler, i, place, i) for i, place in enumerate((group, group, -1)))
    assert scheduler.take(0, 3) == first
    scheduler.refuse(first)
    assert scheduler.take(0, 4) == other
    assert scheduler.take(1, 5) == -1        # the second of the group does not pass the first
    assert scheduler.queue_length == 2
    scheduler.resume(first)
    assert scheduler.take(1, 6) == first
    scheduler.complete(other, 7)
    assert scheduler.take(0, 8) == -1
    scheduler.leave_group(first)
    assert scheduler.take(0, 9) == second
    scheduler.suspend(first)
    scheduler.resume(first)                  # it has no group to wait for any more
    scheduler.refuse(second)
    assert scheduler.take(0, 10) == first
    scheduler.drop(second, 11)
    assert scheduler.queue_length == 0
    third = undeclared(scheduler, 3, group, 12)
    assert scheduler.take(1, 12) == third


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


def test_what_waits_for_a_group_comes_in_order_of_its_key() -> None:
    scheduler = live(workers=2)
    group = scheduler.new_group()
    busy = undeclared(scheduler, 0, group, 0)
    assert scheduler.take(0, 0) == busy
    waiting = [undeclared(scheduler, i, group, i) for i in (1, 2, 3)]
    assert scheduler.take(1, 4) == -1
    assert scheduler.queue_length == 3
    slot = scheduler.release(0, 0, 4, 4)
    source = scheduler.source(slot)
    scheduler.state.x_group[source] = group     # its RAD, 50 us, is before all of them
    scheduler.ready(source, 4)
    done = busy
    for expected in (source, *waiting):
        scheduler.complete(done, 5)
        assert scheduler.take(0, 5) == expected
        assert scheduler.take(1, 5) == -1
        done = expected


# --- drop ----------------------------------------------------------------------------------------

def test_what_is_dropped_never_runs_and_frees_its_place() -> None:
    scheduler = live()
    x = undeclared(scheduler, 7, -1, 0)
    scheduler.drop(x, 1)
    assert scheduler.decisions() == [(DROP, 1, 4, 7, x, 1)]
    assert scheduler.queue_length == 0
    assert scheduler.state.n_open == [0, 0]
    assert undeclared(scheduler, 8, -1, 2) == x, 'its slot is free'
    assert scheduler.queue_length == 1
    assert scheduler.take(0, 2) == x
    assert scheduler.take(1, 2) == -1


def test_a_job_with_a_dropped_message_expires_when_its_time_is_over() -> None:
    scheduler = live(expire_after=10 * US)
    slot = start_job(scheduler)
    x = scheduler.execution(slot, X)
    scheduler.ready(x, 0)
    scheduler.drop(x, 0)
    scheduler.expire_idle(60 * US)
    assert scheduler.state.job_state[slot] == OPEN
    scheduler.expire_idle(60 * US + 1)
    assert scheduler.state.job_state[slot] == FREE
    assert scheduler.decisions()[1:] == [
        (SINK_EXPIRED, 0, J, 0, 50 * US, -1), (JOB_END, 0, -1, 0, EXPIRED, 60 * US + 1)]


@pytest.mark.parametrize('dropped', [0, 1, 2])
def test_a_group_goes_on_when_one_that_waits_for_it_is_dropped(dropped: int) -> None:
    scheduler = live(workers=1)
    group = scheduler.new_group()
    busy = undeclared(scheduler, 0, group, 0)
    scheduler.take(0, 0)
    waiting = [undeclared(scheduler, i, group, i) for i in (1, 2, 3)]
    scheduler.lend(busy)
    assert scheduler.take(0, 4) == -1        # all three wait for the group now
    scheduler.complete(busy, 5)              # the first of them is back in the ready queue
    scheduler.drop(waiting.pop(dropped), 6)
    for expected in waiting:
        assert scheduler.take(0, 7) == expected
        scheduler.complete(expected, 8)
    assert scheduler.take(0, 9) == -1
    assert scheduler.queue_length == 0


def test_the_entry_of_a_dropped_execution_is_not_taken_for_its_successor() -> None:
    # rm: the undeclared come last; the stale entry stands in the queue while x is in use again.
    scheduler = live(workers=1, policy_name='rm')
    first = undeclared(scheduler, 0, -1, 0)
    keep = undeclared(scheduler, 1, -1, 0)
    scheduler.drop(first, 1)
    assert undeclared(scheduler, 2, -1, 2) == first
    assert scheduler.queue_length == 2
    assert scheduler.take(0, 3) == keep
    scheduler.complete(keep, 4)
    assert scheduler.take(0, 5) == first
    scheduler.complete(first, 6)
    assert scheduler.take(0, 7) == -1
    assert scheduler.state.ready == []


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


def test_an_undeclared_job_of_a_load_is_in_no_list_and_its_slot_is_used_again() -> None:
    scheduler = live()
    undeclared_dag = scheduler.tables.n_dags
    slots = []
    for job in range(3):
        slot = scheduler.release(undeclared_dag, job, job, job)
        x = scheduler.execution(slot, scheduler.tables.n_vertices)
        assert run_one(scheduler, x, job)
        slots.append(slot)
    assert slots == [slots[0]] * 3
    assert scheduler.state.oldest[undeclared_dag] == -1
    assert scheduler.decisions() == []

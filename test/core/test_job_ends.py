# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How jobs end when messages make the edges: bounds, expiry, aborts, the run's end."""

from __future__ import annotations

from mddag_executor.core import rules
from mddag_executor.core.state import (
    DROP,
    EXPIRED,
    FAILED,
    FREE,
    JOB_END,
    OPEN,
    SINK_ABORTED,
    SINK_FAILED,
    SINK_MISSED,
    WAITING,
)
from msg_graph import TaskSet

from .live_helpers import J, live, start_job, undeclared, US, X
from .task_sets import declaration


def test_a_job_fails_with_what_fails_of_it() -> None:
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


def test_what_fails_after_the_end_of_its_job_changes_nothing() -> None:
    scheduler = live(max_active_jobs=1)
    slot = start_job(scheduler)
    scheduler.ready(scheduler.execution(slot, X), 1)
    x = scheduler.take(0, 1)
    scheduler.release(0, 1, 10, 10)
    assert scheduler.decisions()[-1] == (JOB_END, 0, -1, 0, EXPIRED, 10)
    rules.fail(scheduler.tables, scheduler.state, scheduler.policy.key, x, 11)
    assert scheduler.decisions() == []


def test_an_undeclared_callback_that_fails_is_judged_by_nobody() -> None:
    scheduler = live()
    x = undeclared(scheduler, 0, -1, 1)
    assert scheduler.take(0, 1) == x
    rules.fail(scheduler.tables, scheduler.state, scheduler.policy.key, x, 2)
    assert scheduler.decisions() == [] and scheduler.state.undeclared == [x]


def test_a_stuck_job_does_not_keep_younger_ones_from_expiring() -> None:
    scheduler = live(expire_after=10 * US)
    stuck = scheduler.release(0, 0, 0, 0)
    scheduler.ready(scheduler.source(stuck), 0)
    assert scheduler.take(0, 0) == scheduler.source(stuck)
    scheduler.suspend(scheduler.source(stuck))     # it waits for what never comes
    lost = [start_job(scheduler, job, job) for job in (1, 2)]
    scheduler.expire_idle(60 * US + 2)
    assert [decision[3] for decision in scheduler.decisions() if decision[0] == JOB_END] == [1]
    scheduler.expire_idle(60 * US + 3)
    assert [decision[3] for decision in scheduler.decisions() if decision[0] == JOB_END] == [2]
    states = [scheduler.state.job_state[slot] for slot in (stuck, *lost)]
    assert states == [OPEN, FREE, FREE]


def test_releases_may_come_out_of_order() -> None:
    """As header stamps do; each job expires by its own release."""
    scheduler = live(expire_after=10 * US)
    scheduler.release(0, 0, 5 * US, 5 * US)
    scheduler.release(0, 1, 1 * US, 6 * US)
    scheduler.expire_idle(61 * US + 1)
    assert [decision[3] for decision in scheduler.decisions() if decision[0] == JOB_END] == [1]


def aborting() -> TaskSet:
    return declaration([
        {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd',
         'on_late': 'abort'},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '5us'},
        {'node': '/n', 'name': 'y', 'subscription': '/s', 'deadline': '50us'},
        {'node': '/n', 'name': 'z', 'subscription': '/s', 'deadline': '60us'}])


def test_what_comes_too_late_aborts_its_job_at_its_turn() -> None:
    scheduler = live(aborting(), workers=1)
    slot = start_job(scheduler)
    y = scheduler.execution(slot, 2)
    scheduler.ready(y, 1)
    assert scheduler.take(0, 5 * US + 1) == -1, 'x has missed its deadline: the job is over'
    kinds = [decision[0] for decision in scheduler.decisions()]
    assert kinds == [SINK_ABORTED, SINK_ABORTED, SINK_ABORTED, JOB_END, DROP]
    assert scheduler.state.job_state[slot] == FREE


def test_a_blocked_callback_does_not_abort_its_job() -> None:
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


def test_the_end_of_the_run_judges_what_is_open() -> None:
    scheduler = live()
    start_job(scheduler, 0, 0)
    start_job(scheduler, 1, 10 * US)
    start_job(scheduler, 2, 20 * US)
    scheduler.finish(60 * US)
    assert scheduler.decisions() == [
        (SINK_MISSED, 0, J, 0, 50 * US, -1), (SINK_MISSED, 0, J, 1, 60 * US, -1)]
    assert scheduler.state.n_open[0] == 3


def test_a_recorded_execution_goes_past_queue_workers_and_groups() -> None:
    scheduler = live(workers=1)
    group = scheduler.new_group()
    busy = undeclared(scheduler, 0, group, 0)
    assert scheduler.take(0, 0) == busy
    slot = scheduler.release(0, 0, 0, 0)
    source = scheduler.source(slot)
    scheduler.state.x_group[source] = group
    assert rules.record(
        scheduler.tables, scheduler.state, scheduler.policy.key, source, 2)
    assert scheduler.idle_workers == 0
    assert scheduler.state.group_owner[group] == busy
    assert scheduler.state.job_active[slot] == 0
    assert scheduler.state.x_state[source] != WAITING

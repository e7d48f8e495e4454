# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The policy ros2: wait-set order and polling rounds, by hand, by property and in the queues."""

from __future__ import annotations

from typing import Any

from mddag_executor.core import PolicyError, Scheduler, Tables
from mddag_executor.core.queues import SWEEP_AT
from mddag_executor.simulate import Settings, simulate, SimulationError
import pytest

from .live_helpers import undeclared
from .task_sets import Case, declaration
from .test_by_hand import after, case, log, single, source, starts


def ros2(callbacks: list[dict[str, Any]], ticks: dict[str, int], **more: Any) -> Case:
    return case(callbacks, ticks, policy='ros2', **more)


# --- order ---------------------------------------------------------------------------------------


def test_timers_then_subscriptions_then_services() -> None:
    callbacks = [
        {'node': f'/{name}', 'name': name, 'period': '50us', 'deadline': '50us', kind: f'/{name}'}
        for name, kind in (
            ('serve', 'service'), ('sub', 'subscription'), ('sub2', 'subscription'))]
    callbacks.append(single('timer', 50))
    ticks = dict.fromkeys(('serve', 'sub', 'sub2', 'timer'), 1)
    assert starts(ros2(callbacks, ticks), 40) == ['timer.0', 'sub.0', 'sub2.0', 'serve.0']


def test_what_becomes_ready_during_a_round_waits_for_the_next() -> None:
    """The timer that is due at 4 is first among timers, but b was ready at the poll, at 3."""
    callbacks = [single('due', 4), source('a', 100), after('a', 'b', 100), after('a', 'c', 100)]
    of = ros2(callbacks, {'due': 1, 'a': 2, 'b': 2, 'c': 2})
    # Round 1 at 0: due, a. Round 2 at 3: b, c. Round 3 at 7: due.1. Round 4 at 8: due.2.
    assert [(now, who) for now, kind, _, who in log(of, 11) if kind == 'start'] == [
        (0, 'due.0'), (1, 'a.0'), (3, 'b.0'), (5, 'c.0'), (7, 'due.1'), (8, 'due.2')]
    # Without rounds the timer would go in front.
    assert starts(case(callbacks, {'due': 1, 'a': 2, 'b': 2, 'c': 2}, policy='picas'), 11)[:4] == [
        'due.0', 'a.0', 'b.0', 'due.1']


def test_workers_share_a_round() -> None:
    """Two workers take what one of them polled; the round goes on until it is empty."""
    callbacks = [single('x', 10), *(single(f'r{i}', 50) for i in range(3))]
    of = ros2(callbacks, {'x': 4, 'r0': 12, 'r1': 3, 'r2': 6}, workers=2)
    # x.1 is due at 10, when worker 1 runs r2 (7 to 13): worker 0 polls at 12.
    assert [entry for entry in log(of, 20) if entry[1] == 'start'] == [
        (0, 'start', 0, 'x.0'), (0, 'start', 1, 'r0.0'), (4, 'start', 0, 'r1.0'),
        (7, 'start', 0, 'r2.0'), (12, 'start', 1, 'x.1')]


# --- callback groups -----------------------------------------------------------------------------


def test_what_is_blocked_is_left_out_of_the_round() -> None:
    """At 0 b is passed over: a holds the group. At 1 c ends, and a poll finds b blocked again."""
    group = {'group': 'g'}
    callbacks = [single('a', 100, **group), single('b', 100, **group), single('c', 100),
                 single('d', 100), single('e', 2, 100)]
    of = ros2(callbacks, {'a': 3, 'b': 1, 'c': 1, 'd': 3, 'e': 9}, workers=2)
    assert [entry for entry in log(of, 12) if entry[1] == 'start'] == [
        (0, 'start', 0, 'a.0'), (0, 'start', 1, 'c.0'), (1, 'start', 1, 'd.0'),
        # The group is free at 3, but e was in the round of 0 yet, and b waits for the next poll.
        (3, 'start', 0, 'e.0'), (4, 'start', 1, 'b.0'), (5, 'start', 1, 'e.1')]


# --- the core by itself --------------------------------------------------------------------------


def scheduler(workers: int = 1) -> Scheduler:
    tables = Tables.build(declaration([
        {'node': '/n', 'name': 'one', 'subscription': '/x', 'period': '10us', 'dag': 'x',
         'publishes': ['/a', '/b']},
        {'node': '/n', 'name': 'join', 'sync': ['/a', '/b'], 'deadline': '10us'},
        {'node': '/n', 'name': 'tick', 'timer': '10us', 'deadline': '10us', 'dag': 't'}]),
        legs=True)
    return Scheduler(tables, workers, 'ros2', propagate=False)


def test_dropped_ones_leave_the_queues() -> None:
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


def test_no_preemption() -> None:
    task_set = declaration([single('a', 10)])
    with pytest.raises(PolicyError, match="policy 'ros2': .* preempts no callback: run it"):
        Scheduler(Tables.build(task_set), 1, 'ros2', preemptive=True)
    of = ros2([single('a', 10)], {'a': 1})
    settings = Settings(policy='ros2', workers=1, preemptive=True, duration_ns=10)
    with pytest.raises(PolicyError, match='preempts no callback'):
        simulate(task_set, of.load(10), settings)
    assert not simulate(
        task_set, of.load(10), Settings(policy='ros2', preemptive=None)).settings.preempts
    with pytest.raises(SimulationError, match='workers'):
        simulate(task_set, of.load(10), Settings(policy='ros2', workers=0))

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The terms of the tests that random sets seldom bring to their limits, worked out by hand."""

from __future__ import annotations

from mddag_executor.analysis import analyse, FAILS, HOLDS, NOTHING, tasks_of
from mddag_executor.analysis.sufficient import own_jobs, own_urgent, rad, urgent
from msg_graph import loads
import pytest

from .test_against_simulation import missed
from .test_by_hand import MS, timers, verdicts

WIDE = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 10ms, publishes: [/a], execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 10ms, execution_time: 3ms}
      - {name: y, subscription: /a, deadline: 10ms, execution_time: 5ms}
"""


def test_a_long_callback_that_has_begun_is_part_of_the_bound() -> None:
    # 2 ms of its own, 4 ms of a job of the other with an earlier RAD, 4 ms of one with a later.
    tasks = tasks_of(loads(timers('100ms 50ms 2ms', '1s 1s 4ms')))
    assert [bound.response for bound in rad(tasks, 1)] == [10 * MS, 6 * MS]
    # On two workers both of these go on beside each other, and each callback of a chain waits.
    wide = tasks_of(loads(WIDE.replace('10ms, publishes', '100ms, publishes').replace(
        'deadline: 10ms', 'deadline: 50ms')
        + timers('1s 1s 4ms', '1s 1s 2ms').partition('nodes:\n')[2].replace('/n', '/m')))
    first = rad(wide, 2)[0]
    # To x: 4 + (5 + urgent 4 + 2 + the lesser of 2 * (4 + 2) and what there is, 6 more) / 2.
    assert first.response == (4 + (5 + 6 + 6) / 2) * MS


def test_without_preemption_less_is_proven() -> None:
    text = timers('100ms 5.999ms 2ms', '100ms 100ms 4ms')
    times, late = [[2 * MS], [4 * MS]], [100, 0]  # ns after the blocking one
    assert missed(loads(text), times, 'rad', False, 1, late)
    assert verdicts(text, 1)['response time, RAD without preemption'].verdict == NOTHING
    assert not missed(loads(text), times, 'rad', True, 1, late)


def test_jobs_before_and_after() -> None:
    task, = tasks_of(loads(timers('10ms 25ms 4ms')))
    # Earlier: 15 and 5 ms into the window, later: 2 ms of it are left, for 2 workers.
    assert own_jobs(task, 12 * MS, 2) == (4 + 4 + 4) * MS
    assert own_jobs(task, 11 * MS, 2) == (4 + 4 + 2) * MS
    assert own_jobs(task, 10 * MS, 2) == (4 + 4) * MS


def test_urgent_work() -> None:
    task, = tasks_of(loads(timers('10ms 25ms 4ms')))
    assert urgent(task, 25 * MS) == 12 * MS
    assert urgent(task, 22 * MS) == (4 + 4 + 2) * MS
    assert urgent(task, 3 * MS) == 3 * MS
    # RADs 25, 15, 5 ms of this job and of those before; 35 ms of the next one.
    assert own_urgent(task, 25 * MS) == 12 * MS
    assert own_urgent(task, 35 * MS) == 16 * MS
    assert own_urgent(task, 24 * MS) == 8 * MS


@pytest.mark.parametrize('budget', ['max', 'mean'])
def test_all_that_is_missing_is_counted(budget: str) -> None:
    from mddag_executor.analysis import AnalysisError
    text = WIDE.replace(', execution_time: 3ms', '').replace(', execution_time: 5ms', '')
    with pytest.raises(AnalysisError, match=r'g:6: /n:x \(and 1 more callbacks\) declares no'):
        analyse(loads(text, 'g'), 2, budget)


def test_words_and_assumptions() -> None:
    for verdict in analyse(loads(WIDE), 2).verdicts:
        assert verdict.verdict in (HOLDS, FAILS, NOTHING)
        assert verdict.kind == 'necessary' or verdict.verdict != FAILS
        assert verdict.name and verdict.assumption and verdict.figure and verdict.reason

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The tests of the analysis, on figures worked out by hand."""

from mddag_executor.laboratory.analyse import analyse, FAILS, HOLDS, NOTHING
from mddag_executor.laboratory.necessary import largest_demand
from mddag_executor.laboratory.tasks import tasks_of
from msg_graph import loads
import pytest

from .test_analysis_against_simulation import missed

MS = 1_000_000
FORK = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 100ms, publishes: [/a], execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 3ms, execution_time: 2ms}
      - {name: y, subscription: /a, deadline: 50ms, execution_time: 40ms}
"""


def timers(*callbacks):
    """Return a declaration of timers, each as `PERIOD DEADLINE COST`."""
    lines = ['mddag: 1', 'nodes:']
    for place, each in enumerate(callbacks):
        period, deadline, cost = each.split()
        lines.append(f'  - {{node: /n{place}, callbacks: [{{name: t, timer: {period}, '
                     f'deadline: {deadline}, execution_time: {cost}}}]}}')
    return '\n'.join(lines)


def verdicts(text, workers, budget='max'):
    found = analyse(loads(text, 'g.yaml'), workers, budget).verdicts
    assert len({verdict.name for verdict in found}) == len(found)
    return {verdict.name: verdict for verdict in found}


def test_a_path_that_is_too_long():
    found = verdicts(FORK.replace('deadline: 3ms', 'deadline: 2.9ms'), 8)
    assert found['longest path'].verdict == FAILS
    assert found['longest path'].figure == '3ms of 2.9ms at /n: /n:x'
    assert found['longest path'].reason == 'too long for 1 of 2 sinks'
    assert all(v.verdict == NOTHING for v in found.values() if v.kind == 'sufficient')


def test_demand():
    found = verdicts(timers('10ms 1ms 1ms', '10ms 1ms 1ms'), 1)
    assert found['utilisation'].verdict == HOLDS
    assert found['demand bound'].verdict == FAILS
    assert found['demand bound'].figure == '2ms due within 1ms, of 1ms'
    # Refined for each sink: 1 ms by 1 ms, 3 ms by 3 ms, and 43 ms by 50 ms.
    demand = largest_demand(tasks_of(loads(FORK)), 2)
    assert (demand.time, demand.work, demand.complete) == (1 * MS, 1 * MS, True)
    assert verdicts(FORK, 1)['demand bound'].verdict == HOLDS


def test_only_rad_puts_the_urgent_first():
    found = verdicts(timers('100ms 14ms 2ms', '100ms 100ms 4ms', '100ms 100ms 3ms'), 1)
    assert found['response time, any policy'].verdict == NOTHING
    bound = found['response time, RAD without preemption']
    assert bound.verdict == HOLDS
    # 2 of its own, a job of each other one that may be urgent, and the longest that had begun.
    assert bound.details['/n0: /n0:t'] == {'deadline_ns': 14 * MS, 'response_bound_ns': 13 * MS}


@pytest.mark.parametrize(('right', 'wrong', 'reason'), [
    ('name: x,', 'name: x, group: g,', '/n:x is in a callback group'),
    ('name: x,', 'name: x, holds_interpreter: true,', '/n:x computes in Python'),
    ('name: x,', 'name: x, holds_interpreter: false,', None),
    ('name: t, timer: 100ms,', 'name: t, subscription: /o, period: 100ms, '
     'release_from: header_stamp,', 'released from header_stamp'),
    ('deadline: 50ms', 'deadline: 99ms', None),
    ('name: t,', 'name: t, max_active_jobs: 1,', None),
])
def test_assumptions(right, wrong, reason):
    text = FORK.replace('deadline: 3ms', 'deadline: 45ms')
    found = verdicts(text.replace(right, wrong), 2)
    for verdict in found.values():
        if reason is not None and verdict.kind == 'sufficient':
            assert verdict.verdict == NOTHING
            assert reason in verdict.reason
    if reason is None:
        assert found['response time, any policy'].verdict == HOLDS


def test_without_preemption_less_is_proven():
    text = timers('100ms 5.999ms 2ms', '100ms 100ms 4ms')
    times, late = [[2 * MS], [4 * MS]], [100, 0]  # ns after the blocking one
    assert missed(loads(text), times, 'rad', False, 1, late)
    assert verdicts(text, 1)['response time, RAD without preemption'].verdict == NOTHING
    assert not missed(loads(text), times, 'rad', True, 1, late)

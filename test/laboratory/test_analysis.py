# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The tests of the analysis: on figures worked out by hand, and against simulated random runs.

A sufficient test that holds must never meet a simulated miss under its own assumptions, whatever
the phases and with times below the budgets; a necessary one that fails must meet one. Sets are
drawn at random, and also brought to the border of what a test accepts, where a wrong one shows.
"""

import random

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.laboratory.analyse import analyse, FAILS, HOLDS, NOTHING
from mddag_executor.laboratory.generate import generate, Options
from mddag_executor.laboratory.necessary import largest_demand
from mddag_executor.laboratory.tasks import tasks_of
from mddag_executor.simulate import periodic_load, Settings, simulate
from msg_graph import loads
import pytest

from ..conftest import examples

MS = 1_000_000
HORIZON = 240 * MS


def random_graph(seed, one_deadline, dags, load):
    """
    Return a random task set whose periods divide the horizon.

    Every third one has single callbacks, with deadlines of all lengths: for those the tests of the
    analysis leave the least room.
    """
    single = seed % 3 == 0
    factor = random.Random(seed).choice(
        [0.3, 0.5, 0.8, 1, 1.5, 3] if single else [1, 1, 1, 0.8, 1.5, 2.5])
    return loads(generate(Options(
        dags=(dags, dags), vertices=(1, 1) if single else (1, 7), or_share=0.1,
        tightness=(factor, factor) if one_deadline else (0.6 * factor, 1.6 * factor),
        utilisation=load * dags, workers=1, most_per_dag=2 * load,
        periods_ns=tuple(ms * MS for ms in (4, 5, 6, 8, 10, 12, 20, 24)), seed=seed)))


def shifted(load, phases):
    """Return the load with a phase for each DAG."""
    releases = sorted((time + phases[dag], dag, job)
                      for time, dag, job in zip(load.times, load.dags, load.jobs))
    return load._replace(times=[r[0] for r in releases], dags=[r[1] for r in releases],
                         jobs=[r[2] for r in releases])


def missed(task_set, times, policy, preemptive, workers, phases):
    load = shifted(periodic_load(task_set, times, HORIZON), phases)
    run = simulate(task_set, load, Settings(
        policy=policy, workers=workers, duration_ns=HORIZON, preemptive=preemptive,
        stop_at_first_miss=True))
    return bool(run.result()['deadline_missed'])


PROVEN = {
    "Graham's bound": [('fifo', False), ('rad', True), ('gedf', True), ('rm', False)],
    'response time, any policy': [
        ('fifo', False), ('rad', False), ('rad', True), ('rm', True), ('wc', False)],
    'response time, RAD without preemption': [('rad', False)],
}
NAMES = tuple(PROVEN)
held = dict.fromkeys(PROVEN, 0)


def budgets_of(task_set):
    return [[v.callback.execution_time.mean_ns for v in dag.vertices
             if v.callback.execution_time is not None] for dag in task_set.dags]


def check_holds(task_set, verdict, workers, rng):
    """Try to find a miss where a sufficient test holds."""
    held[verdict.name] += 1
    budgets = budgets_of(task_set)
    together = [0] * len(budgets)
    phases = [rng.randrange(dag.period_ns) for dag in task_set.dags]
    shorter = [[max(1, round(cost * rng.uniform(0.2, 1))) for cost in row] for row in budgets]
    for times, offsets in ((budgets, together), (budgets, phases), (shorter, phases)):
        for policy, preemptive in PROVEN[verdict.name]:
            assert not missed(task_set, times, policy, preemptive, workers, offsets)


@examples(60)
@given(seed=st.integers(0, 2 ** 32), one=st.booleans(), dags=st.integers(1, 4),
       workers=st.integers(1, 5), part=st.floats(0.05, 1.1))
def check_random_set(seed, one, dags, workers, part):
    task_set = random_graph(seed, one, dags, part * workers / dags)
    rng = random.Random(seed)
    verdicts = analyse(task_set, workers).verdicts
    *_, any_policy, rad = verdicts
    assert any_policy.verdict != HOLDS or rad.verdict == HOLDS
    for verdict in verdicts:
        if verdict.name in ('longest path', 'demand bound') and verdict.verdict == FAILS:
            if verdict.details.get('time_ns', 0) < HORIZON:
                for policy in ('rad', 'fifo'):
                    assert missed(task_set, budgets_of(task_set), policy, True, workers,
                                  [0] * len(task_set.dags))
        if verdict.kind == 'sufficient' and verdict.verdict == HOLDS:
            check_holds(task_set, verdict, workers, rng)


def at_the_border(seed, one, dags, workers, name):
    """Return a random set with nearly the most load for which a test holds."""
    low, high, found = 0.0, 1.2 * workers / dags, None
    for _ in range(8):
        load = (low + high) / 2
        task_set = random_graph(seed, one, dags, load)
        verdict = next(v for v in analyse(task_set, workers).verdicts if v.name == name)
        if verdict.verdict == HOLDS:
            low, found = load, (task_set, verdict)
        else:
            high = load
    return found


@examples(60)
@given(seed=st.integers(0, 2 ** 32), dags=st.integers(1, 4), workers=st.integers(1, 4),
       name=st.sampled_from(NAMES), one=st.booleans())
def check_border(seed, dags, workers, name, one):
    found = at_the_border(
        seed, one, 1 if name == NAMES[0] else dags, workers, name)
    if found is None:
        return
    task_set, verdict = found
    rng = random.Random(seed)
    for _ in range(3):
        check_holds(task_set, verdict, workers, rng)


def test_no_verdict_is_contradicted_by_a_run():
    check_random_set()
    check_border()
    # Each test has been on trial, and not just silent.
    assert min(held.values()) >= 5, held


# --- by hand -------------------------------------------------------------------------------------


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
    path = found['longest path']
    assert (path.verdict, path.figure, path.reason) == (
        FAILS, '3ms of 2.9ms at /n: /n:x', 'too long for 1 of 2 sinks')
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

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The tests of the analysis against simulated runs, on random task sets.

A sufficient test that holds must never meet a simulated miss under its own assumptions, whatever
the phases and with times below the budgets; a necessary one that fails must meet one. Sets are
drawn at random, and also brought to the border of what a test accepts, where a wrong one shows.
"""

import random

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.laboratory.analyse import analyse, FAILS, HOLDS
from mddag_executor.simulate import periodic_load, Settings, simulate
import msg_graph

from ..conftest import examples

MS = 1_000_000
HORIZON = 240 * MS


def random_graph(seed, one_deadline, dags, load):
    """
    Return a declaration: trees with joins, periods that divide the horizon.

    Every third one has single callbacks instead, with deadlines of all lengths: for those the
    tests leave the least room.
    """
    rng = random.Random(seed)
    single = seed % 3 == 0
    lines = ['mddag: 1', 'nodes:']
    for dag in range(dags):
        period = rng.choice([4, 5, 6, 8, 10, 12, 20, 24])
        size = 1 if single else rng.randint(1, 7)
        factors = [0.3, 0.5, 0.8, 1, 1.5, 3] if single else [1, 1, 1, 0.8, 1.5, 2.5]
        deadline = max(1, round(period * rng.choice(factors)))
        parents = [[0]] + [sorted(rng.sample(range(i), min(i, rng.choice([1, 1, 1, 2]))))
                           for i in range(1, size)]
        sinks = set(range(size)) - {p for i in range(1, size) for p in parents[i]}
        share = load * period / size
        lines += [f'  - node: /n{dag}', '    callbacks:']
        for i in range(size):
            start = f'timer: {period}ms'
            if i > 0:
                # A topic for each edge: vertices that start several publish several.
                topics = [f'/d{dag}_{p}_{i}' for p in parents[i]]
                start = (f'subscription: {topics[0]}' if len(topics) == 1
                         else f'sync: [{", ".join(topics)}]')
            out = [f'/d{dag}_{i}_{j}' for j in range(i + 1, size) if i in parents[j]]
            own = deadline if one_deadline else max(1, round(deadline * rng.uniform(0.6, 1.6)))
            ends = f', deadline: {own}ms' if i in sinks else f', publishes: [{", ".join(out)}]'
            cost = max(1, round(1000 * share * rng.uniform(0.1, 1.9)))
            lines.append(f'      - {{name: c{i}, {start}{ends}, execution_time: {cost}us}}')
    return '\n'.join(lines) + '\n'


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
    task_set = msg_graph.loads(random_graph(seed, one, dags, part * workers / dags))
    rng = random.Random(seed)
    for verdict in analyse(task_set, workers).verdicts:
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
        task_set = msg_graph.loads(random_graph(seed, one, dags, load))
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


def test_rad_holds_wherever_any_policy_does():
    for seed in range(60):
        dags, workers = 1 + seed % 3, 1 + seed % 4
        text = random_graph(seed, True, dags, 0.3 * workers / dags)
        found = {v.name: v.verdict for v in analyse(msg_graph.loads(text), workers).verdicts}
        assert (found['response time, any policy'] != HOLDS
                or found['response time, RAD without preemption'] == HOLDS)

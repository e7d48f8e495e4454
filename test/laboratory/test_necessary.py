# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The necessary tests: on figures worked out by hand, and against simulated random runs.

A test that fails must meet a simulated miss.
"""

import random

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.laboratory.generate import generate, Options
from mddag_executor.laboratory.necessary import largest_demand, necessary_tests
from mddag_executor.laboratory.tasks import tasks_of
from mddag_executor.simulate import periodic_workload, Settings, simulate
from msg_graph import loads

from ..conftest import examples

MS = 1_000_000
HORIZON = 240 * MS


def random_graph(seed, one_deadline, dags, load):
    """
    Return a random task set whose periods divide the horizon.

    Every third one has single callbacks, with deadlines of all lengths.
    """
    single = seed % 3 == 0
    factor = random.Random(seed).choice(
        [0.3, 0.5, 0.8, 1, 1.5, 3] if single else [1, 1, 1, 0.8, 1.5, 2.5])
    return loads(generate(Options(
        dags=(dags, dags), vertices=(1, 1) if single else (1, 7), or_share=0.1,
        tightness=(factor, factor) if one_deadline else (0.6 * factor, 1.6 * factor),
        utilisation=load * dags, workers=1, most_per_dag=2 * load,
        periods_ns=tuple(ms * MS for ms in (4, 5, 6, 8, 10, 12, 20, 24)), seed=seed)))


def missed(task_set, policy, workers):
    times = [[vertex.callback.execution_time.mean_ns for vertex in dag.vertices]
             for dag in task_set.dags]
    run = simulate(task_set, periodic_workload(task_set, times, HORIZON), Settings(
        policy=policy, pools=(workers,), duration_ns=HORIZON, preemptive=True,
        stop_at_first_miss=True))
    return bool(run.result()['deadline_missed'])


def test_no_verdict_is_contradicted_by_a_run():
    failed = {'longest path': 0, 'demand bound': 0}

    @examples(60)
    @given(seed=st.integers(0, 2 ** 32), one=st.booleans(), dags=st.integers(1, 4),
           workers=st.integers(1, 5), part=st.floats(0.05, 1.1))
    def check(seed, one, dags, workers, part):
        task_set = random_graph(seed, one, dags, part * workers / dags)
        for verdict in necessary_tests(task_set, workers):
            if (verdict.test in failed and not verdict.holds
                    and verdict.details.get('time_ns', 0) < HORIZON):
                failed[verdict.test] += 1
                for policy in ('rad', 'fifo'):
                    assert missed(task_set, policy, workers)

    check()
    assert min(failed.values()) >= 3, failed


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


def verdicts(text, workers):
    return {verdict.test: verdict for verdict in necessary_tests(loads(text), workers)}


def test_a_path_that_is_too_long():
    found = verdicts(FORK.replace('deadline: 3ms', 'deadline: 2.9ms'), 8)
    path = found['longest path']
    assert (path.holds, path.figure, path.reason) == (
        False, '3ms of 2.9ms at /n:x', 'too long for 1 of 2 sinks')


def test_demand():
    found = verdicts(timers('10ms 1ms 1ms', '10ms 1ms 1ms'), 1)
    assert found['utilisation'].holds
    assert not found['demand bound'].holds
    assert found['demand bound'].figure == '2ms due within 1ms, of 1ms'
    # Refined for each sink: 1 ms by 1 ms, 3 ms by 3 ms, and 43 ms by 50 ms.
    demand = largest_demand(tasks_of(loads(FORK)), 2)
    assert (demand.time, demand.work, demand.complete) == (1 * MS, 1 * MS, True)
    assert verdicts(FORK, 1)['demand bound'].holds

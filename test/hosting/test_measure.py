# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import json

from mddag_executor.hosting.measure import ExecutionPlan, Ledger, measure, Reading
from msg_graph import loads

MS = 1_000_000


def reading(at_ns: int, n: int = 0, cpu_ns: int = 0) -> Reading:
    return Reading(at_ns, cpu_ns, (n,))


SINGLE = ('mddag: 1\nnodes:\n  - node: /a\n    callbacks: '
          '[{name: a, timer: 100ms, deadline: 150ms, execution_time: 10ms}]\n')


def test_every_nominal_release_whose_deadline_lies_in_the_window_is_due() -> None:
    task_set = loads(SINGLE)
    ledger = Ledger(task_set)
    first = 1_700_000_000 * 1000 * MS
    ledger.first_release[0] = first
    # Jobs 0 to 9, deadlines at first + 150, 250, … ms.  The window holds jobs 1 to 8: it begins
    # at the deadline of job 0 and ends at that of job 8.
    for job, response in {0: 10, 1: 150, 2: 151, 3: 20, 5: 250, 6: 30, 8: 40, 9: 50}.items():
        release = first + job * 100 * MS
        ledger.completions[0][0].append((release, release + response * MS))
    ledger.window = reading(first + 150 * MS), reading(first + 950 * MS)
    result = measure(ledger, ExecutionPlan(task_set))
    sink = result['dags']['/a']['sinks']['/a:a']
    assert {k: sink[k] for k in ('due', 'on_time', 'late', 'missing')} == {
        'due': 8, 'on_time': 4, 'late': 2, 'missing': 2}
    assert sink['response_ns'] == {
        'min': 20 * MS, 'median': 40 * MS, 'p99': 250 * MS, 'max': 250 * MS}
    assert (result['sink_jobs_due'], result['on_time_ratio']) == (8, 0.5)


def test_the_ledgers_of_several_processes_are_that_of_one_run():
    task_set = loads("""
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 10ms, publishes: [/x], execution_time: 1ms}]}
  - {node: /b, callbacks: [{name: s, subscription: /x, deadline: 5ms, execution_time: 1ms}]}
""")
    ms = 1_000_000
    parts = []
    for vertex, (begin, end) in enumerate(((100, 300), (150, 350))):
        ledger = Ledger(task_set)
        if vertex == 0:
            ledger.first_release[0] = 0
        for job in range(40):
            ledger.durations[0][vertex].append(ms)
            if vertex == 1:
                ledger.completions[0][1].append((job * 10 * ms, (job * 10 + job % 8) * ms))
        bodies = [0, 0]
        bodies[vertex] = 20
        ledger.window = Reading(begin * ms, 0, (0, 0)), Reading(end * ms, 8 * ms, bodies)
        parts.append(json.loads(json.dumps(vars(ledger), default=list)))
    whole = Ledger.of_processes(task_set, parts)
    assert [reading.at_ns for reading in whole.window] == [150 * ms, 300 * ms]
    result = measure(whole, ExecutionPlan(task_set, mode='spin'))
    assert (result['sink_jobs_due'], result['on_time'], result['missing']) == (15, 12, 0)
    assert (result['callbacks'], result['callbacks_per_s']) == (30, 200.0)

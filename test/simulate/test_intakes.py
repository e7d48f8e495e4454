# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What processes take to notice timers and messages, in virtual time."""

from __future__ import annotations

from typing import Any

from mddag_executor.core import Tables
from mddag_executor.simulate import END, periodic_load, Settings, START
from mddag_executor.simulate.intakes import Costs, Intakes
from mddag_executor.simulate.load import FAILS, Load, RUNS, SKIPPED
from msg_graph import loads, TaskSet
import pytest

MS = 1_000_000
COSTS = Costs(timer_ns=300_000, timer_ready_ns=100_000, message_ns=200_000,
              message_ready_ns=500_000, send_ns=0)
CHAIN = """
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 100ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: s, subscription: /x, deadline: 100ms}]}
processes: {p1: [/a], p2: [/b]}
"""
BOTH = """
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 100ms, deadline: 100ms}]}
  - {node: /b, callbacks: [{name: t, timer: 50ms, deadline: 20ms}]}
"""


def run(
    task_set: TaskSet, times: list[list[int]], compiled: bool = False, costs: Costs = COSTS,
    **columns: Any,
) -> Any:
    """Run 100 ms in which all callbacks compute with Python's lock."""
    tables = Tables.build(task_set)
    load: Load = periodic_load(task_set, times, 100 * MS)
    n = sum(map(len, times))
    edges = [len(dag.edges) for dag in task_set.dags]
    columns = {
        'holds': tables.process[:n], 'delays': [costs.delay_ns] * sum(edges),
        'delay_base': [sum(edges[:i]) for i in range(len(edges))],
        'delay_stride': [0] * len(edges), **columns}
    return Intakes(task_set, tables, costs).schedule(
        load._replace(**columns),
        Settings('rad', 2, 100 * MS, processes=max(1, len(task_set.processes))),
        log=True, compiled=compiled)


@pytest.mark.parametrize('compiled', [False, True])
def test_what_comes_is_noticed_by_a_thread_that_takes_no_worker(compiled: bool) -> None:
    if compiled:
        pytest.importorskip('numba')
    ran = run(loads(CHAIN), [[2 * MS, MS]], compiled)
    ready = 100_000
    ended = 300_000 + 2 * MS    # the intake still has the lock when the callback is ready
    arrived = ended + 500_000
    assert [tuple(map(int, entry)) for entry in ran.log] == [
        (ready, START, 0, 0, 0, 0),
        (300_000, END, 4, 0, ~0, 0),
        (ended, END, 0, 0, 0, 0),
        (arrived, END, 5, 0, ~1, 0),
        (arrived, START, 2, 0, 1, 0),
        (arrived + MS, END, 2, 0, 1, 0)]
    assert ran.busy == [ended - ready, 0, MS, 0]
    assert [(d[2], d[5]) for d in ran.decisions if d[2] >= 0] == [(1, arrived + MS)]


def test_what_computes_stands_still_while_a_timer_is_noticed() -> None:
    ran = run(loads(BOTH), [[80 * MS], [MS]])
    ends = {(int(e[4]), int(e[5])): int(e[0]) for e in ran.log if e[1] == END}
    # a switch interval until the intake gets the lock; then the urgent one waits for it as long
    assert ends[~1, 1] == 50 * MS + MS + 300_000
    assert ends[1, 1] == ends[~1, 1] + MS + MS
    assert ends[0, 0] == 300_001 + MS + 80 * MS + 300_000 + MS


def test_a_skipped_job_is_skipped_and_a_failed_one_fails() -> None:
    task_set = loads(CHAIN)
    for fate, decided in ((SKIPPED, 0), (FAILS, 1)):
        ran = run(task_set, [[2 * MS, MS]], fates=[fate, RUNS])
        started = [e for e in ran.log if e[1] == START]
        assert len(started) == decided
        assert not any(e[4] == 1 for e in ran.log)

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which node runs in which process."""

from __future__ import annotations

from itertools import product

from mddag_executor.laboratory.placement import Placing
from msg_graph import loads, TaskSet

MS = 1_000_000


def workload(*milliseconds: float, holds: str = '') -> TaskSet:
    """Return independent nodes /n0, /n1, … that compute so long of each 100 ms."""
    lines = ['mddag: 1', 'nodes:']
    for i, _ in enumerate(milliseconds):
        lines += [f'  - node: /n{i}', f'    callbacks: [{{name: t, timer: 100ms, '
                  f'deadline: 100ms{holds if i == 0 else ""}}}]']
    return loads('\n'.join(lines))


def placed(task_set: TaskSet, n: int, *milliseconds: float, **rules: object) -> list[set[str]]:
    placing = Placing(task_set, n, [[round(ms * MS)] for ms in milliseconds],
                      **rules)  # type: ignore[arg-type]
    return [set(process.nodes) for process in placing.processes(placing.place())]


def test_the_largest_load_is_the_least_there_can_be() -> None:
    times = (30, 25, 20, 18, 12, 9, 7)
    found = placed(workload(*times), 2, *times)
    loads_ = [sum(times[int(node[2:])] for node in nodes) for nodes in found]
    best = min(max(sum(t for t, p in zip(times, places) if p == 0),
                   sum(t for t, p in zip(times, places) if p == 1))
               for places in product((0, 1), repeat=len(times)))
    assert max(loads_) == best


def test_nodes_that_exchange_many_messages_stay_together() -> None:
    tasks = loads("""
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 1ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: t, timer: 1ms, publishes: [/y]}]}
  - {node: /c, callbacks: [{name: s, subscription: /x, deadline: 1ms}]}
  - {node: /d, callbacks: [{name: s, subscription: /y, deadline: 1ms}]}
""")
    placing = Placing(tasks, 2, [[100_000, 100_000], [100_000, 100_000]])
    assert [p.nodes for p in placing.processes(placing.place())] == [('/a', '/c'), ('/b', '/d')]


def test_what_does_not_hold_the_interpreter_weighs_nothing() -> None:
    times = (90, 30, 25)
    tasks = workload(*times, holds=', holds_interpreter: false')
    assert {'/n1'} in placed(tasks, 2, *times) or {'/n2'} in placed(tasks, 2, *times)


def test_no_process_is_without_a_node_where_nothing_is_declared_to_take_time() -> None:
    times = (0, 0, 0, 0)
    assert sorted(len(nodes) for nodes in placed(workload(*times), 3, *times)) == [1, 1, 2]


def test_nodes_that_publish_one_topic_stay_together() -> None:
    tasks = loads("""
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 10ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: t, timer: 10ms, publishes: [/x]}]}
  - {node: /c, callbacks: [{name: s, subscription: /x, deadline: 10ms}]}
""")
    placing = Placing(tasks, 2, [[4 * MS, MS], [4 * MS, MS]])
    assert [p.nodes for p in placing.processes(placing.place())] == [('/a', '/b'), ('/c',)]

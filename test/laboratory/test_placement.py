# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which node runs in which process."""

from itertools import product

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.placement import Placing
from msg_graph import loads
import pytest

MS = 1_000_000


def several(n):
    """Return independent nodes /n0, /n1, …."""
    return loads('mddag: 1\nnodes:\n' + ''.join(
        f'  - {{node: /n{i}, callbacks: [{{name: t, timer: 100ms, deadline: 100ms}}]}}\n'
        for i in range(n)))


def placed(n, *milliseconds, **rules):
    """Return the nodes of each process, if each node computes so long of each 100 ms."""
    placing = Placing(several(len(milliseconds)), n, [[round(ms * MS)] for ms in milliseconds],
                      **rules)
    return [set(process.nodes) for process in placing.processes(placing.place())]


def test_the_largest_load_is_the_least_there_can_be():
    times = (30, 25, 20, 18, 12, 9, 7)
    found = placed(2, *times)
    loads_ = [sum(times[int(node[2:])] for node in nodes) for nodes in found]
    best = min(max(sum(t for t, p in zip(times, places) if p == 0),
                   sum(t for t, p in zip(times, places) if p == 1))
               for places in product((0, 1), repeat=len(times)))
    assert max(loads_) == best


@pytest.mark.parametrize(('text', 'times', 'expected'), [
    ("""
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 1ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: t, timer: 1ms, publishes: [/y]}]}
  - {node: /c, callbacks: [{name: s, subscription: /x, deadline: 1ms}]}
  - {node: /d, callbacks: [{name: s, subscription: /y, deadline: 1ms}]}
""", [[100_000, 100_000], [100_000, 100_000]], [('/a', '/c'), ('/b', '/d')]),
    ("""
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 10ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: t, timer: 10ms, publishes: [/x]}]}
  - {node: /c, callbacks: [{name: s, subscription: /x, deadline: 10ms}]}
""", [[4 * MS, MS], [4 * MS, MS]], [('/a', '/b'), ('/c',)])], ids=['messages', 'one topic'])
def test_nodes_stay_together_that_exchange_many_messages_or_publish_one_topic(
        text, times, expected):
    placing = Placing(loads(text), 2, times)
    assert [p.nodes for p in placing.processes(placing.place())] == expected


def test_nodes_of_one_program_stay_together_and_no_process_is_empty():
    assert {'/n0', '/n1'} in placed(2, 50, 50, 10, 10, together=[('/n0', '/n1')])
    assert len(placed(3, 0, 0, 0)) == 3
    with pytest.raises(UsageError, match='only 3 nodes'):
        placed(4, 1, 1, 1)

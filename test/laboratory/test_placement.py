# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Which node runs in which process, and what a placement is predicted to do."""

from itertools import combinations, product

from mddag_executor.core.tally import total
from mddag_executor.errors import UsageError
from mddag_executor.laboratory.placement import Placing
from mddag_executor.laboratory.prediction import (
    CALLBACK_NS,
    cost_of,
    improve,
    Predictor,
    PUBLISH_NS,
    RECEIVE_NS,
    SEND_NS,
    TIMER_NS,
)
from msg_graph import loads, Process
import pytest

MS = 1_000_000


def several(n, urgent=0):
    """Return independent nodes /n0, /n1, …; the first ones are urgent."""
    return loads('mddag: 1\nnodes:\n' + ''.join(
        f'  - {{node: /n{i}, callbacks: [{{name: t, timer: 100ms, '
        f'deadline: {40 if i < urgent else 100}ms}}]}}\n' for i in range(n)))


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


TWO = """
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 100ms, deadline: 40ms}]}
  - {node: /b, callbacks: [{name: t, timer: 100ms, deadline: 40ms}]}
"""
CHAIN = """
mddag: 1
nodes:
  - {node: /a, callbacks: [{name: t, timer: 100ms, publishes: [/x]}]}
  - {node: /b, callbacks: [{name: t, subscription: /x, deadline: 100ms}]}
"""
ALL = (Process('all', ('/a', '/b')),)
EACH = (Process('p1', ('/a',)), Process('p2', ('/b',)))


def missed(text, processes, cpus, *ms):
    predictor = Predictor(loads(text), 7, cpus, 'rad', 1000 * MS)
    tally = predictor.predict(processes, [[each * MS] for each in ms])
    return total(tally.result()['dags']).missed


def test_one_process_computes_in_one_callback_at_a_time():
    assert missed(TWO, ALL, 2, 30, 30) == 10
    assert missed(TWO, EACH, 2, 30, 30) == 0
    assert missed(TWO, EACH, 1, 30, 30) > 0  # they share the CPU
    assert missed(TWO, EACH, None, 30, 30) == 0


def test_what_leaves_its_process_takes_longer():
    def response(processes):
        tally = Predictor(loads(CHAIN), 7, 2, 'rad', 1000 * MS).predict(
            processes, [[2 * MS, 3 * MS]])
        return tally.result()['dags']['/a']['sinks']['/b:t']['response_ns']['max']

    assert response(ALL) == 5 * MS + 2 * CALLBACK_NS + PUBLISH_NS + TIMER_NS
    assert response(EACH) == response(ALL) + SEND_NS + RECEIVE_NS


def test_simulation_finds_what_loads_do_not_show():
    # by load alone the two urgent ones may well share a process
    task_set, times = several(4, urgent=2), [[30 * MS]] * 4
    placing = Placing(task_set, 2, times)
    predictor = Predictor(task_set, 7, 2, 'rad', 1000 * MS)
    bad = {0: 0, 1: 0, 2: 1, 3: 1}
    assert predictor.predict(placing.processes(bad), times).missed
    calls = []
    place, tried = improve(
        placing, bad, lambda processes: cost_of(predictor.predict(processes, times)), calls.append)
    assert not predictor.predict(placing.processes(place), times).missed
    assert place[0] != place[1] and calls and tried >= max(calls)


def test_a_few_tries_are_enough_to_stop():
    task_set, times = several(4), [[90 * MS]] * 4
    placing = Placing(task_set, 2, times)
    predictor = Predictor(task_set, 7, 2, 'rad', 300 * MS)
    _, tried = improve(
        placing, placing.place(), lambda p: cost_of(predictor.predict(p, times)), most=5)
    assert tried == 5


def test_together_and_apart():
    times = (50, 50, 10, 10)
    assert {'/n0', '/n1'} <= placed(2, *times, together=[('/n0', '/n1')])[0]
    first, second = placed(2, *times, apart=[('/n2', '/n3')])
    assert ('/n2' in first) != ('/n3' in first)
    with pytest.raises(UsageError, match='together'):
        placed(2, *times, together=[('/n0', '/n1'), ('/n1', '/n2')],
               apart=[('/n0', '/n2')])
    with pytest.raises(UsageError, match='cannot keep'):
        placed(2, *times, apart=[('/n0', '/n1'), ('/n1', '/n2'), ('/n0', '/n2')])


@pytest.mark.timeout(30)
def test_one_node_too_many_to_keep_apart_is_found_at_once():
    """Which of the empty processes a node comes into does not matter: no search through all."""
    times = (10.0,) * 11
    pairs = list(combinations([f'/n{i}' for i in range(11)], 2))
    with pytest.raises(UsageError, match='10 processes cannot keep all these nodes apart'):
        placed(10, *times, apart=pairs)
    assert len(placed(11, *times, apart=pairs)) == 11

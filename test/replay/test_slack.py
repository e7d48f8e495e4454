# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How much longer callbacks may take: by hand, against plain bisection, and what users see."""

import json
import re

from mddag_executor.replay import reschedule
from mddag_executor.replay import slack as module
from mddag_executor.replay.slack import find_slack, Problem, Search
import pytest

from .helpers import Chances, MS, ns, small, VirtualRun, Written

BY_HAND = """\
mddag: 1
workers: 2
nodes:
  - {node: /a, callbacks: [{name: first, timer: 10ms, publishes: [/x], execution_time: 1ms}]}
  - {node: /b, callbacks: [{name: last, subscription: /x, deadline: 8ms, execution_time: 2ms}]}
  - {node: /c, callbacks: [{name: alone, timer: 100ms, deadline: 100ms, execution_time: 100us}]}
"""


def test_by_hand(tmp_path, call):
    graph, trace = tmp_path / 'g.yaml', tmp_path / 't.mcap'
    graph.write_text(BY_HAND)
    call('simulate', graph, '--trace', trace, '--duration', '1s')
    result = call('slack', trace, '--jobs', 1, '--json', '-').result
    factors = {name: one['factor'] for name, one in result['callbacks'].items()}
    assert 5.94 <= factors['/a:first'] <= 6
    assert 3.46 <= factors['/b:last'] <= 3.5
    assert factors['/c:alone'] is None
    assert result['callbacks']['/a:first']['breaks'] == '/b:last'
    assert 2.64 <= result['load']['factor'] <= 8 / 3
    assert result['workers'] == {'given': 2, 'least': 1, 'breaks': None}
    assert result['sinks']['/b:last']['margin_ns'] == {
        'min': 5 * MS, 'p1': 5 * MS, 'median': 5 * MS, 'max': 5 * MS}
    assert result['left_out'] == []
    page = tmp_path / 's.html'
    status, out, _ = call('slack', graph, '--fail-under', 3, '--report', page)
    assert status == 0 and 'b:last    3.49 times  b:last' in out
    assert '1 callback may take 100 times as long and more' in out
    assert '1 of 2 workers is enough' in out and 'b:last' in page.read_text()
    assert call('slack', graph, '--fail-under', 3.6).returncode == 1


def test_what_misses_already_is_left_out(tmp_path, call):
    graph = tmp_path / 'g.yaml'
    graph.write_text(BY_HAND.replace('deadline: 8ms', 'deadline: 2ms').replace(
        'alone, timer: 100ms, deadline: 100ms', 'alone, timer: 100ms, deadline: 5ms'))
    status, out, _ = call('slack', graph, '--fail-under', '0.5', '--json', '-')
    result = json.loads(out)
    assert status == 1
    assert result['left_out'] == ['/b:last']
    assert 49.5 <= result['callbacks']['/c:alone']['factor'] <= 50
    assert result['callbacks']['/a:first']['factor'] > 10     # the other worker is free


def test_a_sink_that_misses_some_deadlines_has_the_factor_at_which_it_misses_another(
        tmp_path, call):
    # /some takes 10 ms, but in two jobs more than its deadline; /every is always late
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
workers: 6
nodes:
  - {node: /some, callbacks: [{name: run, dag: some, timer: 100ms, deadline: 90ms}]}
  - {node: /every, callbacks: [{name: run, dag: every, timer: 100ms, deadline: 10ms}]}
""", 6)
    for job in range(30):
        at = job * 100
        for dag, took in enumerate((95 if job in (3, 20) else 10, 85)):
            trace.release(dag, job, at)
            trace.run(dag, 0, job, at, at + took, worker=dag)
            if took != 10:
                trace.add('deadline', at + took, dag, 0, job, ns(at + (90, 10)[dag]),
                          ns(at + took))
    path = trace.end(3_000)
    status, out, _ = call('slack', path, '--cpus', 6, '--fail-under', '1.2', '--json', '-')
    result = json.loads(out)
    assert status == 1
    assert result['missed'] == {'/some:run': 2, '/every:run': 30}
    assert result['left_out'] == ['/every:run']
    some = result['callbacks']['/some:run']
    assert 8.9 <= some['factor'] <= 9 and some['breaks'] == '/some:run'
    assert result['load']['breaks'] == '/some:run'
    assert result['workers'] == {'given': 6, 'least': 2, 'breaks': '/some:run'}
    out = call('slack', path).stdout
    assert re.match(r'32 deadlines missed already: .*/some:run \(2\)', out)
    assert 'enough' not in out and 'with 2 of 6 workers no further deadline' in out
    assert re.search(r'some:run +90 ms +-5 ms +- ', out)


def test_where_nothing_was_due_nothing_is_proven(tmp_path, call):
    graph = tmp_path / 'g.yaml'
    graph.write_text(BY_HAND)
    arguments = 'slack', graph, '--duration', '1us'
    out = call(*arguments).stdout
    assert 'never completed, so not judged: 2 sinks: ' in out and '100 times' not in out
    status, _, err = call(*arguments, '--fail-under', '1.2')
    assert (status, err.count('\n')) == (1, 1)
    assert err.startswith(f'error: {graph}: no job was due at any sink')


def test_windows_find_what_plain_bisection_finds(tmp_path, monkeypatch):
    path = tmp_path / 'run.mcap'
    VirtualRun(path, small(), 3, duration=500 * MS, longest=2 * MS,
               chances=Chances(0, 0, 0, 0, 0, 0, 0))
    run = reschedule(path)
    problem = Problem(
        run.work.load, run.settings, run.tables, run.task_set.places_of_vertices(),
        run.work.dispatches)
    found = []
    for long in (10 ** 9, 1):
        monkeypatch.setattr(module, 'LONG', long)
        found.append(find_slack(problem).factors)
    for plain, windows in zip(*(each.values() for each in found)):
        assert (plain.factor is None) == (windows.factor is None)
        if plain.factor is not None:
            # both hold on the whole; schedules have anomalies, so neither need be the greatest
            assert windows.factor == pytest.approx(plain.factor, rel=0.25)
    search = Search(problem)
    for callback, one in found[1].items():
        if one.factor is not None:
            assert search.miss(callback, one.factor) is None

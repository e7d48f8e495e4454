# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How much longer callbacks may take: by hand, against plain bisection, and what users see."""

import json

from mddag_executor import reschedule
from mddag_executor.core import Tables
from mddag_executor.simulate import periodic_workload, Settings
from mddag_executor.whatif import slack as module
from mddag_executor.whatif.slack import find_slack, Problem, Search
from msg_graph import loads
import pytest

from ..sources.helpers import Chances, MS, ns, small, VirtualRun, Written

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
    result = call('slack', trace, '--parallel', 1, '--json', '-').result
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


def test_the_margins_of_paths(tmp_path, call):
    """An input is the output of 3 ms later; a change right after it is in that of 13 ms later."""
    graph, trace, page = (tmp_path / name for name in ('g.yaml', 't.mcap', 's.html'))
    graph.write_text(BY_HAND + "paths: [{name: p, callbacks: ['/a:first', '/b:last'], "
                     'reaction: 20ms, age: 2ms}]\n')
    call('simulate', graph, '--trace', trace, '--duration', '1s')
    for given in graph, trace:
        done = call('slack', given, '--fail-under', 1, '--report', page, '--json', '-')
        result = json.loads(done.stdout)
        assert (done.returncode, result['missed']) == (1, {})     # the age is not met
        assert {name: one['margin_ns']['min'] / MS for name, one in result[
            'requirements'].items()} == {'p reaction': 7, 'p age': -1}
        assert not done.stderr
    assert 'p reaction' in page.read_text()
    status, out, _ = call('slack', graph)
    table = out[out.index('How much less than required'):].splitlines()
    assert status == 0
    assert [line.split()[:4] for line in table[2:4]] == [
        ['p', 'age', '2', 'ms'], ['p', 'reaction', '20', 'ms']]
    graph.write_text(graph.read_text().replace('age: 2ms', 'age: 3ms'))
    assert call('slack', graph, '--fail-under', 1).returncode == 0


def test_a_run_that_misses_says_how_much_shorter_callbacks_must_be(tmp_path, call):
    graph = tmp_path / 'g.yaml'
    graph.write_text(BY_HAND.replace('deadline: 8ms', 'deadline: 2ms'))
    status, out, _ = call('slack', graph, '--fail-under', '0.5', '--json', '-')
    result = json.loads(out)
    assert status == 1
    assert 0.66 <= result['load']['factor'] <= 2 / 3      # of 1 ms and 2 ms
    factors = {name: one['factor'] for name, one in result['callbacks'].items()}
    assert 0.495 <= factors.pop('/b:last') <= 0.5
    assert factors == {'/a:first': 0, '/c:alone': 0}       # 2 ms are too much already
    assert (result['left_out'], result['workers']) == ([], None)
    page = tmp_path / 's.html'
    out = call('slack', graph, '--report', page).stdout
    assert '300 deadlines missed: /b:last (300)' in out and 'b:last    0.49 times  b:last' in out
    assert '2 callbacks: deadlines are missed however little one alone takes' in out
    assert 'How much longer' in page.read_text()
    assert 'a:first ' not in out and 'enough' not in out and '0.49 times' in page.read_text()


def test_misses_that_shorter_callbacks_do_not_mend_are_left_out(tmp_path, call):
    """The timer of /every is always noticed after its deadline."""
    trace = Written(tmp_path / 'run.mcap', """\
mddag: 1
workers: 6
nodes:
  - {node: /some, callbacks: [{name: run, dag: some, timer: 100ms, deadline: 90ms}]}
  - {node: /every, callbacks: [{name: run, dag: every, timer: 100ms, deadline: 10ms}]}
""", 6)
    for job in range(30):
        at = job * 100
        for dag, late in enumerate((0, 85)):
            trace.release(dag, job, at, noticed=at + late)
            trace.run(dag, 0, job, at + late, at + late + 10, worker=dag)
            if late:
                trace.add('deadline', at + late + 10, dag, 0, job, ns(at + 10),
                          ns(at + late + 10))
    path = trace.end(3_100)
    status, out, _ = call('slack', path, '--cpus', 6, '--fail-under', '1.2', '--json', '-')
    result = json.loads(out)
    assert status == 1
    assert result['missed'] == {'/every:run': 30}
    assert result['left_out'] == ['/every:run']
    some = result['callbacks']['/some:run']
    assert 8.9 <= some['factor'] <= 9 and some['breaks'] == '/some:run'
    assert result['load']['breaks'] == '/some:run'
    out = call('slack', path).stdout
    assert out.startswith('30 deadlines missed: /every:run (30)\n')
    assert 'left out, because shorter execution times do not help: /every:run' in out


def test_where_nothing_was_due_nothing_is_proven(tmp_path, call):
    graph = tmp_path / 'g.yaml'
    graph.write_text(BY_HAND)
    arguments = 'slack', graph, '--duration', '1us'
    out = call(*arguments, '--report', tmp_path / 's.html').stdout
    assert 'How much longer' not in (tmp_path / 's.html').read_text()  # an empty table before
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


def test_a_callback_that_does_not_help_costs_one_short_run(monkeypatch):
    """A search of all callbacks of an overloaded run needs a few runs, not some for each."""
    nodes = ''.join(
        f'  - {{node: /n{i}, callbacks: [{{name: t, timer: 10ms, deadline: 9ms, '
        'execution_time: 1ms}]}\n' for i in range(20))
    task_set = loads('mddag: 1\nworkers: 1\nnodes:\n' + nodes, 'g.yaml')
    settings = Settings(policy='rad', pools=(1,), duration_ns=2_000 * MS)
    load = periodic_workload(task_set, [[MS]] * 20, settings.duration_ns)
    lengths = []

    def counted(tables, load, settings, **options):
        outcome = schedule(tables, load, settings, **options)
        lengths.append(len(outcome.decisions))
        return outcome

    schedule = module.schedule
    monkeypatch.setattr(module, 'schedule', counted)
    compiled_for = []
    monkeypatch.setattr(module, 'prepare', lambda *each: compiled_for.append(each[-1]))
    slack = find_slack(Problem(load, settings, Tables.build(task_set),
                               task_set.places_of_vertices()))
    factors = [found.factor for number, found in sorted(slack.factors.items())]
    assert 0.44 <= factors[0] <= 0.45 and factors[1:] == [0] * 20
    assert sum(length > 1000 for length in lengths) < 10
    # nor is anything compiled for runs of all callbacks
    assert compiled_for == [module._RUNS]

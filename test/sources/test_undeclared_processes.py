# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Runs of several processes of this executor, not all of which were run with a declaration."""

from itertools import permutations

from mddag_executor import replay, ReplayError, reschedule
from mddag_executor.analysis.drafting import System
from mddag_executor.errors import UsageError
from mddag_executor.sources.open import Traces
from msg_graph import loads
from msg_graph.draft import accept, declaration_of
import pytest

from .mixed import detector, GRAB, GRAPH, IMAGE, N, Own, PLAN
from .recorded import MS, US

END = (N + 1) * 100 * MS


@pytest.fixture
def graph():
    return loads(GRAPH, 'graph.yaml')


def camera(path, n=N, **more):
    """Write the trace of /camera, whose timer is noticed 1 ms after it was due."""
    own = Own(path, pid=3, **more)
    own.node('/camera')
    own.publisher(IMAGE, '/image')
    own.timer(GRAB, 100 * MS)
    for k in range(1, n + 1):
        at = k * 100 * MS
        own.publish(IMAGE, at + 2 * MS)
        own.run(GRAB, at, at + 1 * MS, at + 3 * MS)
    return own.end(END)


def plan(path, end=END, n=N, ahead=0, **more):
    """
    Write the trace of /plan, which gets each box 2 ms after it was published.

    :param ahead: how far the system clock is ahead of the one that it began with.
    """
    own = Own(path, pid=4, **more)
    own.node('/plan')
    own.subscription(PLAN, '/boxes')
    for k in range(1, n + 1):
        at = k * 100 * MS
        own.take(PLAN, at + 11 * MS, at + 9020 * US + ahead, k)
        own.run(PLAN, at + 11 * MS, at + 12 * MS, at + 15 * MS)
    return own.end(end)


def three(folder, declared=False, ahead=0):
    return [camera(folder / 'run.camera.mcap'),
            detector(folder / 'run.detect.mcap', declared=declared, ahead=ahead),
            plan(folder / 'run.plan.mcap', ahead=ahead)]


def sink(result):
    return result['dags']['/camera']['sinks']['/plan:plan']


@pytest.mark.parametrize('declared', [False, True])
@pytest.mark.parametrize('ahead', [0, 400 * US])
def test_jobs_go_through_all_processes(tmp_path, graph, ahead, declared):
    """Their order does not matter, nor that the system clock was adjusted between their starts."""
    results = [replay(given, graph).result()
               for given in permutations(three(tmp_path, declared, ahead=ahead))]
    for result in results:
        assert result['warnings'] == []
        found = sink(result)
        assert (found['completed'], found['late']) == (N, 0)
        assert found['response_ns'] == dict.fromkeys(('min', 'median', 'p99', 'max'), 15 * MS)
        worst = found['breakdown']['worst']
        assert [step['vertex'] for step in worst['chain']] == [
            '/camera:grab', '/detect:detect', '/plan:plan']
        assert (worst['transport_ns'], worst['waiting_ns'], worst['executing_ns']) == (
            (500 + 1_000) * US, (1_000 + 500 + 1_000) * US, (2_000 + 6_000 + 3_000) * US)
        assert (result['policy'], result['workers']) == ('rad', 6)
        assert [(each['topic'], each['arrived']) for each in result['communications']] == [
            ('/boxes', N), ('/image', N)]
        assert result['recording']['shut_down']


@pytest.mark.parametrize('ahead', [5 * MS, -5 * MS])
def test_the_clock_of_another_computer_is_estimated(tmp_path, graph, ahead):
    """From messages both ways: to /detect they take 1.49 ms at least, and back 1.98 ms."""
    paths = [camera(tmp_path / 'camera.mcap'),
             detector(tmp_path / 'detect.mcap', ahead=ahead, boot='other')]
    own = Own(tmp_path / 'plan.mcap', pid=4)
    own.node('/plan')
    own.subscription(PLAN, '/boxes')
    for k in range(1, N + 1):
        at = k * 100 * MS
        own.file.add('rmw_take', own.at(at + 11 * MS), 4, 7, PLAN + 10, 0,
                     own.at(at + 9020 * US) + ahead, True, k)
        own.run(PLAN, at + 11 * MS, at + 12 * MS, at + 15 * MS)
    result = replay([*paths, own.end(END)], graph).result()
    line, = result['warnings']
    assert 'the clock of /detect is taken to be' in line
    assert (sink(result)['completed'], sink(result)['late']) == (N, 0)


def test_a_process_that_was_killed_ends_its_jobs(tmp_path, graph):
    paths = [*three(tmp_path)[:2], plan(tmp_path / 'run.plan.mcap', end=None, n=6)]
    result = replay(paths, graph).result()
    line, = result['warnings']
    assert line.startswith(f'{paths[2]}: its end is not recorded')
    assert (sink(result)['completed'], sink(result)['expired'] + sink(result)['overdue']) == (6, 4)
    assert not result['recording']['shut_down']


def test_the_commands_take_them(tmp_path, graph, call):
    three(tmp_path)
    path = tmp_path / 'graph.yaml'
    path.write_text(GRAPH)
    run = call('replay', tmp_path, path)
    assert f'{N} in time' in run.stdout and 'policy rad, 6 workers' in run.stdout
    assert run.stderr == ''
    run = call('replay', tmp_path)      # also without GRAPH: what ran, and what was sent
    assert '/detect subscription /image' in run.stdout and run.stderr == ''
    for verb in (['explain'], ['slack'], ['export', '-o', tmp_path / 'out.csv']):
        assert call(verb[0], tmp_path, path, *verb[1:]).returncode == 0, verb


def test_a_draft_has_all_processes(tmp_path):
    draft = System(Traces(three(tmp_path))).draft()
    accept(draft)
    found = loads(declaration_of(draft, accepted=True))
    assert sorted((each.name, each.nodes) for each in found.processes) == [
        ('camera', ('/camera',)), ('detect', ('/detect',)), ('plan', ('/plan',))]
    assert [dag.name for dag in found.dags] == ['/camera']
    assert [found.dags[0].vertices[v].callback.node for v in found.dags[0].sinks] == ['/plan']


def test_a_schedule_has_the_pool_of_each_process(tmp_path, graph):
    result = reschedule(three(tmp_path), graph).result()
    assert sorted(each['name'] for each in result['processes']) == ['camera', 'detect', 'plan']
    assert [each['workers'] for each in result['processes']] == [2, 2, 2]
    assert result['policy'] == 'rad'
    assert (sink(result)['completed'], sink(result)['late']) == (N, 0)


def test_traces_that_are_not_of_one_run(tmp_path, graph):
    first, second, _ = three(tmp_path)
    later = detector(tmp_path / 'later.mcap', begin=9_000 * MS, first=90, n=92, end=None)
    with pytest.raises(ReplayError, match='another run than .*: it begins 7.[0-9]* s after the'):
        replay([first, later], graph)
    with pytest.raises(ReplayError, match='it is of the same process as .*camera.mcap: both have '
                       'the node /camera: give the trace of each process once'):
        replay([first, second, first], graph)
    with pytest.raises(UsageError, match='unless each trace is of a declared run'):
        replay(Traces([first, second], {'detect': 5}), graph)

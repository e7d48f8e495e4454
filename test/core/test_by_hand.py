# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Schedules worked out by hand: order, ties, preemption, groups, verdicts, ends."""

from __future__ import annotations

from typing import Any

from msg_graph import TaskSet
import pytest

from .task_sets import Case, declaration

Log = list[tuple[int, str, int, str]]


def single(name: str, period: int, deadline: int | None = None, **more: Any) -> dict[str, Any]:
    """Declare a DAG of one callback; times in ticks."""
    return {'node': '/n', 'name': name, 'dag': name, 'timer': f'{period}us',
            'deadline': f'{deadline or period}us', **more}


def source(name: str, period: int, **more: Any) -> dict[str, Any]:
    return {'node': '/n', 'name': name, 'dag': name, 'timer': f'{period}us',
            'publishes': [f'/{name}'], **more}


def after(before: str, name: str, deadline: int | None = None, **more: Any) -> dict[str, Any]:
    """Declare a callback started by another one; it is a sink where it has a deadline."""
    rest: dict[str, Any] = {'publishes': [f'/{name}']}
    if deadline is not None:
        rest = {'deadline': f'{deadline}us'}
    return {'node': '/n', 'name': name, 'subscription': f'/{before}', **rest, **more}


def case(callbacks: list[dict[str, Any]], ticks: dict[str, int], *, workers: int = 1,
         policy: str = 'rad', preemptive: bool = False, **more: Any) -> Case:
    task_set = declaration(callbacks)
    times = tuple(tuple(ticks[v.callback.name] for v in dag.vertices) for dag in task_set.dags)
    return Case(task_set, times, workers, policy, preemptive, **more)


def names(task_set: TaskSet, dag: int, vertex: int) -> str:
    return task_set.dags[dag].vertices[vertex].callback.name


def log(of: Case, horizon: int, **how: Any) -> Log:
    """Return (tick, what, worker, callback.job) for each event."""
    return [(now, kind, worker, f'{names(of.task_set, dag, vertex)}.{job}')
            for now, kind, worker, dag, vertex, job in of.events(of.run(horizon, **how))]


def starts(of: Case, horizon: int, **how: Any) -> list[str]:
    """Return what starts, in order."""
    return [who for _, kind, _, who in log(of, horizon, **how) if kind == 'start']


def sink(of: Case, horizon: int, name: str, **how: Any) -> dict[str, Any]:
    result = of.run(horizon, **how).result()
    found: dict[str, Any] = next(
        values for dag in result['dags'].values()
        for vertex, values in dag['sinks'].items() if vertex.endswith(f':{name}'))
    return found


# --- order and ties ------------------------------------------------------------------------------


def test_rad_goes_by_the_sink_that_comes_first() -> None:
    """A source that leads to an early sink runs before one with an earlier last deadline."""
    callbacks = [single('lone', 100, 20), source('s', 100), after('s', 'early', 10),
                 after('s', 'late', 90)]
    ticks = dict.fromkeys(('lone', 's', 'early', 'late'), 2)
    assert starts(case(callbacks, ticks), 50) == ['s.0', 'early.0', 'lone.0', 'late.0']
    # One deadline for each DAG, its latest: the DAG of s has 90.
    assert starts(case(callbacks, ticks, policy='gedf'), 50) == [
        'lone.0', 's.0', 'early.0', 'late.0']


@pytest.mark.parametrize('policy', ['rad', 'gedf'])
def test_equal_deadlines_go_by_vertex_then_by_dag(policy: str) -> None:
    # b, vertex 0 of DAG 1, was released with a, and goes before a2, vertex 1 of DAG 0.
    callbacks = [source('a', 50), after('a', 'a2', 30), single('b', 50, 30)]
    assert starts(case(callbacks, {'a': 1, 'a2': 1, 'b': 1}, policy=policy), 50) == [
        'a.0', 'b.0', 'a2.0']


def test_rm_goes_by_period_and_wc_by_job_index_whatever_the_period() -> None:
    callbacks = [single('short', 5), source('long', 20), after('long', 'end', 20)]
    ticks = {'short': 4, 'long': 4, 'end': 4}
    # 4: long, as short.1 comes at 5. 8: short.1 (ready at 5) or end.0 (ready at 8).
    assert starts(case(callbacks, ticks, policy='rm'), 20) == [
        'short.0', 'long.0', 'short.1', 'short.2', 'short.3']
    assert starts(case(callbacks, ticks, policy='wc'), 20) == [
        'short.0', 'long.0', 'end.0', 'short.1', 'short.2']


@pytest.mark.parametrize('policy', ['wc', 'fifo'])
def test_at_one_instant_successors_come_before_releases(policy: str) -> None:
    # At 10 s.1 ends and makes s2.1 ready; long.1 (job 1 as well) and s.2 are released. Under rm,
    # where period and job index come first, there is no such tie.
    callbacks = [single('long', 10), source('s', 5), after('s', 's2', 90)]
    ticks = {'long': 1, 's': 4, 's2': 1}
    assert starts(case(callbacks, ticks, policy=policy), 12) == [
        'long.0', 's.0', 's2.0', 's.1', 's2.1', 'long.1']


@pytest.mark.parametrize('policy', ['fifo', 'wc', 'rm'])
def test_completions_at_one_instant_go_by_worker_then_the_last_listed_first(policy: str) -> None:
    # a publishes x and y, in this order; a3 takes x, so the edges of a are listed a3, a2, a4.
    callbacks = [source('a', 50), after('y', 'a2', 50), after('x', 'a3', 50), after('y', 'a4', 50),
                 source('b', 50), after('b', 'b2', 50)]
    callbacks[0]['publishes'] = ['/x', '/y']
    ticks = {'a': 2, 'a2': 1, 'a3': 1, 'a4': 1, 'b': 2, 'b2': 1}
    assert log(case(callbacks, ticks, workers=2, policy=policy), 50) == [
        (0, 'start', 0, 'a.0'), (0, 'start', 1, 'b.0'),
        (2, 'end', 0, 'a.0'), (2, 'end', 1, 'b.0'),
        (2, 'start', 0, 'a4.0'), (2, 'start', 1, 'a2.0'),
        (3, 'end', 0, 'a4.0'), (3, 'end', 1, 'a2.0'),
        (3, 'start', 0, 'a3.0'), (3, 'start', 1, 'b2.0'),
        (4, 'end', 0, 'a3.0'), (4, 'end', 1, 'b2.0')]


# --- workers and preemption ----------------------------------------------------------------------


def test_of_equal_keys_the_worker_with_the_highest_number_is_preempted() -> None:
    # 0: h on 0, a on 1, b on 2; 1: c on 0; 7: all three run with the period 50.
    callbacks = [single('h', 7), single('a', 50), single('b', 50), single('c', 50)]
    found = log(case(callbacks, {'h': 1, 'a': 20, 'b': 20, 'c': 20}, workers=3, policy='rm',
                     preemptive=True), 8)
    assert found[-3:] == [(7, 'preempt', 2, 'b.0'), (7, 'start', 2, 'h.1'), (8, 'end', 2, 'h.1')]


def test_an_equal_priority_does_not_preempt() -> None:
    # At 10 b.1 has the RAD 20, as has a.0 since 0; b would win the tie by its DAG's index.
    callbacks = [single('b', 10, 10), single('a', 100, 20)]
    plain = case(callbacks, {'b': 1, 'a': 15}, preemptive=True)
    assert log(plain, 18) == [
        (0, 'start', 0, 'b.0'), (1, 'end', 0, 'b.0'), (1, 'start', 0, 'a.0'),
        (16, 'end', 0, 'a.0'), (16, 'start', 0, 'b.1'), (17, 'end', 0, 'b.1')]
    callbacks = [single('b', 10, 9), single('a', 100, 20)]
    strictly = case(callbacks, {'b': 1, 'a': 15}, preemptive=True)
    assert (10, 'preempt', 0, 'a.0') in log(strictly, 18)
    assert starts(case(callbacks, {'b': 1, 'a': 15}), 18) == ['b.0', 'a.0', 'b.1']


def test_what_is_preempted_goes_behind_what_gets_ready_at_that_instant() -> None:
    # rm. 1: v on worker 0, w on worker 1; 4: w ends and makes w2 ready, h and g come again:
    # h takes worker 1, g takes worker 0 from v. 5: of v and w2 (both period 20, job 0) w2 goes
    # first, as v was put back after w2 got ready.
    callbacks = [single('h', 4), single('g', 4), single('v', 20), source('w', 20),
                 after('w', 'w2', 20)]
    ticks = {'h': 1, 'g': 1, 'v': 10, 'w': 3, 'w2': 10}
    found = log(case(callbacks, ticks, workers=2, policy='rm', preemptive=True), 7)
    assert [each for each in found if each[0] >= 4] == [
        (4, 'end', 1, 'w.0'), (4, 'start', 1, 'h.1'), (4, 'preempt', 0, 'v.0'),
        (4, 'start', 0, 'g.1'), (5, 'end', 0, 'g.1'), (5, 'end', 1, 'h.1'),
        (5, 'start', 0, 'w2.0'), (5, 'start', 1, 'v.0')]


# --- edges and groups ----------------------------------------------------------------------------


def test_a_preempted_callback_keeps_its_group() -> None:
    # At 6 a takes the worker from b, which keeps the group g: c.1 of g does not get in between.
    callbacks = [single('a', 6, 2), single('c', 6, 3, group='g'), single('b', 40, 40, group='g')]
    found = log(case(callbacks, {'a': 1, 'c': 1, 'b': 6}, preemptive=True), 12)
    assert found == [
        (0, 'start', 0, 'a.0'), (1, 'end', 0, 'a.0'), (1, 'start', 0, 'c.0'),
        (2, 'end', 0, 'c.0'), (2, 'start', 0, 'b.0'), (6, 'preempt', 0, 'b.0'),
        (6, 'start', 0, 'a.1'), (7, 'end', 0, 'a.1'), (7, 'start', 0, 'b.0'),
        (9, 'end', 0, 'b.0'), (9, 'start', 0, 'c.1'), (10, 'end', 0, 'c.1')]


# --- verdicts ------------------------------------------------------------------------------------


def test_a_completion_at_the_horizon_counts_and_a_release_there_does_not_happen() -> None:
    run = case([single('a', 10, 10)], {'a': 10}).run(20)
    dag = run.result()['dags']['a']
    assert dag['jobs'] == 2
    assert dag['ends'] == {'completed': 2, 'late': 0, 'aborted': 0, 'expired': 0, 'failed': 0,
                           'dropped': 0}
    assert run.ended_ns == 20_000


def test_what_is_overdue_at_the_horizon_is_late_unless_only_completions_are_judged() -> None:
    # a: released at 0 and 10, runs 0 to 8 and 10 to 18; b, later deadline, never runs.
    callbacks = [single('a', 10, 9), single('b', 30, 12)]
    overdue = case(callbacks, {'a': 8, 'b': 5})
    assert sink(overdue, 11, 'b')['late'] == 0
    # At its deadline it could only complete later: it is late.
    assert sink(overdue, 12, 'b')['late'] == 1
    assert sink(overdue, 12, 'b')['overdue'] == 1
    assert sink(overdue, 12, 'b')['completed'] == 0
    assert sink(overdue, 12, 'b', judge='completions')['late'] == 0
    assert overdue.run(12, judge='completions').result()['deadline_missed'] is False
    assert overdue.run(12).result()['first_miss'] == {
        'dag': 'b', 'vertex': '/n:b', 'job': 0, 'deadline_ns': 12_000, 'completed_ns': None}


def test_lateness_stops_the_run_only_when_asked() -> None:
    callbacks = [single('a', 10, 9), single('b', 40, 12)]
    of = case(callbacks, {'a': 8, 'b': 6})
    # a.0 0-8, b.0 8-14 (late by 2), a.1 14-22, …
    run = of.run(40)
    assert run.ended_ns == 40_000
    assert run.result()['dags']['a']['jobs'] == 4
    stopped = of.run(40, stop=True)
    assert stopped.ended_ns == 14_000
    result = stopped.result()
    assert result['first_miss'] == {
        'dag': 'b', 'vertex': '/n:b', 'job': 0, 'deadline_ns': 12_000, 'completed_ns': 14_000}
    assert result['dags']['a']['jobs'] == 2
    assert result['dags']['a']['sinks']['/n:a']['late'] == 0, 'what is open then is not judged'
    assert result['deadline_missed'] is True


# --- ends of jobs --------------------------------------------------------------------------------

TWO_SINKS = [source('s', 50), after('s', 'x', 2), after('s', 'y', 40)]


def test_a_late_job_goes_on_or_is_aborted() -> None:
    ticks = {'s': 1, 'x': 2, 'y': 1}
    going_on = case(TWO_SINKS, ticks).run(50).result()['dags']['s']
    assert going_on['ends'] == {'completed': 0, 'late': 1, 'aborted': 0, 'expired': 0, 'failed': 0,
                           'dropped': 0}
    assert [s['completed'] for s in going_on['sinks'].values()] == [1, 1]
    aborting = [{**TWO_SINKS[0], 'on_late': 'abort'}, *TWO_SINKS[1:]]
    of = case(aborting, ticks)
    assert starts(of, 50) == ['s.0', 'x.0']
    dag = of.run(50).result()['dags']['s']
    assert dag['ends'] == {'completed': 0, 'late': 0, 'aborted': 1, 'expired': 0, 'failed': 0,
                           'dropped': 0}
    assert [(s['completed'], s['late'], s['aborted']) for s in dag['sinks'].values()] == [
        (1, 1, 0), (0, 0, 1)]


def test_the_oldest_job_expires_to_make_room() -> None:
    callbacks = [source('s', 10, max_active_jobs=2), after('s', 'x', 50)]
    of = case(callbacks, {'s': 1, 'x': 30})
    # s.0 0-1, x.0 1-31; s.1 and s.2 wait (their RADs are larger); at 20 job 0 expires: x.0 runs
    # to its end for nothing. At 30 job 1 expires; its source still runs, but x.1 never does.
    dag = of.run(40).result()['dags']['s']
    assert dag['jobs'] == 4
    assert dag['ends'] == {'completed': 0, 'late': 0, 'aborted': 0, 'expired': 2, 'failed': 0,
                           'dropped': 0}
    assert dag['sinks']['/n:x']['expired'] == 2
    assert dag['sinks']['/n:x']['completed'] == 0
    assert starts(of, 40) == ['s.0', 'x.0', 's.1', 's.2', 'x.2']

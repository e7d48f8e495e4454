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


@pytest.mark.parametrize('policy', ['rad', 'gedf'])
def test_equal_deadlines_go_by_vertex_before_readiness(policy: str) -> None:
    # At 2 v3 (vertex 3) has been ready since 1, and w has just made v2 (vertex 2) ready.
    callbacks = [source('v', 100), after('v', 'w'), after('w', 'v2', 90), after('v', 'v3', 90)]
    ticks = dict.fromkeys(('v', 'w', 'v2', 'v3'), 1)
    assert starts(case(callbacks, ticks, policy=policy), 50) == ['v.0', 'w.0', 'v2.0', 'v3.0']
    assert starts(case(callbacks, ticks, policy='fifo'), 50) == ['v.0', 'v3.0', 'w.0', 'v2.0']


OVERTAKING = [source('a', 4), after('a', 'a2', 100), source('b', 4), after('b', 'b2', 100)]
OVERTAKING_TICKS = {'a': 1, 'a2': 1, 'b': 5, 'b2': 1}


@pytest.mark.parametrize(('policy', 'order'), [
    # At 7 b2 of job 0 has been ready since 6, a of job 1 since 4.
    ('rm', ['a.0', 'b.0', 'a2.0', 'b2.0', 'a.1']),
    ('wc', ['a.0', 'b.0', 'a2.0', 'b2.0', 'a.1']),
    ('fifo', ['a.0', 'b.0', 'a2.0', 'a.1', 'b.1']),
])
def test_jobs_in_order_or_readiness_in_order(policy: str, order: list[str]) -> None:
    # 0: a, b released; a until 1; then b (ready at 0) before a2 (ready at 1), until 6.
    assert starts(case(OVERTAKING, OVERTAKING_TICKS, policy=policy), 9)[:5] == order


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

def test_the_idle_worker_with_the_lowest_number_is_taken() -> None:
    callbacks = [single('a', 50), single('b', 50), single('c', 50), single('d', 7, 7)]
    ticks = {'a': 2, 'b': 9, 'c': 2, 'd': 1}
    found = log(case(callbacks, ticks, workers=4), 8)
    assert [(now, worker, who) for now, kind, worker, who in found if kind == 'start'] == [
        (0, 0, 'd.0'), (0, 1, 'a.0'), (0, 2, 'b.0'), (0, 3, 'c.0'), (7, 0, 'd.1')]


def test_a_preemption_takes_the_largest_key() -> None:
    # 0: h on 0, b (40) on 1; 1: a (50) on 0; 7: h comes again and takes the worker of a.
    callbacks = [single('h', 7), single('a', 50), single('b', 40)]
    found = log(case(callbacks, {'h': 1, 'a': 20, 'b': 20}, workers=2, policy='rm',
                     preemptive=True), 8)
    assert found[-3:] == [(7, 'preempt', 0, 'a.0'), (7, 'start', 0, 'h.1'), (8, 'end', 0, 'h.1')]


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


def test_what_was_preempted_goes_on_when_a_worker_is_free() -> None:
    callbacks = [single('a', 6, 2), single('b', 30, 12), single('c', 30, 30)]
    found = log(case(callbacks, {'a': 2, 'b': 8, 'c': 9}, workers=2, preemptive=True), 20)
    # 0: a on 0, b on 1; 2: c on 0; 6: a.1 takes 0 from c; 8: both end.
    assert [each for each in found if 6 <= each[0] <= 8] == [
        (6, 'preempt', 0, 'c.0'), (6, 'start', 0, 'a.1'),
        (8, 'end', 0, 'a.1'), (8, 'end', 1, 'b.0'), (8, 'start', 0, 'c.0')]


def test_migration_is_free() -> None:
    # As before, but b ends on worker 1 at 7, before a.1 does on 0: c goes on on 1, 9 - 4 more.
    callbacks = [single('a', 6, 2), single('b', 30, 9), single('c', 30, 30)]
    found = log(case(callbacks, {'a': 2, 'b': 7, 'c': 9}, workers=2, preemptive=True), 20)
    assert [each for each in found if each[3] == 'c.0'] == [
        (2, 'start', 0, 'c.0'), (6, 'preempt', 0, 'c.0'), (7, 'start', 1, 'c.0'),
        (12, 'end', 1, 'c.0')]


def test_nothing_is_preempted_while_a_worker_is_idle() -> None:
    callbacks = [single('a', 4, 4), single('b', 20, 6), single('c', 20, 20)]
    found = log(case(callbacks, {'a': 2, 'b': 3, 'c': 6}, workers=2, preemptive=True), 10)
    # 0: a on 0, b on 1; 2: c on 0; 3: b ends; 4: a.1 on 1.
    assert (4, 'start', 1, 'a.1') in found
    assert all(kind != 'preempt' for _, kind, *_ in found)


def test_overheads_are_added_to_what_is_left() -> None:
    callbacks = [single('a', 6, 2), single('b', 30, 30)]
    ticks = {'a': 1, 'b': 8}
    found = log(case(callbacks, ticks, preemptive=True, dispatch_overhead=1, switch_overhead=2),
                25)
    # a: 1 + 1. b: 8 + 1 = 9 from 2; at 6 it has had 4 of it; 5 + 2 + 1 more from 8: at 12 it
    # has had 4 of these 8; 4 + 2 + 1 from 14: at 18 4 of these 7; 3 + 2 + 1 from 20.
    assert [each for each in found if each[3] == 'b.0'] == [
        (2, 'start', 0, 'b.0'), (6, 'preempt', 0, 'b.0'), (8, 'start', 0, 'b.0'),
        (12, 'preempt', 0, 'b.0'), (14, 'start', 0, 'b.0'), (18, 'preempt', 0, 'b.0'),
        (20, 'start', 0, 'b.0'), (24, 'preempt', 0, 'b.0')]


# --- edges and groups ----------------------------------------------------------------------------

def test_a_join_waits_for_the_last_and_an_or_runs_for_each() -> None:
    callbacks = [source('s', 50), after('s', 'x'), after('s', 'y'),
                 {'node': '/n', 'name': 'join', 'sync': ['/x', '/y'], 'deadline': '50us'}]
    ticks = {'s': 1, 'x': 1, 'y': 5, 'join': 1}
    assert log(case(callbacks, ticks, workers=2), 50)[-2:] == [
        (6, 'start', 0, 'join.0'), (7, 'end', 0, 'join.0')]
    callbacks[1]['publishes'] = ['/x', '/any']
    callbacks[2]['publishes'] = ['/y', '/any']
    callbacks.append({'node': '/n', 'name': 'each', 'subscription': '/any', 'deadline': '50us'})
    order = starts(case(callbacks, {**ticks, 'each': 1}, workers=2), 50)
    assert order.count('each.0') == 2


def test_a_busy_group_lets_others_pass() -> None:
    callbacks = [single('a', 50, 20, group='g'), single('b', 50, 30, group='g'),
                 single('c', 50, 40), single('d', 50, 35, group='g')]
    found = log(case(callbacks, {'a': 3, 'b': 2, 'c': 4, 'd': 1}, workers=3), 50)
    assert [each for each in found if each[1] == 'start'] == [
        (0, 'start', 0, 'a.0'), (0, 'start', 1, 'c.0'), (3, 'start', 0, 'b.0'),
        (5, 'start', 0, 'd.0')]


def test_a_preempted_callback_keeps_its_group() -> None:
    # At 6 a takes the worker from b, which keeps the group g: c.1 of g does not get in between.
    callbacks = [single('a', 6, 2), single('c', 6, 3, group='g'), single('b', 40, 40, group='g')]
    found = log(case(callbacks, {'a': 1, 'c': 1, 'b': 6}, preemptive=True), 12)
    assert found == [
        (0, 'start', 0, 'a.0'), (1, 'end', 0, 'a.0'), (1, 'start', 0, 'c.0'),
        (2, 'end', 0, 'c.0'), (2, 'start', 0, 'b.0'), (6, 'preempt', 0, 'b.0'),
        (6, 'start', 0, 'a.1'), (7, 'end', 0, 'a.1'), (7, 'start', 0, 'b.0'),
        (9, 'end', 0, 'b.0'), (9, 'start', 0, 'c.1'), (10, 'end', 0, 'c.1')]


def test_groups_are_those_of_a_node() -> None:
    callbacks = [single('a', 50, group='g'), {**single('b', 50, group='g'), 'node': '/other'}]
    found = log(case(callbacks, {'a': 3, 'b': 3}, workers=2), 50)
    assert [each for each in found if each[1] == 'start'] == [
        (0, 'start', 0, 'a.0'), (0, 'start', 1, 'b.0')]


# --- verdicts ------------------------------------------------------------------------------------

def test_a_completion_at_the_deadline_is_in_time() -> None:
    assert sink(case([single('a', 20, 5)], {'a': 5}), 20, 'a')['late'] == 0
    assert sink(case([single('a', 20, 5)], {'a': 6}), 20, 'a')['late'] == 1


def test_a_completion_at_the_horizon_counts_and_a_release_there_does_not_happen() -> None:
    run = case([single('a', 10, 10)], {'a': 10}).run(20)
    dag = run.result()['dags']['a']
    assert dag['jobs'] == 2
    assert dag['ends'] == {'completed': 2, 'late': 0, 'aborted': 0, 'expired': 0, 'failed': 0}
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


def test_of_what_is_overdue_the_first_deadline_is_the_first_miss() -> None:
    callbacks = [single('a', 50, 30), single('b', 50, 20), single('c', 50, 5)]
    first = case(callbacks, {'a': 50, 'b': 50, 'c': 50}, policy='fifo').run(40)
    assert first.result()['first_miss'] == {
        'dag': 'c', 'vertex': '/n:c', 'job': 0, 'deadline_ns': 5_000, 'completed_ns': None}


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


@pytest.mark.parametrize('bound', [{'on_late': 'abort'}, {'max_active_jobs': 1}])
def test_any_kind_of_miss_stops_the_run(bound: dict[str, Any]) -> None:
    # b.0 waits behind a. At 10, when b.1 is released, it expires, or is seen to be late.
    callbacks = [single('a', 100), single('b', 10, 9, **bound)]
    stopped = case(callbacks, {'a': 20, 'b': 1}, policy='fifo').run(100, stop=True)
    assert stopped.ended_ns == 10_000
    assert stopped.result()['first_miss']['completed_ns'] is None


# --- ends of jobs --------------------------------------------------------------------------------

TWO_SINKS = [source('s', 50), after('s', 'x', 2), after('s', 'y', 40)]


def test_a_late_job_goes_on_or_is_aborted() -> None:
    ticks = {'s': 1, 'x': 2, 'y': 1}
    going_on = case(TWO_SINKS, ticks).run(50).result()['dags']['s']
    assert going_on['ends'] == {'completed': 0, 'late': 1, 'aborted': 0, 'expired': 0, 'failed': 0}
    assert [s['completed'] for s in going_on['sinks'].values()] == [1, 1]
    aborting = [{**TWO_SINKS[0], 'on_late': 'abort'}, *TWO_SINKS[1:]]
    of = case(aborting, ticks)
    assert starts(of, 50) == ['s.0', 'x.0']
    dag = of.run(50).result()['dags']['s']
    assert dag['ends'] == {'completed': 0, 'late': 0, 'aborted': 1, 'expired': 0, 'failed': 0}
    assert [(s['completed'], s['late'], s['aborted']) for s in dag['sinks'].values()] == [
        (1, 1, 0), (0, 0, 1)]


def test_an_abort_lets_finish_what_has_started() -> None:
    aborting = [{**TWO_SINKS[0], 'on_late': 'abort'}, *TWO_SINKS[1:]]
    of = case(aborting, {'s': 1, 'x': 2, 'y': 9}, workers=2)
    assert log(of, 50)[-2:] == [(3, 'end', 0, 'x.0'), (10, 'end', 1, 'y.0')]
    dag = of.run(50).result()['dags']['s']
    assert [s['completed'] for s in dag['sinks'].values()] == [1, 0]
    assert dag['ends']['aborted'] == 1


def test_what_would_start_too_late_is_aborted_at_its_turn() -> None:
    callbacks = [single('a', 100, 100), single('b', 10, 5, on_late='abort')]
    # fifo: a runs 0-7; at 7 b.0 is past its deadline at 5; at 10 b.1 starts.
    of = case(callbacks, {'a': 7, 'b': 1}, policy='fifo')
    assert starts(of, 20) == ['a.0', 'b.1']
    dag = of.run(20).result()['dags']['b']
    assert dag['ends'] == {'completed': 1, 'late': 0, 'aborted': 1, 'expired': 0, 'failed': 0}
    # At the very deadline nothing is lost yet.
    callbacks = [single('a', 100, 100), single('b', 10, 7, on_late='abort')]
    assert starts(case(callbacks, {'a': 7, 'b': 1}, policy='fifo'), 10) == ['a.0', 'b.0']


def test_the_oldest_job_expires_to_make_room() -> None:
    callbacks = [source('s', 10, max_active_jobs=2), after('s', 'x', 50)]
    of = case(callbacks, {'s': 1, 'x': 30})
    # s.0 0-1, x.0 1-31; s.1 and s.2 wait (their RADs are larger); at 20 job 0 expires: x.0 runs
    # to its end for nothing. At 30 job 1 expires; its source still runs, but x.1 never does.
    dag = of.run(40).result()['dags']['s']
    assert dag['jobs'] == 4
    assert dag['ends'] == {'completed': 0, 'late': 0, 'aborted': 0, 'expired': 2, 'failed': 0}
    assert dag['sinks']['/n:x']['expired'] == 2
    assert dag['sinks']['/n:x']['completed'] == 0
    assert starts(of, 40) == ['s.0', 'x.0', 's.1', 's.2', 'x.2']


def test_nothing_starts_at_the_horizon() -> None:
    of = case([single('a', 4), single('b', 8)], {'a': 4, 'b': 1}, policy='fifo')
    assert starts(of, 4) == ['a.0']
    assert starts(of, 5) == ['a.0', 'b.0']

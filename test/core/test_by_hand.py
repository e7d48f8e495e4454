# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Schedules worked out by hand: order, ties, preemption, groups, verdicts, ends."""

import pytest

from .task_sets import Case, declaration

Log = list[tuple[int, str, int, str]]


def single(name, period, deadline=None, **more):
    """Declare a DAG of one callback; times in ticks."""
    return {'node': '/n', 'name': name, 'dag': name, 'timer': f'{period}us',
            'deadline': f'{deadline or period}us', **more}


def source(name, period, **more):
    return {'node': '/n', 'name': name, 'dag': name, 'timer': f'{period}us',
            'publishes': [f'/{name}'], **more}


def after(before, name, deadline=None, **more):
    """Declare a callback started by another one; it is a sink where it has a deadline."""
    rest = {'publishes': [f'/{name}']}
    if deadline is not None:
        rest = {'deadline': f'{deadline}us'}
    return {'node': '/n', 'name': name, 'subscription': f'/{before}', **rest, **more}


def case(callbacks, ticks, *, workers=1, policy='rad', preemptive=False, **more):
    task_set = declaration(callbacks)
    times = tuple(tuple(ticks[v.callback.name] for v in dag.vertices) for dag in task_set.dags)
    return Case(task_set, times, workers, policy, preemptive, **more)


def names(task_set, dag, vertex):
    return task_set.dags[dag].vertices[vertex].callback.name


def log(of, horizon, **how):
    """Return (tick, what, worker, callback.job) for each event."""
    return [(now, kind, worker, f'{names(of.task_set, dag, vertex)}.{job}')
            for now, kind, worker, dag, vertex, job in of.events(of.run(horizon, **how))]


def starts(of, horizon, **how):
    """Return what starts, in order."""
    return [who for _, kind, _, who in log(of, horizon, **how) if kind == 'start']


def sink(of, horizon, name, **how):
    result = of.run(horizon, **how).result()
    return next(
        values for dag in result['dags'].values()
        for vertex, values in dag['sinks'].items() if vertex.endswith(f':{name}'))


# --- order and ties ------------------------------------------------------------------------------


def test_rad_goes_by_the_sink_that_comes_first():
    """A source that leads to an early sink runs before one with an earlier last deadline."""
    callbacks = [single('lone', 100, 20), source('s', 100), after('s', 'early', 10),
                 after('s', 'late', 90)]
    ticks = dict.fromkeys(('lone', 's', 'early', 'late'), 2)
    assert starts(case(callbacks, ticks), 50) == ['s.0', 'early.0', 'lone.0', 'late.0']
    # One deadline for each DAG, its latest: the DAG of s has 90.
    assert starts(case(callbacks, ticks, policy='gedf'), 50) == [
        'lone.0', 's.0', 'early.0', 'late.0']


@pytest.mark.parametrize('policy', ['rad', 'gedf'])
def test_equal_deadlines_go_by_vertex_then_by_dag(policy):
    # b, vertex 0 of DAG 1, was released with a, and goes before a2, vertex 1 of DAG 0.
    callbacks = [source('a', 50), after('a', 'a2', 30), single('b', 50, 30)]
    assert starts(case(callbacks, {'a': 1, 'a2': 1, 'b': 1}, policy=policy), 50) == [
        'a.0', 'b.0', 'a2.0']


# --- verdicts ------------------------------------------------------------------------------------


def test_what_is_overdue_at_the_horizon_is_late_unless_only_completions_are_judged():
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


# --- ends of jobs --------------------------------------------------------------------------------

TWO_SINKS = [source('s', 50), after('s', 'x', 2), after('s', 'y', 40)]


def test_a_late_job_goes_on_or_is_aborted():
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

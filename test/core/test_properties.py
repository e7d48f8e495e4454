# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What holds of every schedule and of its tables; the core against its twin by brute force."""

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import POLICIES, policy, rad_offsets, Tables
import pytest

from ..conftest import examples
from .brute_force import BruteForce
from .task_sets import cases, declaration, task_sets, TICK


def paths_to_sinks(dag, index):
    """Yield the sink at the end of each path from a vertex."""
    open_paths = [index]
    while open_paths:
        vertex = dag.vertices[open_paths.pop()]
        if vertex.successors:
            open_paths += vertex.successors
        else:
            yield vertex.index


def rad_offset(dag, index):
    """Return RAD minus release as the paper defines it, ns."""
    deadlines = [dag.vertices[sink].deadline_ns for sink in paths_to_sinks(dag, index)]
    return min(deadline for deadline in deadlines if deadline is not None)


@examples(100)
@given(task_sets(max_callbacks=8))
def test_rad_is_the_least_deadline_of_the_sinks_it_leads_to(task_set):
    tables = Tables.build(task_set)
    for dag in task_set.dags:
        brute = [rad_offset(dag, vertex.index) for vertex in dag.vertices]
        assert rad_offsets(dag) == brute
        first = tables.first_vertex[dag.index]
        assert tables.rad_offset[first:first + len(dag.vertices)] == brute


def compare(case, horizon, judge='horizon', stop=False, last_release=None):
    """Run a case both ways; every event and every verdict must be the same."""
    run = case.run(horizon, judge, stop, last_release)
    brute = BruteForce(
        case.task_set, case.ticks, tick=TICK, horizon=horizon, workers=case.workers,
        policy=case.policy, preemptive=case.preemptive, judge=judge, stop_at_first_miss=stop,
        dispatch_overhead=case.dispatch_overhead, switch_overhead=case.switch_overhead,
        last_release=last_release)
    assert case.events(run) == brute.events
    result = run.result()
    for dag in result['dags'].values():
        for sink in dag['sinks'].values():
            sink.pop('demoted', None)  # counted when it is noticed
    assert result['dags'] == brute.result()
    assert result['first_miss'] == brute.first_miss()
    assert result['deadline_missed'] == bool(brute.misses)
    assert run.ended_ns == brute.now * TICK
    return brute


@pytest.mark.parametrize('policy', POLICIES)
@examples(100)
@given(st.data(), st.integers(5, 50), st.sampled_from(['horizon', 'completions']), st.booleans())
def test_everything_at_once(policy, data, horizon, judge, stop):
    """Groups, bounds, aborts and overheads, or none of them, as in the paper."""
    with_groups, with_bounds, overheads = (data.draw(st.booleans()) for _ in range(3))
    compare(data.draw(cases((policy,), groups=with_groups, bounds=with_bounds,
                            newest=with_bounds, overheads=overheads)), horizon, judge, stop)


@examples(150)
@given(cases(newest=True), st.integers(5, 30))
def test_until_all_is_done(case, last_release):
    """Releases end and the run goes on until nothing is left: every job ends, and only once."""
    work = sum(map(sum, case.ticks))
    brute = compare(case, last_release * (1 + work), last_release=last_release)
    assert all(job.outcome for job in brute.jobs)
    assert not brute.waiting


US = 1_000


def test_a_sync_has_a_leg_for_each_publisher_of_a_topic():
    tables = Tables.build(declaration([
        {'node': '/n', 'name': 's', 'timer': '10us', 'publishes': ['/s', '/x'], 'dag': 'd'},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'publishes': ['/x', '/y']},
        {'node': '/n', 'name': 'join', 'sync': ['/x', '/y'], 'deadline': '9us'}]), legs=True)
    assert tables.n_legs[:3] == [1, 1, 3]
    assert tables.n_predecessors[:3] == [0, 1, 3]
    assert tables.leg_topic[tables.first_leg[2]:tables.first_leg[3]] == [0, 0, 1]


def test_rad_of_a_long_chain_is_found_without_recursion():
    n = 3_000
    chain = [{'node': '/n', 'name': 'c0', 'timer': '1ms', 'publishes': ['/t0'], 'dag': 'd'}]
    chain += [{'node': '/n', 'name': f'c{i}', 'subscription': f'/t{i - 1}',
               'publishes': [f'/t{i}']} for i in range(1, n)]
    chain[-1] = {**{k: v for k, v in chain[-1].items() if k != 'publishes'}, 'deadline': '5ms'}
    assert rad_offsets(declaration(chain).dags[0]) == [5_000_000] * n


def test_latest_start_by_hand():
    """The sink with the earlier deadline is not the one that has to start first."""
    tables = Tables.build(declaration([
        {'node': '/n', 'name': 's', 'timer': '90us', 'publishes': ['/s'], 'dag': 'd',
         'execution_time': '2us'},
        {'node': '/n', 'name': 'quick', 'subscription': '/s', 'deadline': '40us'},
        {'node': '/n', 'name': 'way', 'subscription': '/s', 'publishes': ['/w'],
         'execution_time': {'quantiles_us': [10, 30]}},
        {'node': '/n', 'name': 'long', 'subscription': '/w', 'deadline': '60us',
         'execution_time': '15us'}]), default_deadline=7)
    assert tables.rad_offset == [40 * US, 40 * US, 60 * US, 60 * US, 7]
    assert tables.latest_start == [23 * US, 40 * US, 25 * US, 45 * US, 7]
    assert policy('llf').key(tables, 2, 1_000, 6, 9) == (1_000 + 25 * US, 2, 0, 9)


def test_chains_of_equal_deadlines_go_by_period_then_by_dag():
    tables = Tables.build(declaration([
        {'node': '/n', 'name': name, 'timer': f'{period}us', 'deadline': '90us', 'dag': name}
        for name, period in (('a', 20), ('b', 10), ('c', 20))]))
    assert tables.chain_rank[:3] == [1, 0, 2]

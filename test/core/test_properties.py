# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The core against its twin by brute force; the tables of what that does not know."""

from hypothesis import given
from hypothesis import strategies as st
from mddag_executor.core import rad_offsets, Tables
from mddag_executor.simulate import ALL_POLICIES
import pytest

from ..conftest import examples
from .brute_force import BruteForce
from .task_sets import cases, declaration, TICK


def compare(case, horizon, judge='horizon', stop=False, last_release=None):
    """Run a case both ways; every event and every verdict must be the same."""
    run = case.run(horizon, judge, stop, last_release)
    brute = BruteForce(case, horizon, TICK, judge, stop, last_release)
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


@pytest.mark.parametrize('policy', ALL_POLICIES)
@examples(100)
@given(st.data(), st.integers(5, 50), st.sampled_from(['horizon', 'completions']), st.booleans())
def test_everything_at_once(policy, data, horizon, judge, stop):
    """Groups, bounds and overheads, or none of them, as in the paper."""
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


def test_a_sync_has_a_leg_for_each_publisher_of_a_topic():
    tables = Tables.build(declaration([
        {'node': '/n', 'name': 's', 'timer': '10us', 'publishes': ['/s', '/x'], 'dag': 'd'},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'publishes': ['/x', '/y']},
        {'node': '/n', 'name': 'join', 'sync': ['/x', '/y'], 'deadline': '9us'}]), legs=True,
        default_deadline=7)
    assert tables.n_legs[:3] == [1, 1, 3]
    assert tables.n_predecessors[:3] == [0, 1, 3]
    # what is undeclared has the default
    assert tables.rad_offset == tables.latest_start == [9 * TICK] * 3 + [7]


def test_rad_of_a_long_chain_is_found_without_recursion():
    n = 3_000
    chain = [{'node': '/n', 'name': f'c{i}', 'subscription': f'/t{i}', 'publishes': [f'/t{i + 1}']}
             for i in range(n)]
    chain[0] = {'node': '/n', 'name': 'c0', 'timer': '1ms', 'publishes': ['/t1'], 'dag': 'd'}
    chain[-1] = {'node': '/n', 'name': 'end', 'subscription': f'/t{n - 1}', 'deadline': '5ms'}
    assert rad_offsets(declaration(chain).dags[0]) == [5_000_000] * n

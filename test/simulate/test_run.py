# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Loads, execution times and settings of a simulated run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mddag_executor.simulate import (
    draw_execution_times,
    Load,
    periodic_load,
    scale_execution_times,
    Settings,
    simulate,
    SimulationError,
    utilisation,
)
from msg_graph import TaskSet
import pytest

from ..core.task_sets import declaration

US = 1_000


def two_dags(**more: Any) -> TaskSet:
    return declaration([
        {'node': '/n', 'name': 's', 'timer': '10us', 'publishes': ['/s'], 'dag': 'a',
         'execution_time': '2us', **more},
        {'node': '/n', 'name': 'x', 'subscription': '/s', 'deadline': '9us',
         'execution_time': {'quantiles_us': [1, 3]}},
        {'node': '/n', 'name': 't', 'timer': '4us', 'publishes': ['/s'], 'dag': 'b',
         'execution_time': '1us'}])


# --- loads ---------------------------------------------------------------------------------------


def test_a_source_may_get_ready_after_its_release() -> None:
    """As with a header stamp: the deadline counts from the release."""
    load = Load([5 * US], [0], [0], [2 * US, 2 * US], [0], [0], releases=[1])
    run = simulate(two_dags(), load, Settings(workers=1, duration_ns=100 * US))
    sink = run.result()['dags']['a']['sinks']['/n:x@a']
    assert (sink['completed'], sink['late']) == (1, 0)
    assert sink['response_ns']['max'] == 9 * US - 1
    late = simulate(two_dags(), load._replace(times=[5 * US + 2]),
                    Settings(workers=1, duration_ns=100 * US))
    assert late.result()['first_miss'] == {
        'dag': 'a', 'vertex': '/n:x@a', 'job': 0, 'deadline_ns': 9 * US + 1,
        'completed_ns': 9 * US + 2}


def test_a_bound_for_all_dags_and_one_of_its_own() -> None:
    task_set = two_dags(max_active_jobs=3)
    load = periodic_load(task_set, [[1, 900 * US], [900 * US, 1]], 100 * US)
    settings = Settings(workers=2, duration_ns=100 * US)
    ends = {name: dag['ends']['expired'] for name, dag in simulate(
        task_set, load, settings, max_active_jobs=2).result()['dags'].items()}
    assert ends == {'a': 10 - 3, 'b': 25 - 2}
    ends = {name: dag['ends']['expired']
            for name, dag in simulate(task_set, load, settings).result()['dags'].items()}
    assert ends == {'a': 10 - 3, 'b': 0}


# --- settings ------------------------------------------------------------------------------------

@pytest.mark.parametrize(('setting', 'says'), [
    ({'workers': 0}, 'workers: 0 is out of range: give 1 to 4096'),
    ({'workers': -1}, 'workers: -1 is out of range'),
    ({'duration_ns': 0}, 'duration: 0 ns is too short'),
    ({'judge': 'me'}, "judge 'me': .*: choose one of horizon, completions"),
    ({'policy': 'edf'}, "policy 'edf': .*: choose one of rad, rm"),
    ({'dispatch_overhead_ns': -1}, 'overhead'), ({'switch_overhead_ns': -1}, 'overhead'),
])
def test_settings_that_make_no_sense(setting: dict[str, Any], says: str) -> None:
    from mddag_executor.errors import MddagError
    load = periodic_load(two_dags(), [[1, 1], [1, 1]], US)
    with pytest.raises(MddagError, match=says) as error:
        simulate(two_dags(), load, replace(Settings(), **setting))
    assert '\n' not in str(error.value)


@pytest.mark.parametrize(('policy', 'own'), [
    ('rad', True), ('rm', True), ('gedf', True), ('wc', False), ('fifo', False)])
def test_a_policy_has_its_own_mode(policy: str, own: bool) -> None:
    load = periodic_load(two_dags(), [[1, 1], [1, 1]], US)
    assert Settings(policy=policy).preemptive is False
    for asked, got in ((None, own), (True, True), (False, False)):
        run = simulate(two_dags(), load, Settings(policy=policy, preemptive=asked))
        assert run.settings.preempts is run.result()['preemptive'] is got


# --- execution times -----------------------------------------------------------------------------

def test_a_seed_draws_the_same_for_ever() -> None:
    """The draw is part of results that people publish: it must not change."""
    assert draw_execution_times(two_dags(), 1) == [[2_000, 2_695], [2_528, 1_000]]
    assert draw_execution_times(two_dags(), 2) == [[2_000, 2_896], [1_113, 1_000]]


def test_utilisation_and_its_scaling() -> None:
    times = [[2_000, 3_000], [1_000, 1_000]]
    assert utilisation(two_dags(), times, 2) == pytest.approx(0.5)
    scaled = scale_execution_times(two_dags(), times, 2, 0.25)
    assert scaled == [[1_000, 1_500], [500, 500]]
    assert times == [[2_000, 3_000], [1_000, 1_000]]
    for target in (0.0, -1.0, float('nan'), float('inf')):
        with pytest.raises(SimulationError, match='utilisation'):
            scale_execution_times(two_dags(), times, 2, target)
    with pytest.raises(SimulationError, match='nothing|0'):
        scale_execution_times(two_dags(), [[0, 0], [0, 0]], 2, 0.5)

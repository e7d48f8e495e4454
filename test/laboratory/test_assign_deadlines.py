# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Deadlines by critical path and by what paths require."""

from dataclasses import replace
from pathlib import Path
import random

from mddag_executor.errors import UsageError
from mddag_executor.laboratory.assign_deadlines import assigned
from mddag_executor.laboratory.tasks import tasks_of
from msg_graph import load, loads
from msg_graph.edit import with_deadlines
from msg_graph.segments import bound, segments, why_unbounded
import pytest

from ..analysis.path_systems import random_system, simulated_run

TOP = Path(__file__).resolve().parents[2]
GRAPH = """\
mddag: 1
workers: 1
nodes:
  - node: /n
    callbacks:
      - {name: t, timer: 20ms, publishes: [/a, /b], dag: one, execution_time: 1ms}
      - {name: x, subscription: /a, deadline: 5ms, execution_time: 1ms}
      - name: y
        subscription: /b
        deadline: 50ms
        execution_time: {quantiles_us: [1000, 3000, 9000], percent: [0, 50, 100]}
      - {name: z, timer: 10ms, reads: [x], deadline: 10ms, dag: two, execution_time: 1ms}
"""
#: /n:s is a sink of both DAGs.
SHARED = """\
mddag: 1
nodes:
  - node: /n
    callbacks:
      - {name: a, timer: 20ms, publishes: [/a], dag: one, execution_time: 3ms}
      - {name: b, timer: 40ms, publishes: [/a], dag: two, execution_time: 1ms}
      - {name: s, subscription: /a, deadline: 5ms, execution_time: 1ms}
"""
PATH = "paths: [{{name: p, callbacks: ['/n:t', '/n:x', '/n:z'], {}}}]\n"


def test_proportional():
    # To x it is 2 ms, to y 1 ms + 9 ms.
    assert assigned(loads(GRAPH), 'max') == {
        '/n:x': 4_000_000, '/n:y': 20_000_000, '/n:z': 10_000_000}
    assert assigned(loads(GRAPH), 'mean')['/n:x'] == 8_000_000
    with pytest.raises(UsageError, match="budget 'median': there is no such budget"):
        assigned(loads(GRAPH), 'median')
    assert assigned(loads(SHARED), 'max') == {'/n:s': 20_000_000}


@pytest.mark.parametrize(('required', 'x', 'z'), [
    ('reaction: 1s', 4, 10),            # nothing has to be shorter
    ('reaction: 42ms', 4, 8),           # of the 12 ms that are left x would get 8, so z gets more
    ('reaction: 36ms', 4, 2),           # x and z share 6 ms
    ('reaction: 33ms', 2, 1),           # just the critical paths
    ('age: 26ms', 4, 2),                # no period of the last segment
    ('reaction: 42ms, age: 26ms', 4, 2)])
def test_requirements_by_hand(required, x, z):
    """The critical paths are 2 and 1 ms, the periods 20 and 10 ms."""
    task_set = loads(GRAPH + PATH.format(required))
    found = assigned(task_set, 'max')
    assert found == {'/n:x': x * 10 ** 6, '/n:y': 20_000_000, '/n:z': z * 10 ** 6}


@pytest.mark.parametrize(('change', 'required', 'says'), [
    ((), 'reaction: 30ms', 'path p: a reaction of 30ms cannot be met: its periods take 30ms and '
     'its critical paths 3ms: shorten first the period of one, 20ms'),
    ((), 'age: 22ms', 'path p: an age of 22ms cannot be met'),
    (('dag: two, execution_time: 1ms', 'dag: two, execution_time: 25ms'), 'reaction: 50ms',
     'its critical paths 27ms: shorten first the critical path to /n:z, 25ms'),
    (('reads: [x], deadline: 10ms', 'reads: [x], deadline: none'), 'reaction: 50ms',
     'path p: reaction: no sink with a deadline comes after /n:z, so nothing bounds it: give')])
def test_what_cannot_be_met_says_what_is_too_long(change, required, says):
    text = GRAPH.replace(*change) if change else GRAPH
    with pytest.raises(UsageError) as caught:
        assigned(loads(text + PATH.format(required)), 'max')
    assert says in str(caught.value)


@pytest.mark.parametrize(('change', 'why'), [
    (None, None),
    (('reads: [x], deadline: 10ms', 'reads: [x], deadline: none'), "'/n:z' has no deadline"),
    (('deadline: 5ms, execution_time: 1ms}', 'publishes: [/c], execution_time: 1ms}\n'
      '      - {name: w, subscription: /c, deadline: none, execution_time: 1ms}'),
     "'/n:x' leads to no deadline"),
    (('timer: 10ms, reads: [x],', 'subscription: /d, sporadic: true, period: 1ms, reads: [x],'),
     "nothing says when '/n:z' runs next")])
def test_why_nothing_bounds_a_requirement(change, why):
    text = GRAPH.replace(*change) if change else GRAPH
    task_set = loads(text + PATH.format('reaction: 500ms'))
    path, = task_set.paths
    assert why_unbounded(task_set, path, 'reaction') == why
    assert (bound(task_set, path, 'reaction') is None) == (why is not None)


def holds(task_set):
    """Assign deadlines and simulate; return whether all sinks were in time."""
    deadlines = assigned(task_set, 'max')
    task_set = with_deadlines(task_set, deadlines)
    shortest = {}
    for task in tasks_of(task_set, 'max'):
        for index, _, length in task.sinks if task.length <= task.period else ():
            key = task.dag.vertices[index].callback.key
            shortest[key] = min(length, shortest.get(key, length))
    assert all(deadlines[key] >= length - 1000 for key, length in shortest.items())
    for path in task_set.paths:
        for what, required in path.requirements.items():
            assert bound(task_set, path, what) <= required
    result, run = simulated_run(task_set)
    if not result['deadline_missed']:
        for name, every in run.requirements()['requirements'].items():
            for what, each in every.items():
                assert each['completed'] > 0 and not each['late'], (task_set.file, name, what)
    return not result['deadline_missed']


def with_requirements(task_set, factor):
    """Return a task set whose paths allow their periods and some times their critical paths."""
    lengths = {task.dag.name: task.length for task in tasks_of(task_set, 'max')}
    paths = []
    for path in task_set.paths:
        parts = segments(task_set, path)
        least = sum(lengths[part.dag] for part in parts)
        periods = sum(part.period_ns for part in parts)
        paths.append(replace(path, reaction_ns=round(periods + factor * least),
                             age_ns=round(periods - parts[-1].period_ns + factor * least)))
    return replace(task_set, paths=tuple(paths))


@pytest.mark.parametrize('seeds', [
    range(40), pytest.param(range(40, 1040), marks=pytest.mark.nightly)])
def test_requirements_hold_in_random_systems(seeds):
    in_time = 0
    for seed in seeds:
        chance = random.Random(seed)
        task_set = loads(random_system(chance), f'{seed}.yaml')
        if task_set.paths:
            in_time += holds(with_requirements(task_set, chance.uniform(1.0, 4.0)))
    assert in_time > len(seeds) // 3


def test_requirements_hold_on_the_paths_of_autoware():
    task_set = load(TOP / 'config' / 'autoware.yaml')
    assert task_set.paths
    holds(replace(with_requirements(task_set, 1.5), workers=7))

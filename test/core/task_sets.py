# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Random task sets for property tests: declarations as people write them, small times.

One *tick* is a microsecond, the least period that a declaration may have; every time of a random
task set is a whole number of ticks, so that a slow simulator can go tick by tick.
"""

from dataclasses import dataclass
import json

from hypothesis import strategies as st
from mddag_executor.core import Scheduler, Tables
from mddag_executor.simulate import (
    ALL_POLICIES,
    END,
    periodic_workload,
    PREEMPT,
    Settings,
    simulate,
    START,
)
from mddag_executor.simulate.policies import ROS2
from msg_graph import loads, TaskSet

TICK = 1_000
KINDS = {START: 'start', END: 'end', PREEMPT: 'preempt'}


@dataclass(frozen=True)
class Case:
    """A task set with an execution time (ticks) for each vertex, and how to run it."""

    task_set: TaskSet
    ticks: tuple[tuple[int, ...], ...]
    workers: int
    policy: str
    preemptive: bool
    dispatch_overhead: int = 0
    switch_overhead: int = 0

    def load(self, ticks):
        """Return the periodic load of all releases before a time."""
        times_ns = [[tick * TICK for tick in row] for row in self.ticks]
        return periodic_workload(self.task_set, times_ns, ticks * TICK)

    def run(self, horizon, judge='horizon', stop=False, last_release=None):
        """Simulate it; times in ticks."""
        settings = Settings(
            policy=self.policy, pools=(self.workers,), duration_ns=horizon * TICK,
            preemptive=self.preemptive, judge=judge, stop_at_first_miss=stop,
            dispatch_overhead_ns=self.dispatch_overhead * TICK,
            switch_overhead_ns=self.switch_overhead * TICK)
        return simulate(self.task_set, self.load(last_release or horizon), settings, log=True)

    def events(self, run):
        """Return a run's log in ticks, with each vertex by its index in its DAG."""
        first = [0]
        for dag in self.task_set.dags:
            first.append(first[-1] + len(dag.vertices))
        return [(time // TICK, KINDS[kind], worker, dag, vertex - first[dag], job)
                for time, kind, worker, dag, vertex, job in run.log if kind in KINDS]

    def _repr_pretty_(self, printer, cycle):
        """Show in hypothesis' reports what is needed to try it by hand."""
        rest = (self.ticks, self.workers, self.policy, self.preemptive, self.dispatch_overhead,
                self.switch_overhead)
        printer.text(f'Case(loads({self.task_set.text!r}), {", ".join(map(repr, rest))})')


def declaration(callbacks):
    """Derive callbacks that each name their node; the file lists them in this order."""
    nodes = [{'node': callback['node'],
              'callbacks': [{k: v for k, v in callback.items() if k != 'node'}]}
             for callback in callbacks]
    return loads(json.dumps({'mddag': 1, 'nodes': nodes}), 'random.yaml')


def single(name, period, deadline=None, **more):
    """Declare a DAG of one callback; times in ticks."""
    return {'node': '/n', 'name': name, 'timer': f'{period}us',
            'deadline': f'{deadline or period}us', 'dag': name, **more}


JOIN = declaration([
    {'node': '/n', 'name': 's', 'timer': '100us', 'publishes': ['/s'], 'dag': 'd'},
    {'node': '/n', 'name': 'x', 'subscription': '/s', 'publishes': ['/x']},
    {'node': '/n', 'name': 'y', 'subscription': '/s', 'publishes': ['/y']},
    {'node': '/n', 'name': 'join', 'sync': ['/x', '/y'], 'deadline': '50us'},
])


def live(task_set=JOIN, workers=2, policy_name='rad', **options):
    """Return a scheduler as the live executor makes it."""
    tables = Tables.build(task_set, legs=True, **options)
    return Scheduler(tables, workers, policy_name)


def _ticks(draw, least, most):
    return f'{draw(st.integers(least, most))}us'


def _triggers(draw, callbacks):
    """Return what starts a callback: one before it, one of two (OR) or both of two (AND)."""
    kind = draw(st.sampled_from(['one', 'one', 'and', 'or'])) if len(callbacks) > 1 else 'one'
    if kind == 'one':
        before = draw(st.sampled_from(callbacks))
        before['publishes'].add(before['topic'])
        return {'subscription': before['topic']}
    two = draw(st.lists(st.sampled_from(callbacks), min_size=2, max_size=2,
                        unique_by=lambda callback: callback['name']))
    if kind == 'and':
        for before in two:
            before['publishes'].add(before['topic'])
        return {'sync': [before['topic'] for before in two]}
    topic = f"{two[0]['topic']}_or{len(callbacks)}"
    for before in two:
        before['publishes'].add(topic)
    return {'subscription': topic}


@st.composite
def task_sets(
    draw, /, max_dags=3, max_callbacks=5, groups=True,
    bounds=True, newest=False, importance=False, optional=False,
):
    """
    Draw a task set: one to some DAGs with AND, OR, unequal deadlines, shared callbacks.

    :param groups: some callbacks are in mutually exclusive groups, also across DAGs.
    :param bounds: some DAGs demote late jobs or bound their open jobs.
    :param newest: some sources and sinks keep only the newest.
    :param optional: some topics are published only sometimes, some sinks have no deadline.
    :param importance: sinks have an importance, and some tolerate misses.
    """
    every = []
    n_dags = draw(st.integers(1, max_dags))
    for dag in range(n_dags):
        mine = []
        for number in range(draw(st.integers(1, max_callbacks))):
            callback = {
                'node': f'/n{draw(st.integers(0, 1))}', 'name': f'd{dag}c{number}',
                'topic': f'/d{dag}/t{number}', 'publishes': set()}
            if number:
                callback.update(_triggers(draw, mine))
            else:
                callback['timer'] = _ticks(draw, 3, 15)
                callback['dag'] = f'dag{dag}'
                if bounds:
                    callback['on_late'] = draw(st.sampled_from(['continue', 'demote', 'demote']))
                    if draw(st.booleans()):
                        callback['max_active_jobs'] = draw(st.integers(1, 3))
            mine.append(callback)
        every += mine
    if n_dags > 1 and draw(st.booleans()):
        # One callback that two DAGs trigger: a vertex in each of them.
        before = [draw(st.sampled_from([c for c in every if c['name'].startswith(f'd{dag}')]))
                  for dag in (0, 1)]
        for callback in before:
            callback['publishes'].add('/shared')
        every.append({'node': '/n0', 'name': 'shared', 'topic': '/shared_out',
                      'publishes': set(), 'subscription': '/shared'})
    for callback in every:
        if groups:
            group = draw(st.sampled_from([None, None, 'g', 'h']))
            if group is not None:
                callback['group'] = group
        if draw(st.booleans()):  # for llf and demote; the times of a run are the case's
            callback['execution_time'] = _ticks(draw, 1, 9)
        if not callback['publishes']:
            callback['deadline'] = _ticks(draw, 1, 40)
        if newest and ('timer' in callback or 'deadline' in callback):
            callback['keep'] = draw(st.sampled_from(['all', 'all', 'newest']))
        if importance and 'deadline' in callback:
            callback['importance'] = draw(st.sampled_from(['high', 'normal', 'low']))
            if draw(st.booleans()):
                callback['tolerate'] = f'{draw(st.integers(1, 2))} of {draw(st.integers(3, 5))}'
        callback['publishes'] = sorted(callback['publishes'])
        if optional:
            callback['may_publish'] = [t for t in callback['publishes'] if draw(st.booleans())]
            callback['publishes'] = [
                t for t in callback['publishes'] if t not in callback['may_publish']]
            if callback.get('deadline') and draw(st.integers(0, 3)) == 0:
                callback['deadline'] = 'none'
        del callback['topic']
        if not callback['publishes']:
            del callback['publishes']
    return declaration(draw(st.permutations(every)))


@st.composite
def cases(draw, /, policies=tuple(ALL_POLICIES), overheads=False, **options):
    """Draw a task set and how to run it."""
    task_set = draw(task_sets(**options))
    policy = draw(st.sampled_from(policies))
    preemptive = draw(st.booleans()) and policy != ROS2
    most = draw(st.sampled_from([2, 5, 9]))  # light load to overload
    ticks = tuple(
        tuple(draw(st.lists(st.integers(1, most), min_size=len(dag.vertices),
                            max_size=len(dag.vertices))))
        for dag in task_set.dags)
    return Case(
        task_set, ticks, draw(st.integers(1, 4)), policy, preemptive,
        draw(st.integers(0, 2)) if overheads else 0, draw(st.integers(0, 2)) if overheads else 0)

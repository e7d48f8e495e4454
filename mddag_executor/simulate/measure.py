# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How long simulation takes: for each run of an experiment, and for each job of a vertex."""

from __future__ import annotations

from dataclasses import replace
import json
import random
from statistics import median
import time
from typing import Any

from mddag_executor import defaults
from mddag_executor.simulate.compiled import CompiledJudge
from mddag_executor.simulate.draws import Draws
from mddag_executor.simulate.evaluate import evaluate
from mddag_executor.simulate.experiment import Experiment, Judge, PlainJudge
from mddag_executor.simulate.run import Settings
from msg_graph import loads, TaskSet
import numpy as np

WORKERS = defaults.WORKERS
_DAG = 10
_PERIODS_MS = (10, 20, 33, 50, 100)
_UTILISATION = 0.6


def time_runs(
    experiment: Experiment, runs: int, *, core: str, jobs: int, repeat: int
) -> dict[str, Any]:
    """
    Measure how long each run and policy of an experiment takes.

    :param repeat: do it so often, with draws of their own, and take the medians.
    :return: for machines; ``ms`` is wall-clock time for each run and policy.
    """
    evaluate(experiment, jobs, jobs=jobs, core=core)  # compiled or loaded, memory in place
    taken = []
    for number in range(repeat):
        outcome = evaluate(replace(experiment, seed=number), runs, jobs=jobs, core=core)
        taken.append(outcome.elapsed_s)
    each = median(taken) / runs / len(experiment.policies)
    return {
        'core': core, 'jobs': jobs, 'runs': runs, 'policies': list(experiment.policies),
        'repeat': repeat, 's': median(taken), 'ms': 1000 * each,
        'runs_per_s': runs / median(taken)}


def random_task_set(n_vertices: int, seed: int = 0) -> TaskSet:
    """
    Make DAGs of ten vertices (one to three predecessors each) whose deadlines are never missed.

    The normalised utilisation on ``WORKERS`` workers is 0.6.
    """
    generator = random.Random(seed)
    callbacks: list[dict[str, Any]] = []
    for dag in range(-(-n_vertices // _DAG)):
        period = generator.choice(_PERIODS_MS)
        size = min(_DAG, n_vertices - dag * _DAG)
        share = _UTILISATION * WORKERS * period * 1e6 / n_vertices  # ns for each vertex
        mine: list[dict[str, Any]] = []
        for number in range(size):
            callback: dict[str, Any] = {
                'name': f'd{dag}v{number}', 'publishes': [],
                'execution_time': f'{max(1, round(share * generator.uniform(0.5, 1.5)))}ns'}
            if number:
                before = generator.sample(mine, min(len(mine), generator.randint(1, 3)))
                topics = [f'/d{dag}/t{number}_{i}' for i in range(len(before))]
                for publisher, topic in zip(before, topics):
                    publisher['publishes'].append(topic)
                if len(topics) == 1:
                    callback['subscription'] = topics[0]
                else:
                    callback['sync'] = topics
            else:
                callback.update(timer=f'{period}ms', dag=f'd{dag}')
            mine.append(callback)
        callbacks += mine
    for callback in callbacks:
        if not callback['publishes']:
            del callback['publishes']
            callback['deadline'] = '86400s'
    return loads(
        json.dumps({'mddag': 1, 'nodes': [{'node': '/n', 'callbacks': callbacks}]}), '<random>')


def time_vertex_jobs(
    n_vertices: int, *, core: str, vertex_jobs: int, repeat: int
) -> dict[str, Any]:
    """
    Measure how long each job of a vertex takes under ``rad``, in a random task set.

    :param vertex_jobs: about how many to simulate; each DAG has one job at least.
    :return: for machines; ``ns`` of CPU time is the median over the repetitions.
    """
    task_set = random_task_set(n_vertices)
    rate = sum(len(dag.vertices) / dag.period_ns for dag in task_set.dags)
    duration_ns = max(max(_PERIODS_MS) * 1_000_000, round(vertex_jobs / rate))
    judge: Judge
    if core == 'compiled':
        judge = CompiledJudge(task_set, duration_ns)
    else:
        judge = PlainJudge(task_set, duration_ns)
    judge.warm_up()
    settings = Settings('rad', WORKERS, duration_ns, True, 'completions', True)
    done = sum(-(-duration_ns // dag.period_ns) * len(dag.vertices) for dag in task_set.dags)
    times = Draws(task_set, 0).times(0, 1)
    taken = []
    for _ in range(repeat):
        begin = time.thread_time()
        accepted = judge(settings, times)
        taken.append(time.thread_time() - begin)
        assert np.all(accepted)  # else it ended early
    return {'vertices': n_vertices, 'core': core, 'vertex_jobs': done,
            'ns': 1e9 * median(taken) / done}

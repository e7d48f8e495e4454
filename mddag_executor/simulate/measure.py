# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How long simulation takes: for each run of an experiment, and for each job of a vertex."""

from __future__ import annotations

from dataclasses import replace
from statistics import median
import time
from typing import Any

from mddag_executor import defaults
from mddag_executor.generate import generate, Options
from mddag_executor.simulate.compiled import ACCEPT_RUNS, CompiledJudge, prepare
from mddag_executor.simulate.draws import Draws
from mddag_executor.simulate.evaluate import evaluate
from mddag_executor.simulate.experiment import Experiment, Judge, PlainJudge
from mddag_executor.simulate.schedule import Settings
from msg_graph import loads, TaskSet
import numpy as np

WORKERS = defaults.WORKERS
_PERIODS_NS = (50_000_000, 100_000_000, 200_000_000)
_MOST_DAGS = 1000
_LOOSE = 1000.0


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


def random_task_set(n_vertices: int) -> TaskSet:
    """
    Make DAGs of about ten vertices, or more where there would be too many, that miss no deadline.

    The normalised utilisation on ``WORKERS`` workers is 0.6.
    """
    dags = min(_MOST_DAGS, max(1, n_vertices // 10))
    size = n_vertices // dags
    return loads(generate(Options(
        dags=(dags, dags), vertices=(size, size), edge_probability=min(1.0, 2 / size),
        utilisation=0.6, workers=WORKERS, most_per_dag=WORKERS, periods_ns=_PERIODS_NS,
        tightness=(_LOOSE, _LOOSE))), '<random>')


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
    duration_ns = max(max(_PERIODS_NS), round(vertex_jobs / rate))
    judge: Judge = PlainJudge(task_set, duration_ns)
    if core == 'compiled':
        prepare(ACCEPT_RUNS)
        judge = CompiledJudge(task_set, duration_ns)
    settings = Settings('rad', WORKERS, duration_ns, True, 'completions', True)
    done = sum(-(-duration_ns // dag.period_ns) * len(dag.vertices) for dag in task_set.dags)
    times = Draws(task_set, 0).times(0, 1)
    taken = []
    for _ in range(repeat):
        begin = time.thread_time()
        accepted = judge(settings, times)
        taken.append(time.thread_time() - begin)
        assert np.all(accepted)  # else it ended early
    return {'vertices': len(task_set.vertices), 'core': core, 'vertex_jobs': done,
            'ns': 1e9 * median(taken) / done}

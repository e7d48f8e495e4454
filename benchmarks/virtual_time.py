# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measures the time of simulation per run and per job of a vertex, and of the core per event.

Theory of operation
-------------------
``time_core`` has two drivers of the same core in plain Python.  *Simulated*: ``engine.run`` over a
periodic load in virtual time, with the workload's parallelism and waiting; the engine's own time
is included.  *Live calls*: the live executor's calls of the core for each callback (release,
ready, take, complete), leg by leg, one callback after the other, without clock, threads and
messages.

An *event* is an input or a decision of the core: a release, a completion, a start or a preemption.
Times are CPU time of the thread, medians over repetitions; the garbage collector is off meanwhile,
because its share depends on other objects of the process.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import gc
from statistics import median
import time
from typing import Any

from mddag_executor import defaults
from mddag_executor.core import Scheduler, Tables
from mddag_executor.core.policies import POLICIES as LIVE_POLICIES
from mddag_executor.core.state import IDLE
from mddag_executor.laboratory.draws import Draws
from mddag_executor.laboratory.evaluate import evaluate
from mddag_executor.laboratory.experiment import Experiment, judge_of
from mddag_executor.laboratory.generate import generate, Options
from mddag_executor.simulate import END
from mddag_executor.simulate.execution_times import draw_execution_times
from mddag_executor.simulate.schedule import schedule, Settings
from mddag_executor.simulate.workload import periodic_workload, Workload
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
    Measure the time per run and policy of an experiment.

    :param repeat: number of repetitions, each with its own draws; medians are returned.
    :return: for JSON; ``ms`` is wall-clock time for each run and policy.
    """
    compiled = core == 'compiled'
    evaluate(experiment, jobs, jobs=jobs, compiled=compiled)  # compile or load, touch memory
    taken = [evaluate(replace(experiment, seed=number), runs, jobs=jobs, compiled=compiled)
             .elapsed_s for number in range(repeat)]
    each = median(taken) / runs / len(experiment.policies)
    return {
        'core': core, 'jobs': jobs, 'runs': runs, 'policies': list(experiment.policies),
        'repeat': repeat, 's': median(taken), 'ms': 1000 * each,
        'runs_per_s': runs / median(taken)}


def random_task_set(n_vertices: int) -> TaskSet:
    """
    Make DAGs of about ten vertices (larger ones if there are too many), without misses.

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
    Measure the time per job of a vertex under ``rad``, in a random task set.

    :param vertex_jobs: approximate number to simulate; each DAG has at least one job.
    :return: for JSON; ``ns`` of CPU time is the median over the repetitions.
    """
    task_set = random_task_set(n_vertices)
    rate = sum(len(dag.vertices) / dag.period_ns for dag in task_set.dags)
    duration_ns = max(max(_PERIODS_NS), round(vertex_jobs / rate))
    judge = judge_of(task_set, duration_ns, core == 'compiled')
    settings = Settings('rad', (WORKERS,), duration_ns, True, 'completions', True)
    done = sum(-(-duration_ns // dag.period_ns) * len(dag.vertices) for dag in task_set.dags)
    times = Draws(task_set, 0).times(0, 1)
    accepted = judge(settings, times)
    assert np.all(accepted)  # otherwise it ended early
    return {'vertices': len(task_set.vertices), 'core': core, 'vertex_jobs': done,
            'ns': 1e9 * _seconds(lambda: judge(settings, times), repeat) / done}


def time_core(
    task_set: TaskSet, policy: str, *, workers: int, duration_ns: int, seed: int = 0,
    repeat: int = 5,
) -> dict[str, Any]:
    """
    Measure the core under a policy, in its own mode of the paper's experiment.

    :param duration_ns: of virtual time.
    :param seed: of the execution times.
    :return: for JSON: counts, and us of CPU time for each event and vertex job, in live calls only
        under policies that live runs can have.
    :raises mddag_executor.core.PolicyError: if there is no such policy.
    :raises InputError: if a callback declares no execution time.
    """
    settings = Settings(policy, (workers,), duration_ns, preemptive=None)
    tables = Tables.build(task_set)
    load = periodic_workload(task_set, draw_execution_times(task_set, seed), duration_ns)

    def simulate() -> None:
        schedule(tables, load, settings)

    log = schedule(tables, load, settings, log=True).log
    vertex_jobs = sum(kind == END for _, kind, *_ in log)
    events = len(log)
    taken = _seconds(simulate, repeat)
    legs = Tables.build(task_set, legs=True)
    live, live_jobs = 0.0, 0
    if policy in LIVE_POLICIES:
        live_jobs = drive_live(legs, policy, load)
        live = _seconds(lambda: drive_live(legs, policy, load), repeat)
    return {
        'policy': policy, 'preemptive': settings.preempts, 'vertex_jobs': vertex_jobs,
        'events': events, 'repeat': repeat, 'us_per_event': _us(taken, events),
        'us_per_vertex_job': _us(taken, vertex_jobs),
        'live_us_per_vertex_job': _us(live, live_jobs)}


def _us(seconds: float, count: int) -> float | None:
    return 1e6 * seconds / count if count else None


def _seconds(work: Callable[[], object], repeat: int) -> float:
    """Return the median CPU time of some work, s."""
    taken = []
    for _ in range(repeat):
        gc.collect()
        gc.disable()
        try:
            begin = time.thread_time()
            work()
            taken.append(time.thread_time() - begin)
        finally:
            gc.enable()
    return median(taken)


def drive_live(tables: Tables, policy: str, load: Workload) -> int:
    """
    Make the core's calls of a live run: jobs with the same release together, until they end.

    :param tables: with legs.
    :return: the number of vertex jobs that completed.
    """
    core = Scheduler(tables, 1, policy)
    completed = 0
    first, successors = tables.first_successor, tables.successors
    state = core.state
    for i, (now, dag, job) in enumerate(zip(load.times, load.dags, load.jobs)):
        core.ready(core.source(core.release(dag, job, now, now)), now)
        if i + 1 < len(load.times) and load.times[i + 1] == now:
            continue
        x = core.take(0, now)
        while x >= 0:
            slot, vertex = state.x_slot[x], state.x_vertex[x]
            if core.complete(x, now):
                completed += 1
                for after in successors[first[vertex]:first[vertex + 1]]:
                    # A leg of the vertex that is not ready yet.
                    leg = core.execution(slot, after)
                    while state.x_state[leg] != IDLE:
                        leg += 1
                    core.ready(leg, now)
            if state.decisions:
                core.decisions()
            x = core.take(0, now)
    return completed

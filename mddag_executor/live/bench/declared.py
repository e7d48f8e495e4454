# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Measure an executor with the synthetic nodes of a declaration."""

from __future__ import annotations

from collections.abc import Sequence
import gc
from typing import Any, cast

from mddag_executor.core.tally import quantiles_us
from mddag_executor.live import current_job
from mddag_executor.live.bench.executors import make_executor, UnfinishedSession
from mddag_executor.live.bench.latency import Starts
from mddag_executor.live.bench.spec import BenchError, OURS, Spec
from mddag_executor.live.bodies import no_job
from mddag_executor.live.execution import ExecutionPlan, Mode
from mddag_executor.live.measure import Books, measure
from mddag_executor.live.session import run_and_note
from mddag_executor.live.synthetic import SyntheticWorkload
from msg_graph import load, TaskSet

HOT_PATH = 'hot_path'
"""Name of the path in a declaration whose latency is reported."""


def run_declared(spec: Spec) -> dict[str, Any]:
    """
    Run the nodes of a declaration under an executor, or those of one of its processes.

    :return: the figures of ``result_of``; of one process what that takes.
    :raises BenchError: when the run was over before anything was measured.
    :raises mddag_executor.errors.MddagError: when declaration and execution times do not fit.
    :raises msg_graph.GraphError: when the declaration is wrong.
    """
    if spec.graph is None:
        raise BenchError(f'--load {spec.load}: it needs a declaration: give --graph')
    task_set = load(spec.graph)
    plan = ExecutionPlan(
        task_set, spec.seed, spec.utilisation, spec.workers, cast(Mode, spec.bodies))
    executor = make_executor(spec, task_set)
    job_of_thread = current_job if spec.executor in OURS else no_job
    workload = SyntheticWorkload(
        task_set, plan, current_job=job_of_thread, process=spec.process)
    starts = Starts()
    # before an executor learns of them
    starts.watch(workload.nodes,
                 {timer: workload.ledger.delays[dag] for dag, timer in workload.timers.items()})
    for node in workload.nodes:
        executor.add_node(node)
    session = UnfinishedSession(executor, spec)
    # for all alike: a full collection of what there is by now stops every thread for 25 ms
    gc.collect()
    gc.freeze()
    with session:
        books = run_and_note(session, workload, spec.seconds, warm_up_s=spec.warm_up_s)
    if session.error is not None:
        raise session.error
    if books is None:
        raise BenchError('the run was ended before anything was measured: run it again')
    # rclpy's EventsExecutor moves a timer on before it queues the call, so that calls in a backlog
    # do not say for which due time they stand: only messages are counted there.
    latencies = starts.within(
        books.start.at_ns, books.end.at_ns, timers=spec.executor != 'events')
    if spec.process is not None:
        return {'books': books.plain(), 'latencies': latencies}
    return result_of(task_set, plan, books, latencies)


def result_of(
    task_set: TaskSet, plan: ExecutionPlan, books: Books, latencies: list[int]
) -> dict[str, Any]:
    """Return the figures of ``measure``, ``dispatch_latency_us`` and ``hot_path_us``."""
    result = measure(books.ledger, plan, books.start, books.end)
    return {
        **result, 'infeasible_sinks': len(plan.infeasible()),
        'dispatch_latency_us': quantiles_us(latencies), 'hot_path_us': hot_path(task_set, result)}


def of_processes(spec: Spec, parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a run from what its processes returned."""
    task_set = load(spec.graph or '')
    plan = ExecutionPlan(
        task_set, spec.seed, spec.utilisation, spec.workers, cast(Mode, spec.bodies))
    return result_of(
        task_set, plan, Books.of_processes(task_set, [part['books'] for part in parts]),
        [latency for part in parts for latency in part['latencies']])


def hot_path(task_set: TaskSet, result: dict[str, Any]) -> dict[str, Any] | None:
    """
    Return the latency of the path ``hot_path``, from its source's release to its sink's end.

    :param result: what ``measure`` made of the run.
    :return: p50, p99 and max of the jobs that were due and completed, how many were due, and how
        many of these are missing; None when the declaration has no such path within one DAG.
    """
    path = next((path for path in task_set.paths if path.name == HOT_PATH), None)
    if path is None:
        return None
    for dag in task_set.dags:
        keys = {vertex.callback.key for vertex in dag.vertices}
        ends = [dag.vertices[i] for i in dag.sinks
                if dag.vertices[i].callback.key == path.callbacks[-1]]
        if ends and keys.issuperset(path.callbacks):
            sink = result['dags'][dag.name]['sinks'][ends[0].name]
            response = sink['response_ns'] or {}
            shown = {'p50': 'median', 'p99': 'p99', 'max': 'max'}
            return {
                **{name: response[key] / 1000 if key in response else None
                   for name, key in shown.items()},
                'due': sink['due'], 'missing': sink['missing']}
    return None

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measures an executor with a load, in this process.

*Declared* loads are the synthetic nodes of a declaration.

*Message* loads are subscriptions with empty callbacks.  Every message is counted: published
messages whose callback has not run when no more messages arrive are lost.  The publishers are in
another process, so the CPU time is that of receiving only: executor, middleware, interpreter, and
reading the clock.

The *robot* is the ordinary nodes of ``examples/robot``.  Their sensors stamp samples on exact
grids, and the node at the end of a chain logs the stamps.  *Due* are the points of a sink's grid
whose deadline is inside the measured window.  A point is *in time* if it was done by its deadline,
and *missing* if it was never done.
"""

from __future__ import annotations

import dataclasses
from importlib.util import module_from_spec, spec_from_file_location
import os
from pathlib import Path
import time
from typing import Any, cast

from benchmarks.campaign import DECLARED, OURS, ROBOT, Spec
from benchmarks.executors import make_executor, noting, spin_of, Start, within
from benchmarks.publisher import PublisherProcess
from mddag_executor.core import quantile
from mddag_executor.executor import current_job
from mddag_executor.executor.quiet_nodes import quiet_node
from mddag_executor.resources import find
from mddag_executor.synthetic.measure import (
    ExecutionPlan,
    judge_sink,
    measure,
    Mode,
    totals,
    WARM_UP_S,
)
from mddag_executor.synthetic.peers import run_nodes, UnfinishedSession
from mddag_executor.synthetic.workload import no_job, QOS, SyntheticWorkload
from msg_graph import load, TaskSet
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from std_msgs.msg import Header

HOT_PATH = 'hot_path'
"""Name of the path in a declaration whose latency is reported."""

QUIET_S = 0.5
"""After this time without callbacks, after the last publication, no messages are expected."""
DRAIN_S = 10.0
MIDDLEWARE = 'dds.'
"""Prefix of the names of Fast DDS's threads."""

PROGRAM = 'examples/robot/robot.py'

Log = list[tuple[int, int]]


def quantiles_us(values: list[int]) -> dict[str, float] | None:
    """Return p50, p99 and max in us of values in ns; None when there are none."""
    if not values:
        return None
    ordered = sorted(values)
    return {
        'p50': quantile(ordered, 0.5) / 1000, 'p99': quantile(ordered, 0.99) / 1000,
        'max': ordered[-1] / 1000}


def run(spec: Spec) -> dict[str, Any]:
    """
    Make a measurement; return its figures.

    :raises ChildError: if the run ended before anything was measured.
    :raises mddag_executor.errors.MddagError: if declaration and execution times do not fit, or
        publishers and subscriptions do not discover each other.
    :raises msg_graph.GraphError: if the declaration is wrong.
    """
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    if spec.load == ROBOT:
        return run_robot(spec)
    return run_declared(spec) if spec.load in DECLARED else run_messages(spec)


def run_declared(spec: Spec) -> dict[str, Any]:
    """
    Run the nodes of a declaration, in one process, under an executor.

    :return: the figures of ``measure``, those of important sinks, and latencies.
    """
    assert spec.graph is not None
    task_set = dataclasses.replace(load(spec.graph), processes=())
    plan = ExecutionPlan(
        task_set, spec.seed, spec.utilisation, spec.workers, cast(Mode, spec.bodies))
    executor = make_executor(spec, task_set)
    job_of_thread = current_job if spec.executor == OURS else no_job
    workload = SyntheticWorkload(task_set, plan, current_job=job_of_thread)
    starts: list[Start] = []
    for node in workload.nodes:
        for subscription in node.subscriptions:
            subscription.callback = noting(starts, subscription.callback)
    run_nodes(executor, workload, spec.seconds, spin_of(executor))
    # rclpy's EventsExecutor advances a timer before it queues the call, so the due time of a call
    # in a backlog is unknown: only messages are counted there.
    if spec.executor != 'events':
        starts += [start for delays in workload.ledger.delays.values() for start in list(delays)]
    latencies = within(starts, *(reading.at_ns for reading in workload.ledger.window))
    result = measure(workload.ledger, plan)
    important = [
        result['dags'][dag.name]['sinks'][dag.vertices[i].name] for dag in task_set.dags
        for i in dag.sinks if dag.vertices[i].callback.importance == 'high']
    return {
        **{f'important_{name}': sum(sink[name] for sink in important)
           for name in ('due', 'on_time')},
        **result, 'infeasible_sinks': len(plan.infeasible()),
        'dispatch_latency_us': quantiles_us(latencies),
        'hot_path_us': hot_path(task_set, result)}


def hot_path(task_set: TaskSet, result: dict[str, Any]) -> dict[str, Any] | None:
    """
    Return the latency of the path ``hot_path``, from its source's release to its sink's end.

    :param result: of ``measure``.
    :return: p50, p99 and max of completed due jobs, and the numbers of due and missing jobs; None
        if the declaration has no such path within one DAG.
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


def run_messages(spec: Spec) -> dict[str, Any]:
    """
    Run subscriptions under an executor while another process publishes.

    :return: callbacks, CPU time and dispatch latency within the window; ``published``,
        ``received`` and ``lost`` of the whole run.
    """
    executor = make_executor(spec, None)
    # Topics of this process only, if others use this domain.
    prefix = f'/mddag_bench_{os.getpid()}'
    topics = [f'{prefix}/topic_{i}' for i in range(spec.topics)]
    node = quiet_node('/mddag_bench')
    starts: list[Start] = []
    active = [_subscribe(node, topic, starts) for topic in topics]
    for i in range(spec.idle):
        _subscribe(node, f'{prefix}/idle_{i}', starts)
    executor.add_node(node)
    session = UnfinishedSession(executor, spin_of(executor))
    seed = None if spec.phases == 'together' else spec.seed
    with session, PublisherProcess(topics, spec.rate_hz, seed) as publisher:
        publisher.wait_until_ready()
        session.wait_until_matched(lambda: [
            each.topic_name for each in active if not each.get_publisher_count()])
        publisher.begin()
        session.wait(WARM_UP_S)
        begin, cpu_begin, dds_begin = _clocks()
        session.wait(spec.seconds)
        end, cpu_end, dds_end = _clocks()
        published = sum(publisher.finish())
        _drain(session, starts, published)
        received = len(starts)
    session.check(True)
    latencies = within(starts, begin, end)
    callbacks = len(latencies)
    return {
        'window_ns': end - begin, 'callbacks': callbacks,
        'callbacks_per_s': callbacks / ((end - begin) / 1e9),
        'cpu_us_per_callback': (cpu_end - cpu_begin) / 1000 / callbacks if callbacks else None,
        'middleware_cpu_us_per_callback':
            None if dds_begin is None or dds_end is None or not callbacks
            else (dds_end - dds_begin) / 1000 / callbacks,
        'dispatch_latency_us': quantiles_us(latencies), 'published': published,
        'received': received, 'lost': published - received}


def _clocks() -> tuple[int, int, int | None]:
    """Return the time, and the CPU time of the process and of its middleware's threads, ns."""
    return time.time_ns(), time.process_time_ns(), _middleware_cpu_ns()


def _middleware_cpu_ns() -> int | None:
    """
    Return the CPU time of the middleware's own threads, ns.

    They receive and store messages independently of the executor.  None if the kernel does not
    report it (no Linux), or no thread has such a name (another middleware).
    """
    times = []
    for task in Path('/proc/self/task').glob('*'):
        try:
            if (task / 'comm').read_text().startswith(MIDDLEWARE):
                times.append(int((task / 'schedstat').read_text().split()[0]))
        except (OSError, ValueError, IndexError):
            continue  # the thread has ended, or is unknown
    return sum(times) if times else None


def _subscribe(node: Node, topic: str, starts: list[Start]) -> Subscription:
    return node.create_subscription(Header, topic, noting(starts), QOS)


def _drain(session: UnfinishedSession, starts: list[Start], published: int) -> None:
    """Wait until all messages were received, or none arrived for some time."""
    last, quiet_since = -1, time.monotonic()
    end = time.monotonic() + DRAIN_S
    while len(starts) < published and time.monotonic() < end:
        count = len(starts)
        if count != last:
            last, quiet_since = count, time.monotonic()
        elif time.monotonic() - quiet_since > QUIET_S:
            return
        if session.wait(0.02):
            return


def run_robot(spec: Spec) -> dict[str, Any]:
    """
    Run the robot's nodes under an executor.

    :return: by sink the numbers due, in time, late and missing, and response times; the sums.
    """
    assert spec.graph is not None
    task_set = load(spec.graph)
    executor = make_executor(spec, task_set)
    nodes = _make_nodes(spec.scale)
    for node in nodes:
        executor.add_node(node)
    session = UnfinishedSession(executor, spin_of(executor))
    with session:
        ended = session.wait(WARM_UP_S + 1.0)  # time for discovery
        begin, cpu = time.time_ns(), time.process_time_ns()
        ended = ended or session.wait(spec.seconds)
        end, cpu = time.time_ns(), time.process_time_ns() - cpu
    session.check(not ended)
    logs = {f'{node.get_fully_qualified_name()}:{callback}': log
            for node in nodes for callback, log in getattr(node, 'log', {}).items()}
    sinks = judge(task_set, logs, begin, end)
    return {
        **totals(sinks.values()), 'cpu_cores': cpu / (end - begin), 'window_ns': end - begin,
        'sinks': sinks}


def _make_nodes(scale: float) -> list[Any]:
    path = find(PROGRAM)
    spec = spec_from_file_location('mddag_robot', path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    nodes: list[Any] = module.make_nodes(scale)
    return nodes


def judge(
    task_set: TaskSet, logs: dict[str, Log], begin: int, end: int
) -> dict[str, dict[str, Any]]:
    """
    Judge the results that were due in a window, by the nodes' logs.

    :param logs: for each sink (stamp, when it was done), ns.
    """
    sinks = {}
    for dag in task_set.dags:
        for index in dag.sinks:
            vertex = dag.vertices[index]
            deadline, log = vertex.deadline_ns or 0, logs.get(vertex.name, [])
            done: dict[int, int] = {}
            for stamp, at in log:
                done.setdefault(stamp, at)
            first = min(done, default=begin)
            first += -((first - begin) // dag.period_ns) * dag.period_ns
            sinks[vertex.name] = judge_sink(
                deadline, range(first, end - deadline + 1, dag.period_ns), done)
    return sinks

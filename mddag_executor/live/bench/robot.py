# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Measure an executor with ordinary nodes: those of ``examples/robot``.

The nodes stamp what their sensors sample, on exact grids, and whoever ends a chain keeps a log of
stamps.  *Due* are the points of a sink's grid whose deadline lies inside the measured window.  One
is *on time* when it was done by its deadline; when nothing was done for it, it is *missing*.
"""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
import time
from typing import Any

from mddag_executor.live.bench.executors import make_executor, UnfinishedSession
from mddag_executor.live.bench.spec import BenchError, Spec
from mddag_executor.live.measure import judge_sink
from mddag_executor.resources import find
from msg_graph import load, TaskSet

PROGRAM = 'examples/robot/robot.py'

Log = list[tuple[int, int]]


def run_robot(spec: Spec) -> dict[str, Any]:
    """
    Run the robot's nodes under an executor.

    :return: for each sink what was due, on time, late and missing, and response times; the sums.
    :raises BenchError: when the run was over before anything was measured.
    """
    assert spec.graph is not None
    task_set = load(spec.graph)
    executor = make_executor(spec, task_set)
    nodes = _make_nodes(spec.scale)
    for node in nodes:
        executor.add_node(node)
    session = UnfinishedSession(executor, spec)
    with session:
        ended = session.wait(spec.warm_up_s + 1.0)  # discovery takes a moment
        begin, cpu = time.time_ns(), time.process_time_ns()
        ended = ended or session.wait(spec.seconds)
        end, cpu = time.time_ns(), time.process_time_ns() - cpu
    if session.error is not None:
        raise session.error
    if ended:
        raise BenchError('the run was ended before anything was measured: run it again')
    logs = {f'{node.get_fully_qualified_name()}:{callback}': log
            for node in nodes for callback, log in getattr(node, 'log', {}).items()}
    sinks = judge(task_set, logs, begin, end)
    return {
        **{name: sum(sink[key] for sink in sinks.values()) for name, key in (
            ('sink_jobs_due', 'due'), ('on_time', 'on_time'), ('late', 'late'),
            ('missing', 'missing'))},
        'cpu_cores': cpu / (end - begin), 'window_ns': end - begin, 'sinks': sinks}


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
    Judge what was due in a window, by the nodes' logs.

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

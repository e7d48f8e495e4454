# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Deadlines in proportion to critical paths.

A sink's critical path is the longest path from the source to it, by a budget (mean, 99 % quantile
or maximum) of the execution times.  Deadlines are rounded up to whole us.
"""

from __future__ import annotations

from mddag_executor.analysis.model import tasks_of
from msg_graph import TaskSet
from msg_graph.duration import whole_us


def proportional(
    task_set: TaskSet, budget: str, factor: float = 1.0, base: str = 'period'
) -> dict[str, int]:
    """
    Return a deadline (ns) for each sink by its callback's key.

    The sink of a DAG with the longest critical path gets the base times the factor, the others
    less in proportion to theirs.  A callback that is several sinks gets the shortest of theirs.

    :param base: ``period``, or ``deadline``: the longest that the DAG has so far.
    :raises mddag_executor.analysis.model.AnalysisError: an execution time is not declared.
    """
    deadlines: dict[str, int] = {}
    for task in tasks_of(task_set, budget):
        longest = max(length for _, _, length in task.sinks)
        whole = task.period if base == 'period' else task.deadline
        for index, _, length in task.sinks:
            share = length / longest if longest else 1.0
            key = task.dag.vertices[index].callback.key
            deadline = whole_us(whole * factor * share)
            deadlines[key] = min(deadline, deadlines.get(key, deadline))
    return deadlines


def scaled(task_set: TaskSet, budget: str, scale: float) -> dict[str, int]:
    """
    Return a deadline (ns) for each sink by its callback's key: its critical path times a scale.

    A callback that is several sinks gets the longest of theirs.

    :raises mddag_executor.analysis.model.AnalysisError: an execution time is not declared.
    """
    deadlines: dict[str, int] = {}
    for task in tasks_of(task_set, budget):
        for index, _, length in task.sinks:
            key = task.dag.vertices[index].callback.key
            deadlines[key] = max(whole_us(length * scale), deadlines.get(key, 0))
    return deadlines

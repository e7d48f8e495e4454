# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Deadlines for sinks, in proportion to their critical paths."""

from __future__ import annotations

from mddag_executor.laboratory.tasks import tasks_of
from msg_graph import TaskSet
from msg_graph.duration import whole_us


def proportional(task_set: TaskSet, budget: str) -> dict[str, int]:
    """
    Return a deadline (ns) for each sink by its callback's key, rounded up to whole us.

    A sink's critical path is the longest path from the source to it.  The sink of a DAG with the
    longest one gets the period, the others less in proportion to theirs.  A callback that is
    several sinks gets the shortest of their deadlines.

    :param budget: which value of each execution time counts: ``max``, ``p99`` or ``mean``.
    :raises mddag_executor.laboratory.tasks.AnalysisError: an execution time is not declared.
    """
    deadlines: dict[str, int] = {}
    for task in tasks_of(task_set, budget):
        longest = max(length for _, _, length in task.sinks)
        for index, _, length in task.sinks:
            key = task.dag.vertices[index].callback.key
            deadline = whole_us(task.period * (length / longest if longest else 1.0))
            deadlines[key] = min(deadline, deadlines.get(key, deadline))
    return deadlines

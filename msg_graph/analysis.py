# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Figures of a DAG that reports show: topological order, longest path, load."""

from __future__ import annotations

from collections.abc import Sequence

from msg_graph.model import Dag


def topological_order(dag: Dag) -> list[int]:
    """Return the vertices (indices in the DAG) so that each comes after its predecessors."""
    waiting = [len(vertex.predecessors) for vertex in dag.vertices]
    order = [dag.source]
    for index in order:
        for after in dag.vertices[index].successors:
            waiting[after] -= 1
            if waiting[after] == 0:
                order.append(after)
    return order


def path_lengths(dag: Dag, weights: Sequence[int]) -> list[int]:
    """
    Return for each vertex the length of the longest path from the source through it.

    :param weights: weight of each vertex, by its index in the DAG; the vertex's own counts.
    """
    lengths = [0] * len(dag.vertices)
    for index in topological_order(dag):
        before = dag.vertices[index].predecessors
        lengths[index] = weights[index] + max((lengths[p] for p in before), default=0)
    return lengths


def mean_execution_times(dag: Dag) -> list[int] | None:
    """Return each vertex's mean execution time in ns, or None where one is not declared."""
    means = []
    for vertex in dag.vertices:
        if vertex.callback.execution_time is None:
            return None
        means.append(vertex.callback.execution_time.mean_ns)
    return means


def load_of(dag: Dag) -> float | None:
    """
    Return the load of the DAG in cores, with mean execution times: sum(C) / T.

    None where an execution time is not declared.
    """
    means = mean_execution_times(dag)
    return None if means is None else sum(means) / dag.period_ns

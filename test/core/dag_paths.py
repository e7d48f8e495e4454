# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What follows from the graph of a DAG, by going through all its paths: for the slow simulator."""


def reachable_sinks(dag, index):
    """Return the sinks that a vertex leads to, itself included."""
    vertex = dag.vertices[index]
    if not vertex.successors:
        return {index}
    return set().union(*(reachable_sinks(dag, after) for after in vertex.successors))


def paths(dag, index):
    """Yield every path from a vertex to a sink."""
    vertex = dag.vertices[index]
    for after in vertex.successors:
        for path in paths(dag, after):
            yield [vertex, *path]
    if not vertex.successors:
        yield [vertex]


def ways_to(dag, index):
    """Yield every path from the source to a vertex."""
    before = dag.vertices[index].predecessors
    for one in before:
        for way in ways_to(dag, one):
            yield [*way, index]
    if not before:
        yield [index]


def laxity(dag, index, sink):
    """Return the deadline of a sink less the mean times of the longest path to it, in ns."""
    return (dag.vertices[sink].deadline_ns or 0) - max(
        sum(v.callback.execution_time.mean_ns for v in path
            if v.callback.execution_time is not None)
        for path in paths(dag, index) if path[-1].index == sink)

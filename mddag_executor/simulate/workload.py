# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The workload of a run in virtual time: releases, and the properties of their executions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple, TypeVar

from mddag_executor.core.state import State
from mddag_executor.core.tables import processes_of, Tables
from mddag_executor.errors import UsageError
from msg_graph import TaskSet

MOST_JOBS = 20_000_000
"""With more jobs a load does not fit into the memory of usual machines."""

# The fate of an execution: it runs, fails at its end, or does not run and its job expires.
RUNS, FAILS, SKIPPED = range(3)


class Workload(NamedTuple):
    """
    Releases in order of (time, DAG), with the indices and execution times of their jobs.

    Times are in ns.  The execution time of vertex v in job k of DAG d is ``costs[cost_base[d] + k
    * cost_stride[d] + local index of v]``: a stride of zero gives every job the same times, the
    number of vertices of the DAG a row for each job.  The other columns are indexed like
    ``costs``, and may be empty:

    * ``releases``: by release, if a source becomes ready later (``times``) than it is released;
    * ``holds``: the interpreter that an execution holds (from 1; 0: none);
    * ``computed``: its CPU time; -1: it only waits, as far as is known.  Empty: it computes all
      the time;
    * ``fates``: its fate (``RUNS``, …; ``SKIPPED`` only at a source).

    ``delays[delay_base[d] + k * delay_stride[d] + e]`` is how long after a vertex's completion its
    edge e in job k of DAG d is satisfied (see ``deliveries``); the edges of a DAG are numbered as
    in ``Tables.successors``, from its first vertex on.

    ``inherited`` is, by job of the undeclared DAG, the priority that it inherits, and
    ``inherits_from`` the vertex (see ``core.inheritance``; NEVER: none).  Both may be empty.
    """

    times: list[int]
    dags: list[int]
    jobs: list[int]
    costs: list[int]
    cost_base: list[int]
    cost_stride: list[int]
    releases: list[int] = []
    holds: list[int] = []
    computed: list[int] = []
    fates: list[int] = []
    delays: list[int] = []
    delay_base: list[int] = []
    delay_stride: list[int] = []
    inherited: list[int] = []
    inherits_from: list[int] = []


Arrays = TypeVar('Arrays', Workload, Tables)


def as_lists(load: Workload) -> Workload:
    """Return a load whose columns are lists, not arrays."""
    return Workload(*map(as_list, load))


def as_list(column: Any) -> list[int]:
    """Return a column as a list of Python's integers."""
    values: list[int] = column if isinstance(column, list) else column.tolist()
    return values


def as_arrays(columns: Arrays) -> Arrays:
    """Return a load or tables whose columns are arrays, which are faster to change and to pass."""
    import numpy as np
    arrays: list[Any] = [
        column if isinstance(column, int) else np.array(column, dtype=np.int64)
        for column in columns]
    return type(columns)(*arrays)


def needs_python(load: Workload) -> bool:
    """Return whether executions that do not hold the interpreter need the GIL at their end."""
    return len(load.computed) > 0 and len(load.holds) > 0


def place_of(s: State, load: Workload, x: int) -> int:
    """Return the index of an execution in ``load.costs``."""
    slot = s.x_slot[x]
    dag = s.job_dag[slot]
    return (load.cost_base[dag] + s.job_index[slot] * load.cost_stride[dag]
            + x - s.job_base[slot])


def edge_numbers(tables: Tables) -> dict[tuple[int, int], int]:
    """Return the number of each edge in its DAG, by the global vertices that it joins."""
    first = tables.first_successor
    return {
        (vertex, tables.successors[i]): i - first[tables.first_vertex[tables.dag_of[vertex]]]
        for vertex in range(tables.n_vertices) for i in range(first[vertex], first[vertex + 1])}


def periodic_workload(
    task_set: TaskSet, times: Sequence[Sequence[int]], duration_ns: int
) -> Workload:
    """
    Return the workload of releases at k*T from 0, with the same execution times in each job.

    :raises mddag_executor.errors.UsageError: if it has more than ``MOST_JOBS`` jobs.
    """
    if sum(dag.jobs_in(duration_ns) for dag in task_set.dags) > MOST_JOBS:
        raise UsageError(
            f'{task_set.file}: it has more than {MOST_JOBS} jobs in {duration_ns / 1e9:g} s: '
            'give a shorter --duration')
    releases = sorted(
        (job * dag.period_ns, dag.index, job)
        for dag in task_set.dags
        for job in range(dag.jobs_in(duration_ns)))
    holds = [number * int(vertex.callback.holds_interpreter or False)
             for number, vertex in zip(processes_of(task_set), task_set.vertices)]
    return Workload(
        [each[0] for each in releases], [each[1] for each in releases],
        [each[2] for each in releases], costs=[time for row in times for time in row],
        cost_base=list(accumulate(map(len, times), initial=0))[:-1],
        cost_stride=[0] * len(times), holds=holds if any(holds) else [])

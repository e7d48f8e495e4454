# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Execution times for many runs: each vertex gets one value for the whole of a run.

Theory of operation
-------------------
As in the paper, the execution time of a vertex is one uniform pick from its callback's values for
each run, the same for the whole run and for every policy.  A callback that two DAGs trigger is two
vertices with separate draws.  The values are the quantile table of the declaration (ns), or
measured ones, which the paper's program rounds up to whole microseconds, at least one.

The uniform numbers of run r of seed s come from a counter-based generator (Philox) with the key
(s, r).  So a run has the same numbers in every process and range of runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any
import zipfile
import zlib

from mddag_executor.core import rad_offsets
from mddag_executor.errors import InputError
from mddag_executor.simulate.execution_times import check_execution_times
from msg_graph import Dag, ExecutionTime, TaskSet
from msg_graph.duration import DAY
from msg_graph.model import topological_order
import numpy as np
import numpy.typing as npt

Times = npt.NDArray[np.int64]
"""Execution times, ns: a row for each run, a column for each vertex, DAG by DAG."""

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Samples = Mapping[str, Times]

_REMEDY = "write one array of measured ns for each 'node:callback' with numpy.savez"
_DAMAGED = (TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)


def read_samples(task_set: TaskSet, path: Path, name: str) -> dict[str, Times]:
    """
    Read measured execution times: an .npz file with one array (ns) for each ``node:callback``.

    :param name: what to call the file in messages.
    :return: for each callback in a DAG its values in ns, rounded up to whole us, at least 1 us.
    """
    try:
        archive = np.load(path, allow_pickle=False)
    except _DAMAGED:
        archive = None
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise InputError(name, 'this is not a .npz file', _REMEDY)
    with archive:
        return {key: _read_values(archive, key, name)
                for key in {vertex.callback.key: None for vertex in task_set.vertices}}


def _read_values(archive: Any, key: str, name: str) -> Times:
    if key not in archive.files:
        raise InputError(name, f'no values for {key}', 'add an array of that name')
    try:
        values: Floats = archive[key].astype(np.float64)
    except (*_DAMAGED, OSError):
        values = np.empty(0)
    # false for NaN
    if values.ndim != 1 or not values.size or not np.all((values >= 0) & (values < DAY)):
        raise InputError(
            name, f'the values of {key} are damaged, or not a list of ns below one day', _REMEDY)
    rounded: Times = np.maximum(np.ceil(values / 1000).astype(np.int64), 1) * 1000
    return rounded


class Draws:
    """
    The execution times of numbered runs.

    :param seed: 0 to 2**64 - 1.
    :param samples: measured values of each callback, ns; None draws from the quantile tables.
    """

    def __init__(self, task_set: TaskSet, seed: int, samples: Samples | None = None) -> None:
        self._seed = seed
        if samples is None:
            check_execution_times(task_set, ', or give --execution-times FILE.npz')
        self._pickers: list[Callable[[Floats], Times]] = [
            partial(_from_table, vertex.callback.execution_time)  # type: ignore[arg-type]
            if samples is None else partial(_from_measured, samples[vertex.callback.key])
            for vertex in task_set.vertices]

    def times(self, first: int, count: int) -> Times:
        """Return the execution times of ``count`` runs from number ``first`` on."""
        uniform = np.empty((count, len(self._pickers)))
        key = np.array([self._seed, 0], dtype=np.uint64)
        for row in range(count):
            key[1] = first + row
            np.random.Generator(np.random.Philox(key=key)).random(out=uniform[row])
        times = np.empty(uniform.shape, dtype=np.int64)
        for column, pick in enumerate(self._pickers):
            times[:, column] = pick(uniform[:, column])
        return times


def _from_measured(values: Times, uniform: Floats) -> Times:
    return values[(uniform * len(values)).astype(np.int64)]


def _from_table(table: ExecutionTime, uniform: Floats) -> Times:
    return np.array([max(1, table.draw(share)) for share in uniform.tolist()], dtype=np.int64)


def _by_dag(task_set: TaskSet, times: Times) -> Iterator[tuple[Dag, Times]]:
    first = 0
    for dag in task_set.dags:
        yield dag, times[:, first:first + len(dag.vertices)]
        first += len(dag.vertices)


def utilisations(task_set: TaskSet, times: Times, workers: int) -> Floats:
    """Return each run's normalised utilisation: sum of execution time over period, by workers."""
    total = np.zeros(len(times))
    for dag, of_dag in _by_dag(task_set, times):
        total += 0.0 if dag.once else of_dag.sum(axis=1) / dag.period_ns
    return total / workers


def feasible(
    task_set: TaskSet, times: Times, workers: int, duration_ns: int, judge: str = 'horizon',
    overhead_ns: int = 0,
) -> npt.NDArray[np.bool_]:
    """
    Return for each run whether it could be accepted, as far as that is easily known.

    A run is not accepted by any scheduler that never lets a worker idle without need,

    * judged by the ``horizon``: if the longest path to a sink is longer than its deadline, or if
      more has to be executed by deadlines within the duration than the workers can by then;
    * judged by ``completions``: if the longest path to a sink is longer than its deadline, and the
      first job of the sink surely completes within the duration.
      Jobs that never complete are not judged, so that an overload alone proves nothing.

    :param overhead_ns: of each dispatch
    """
    horizon = judge == 'horizon'
    possible = np.ones(len(times), dtype=np.bool_)
    demand = np.zeros(len(times), dtype=np.float64)
    latest = np.zeros(len(times)) if horizon else _waiting(
        task_set, times, workers, duration_ns, overhead_ns)
    for dag, of_dag in _by_dag(task_set, times):
        offsets = rad_offsets(dag)
        lengths = np.empty((len(dag.vertices), len(times)), dtype=np.int64)
        # a vertex that has been preempted is dispatched again
        overheads = 2 * overhead_ns * len(dag.vertices)
        for index in topological_order(dag):
            vertex = dag.vertices[index]
            lengths[index] = of_dag[:, index]
            if vertex.predecessors:
                lengths[index] += lengths[list(vertex.predecessors)].max(axis=0)
            if vertex.deadline_ns is not None and vertex.deadline_ns <= duration_ns:
                late = lengths[index] > vertex.deadline_ns
                if not horizon:
                    late &= lengths[index] + overheads + latest < duration_ns
                possible &= ~late
            jobs = max(0, dag.jobs_in(duration_ns - offsets[index] + 1))
            demand += float(jobs) * of_dag[:, index]
    return possible & (demand <= float(workers) * duration_ns) if horizon else possible


def _waiting(
    task_set: TaskSet, times: Times, workers: int, duration_ns: int, overhead_ns: int
) -> Floats:
    """
    Return how long a job can wait at most while no vertex of its longest path runs, ns.

    All workers are busy then (Graham), with work that is released within the duration. With
    callback groups, processes or the interpreter's lock at least one is.
    """
    shared = bool(task_set.processes) or any(
        callback.group is not None or callback.holds_interpreter
        for callback in task_set.callbacks)
    work = np.zeros(len(times))
    for dag, of_dag in _by_dag(task_set, times):
        work += dag.jobs_in(duration_ns) * (of_dag + 2 * overhead_ns).sum(axis=1)
    waiting: Floats = work / (1 if shared else workers)
    return waiting

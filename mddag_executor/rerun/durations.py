# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How long callbacks and messages take in virtual time.

Theory of operation
-------------------
A job takes the times of the job of a load with the nearest release, at most half a period away. If
there is none, each vertex takes the median of its times.

*Recorded*: the load is that of a recording, whose k-th job is not always the k-th of the rerun.
The time from a vertex's end to the arrival of its message is also the recorded one. Messages leave
at the end, even if the recorded callback published earlier.

*Fixed* (declared, drawn, or from a file of execution times): each vertex takes the same time in
every job. Its messages leave at its end and arrive at once.
"""

from __future__ import annotations

from bisect import bisect_left
from functools import cache

from mddag_executor.core import NEVER, quantile, Tables
from mddag_executor.recording.joins import sort_by
from mddag_executor.recording.recorded_jobs import Jobs
from mddag_executor.simulate.workload import edge_numbers, needs_python, Workload
import numpy as np


class Durations:
    """
    Times of jobs; all times are in ns, vertices are global.

    :param jobs: the jobs of the recording that the load is of; None: it is not recorded, and
        every job takes the same times.
    """

    def __init__(self, tables: Tables, load: Workload, jobs: Jobs | None = None) -> None:
        self._tables, self._load = tables, load
        releases = [np.zeros(1, dtype=np.int64) if jobs is None else jobs.release[jobs.of_dag(dag)]
                    for dag in range(tables.n_dags)]
        #: By DAG the rows of its jobs in the load, in the order of their releases.
        self._rows = [sort_by(each) for each in releases]
        #: By DAG the recorded releases, in order.
        self._releases: list[list[int]] = [
            [] if jobs is None else each[rows].tolist()
            for each, rows in zip(releases, self._rows)]
        self._edges = edge_numbers(tables)
        self._values = cache(self._values_of_jobs)

    def first_release(self, dag: int) -> int | None:
        """Return when the first job of a DAG was released in the recording; None: unknown."""
        return next(iter(self._releases[dag]), None)

    def execution(self, vertex: int, release: int) -> int:
        """Return how long a vertex of the job with that release executed."""
        return self._value('costs', vertex, release)

    def computed(self, vertex: int, release: int) -> int:
        """Return the CPU time that a vertex of the job with that release took."""
        return self._value('computed' if len(self._load.computed) else 'costs', vertex, release)

    def transport(self, before: int, after: int, release: int) -> int:
        """Return how long after the end of a vertex its message arrived."""
        edge = self._edges.get((before, after))
        if edge is None or not len(self._load.delays):
            return 0
        return max(0, self._value('delays', before, release, edge))

    def holds(self, vertex: int) -> bool:
        """Return whether a vertex held the interpreter in most jobs."""
        *held, _ = self._values('holds', vertex, None) if len(self._load.holds) else [0]
        return 2 * sum(held) > len(held)

    @property
    def python(self) -> bool:
        """Return whether it is known what needs the interpreter."""
        return needs_python(self._load)

    def _value(self, column: str, vertex: int, release: int, edge: int | None = None) -> int:
        dag = self._tables.dag_of[vertex]
        return self._values(column, vertex, edge)[self._row(dag, release)]

    def _values_of_jobs(self, column: str, vertex: int, edge: int | None) -> list[int]:
        """
        Return a value of each recorded job, in the order of releases, then their median.

        A job in which nothing was published has the median delay: the rerun may publish there.
        """
        load, dag = self._load, self._tables.dag_of[vertex]
        first = load.cost_base[dag] + vertex - self._tables.first_vertex[dag]
        stride = load.cost_stride[dag]
        if edge is not None:
            first, stride = load.delay_base[dag] + edge, load.delay_stride[dag]
        found = np.asarray(getattr(load, column))[first + self._rows[dag] * stride]
        known = np.sort(found[found < NEVER]).tolist()
        median = quantile(known, 0.5) if known else 0
        return [*np.where(found < NEVER, found, median).tolist(), median]

    def _row(self, dag: int, release: int) -> int:
        """Return the place of the recorded job that was released about then; -1: there is none."""
        releases = self._releases[dag]
        place = bisect_left(releases, release)
        near = [i for i in (place - 1, place) if 0 <= i < len(releases)]
        row = min(near, key=lambda i: abs(releases[i] - release), default=-1)
        is_near = row >= 0 and abs(releases[row] - release) * 2 <= self._tables.period[dag]
        return row if is_near else -1

# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How long callbacks and messages take in virtual time.

Theory of operation
-------------------
A job takes the times of the job of a load with the nearest release, at most half a period away. If
there is none, each vertex takes the median of its times.

*Recorded*: the load is that of a recording, whose k-th job is not always the k-th of the rerun.
The time from a vertex's end to the arrival of its message is the recorded one, too. Messages leave
at the end, also if the recorded callback published earlier.

*Fixed* (declared, drawn, or from a file of execution times): each vertex takes the same time in
every job. Its messages leave at its end and arrive at once.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

from mddag_executor.core import quantile, Tables
from mddag_executor.simulate.load import as_lists, edge_numbers, Load, needs_python


class Durations:
    """
    Times of jobs; all times are in ns, vertices are global.

    :ivar recorded: whether the load is recorded; if not, messages take no time.
    """

    def __init__(self, tables: Tables, load: Load, recorded: bool) -> None:
        self.recorded = recorded
        self._tables = tables
        self._load = load = as_lists(load)
        self._releases: list[list[tuple[int, int]]] = [[] for _ in range(tables.n_dags)]
        for dag, job, release in zip(load.dags, load.jobs, load.releases or load.times):
            if dag < tables.n_dags:
                self._releases[dag].append((release, job))
        for rows in self._releases:
            rows.sort()
        self._edges = edge_numbers(tables)
        self._usual: dict[tuple[int, int], int] = {}

    def first_release(self, dag: int) -> int | None:
        """Return when the first job of a DAG was released in the recording; None: unknown."""
        rows = self._releases[dag]
        return rows[0][0] if rows and self.recorded else None

    def execution(self, dag: int, vertex: int, release: int) -> int:
        """Return how long a vertex of the job with that release executed."""
        return self._cost(self._load.costs, dag, vertex, release, -1)

    def computed(self, dag: int, vertex: int, release: int) -> int:
        """Return the CPU time that a vertex of the job with that release took."""
        load = self._load
        return self._cost(load.computed or load.costs, dag, vertex, release, -2)

    def _cost(
        self, values: Sequence[int], dag: int, vertex: int, release: int, column: int
    ) -> int:
        load, local = self._load, vertex - self._tables.first_vertex[dag]
        return self._value(values, load.cost_base[dag] + local, load.cost_stride[dag], dag,
                           release, (vertex, column))

    def transport(self, dag: int, before: int, after: int, release: int) -> int:
        """Return how long after the end of a vertex its message arrived."""
        edge, load = self._edges.get((before, after)), self._load
        if edge is None or not self.recorded:
            return 0
        return max(0, self._value(load.delays, load.delay_base[dag] + edge,
                                  load.delay_stride[dag], dag, release, (before, after)))

    def holds(self, vertex: int) -> bool:
        """Return whether a vertex held the interpreter in most jobs."""
        load, dag = self._load, self._tables.dag_of[vertex]
        first = load.cost_base[dag] + vertex - self._tables.first_vertex[dag]
        held = [load.holds[first + job * load.cost_stride[dag]]
                for _, job in self._releases[dag]] if load.holds else []
        return 2 * sum(held) > len(held)

    @property
    def python(self) -> bool:
        """Return whether it is known what needs the interpreter."""
        return needs_python(self._load)

    def _value(
        self, values: Sequence[int], first: int, stride: int, dag: int, release: int,
        of: tuple[int, int],
    ) -> int:
        row = self._row(dag, release)
        if row >= 0:
            return int(values[first + row * stride])
        usual = self._usual.get(of)
        if usual is None:
            every = sorted(values[first + job * stride] for _, job in self._releases[dag])
            usual = self._usual[of] = int(quantile(every, 0.5)) if every else 0
        return usual

    def _row(self, dag: int, release: int) -> int:
        """Return the place of the recorded job that was released about then; -1: there is none."""
        rows = self._releases[dag]
        place = bisect_left(rows, (release,))
        near = [rows[i] for i in (place - 1, place) if 0 <= i < len(rows)]
        if not near:
            return -1
        at, job = min(near, key=lambda row: abs(row[0] - release))
        return job if abs(at - release) * 2 <= self._tables.period[dag] else -1

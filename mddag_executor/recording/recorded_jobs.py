# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The jobs of a recording."""

from __future__ import annotations

from typing import Any

from mddag_executor.recording.columns import in_parts, Ints, Mask, Places, Table
from mddag_executor.recording.joins import equal, sort_by
from mddag_executor.recording.tables import UNKNOWN
import numpy as np


class Jobs:
    """
    The jobs of a recording: by DAG, those of a DAG in the order of their releases.

    A *place* is the position of a job among all jobs, -1 for an unknown job.  It indexes the
    columns, and any array that has a value for each job (and one more for unknown jobs).

    :ivar rows: by place the row of ``releases``; ``number``, ``release``: columns of it.
    :ivar first: by DAG the place of its first job; at the end the number of all jobs.
    """

    def __init__(self, n_dags: int, releases: Table) -> None:
        rows = np.flatnonzero((releases['dag'] >= 0) & (releases['dag'] < n_dags))
        rows = rows[sort_by(releases['dag'][rows], releases['order'][rows])]
        self.rows: Ints = rows
        self.number, self.release, self.noticed, self.order = (
            releases[name][rows] for name in ('job', 'release', 'noticed', 'order'))
        self.first: Ints = np.searchsorted(releases['dag'][rows], np.arange(n_dags + 1))
        # if the jobs of a DAG are numbered one after the other, a place need not be searched for
        self._searched = [
            dag for dag in range(n_dags) if (np.diff(self.number[self.of_dag(dag)]) != 1).any()]
        self._least = np.append(self.number, 0)[self.first[:-1]]
        self._counts = np.diff(self.first)
        self._counts[self._searched] = 0

    def __len__(self) -> int:
        return len(self.rows)

    def of_dag(self, dag: int) -> slice:
        """Return the places of the jobs of a DAG."""
        return slice(int(self.first[dag]), int(self.first[dag + 1]))

    def places(self, table: Table) -> Places:
        """Return by row the place of its job."""
        return self.places_of(table['dag'], table['job'])

    def places_of(self, dag: Any, job: Any) -> Places:
        """Return the places of jobs, by their DAGs and numbers."""
        found = np.full(len(job), UNKNOWN, dtype=np.int32)
        if len(self):
            for part, dags, jobs in zip(*map(in_parts, (found, dag, job))):
                at = np.where((dags >= 0) & (dags < len(self._counts)), dags, 0)
                away = jobs - self._least[at]
                known = (away >= 0) & (away < self._counts[at]) & (at == dags)
                part[known] = (self.first[at] + away)[known]
        for each in self._searched:
            mine, jobs = np.flatnonzero(dag == each), self.of_dag(each)
            at = equal(self.number[jobs], job[mine])
            found[mine] = np.where(at >= 0, at + jobs.start, UNKNOWN)
        return found

    def rows_of(self, dag: int, job: Any) -> Ints:
        """Return the positions of jobs among those of their DAG, -1 for unknown jobs."""
        places = self.places_of(np.broadcast_to(dag, len(job)), job)
        return np.where(places >= 0, places - self.first[dag], UNKNOWN)

    def marked(self, which: Mask) -> Mask:
        """Return by place whether the job is one of the chosen releases; at the end False."""
        return np.append(which[self.rows], False)

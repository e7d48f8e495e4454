# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A tally with the longest burst of misses of each sink."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

from mddag_executor.core import Tables, Tally
from msg_graph import TaskSet
import numpy as np


def longest_run(numbers: Sequence[int]) -> int:
    """Return the length of the longest run of consecutive numbers, in any order, with repeats."""
    ordered = np.unique(np.array(numbers, dtype=np.int64))
    last = np.flatnonzero(np.diff(ordered) != 1)    # ends of all runs but the last one
    return int(np.diff([-1, *last, len(ordered) - 1]).max())


class MissTally(Tally):
    """A tally that records the missed jobs of each sink."""

    def __init__(self, task_set: TaskSet, tables: Tables, keep: int | None = None) -> None:
        super().__init__(task_set, tables, keep)
        #: By global vertex of each sink: the missed jobs.
        self.missed_jobs = {vertex: array('q') for vertex in self.sinks}

    def _add_miss(
        self, kind: int, dag: int, vertex: int, job: int, deadline: int, time: int
    ) -> None:
        super()._add_miss(kind, dag, vertex, job, deadline, time)
        self.missed_jobs[vertex].append(job)

    def add_bursts(self, dags: Mapping[str, Any]) -> None:
        """Add to each sink of a result its longest burst of misses, as `longest_burst`."""
        for v, jobs in self.missed_jobs.items():
            dag = self._dags[self._tables.dag_of[v]].name
            dags[dag]['sinks'][self.vertex_name(v)]['longest_burst'] = longest_run(jobs)

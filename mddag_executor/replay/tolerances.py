# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How many missed deadlines are tolerated, and whether a run keeps within that.

Theory of operation
-------------------
As in CARET's report (its callback validation), each sink is judged by two measures, and both have
to hold:

* *ratio*: of the sink's jobs that were due, the share that missed the deadline is at most R;
* *burst*: the longest run of consecutive jobs that missed it is at most B.

A job was due at a sink when it completed there, expired, was aborted, or was past its deadline at
the end of the run.  Jobs are consecutive by their number; a job that is not in the trace ends a
burst.  Where only one of the two is given, only that one is asked for; where neither is, no miss
is tolerated.  A sink of which no job was due is within every tolerance, unless none was due at any
sink: then nothing has shown that deadlines hold, and all sinks fail.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mddag_executor.core import Tables, Tally
from mddag_executor.core.tally import counts, total
from mddag_executor.text import counted
from msg_graph import TaskSet
import numpy as np

NOTHING_DUE = 'no job was due at any sink, so no deadline was judged'


def longest_run(numbers: Sequence[int]) -> int:
    """Return how many numbers follow each other at most, in whatever order and how often told."""
    ordered = np.unique(np.array(numbers, dtype=np.int64))
    last = np.flatnonzero(np.diff(ordered) != 1)    # of each run but the last one
    return int(np.diff([-1, *last, len(ordered) - 1]).max())


class MissTally(Tally):
    """A tally that keeps which jobs missed at each sink."""

    def __init__(self, task_set: TaskSet, tables: Tables, keep: int | None = None) -> None:
        super().__init__(task_set, tables, keep)
        #: By global vertex of each sink: the jobs that missed.
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


@dataclass(frozen=True)
class Tolerance:
    """What is tolerated of each sink; None: not asked for."""

    ratio: float | None = None
    burst: int | None = None

    def broken_by(self, sink: Mapping[str, Any]) -> str | None:
        """
        Return why a sink is not within the tolerance, None where it is.

        :param sink: its part of a result, with its `longest_burst`.
        """
        verdicts = counts(sink)
        due, missed = verdicts.due, verdicts.missed
        if not missed:
            return None
        failed = f' ({verdicts.failed} failed: a callback raised)' if verdicts.failed else ''
        if self.ratio is None and self.burst is None:
            return f'{missed} of {counted(due, "job")} missed the deadline{failed}'
        broken = []
        if self.ratio is not None and missed > self.ratio * due:
            broken.append(f'{missed} of {counted(due, "job")} missed the deadline{failed} '
                          f'({missed / due:.4%}), tolerated: {self.ratio:.4%}')
        if self.burst is not None and sink['longest_burst'] > self.burst:
            broken.append(f'{counted(sink["longest_burst"], "job")} in a row missed the deadline, '
                          f'tolerated: {self.burst}')
        return '; '.join(broken) or None

    def verdicts(self, dags: Mapping[str, Any]) -> dict[tuple[str, str], str]:
        """Return by DAG and sink why it is not within the tolerance; empty: all are."""
        found = {}
        nothing_due = not total(dags).due
        for dag_name, dag in dags.items():
            for name, sink in dag['sinks'].items():
                why = NOTHING_DUE if nothing_due else self.broken_by(sink)
                if why is not None:
                    found[dag_name, name] = why
        return found

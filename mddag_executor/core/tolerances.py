# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How many missed deadlines are tolerated, and whether a run meets that.

Theory of operation
-------------------
A sink with a declared `tolerate: m of k` is judged by that: of any k of its jobs in a row at most
m miss (`mddag_executor/core/weakly_hard.py`). For the others two limits apply to the run, as in
CARET's report (its callback validation), and both have to hold:

* *ratio*: of the sink's due jobs, the fraction that missed the deadline is at most R;
* *burst*: the longest run of consecutive jobs that missed it is at most B.

A job was due at a sink when it completed there, expired, was aborted, or was past its deadline at
the end of the run.  Jobs are consecutive by their number; a job that is not in the trace ends a
burst.  If only one of the two limits is given, only that one applies; if neither is, no miss is
tolerated.  A sink without a due job is within every tolerance, unless no sink has a due job: then
deadlines were never tested, and all sinks fail.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mddag_executor.core.tally import counts, is_kept, total
from mddag_executor.text import counted

NOTHING_DUE = 'no job was due at any sink, so no deadline was judged'


@dataclass(frozen=True)
class Tolerance:
    """The tolerance of each sink; None: no limit."""

    ratio: float | None = None
    burst: int | None = None

    def broken_by(self, sink: Mapping[str, Any]) -> str | None:
        """
        Return why a sink is not within the tolerance; None if it is.

        :param sink: its part of a result, with its `longest_burst`.
        """
        if is_kept(sink):
            return None
        verdicts = counts(sink)
        due, missed = verdicts.due, verdicts.missed
        failed = f' ({verdicts.failed} failed: a callback raised)' if verdicts.failed else ''
        declared = sink.get('tolerate')
        if declared is not None:
            misses, of, worst = declared['misses'], declared['of'], declared['worst']
            return (f'{worst} of {of} jobs in a row missed the deadline{failed}, '
                    f'tolerated: {misses} of {of}')
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


NO_MISS = Tolerance()
"""No miss is tolerated, except by sinks whose declaration tolerates some."""

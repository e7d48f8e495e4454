# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
How many missed deadlines are tolerated, and whether a run meets that.

A sink with a declared `tolerate: m of k` is judged by that: of any k of its jobs in a row at most
m miss (`mddag_executor/core/weakly_hard.py`).  Of the others no miss is tolerated.

A job was due at a sink when it completed there, expired, failed, was aborted or dropped, or was
past its deadline at the end of the run.  A sink without a due job is within every tolerance,
unless no sink has a due job: then deadlines were never tested, and all sinks fail.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mddag_executor.core.tally import counts, is_kept, total
from mddag_executor.text import counted

NOTHING_DUE = 'no job was due at any sink, so no deadline was judged'


def not_tolerated(dags: Mapping[str, Any]) -> dict[tuple[str, str], str]:
    """Return by DAG and sink why a result is not tolerated; empty: it is."""
    nothing_due = not total(dags).due
    return {
        (dag_name, name): NOTHING_DUE if nothing_due else _reason(sink)
        for dag_name, dag in dags.items() for name, sink in dag['sinks'].items()
        if nothing_due or not is_kept(sink)}


def _reason(sink: Mapping[str, Any]) -> str:
    verdicts, declared = counts(sink), sink.get('tolerate')
    failed = f' ({verdicts.failed} failed: a callback raised)' if verdicts.failed else ''
    if declared is None:
        return f'{verdicts.missed} of {counted(verdicts.due, "job")} missed the deadline{failed}'
    misses, of, worst = declared['misses'], declared['of'], declared['worst']
    return (f'{worst} of {of} jobs in a row missed the deadline{failed}, '
            f'tolerated: {misses} of {of}')

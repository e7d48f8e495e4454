# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The tables of a recording: the names and types of their columns.

Theory of operation
-------------------
1. Every recording has the same tables.  A source builds them once; an analysis is a function of
   them and does not depend on the source.
2. Times are int64 nanoseconds on the clock of the recording.  ``UNKNOWN`` (-1) is a time or number
   that is not recorded.
3. DAGs and vertices are those of ``Recording.task_set``.  Vertices are numbered over all DAGs; -1
   is an undeclared callback.  ``mapping.judged_by`` converts a recording to another task set.
4. A row of ``executions`` is one run of a callback on a thread.  A suspended coroutine has several
   rows: ``piece`` counts them, ``began`` is the start of the first, ``busy`` the total time up to
   this row.  So the row that completes a vertex has the values of the whole execution.
5. ``leg`` is the message of a sync callback that the execution processed; ``ALL_LEGS`` if it
   processed all.  ``completes`` says whether it completed a leg or the vertex.
6. An execution that had not ended when the recording did ends with it, and completes nothing.
   ``unfinished`` names these, by callback and start.
7. ``order`` is the position in the sequence in which the executor's core processed releases,
   completions and ends of jobs.  It decides between equal times.
8. ``due`` is when an undeclared timer's execution was due by its period; 0 if unknown.
9. ``inherited`` is the deadline that an undeclared execution has inherited, because a callback
   with this deadline has sent the request (``core.rules``, rule 15); 0: none.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from mddag_executor.recording.columns import rows, Table
import numpy as np

UNKNOWN = -1
"""A time or number that is not recorded."""
ALL_LEGS = -1
"""One execution for all legs of a sync callback."""

# What an execution completes.
NOTHING, LEG, VERTEX = range(3)

EXPIRED, ABORTED, FAILED, WITHDRAWN, OUTDATED = range(5)
REASONS = ('expired', 'aborted', 'failed', 'withdrawn', 'dropped')
"""Why a job ended: names of the values of ``job_ends['reason']``."""


def _table(**columns: str) -> np.dtype[Any]:
    return np.dtype(list(columns.items()))


RELEASES = _table(
    process='i2', dag='i4', job='i8', release='i8', noticed='i8', order='i8')
EXECUTIONS = _table(
    process='i2', callback='i8', dag='i2', vertex='i4', job='i8', leg='i2', piece='i4',
    thread='i4', worker='i2', ready='i8', began='i8', start='i8', end='i8', busy='i8', cpu='i8',
    holds_gil='?', completes='i1', guessed='?', message='i4', order='i4', due='i8',
    inherited='i8')
PUBLICATIONS = _table(
    process='i2', publisher='i8', execution='i8', vertex='i4', time='i8', source_timestamp='i8',
    header_stamp='i8')
TAKES = _table(execution='i8', message='i8', time='i8')
JOB_ENDS = _table(
    process='i2', dag='i4', vertex='i4', job='i8', time='i8', reason='i1', order='i8')
DROPS = _table(
    process='i2', callback='i8', vertex='i4', job='i8', time='i8', reason='i2')
LOSSES = _table(process='i2', callback='i8', time='i8', count='i8')
DEMOTIONS = _table(process='i2', dag='i4', vertex='i4', job='i8', time='i8')
MISSES = _table(dag='i4', vertex='i4', job='i8', deadline='i8', completed='i8')
STOPS = _table(process='i2', start='i8', end='i8')
SPIN_GAPS = _table(process='i2', program='i4', start='i8', end='i8')
UNFINISHED = _table(process='i2', callback='i8', start='i8', where='i2')

TABLES = {
    'releases': RELEASES, 'executions': EXECUTIONS, 'publications': PUBLICATIONS,
    'job_ends': JOB_ENDS, 'stops': STOPS, 'spin_gaps': SPIN_GAPS, 'takes': TAKES, 'drops': DROPS,
    'losses': LOSSES, 'demotions': DEMOTIONS, 'misses': MISSES, 'unfinished': UNFINISHED}
"""The tables of a recording with the types of their columns."""


def _empty(name: str) -> Any:
    return field(default_factory=lambda: rows(TABLES[name]))


@dataclass(frozen=True)
class Columns:
    """The tables of a recording.  Their columns cannot be written."""

    releases: Table = _empty('releases')
    executions: Table = _empty('executions')
    publications: Table = _empty('publications')
    job_ends: Table = _empty('job_ends')
    stops: Table = _empty('stops')
    spin_gaps: Table = _empty('spin_gaps')
    takes: Table = _empty('takes')
    drops: Table = _empty('drops')
    losses: Table = _empty('losses')
    demotions: Table = _empty('demotions')
    misses: Table = _empty('misses')
    unfinished: Table = _empty('unfinished')

    def __post_init__(self) -> None:
        for each in fields(self):
            getattr(self, each.name).freeze()

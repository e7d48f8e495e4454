# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The columns of exported recordings: one row per execution, or per job and sink.

Executions: a row is one run of a callback on a worker; a suspended coroutine has several,
``first`` marks the first. Undeclared callbacks have neither DAG nor job.

Jobs: a row is the verdict about one job at one sink: ``in_time``, ``late``, ``overdue`` (not
completed when the run ended past its deadline), ``expired``, ``failed`` or ``aborted``; the last
four have no completion.

Columns that end in ``_ns`` are integer nanoseconds: times on the recording's clock, or durations.
``start_s`` and ``release_s`` are seconds since the run's first release (or an earlier execution).
``reference_deadline_ns`` is the vertex's (RAD), ``slack_ns`` its remainder at the end. ``worker``
-1 is a spare thread in addition to the pool.

Rows are in the order of their releases; without release, of their ready times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mddag_executor.analysis.as_recorded import Replay
from mddag_executor.analysis.usage import ran
from mddag_executor.core.tally import VERDICTS
from mddag_executor.recording.columns import Ints, Mask
from mddag_executor.recording.joins import sort_by
from mddag_executor.recording.recording import Recording
import numpy as np


class Column(NamedTuple):
    """
    A column to export.

    :ivar values: numbers, or with ``names`` indices of names.
    :ivar known: which rows have a value; None: all.
    """

    name: str
    values: Any
    known: Mask | None = None
    names: Sequence[str] = ()


def executions(replay: Replay, rows: Ints | None = None) -> tuple[list[Column], Ints]:
    """Return the columns of executions (all, or these rows), and their rows of the table."""
    recording, judged = replay.recording, replay.judged
    rows = ran(recording.executions) if rows is None else rows
    release, known = _releases(replay, rows)
    ready = recording.executions['ready'][rows]
    order = sort_by(np.where(known, release, ready))
    rows, release, known = rows[order], release[order], known[order]
    table = recording.executions[rows]
    declared = table['vertex'] >= 0
    names = [vertex.name for vertex in recording.task_set.vertices]
    others, which = np.unique(table['callback'][~declared], return_inverse=True)
    vertex = table['vertex'].astype(np.int64)
    labels, place = recording.labels(others)
    vertex[~declared] = len(names) + place[which]
    names += labels
    start, end = table['start'], table['end']
    reference = release + np.array([*judged.tables.rad_offset[:-1], 0])[table['vertex']]
    first = table['piece'] == 0
    return [
        Column('dag', table['dag'], declared, [dag.name for dag in recording.task_set.dags]),
        Column('job', table['job'], declared), Column('vertex', vertex, None, names),
        Column('worker', table['worker']), Column('first', first),
        Column('start_s', _seconds(recording, start)), Column('release_ns', release, known),
        Column('ready_ns', table['ready']), Column('start_ns', start), Column('end_ns', end),
        Column('waiting_ns', start - table['ready'], first),
        Column('executing_ns', end - start), Column('reference_deadline_ns', reference, known),
        Column('slack_ns', reference - end, known)], rows


def _releases(replay: Replay, rows: Ints) -> tuple[Ints, Mask]:
    """Return the releases of the jobs of executions (rows), and which are known."""
    recording = replay.recording
    places = recording.job_places[rows]
    known = (places >= 0) & (recording.executions['vertex'][rows] >= 0)
    return np.where(known, np.append(recording.jobs.release, 0)[places], 0), known


def jobs(replay: Replay) -> list[Column]:
    """Return the columns of the verdicts about jobs at sinks."""
    recording, verdicts = replay.recording, replay.judged.verdicts
    verdicts = verdicts[sort_by(verdicts['release'], verdicts['sink'])]
    completed = verdicts['completed']
    done = completed >= 0
    return [
        Column('dag', verdicts['dag'], None, [dag.name for dag in recording.task_set.dags]),
        Column('job', verdicts['job']),
        Column('sink', verdicts['sink'], None, [v.name for v in recording.task_set.vertices]),
        Column('release_s', _seconds(recording, verdicts['release'])),
        Column('release_ns', verdicts['release']), Column('deadline_ns', verdicts['deadline']),
        Column('completed_ns', completed, done),
        Column('response_ns', completed - verdicts['release'], done),
        Column('slack_ns', verdicts['deadline'] - completed, done),
        Column('verdict', verdicts['kind'], None, [VERDICTS[kind] for kind in sorted(VERDICTS)])]


def _seconds(recording: Recording, times: Ints) -> Any:
    return (times - (recording.start or 0)) / 1e9
